"""Every criterion with limits of every kind, beside a linear program written from the definitions.

Where totals are told apart without a horizon, steps that cost something lead on to a later group of
states, so that no total exceeds what the reference tells apart; free steps move about within a
group, perhaps for ever. Elsewhere steps lead anywhere: loops are free in the cost, in the fuel, in
both or in neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from formulations import (
    EGUBS,
    GUBS,
    MCMP,
    S3P,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from references import combined
from references.combined import Limit, Program, Task
from small_models import model_of
from ssp_lp import (
    Constraint,
    InfeasibleError,
    Quantity,
    certify,
    end_probability,
    evaluate,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    solve,
    visits,
)

GROUPS = (("s0", "s1"), ("s2",), ("s3", "s4"))
LIVE = tuple(state for group in GROUPS for state in group)
HORIZON = 3 * len(GROUPS) + 1
ENDS = ("home", "wall", "ditch")
SHAPE = {"rel": 1e-7, "abs": 1e-7}
MEANINGS = ("anywhere", "attention", "dead_ends")


def outcomes_of(rng: np.random.Generator, group: int, *, loops: bool) -> list:
    """One action: a free one leads anywhere from its group on, one that costs leads on."""
    free = rng.random() < 0.3
    after = LIVE if loops else [s for states in GROUPS[group + (not free) :] for s in states]
    count = 1 if rng.random() < 0.2 else int(rng.integers(1, 4))
    successors = rng.choice([*after, *ENDS, "home"], size=count)
    weights = rng.integers(1, 6, size=count).astype(float)
    return [
        (float(w), str(s), 0 if free else int(rng.integers(1, 4)))
        for w, s in zip(weights / weights.sum(), successors, strict=True)
    ]


def drawn_limit(rng: np.random.Generator) -> Limit:
    """One limit of any kind, that may or may not be kept."""

    def one(*values: float) -> float:
        return float(rng.choice(values))

    seen, level = f"visits {rng.choice(['s0', 's1', 's3', 'wall'])}", one(0.05, 0.1, 0.2)
    kinds = (
        Limit({"fuel": 1.0}, "<=", one(0.5, 1, 1.2, 2, 3)),
        Limit({seen: 1.0}, "<=", one(0.2, 0.5, 1.0, 1.2, 1.5)),
        Limit({"end wall": 1.0}, ">=", level),
        Limit({"end wall": 1.0}, "<=", one(0.02, 0.1, 0.15)),
        Limit({"end wall": 1.0}, "==", level),
        Limit({"goal": 1.0}, ">=", one(0.3, 0.5, 0.8)),
        Limit({"goal": 1.0}, "<=", one(0.5, 0.8)),
        Limit({"failure": 1.0}, "<=", one(0.1, 0.4)),
        Limit({"cost": 1.0}, "<=", one(1, 2, 4)),
        Limit({"goal": 1.0, "end ditch": 1.0}, ">=", one(0.4, 0.7)),
        Limit({"fuel": 1.0, seen: 0.5, "end wall": -2.0}, "<=", one(0.2, 1.0, 2.0)),
        Limit({"goal": 0.5, "end wall": -1.0}, ">=", one(0.1, 0.3), one(-0.1, 0.1)),
        Limit({seen: 0.1}, "<=", one(-0.03, 0.04), -0.025),
        Limit({"end wall": 1.0}, "<=", one(-0.05, 0.0)),
        Limit({"goal": 1.0}, ">=", one(1.04, 1.0)),
    )
    likely = np.array([3.0] * 12 + [1.0] * 3)
    return kinds[rng.choice(len(kinds), p=likely / likely.sum())]


def drawn_task(rng: np.random.Generator, *, loops: bool) -> Task:
    """A model with a start and up to four limits."""
    choices: dict[str, dict[str, list[tuple[float, str, int]]]] = {
        state: {
            f"a{k}": outcomes_of(rng, number, loops=loops) for k in range(int(rng.integers(1, 4)))
        }
        for number, group in enumerate(GROUPS)
        for state in group
    }
    choices["s0"]["go"] = [(0.8, "home", 2), (0.2, "wall", 1)]
    choices |= {end: {} for end in ENDS}
    if rng.random() < 0.2:  # a dead-end in which steps go on
        choices["ditch"] = {
            "roll": [(1.0, "ditch", 2)],
            "sink": [(0.5, "bog", 1), (0.5, "wall", 3)],
        }
        choices["bog"] = {"rest": [(1.0, "bog", 0)]}
    fuel = {
        s: {a: float(max(rng.integers(-2, 4), 0)) for a in choices[s]} for s in (*LIVE, "ditch")
    }
    asked = rng.random()
    start = {"s0": 1.0} if asked < 0.6 else {"s0": 0.5, "s1": 0.5}
    if asked > 0.9:
        start = {"s1": 0.5, "home": 0.25, "ditch": 0.25}
    if asked > 0.98:
        start = {"home": 0.75, "wall": 0.25}
    task = Task(choices, frozenset({"home"}), start, fuel)
    limits = tuple(drawn_limit(rng) for _ in range(int(rng.integers(5))))
    budget = None if rng.random() < 0.15 else float(rng.choice([0.1, 0.2, 0.3, 0.5, 1.0, 1.0, 1.0]))
    return task._replace(limits=limits, most_failure=budget)


def quantity_of(task: Task, weights: dict[str, float], constant: float = 0.0) -> Quantity:
    """The quantity that a limit's parts make."""
    simple = {
        "fuel": secondary_cost(task.fuel),
        "cost": expected_cost(),
        "goal": goal_probability(),
        "failure": failure_probability(),
    }
    result = Quantity((), constant)
    for part, weight in weights.items():
        kind, _, state = part.partition(" ")
        if kind == "visits":
            counted = visits(state)
        elif kind == "end":
            counted = end_probability(state)
        else:
            counted = simple[part]
        result = result + weight * counted
    return result


