"""Every criterion with limits of every kind, beside a linear program written from the definitions.

Steps that cost something lead on to a later group of states, so that no total exceeds the horizon
and the reference is exact; free steps move about within a group, perhaps for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from formulations import (
    EGUBS,
    GUBS,
    S3P,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
)
from references import combined
from references.combined import Program, Task
from small_models import model_of
from ssp_lp import (
    InfeasibleError,
    certify,
    end_probability,
    evaluate,
    failure_probability,
    secondary_cost,
    solve,
    visits,
)

GROUPS = (("s0", "s1"), ("s2",), ("s3", "s4"))
LIVE = tuple(state for group in GROUPS for state in group)
HORIZON = 3 * len(GROUPS) + 1
ENDS = ("home", "wall", "ditch")
SHAPE = {"rel": 1e-7, "abs": 1e-7}


def outcomes_of(rng: np.random.Generator, group: int) -> list[tuple[float, str, int]]:
    """One action: a free one leads anywhere from its group on, one that costs leads on."""
    free = rng.random() < 0.3
    after = [s for states in GROUPS[group + (not free) :] for s in states]
    count = int(rng.integers(1, 4))
    successors = rng.choice([*after, *ENDS, "home"], size=count)
    weights = rng.integers(1, 6, size=count).astype(float)
    return [
        (float(w), str(s), 0 if free else int(rng.integers(1, 4)))
        for w, s in zip(weights / weights.sum(), successors, strict=True)
    ]


def drawn_task(rng: np.random.Generator) -> Task:
    """A model with a start and limits, often several."""
    choices: dict[str, dict[str, list[tuple[float, str, int]]]] = {
        state: {f"a{k}": outcomes_of(rng, number) for k in range(int(rng.integers(1, 4)))}
        for number, group in enumerate(GROUPS)
        for state in group
    }
    choices["s0"]["go"] = [(0.8, "home", 2), (0.2, "wall", 1)]
    choices |= {end: {} for end in ENDS}
    fuel = {s: {a: float(rng.integers(0, 4)) for a in choices[s]} for s in LIVE}
    bare = Task(choices, frozenset({"home"}), {"s0": 1.0}, fuel)
    start = {"s0": 1.0}
    if rng.random() < 0.3 and "s1" not in combined.dead_ends(bare):
        start = {"s0": 0.5, "s1": 0.5}
    limits: dict[str, object] = {"start": start}
    if rng.random() < 0.6:
        limits["most_fuel"] = float(rng.choice([0.5, 1, 2, 3]))
    if rng.random() < 0.5:
        limits["watched"] = str(rng.choice(["s0", "s1"]))
        limits["most_visits"] = float(rng.choice([0.5, 1.0, 1.2, 1.5]))
    asked = rng.random()
    if asked < 0.3:
        limits["least_end"] = "wall", float(rng.choice([0.05, 0.1, 0.2]))
    elif asked < 0.6:
        limits["most_end"] = "wall", float(rng.choice([0.02, 0.1, 0.15]))
    if rng.random() < 0.5:
        limits["most_failure"] = float(rng.choice([0.1, 0.2, 0.3, 0.5]))
    return bare._replace(**limits)


def constraints_of(task: Task) -> dict:
    found = {}
    if task.most_fuel < np.inf:
        found["fuel"] = secondary_cost(task.fuel) <= task.most_fuel
    if task.most_visits < np.inf:
        found["seen"] = visits(task.watched) <= task.most_visits
    if task.least_end[0]:
        found["wall"] = end_probability("wall") >= task.least_end[1]
    if task.most_end[0]:
        found["wall"] = end_probability("wall") <= task.most_end[1]
    return found


def patience(cost):
    """A utility that is used up at 10."""
    return np.maximum(1.0 - cost / 10.0, 0.0)


class Numbers(NamedTuple):
    """What a criterion may ask."""

    level: float
    bound: int
    penalty: float


def least_ratio(task: Task, program: Program, charge: Callable[[int], float]) -> float | None:
    charged = combined.charged(program, charge)
    return combined.least(task, program, charged, ratio=True)


def greatest(task: Task, program: Program, worth: Callable[[int], float]) -> float | None:
    charged = combined.charged(program, lambda total: -worth(total))
    found = combined.least(task, program, charged, ratio=False)
    return None if found is None else -found


def least_tail_mean(task: Task, program: Program, level: float) -> float | None:
    found = [
        least_ratio(task, program, lambda c, z=z: z + max(c - z, 0) / (1.0 - level))
        for z in range(HORIZON)
    ]
    return None if None in found else min(found)


def least_quantile(task: Task, program: Program, level: float) -> float | None:
    for bound in range(HORIZON + 1):
        late = least_ratio(task, program, lambda c, bound=bound: float(c > bound))
        if late is None:
            return None
        if late <= 1.0 - level + 1e-9:
            return float(bound)
    return None


@dataclass(frozen=True)
class Criterion:
    """The library's problem and the reference's answer."""

    posed: Callable[..., object]
    answer: Callable[[Task, Program, Numbers], float | None]
    counts_cost: bool = True  # whether the reference tells accumulated costs apart
    anywhere: bool = False  # whether a policy may stop anywhere


def safe(task: Task) -> dict:
    """The failure budget as a constraint, for criteria that have none."""
    if task.most_failure >= 1.0:
        return {}
    return {"safe": failure_probability() <= task.most_failure}


CRITERIA = {
    "S3P": Criterion(
        lambda m, t, n, c: S3P(m, t.start, failure_budget=t.most_failure, constraints=c),
        lambda t, p, n: least_ratio(t, p, float),
    ),
    "CVaR": Criterion(
        lambda m, t, n, c: CVaR(m, t.start, n.level, t.most_failure, constraints=c),
        lambda t, p, n: least_tail_mean(t, p, n.level),
    ),
    "CostQuantile": Criterion(
        lambda m, t, n, c: CostQuantile(m, t.start, n.level, t.most_failure, constraints=c),
        lambda t, p, n: least_quantile(t, p, n.level),
    ),
    "CostBoundedReach": Criterion(
        lambda m, t, n, c: CostBoundedReach(m, t.start, n.bound, t.most_failure, constraints=c),
        lambda t, p, n: greatest(t, p, lambda total: float(total <= n.bound)),
    ),
    "GUBS": Criterion(
        lambda m, t, n, c: GUBS(m, t.start, patience, 0.7, constraints=c | safe(t)),
        lambda t, p, n: greatest(t, p, lambda total: float(patience(total)) + 0.7),
    ),
    "EGUBS": Criterion(
        lambda m, t, n, c: EGUBS(m, t.start, -0.4, 0.7, constraints=c | safe(t)),
        lambda t, p, n: greatest(t, p, lambda total: float(np.exp(-0.4 * total)) + 0.7),
    ),
    "MaxProb": Criterion(
        lambda m, t, n, c: MaxProb(m, t.start, constraints=c | safe(t)),
        lambda t, p, n: greatest(t, p, lambda total: 1.0),
        counts_cost=False,
    ),
    "CostBudgetedMaxProb": Criterion(
        lambda m, t, n, c: CostBudgetedMaxProb(m, t.start, n.bound / 2, constraints=c | safe(t)),
        lambda t, p, n: greatest(t._replace(most_cost=n.bound / 2), p, lambda total: 1.0),
        counts_cost=False,
    ),
    "FinitePenalty": Criterion(
        lambda m, t, n, c: FinitePenalty(m, t.start, n.penalty, constraints=c | safe(t)),
        lambda t, p, n: combined.least(t, p, p.cost + n.penalty * p.failure, ratio=False),
        counts_cost=False,
        anywhere=True,
    ),
    "LeastQuantity": Criterion(
        lambda m, t, n, c: LeastQuantity(
            m,
            t.start,
            secondary_cost(t.fuel) - n.penalty * end_probability("wall"),
            t.most_failure,
            constraints=c,
        ),
        lambda t, p, n: combined.least(t, p, p.fuel - n.penalty * p.wall, ratio=False),
        counts_cost=False,
    ),
}


def drawn(name: str, seed: int) -> tuple[object, float | None]:
    """A problem, and its optimum by the reference; None: there is none."""
    rng, criterion = np.random.default_rng(seed), CRITERIA[name]
    task = drawn_task(rng)
    numbers = Numbers(
        float(rng.choice([0.3, 0.5, 0.8])), int(rng.integers(1, 8)), float(rng.integers(1, 9))
    )
    horizon = HORIZON if criterion.counts_cost else 0
    program = combined.program(task, horizon, anywhere=criterion.anywhere)
    model = model_of(task.choices, "home", {"wall": ["wall"]})
    problem = criterion.posed(model, task, numbers, constraints_of(task))
    return problem, criterion.answer(task, program, numbers)


@pytest.mark.parametrize("block", range(5))
@pytest.mark.parametrize("name", CRITERIA)
def test_a_hundred_models_each(name: str, block: int) -> None:
    """Optimum, infeasibility and certificate; every limit kept by the policy itself."""
    feasible = 0
    for seed in range(20 * block, 20 * block + 20):
        problem, expected = drawn(name, seed)
        if expected is None:
            with pytest.raises(InfeasibleError):
                solve(problem)
            continue
        feasible += 1
        solution = solve(problem)
        assert solution.objective == pytest.approx(expected, **SHAPE), seed
        certificate = certify(solution)
        assert certificate.accepted, (seed, certificate.reason)
        assert certificate.gap < 1e-8, seed
        assert solution.evaluation.objective == pytest.approx(solution.objective, rel=1e-9), seed
    assert feasible > 5


LINEAR = [name for name in CRITERIA if name not in ("CVaR", "CostQuantile")]


@pytest.mark.parametrize("name", LINEAR)
def test_the_full_program_agrees(name: str) -> None:
    """By a solver, read back as a measure, as a lottery and as a randomised policy."""
    for seed in range(200, 215):
        problem, expected = drawn(name, seed)
        if expected is None:
            continue
        assert solve(problem, "lp").objective == pytest.approx(expected, **SHAPE), seed
        measure = problem.program().solve()
        assert measure.objective == pytest.approx(expected, **SHAPE), seed
        assert measure.optimal_value_from_dual == pytest.approx(expected, **SHAPE), seed
        for policy in (measure.mixed_policy(), measure.randomised_policy()):
            found = evaluate(policy, problem)
            assert found.objective == pytest.approx(measure.objective, rel=1e-8, abs=1e-9), seed
            for condition in problem.conditions:
                for row in condition.rows:
                    spent = row.activity(found.secondary_costs[condition.name])
                    assert spent <= row.bound + 1e-8, (seed, row.name)