def constraints_of(task: Task) -> dict[str, Constraint]:
    found = {}
    for number, limit in enumerate(task.limits):
        quantity = quantity_of(task, limit.weights, limit.constant)
        compared = {"<=": quantity.__le__, ">=": quantity.__ge__, "==": quantity.__eq__}
        found[f"limit {number}"] = compared[limit.sense](limit.bound)
    return found


def patience(cost):
    """A utility that is used up at 10."""
    return np.maximum(1.0 - cost / 10.0, 0.0)


class Asked(NamedTuple):
    """What a criterion may ask."""

    level: float
    bound: int
    penalty: float
    give_up: str
    charged: bool
    discount: float | None


def least_ratio(task: Task, program: Program, charge: Callable[[int], float]) -> float | None:
    charged = combined.charged(program, charge)
    return combined.least(task, program, charged, ratio=True)


def greatest(task: Task, program: Program, worth: Callable[[int], float]) -> float | None:
    charged = combined.charged(program, lambda total: -worth(total))
    found = combined.least(task, program, charged, ratio=False)
    return None if found is None else -found


def least_of(task: Task, program: Program, **weights: float) -> float | None:
    """The least weighted sum of parts; an underscore stands for a blank."""
    objective = sum(w * program.parts[name.replace("_", " ")] for name, w in weights.items())
    return combined.least(task, program, np.asarray(objective), ratio=False)


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
    answer: Callable[[Task, Program, Asked], float | None]
    minimised: tuple[str, ...] | None = None  # parts; None: the reference tells costs apart
    budgeted: bool = True  # whether it has a failure budget, or a limit stands in its place
    gives_up: str = ""  # where a policy may give up; empty: that may be asked
    charges: bool = False  # whether the failing step may be charged
    discounts: bool = False


CRITERIA = {
    "S3P": Criterion(
        lambda m, t, n, **k: S3P(m, t.start, t.most_failure, discount=n.discount, **k),
        lambda t, p, n: least_ratio(t, p, float),
        discounts=True,
        gives_up="attention",
    ),
    "CVaR": Criterion(
        lambda m, t, n, **k: CVaR(m, t.start, n.level, t.most_failure, **k),
        lambda t, p, n: least_tail_mean(t, p, n.level),
        gives_up="attention",
    ),
    "CostQuantile": Criterion(
        lambda m, t, n, **k: CostQuantile(m, t.start, n.level, t.most_failure, **k),
        lambda t, p, n: least_quantile(t, p, n.level),
        gives_up="attention",
    ),
    "CostBoundedReach": Criterion(
        lambda m, t, n, **k: CostBoundedReach(m, t.start, n.bound, t.most_failure, **k),
        lambda t, p, n: greatest(t, p, lambda total: float(total <= n.bound)),
        gives_up="attention",
    ),
    "GUBS": Criterion(
        lambda m, t, n, **k: GUBS(m, t.start, patience, 0.7, **k),
        lambda t, p, n: greatest(t, p, lambda total: float(patience(total)) + 0.7),
        budgeted=False,
        gives_up="attention",
    ),
    "EGUBS": Criterion(
        lambda m, t, n, **k: EGUBS(m, t.start, -0.4, 0.7, **k),
        lambda t, p, n: greatest(t, p, lambda total: float(np.exp(-0.4 * total)) + 0.7),
        budgeted=False,
        gives_up="attention",
    ),
    "MaxProb": Criterion(
        lambda m, t, n, **k: MaxProb(m, t.start, **k),
        lambda t, p, n: greatest(t, p, lambda total: 1.0),
        minimised=(),
        budgeted=False,
        gives_up="attention",
    ),
    "MinProb": Criterion(
        lambda m, t, n, **k: MinProb(m, t.start, **k),
        lambda t, p, n: least_of(t, p, goal=1.0),
        minimised=(),
        budgeted=False,
        gives_up="attention",
    ),
    "CostBudgetedMaxProb": Criterion(
        lambda m, t, n, **k: CostBudgetedMaxProb(m, t.start, n.bound / 2, n.give_up, **k),
        lambda t, p, n: greatest(
            t._replace(limits=(*t.limits, Limit({"cost": 1.0}, "<=", n.bound / 2))),
            p,
            lambda total: 1.0,
        ),
        minimised=("cost",),
        budgeted=False,
    ),
    "MinCost": Criterion(
        lambda m, t, n, **k: MinCost(m, t.start, **k),
        lambda t, p, n: least_of(t._replace(most_failure=0.0), p, cost=1.0),
        minimised=("cost",),
        budgeted=False,
        gives_up="dead_ends",
    ),
    "FinitePenalty": Criterion(
        lambda m, t, n, **k: FinitePenalty(
            m, t.start, n.penalty, n.discount, n.give_up, charge_failing_step=n.charged, **k
        ),
        lambda t, p, n: least_of(t, p, cost=1.0, failure=n.penalty),
        discounts=True,
        minimised=("cost",),
        budgeted=False,
        charges=True,
    ),
    "MCMP": Criterion(
        lambda m, t, n, **k: MCMP(
            m, t.start, t.most_failure, n.discount, n.give_up, n.charged, **k
        ),
        lambda t, p, n: least_of(t, p, cost=1.0),
        discounts=True,
        minimised=("cost",),
        charges=True,
    ),
    "LeastQuantity": Criterion(
        lambda m, t, n, **k: LeastQuantity(
            m,
            t.start,
            quantity_of(t, {"fuel": 1.0, "visits s1": 0.5, "end wall": -n.penalty / 4.0}),
            t.most_failure,
            n.discount,
            n.give_up,
            n.charged,
            **k,
        ),
        lambda t, p, n: least_of(t, p, fuel=1.0, visits_s1=0.5, end_wall=-n.penalty / 4.0),
        minimised=("fuel", "visits s1", "end wall"),
        charges=True,
    ),
    "LeastFuel": Criterion(
        lambda m, t, n, **k: LeastQuantity(
            m,
            t.start,
            secondary_cost(t.fuel),
            t.most_failure,
            n.discount,
            n.give_up,
            n.charged,
            **k,
        ),
        lambda t, p, n: least_of(t, p, fuel=1.0),
        discounts=True,
        minimised=("fuel",),
        charges=True,
    ),
}


def drawn(name: str, seed: int) -> tuple[Any, float | None]:
    """A problem, and its optimum by the reference; None: there is none."""
    rng, criterion = np.random.default_rng(seed), CRITERIA[name]
    horizon = int(rng.integers(2, 4)) if rng.random() < 0.25 else None
    task = drawn_task(rng, loops=criterion.minimised is not None or horizon is not None)
    if not criterion.budgeted:
        safe = task.most_failure or 1.0
        within = (Limit({"failure": 1.0}, "<=", safe),) if safe < 1.0 else ()
        task = task._replace(most_failure=1.0, limits=task.limits + within)
    asked = Asked(
        float(rng.choice([0.3, 0.5, 0.8])),
        int(rng.integers(1, 8)),
        float(rng.integers(1, 9)),
        criterion.gives_up or str(rng.choice(MEANINGS)),
        criterion.charges and bool(rng.random() < 0.5),
        0.9 if criterion.discounts and rng.random() < 0.2 else None,
    )
    if asked.discount is not None:
        task = task._replace(most_failure=max(0.5, task.most_failure or 0.0))
    told = task if horizon is None else combined.within_steps(task, horizon)
    written = combined.program(
        told,
        HORIZON if criterion.minimised is None else 0,
        give_up=asked.give_up,
        charged=asked.charged,
        minimised=criterion.minimised or (),
        discount=asked.discount or 1.0,
    )
    model = model_of(task.choices, "home", {"wall": ["wall"]})
    beside = {"constraints": constraints_of(task), "horizon": horizon}
    problem = criterion.posed(model, task, asked, **beside)
    return problem, criterion.answer(told, written, asked)


@pytest.mark.parametrize("block", range(2))
@pytest.mark.parametrize("name", CRITERIA)
def test_many_models_each(name: str, block: int) -> None:
    """Optimum, infeasibility and certificate; every limit kept by the policy itself."""
    for seed in range(20 * block, 20 * block + 20):
        check(name, seed)


def check(name: str, seed: int) -> None:
    """One draw."""
    problem, expected = drawn(name, seed)
    if expected is None:
        with pytest.raises(InfeasibleError):
            solve(problem)
        return
    solution = solve(problem)
    assert solution.objective == pytest.approx(expected, **SHAPE), seed
    assert name != "LeastFuel" or solution.lower_bound >= 0.0  # a sum of nonnegative terms
    certificate = certify(solution)
    assert certificate.accepted, (seed, certificate.reason)
    assert certificate.gap < 1e-8, seed
    assert solution.evaluation.objective == pytest.approx(solution.objective, rel=1e-9), seed


LINEAR = [name for name in CRITERIA if name not in ("CVaR", "CostQuantile")]


@pytest.mark.parametrize("name", LINEAR)
def test_the_full_program_agrees(name: str) -> None:
    """By a solver, read back as a measure, as a lottery and as a randomised policy."""
    for seed in range(200, 212):
        check_program(name, seed)


def check_program(name: str, seed: int) -> None:
    """The program of one draw."""
    problem, expected = drawn(name, seed)
    if expected is None:
        with pytest.raises(InfeasibleError):
            solve(problem, "lp")
        return
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
