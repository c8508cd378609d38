"""Every criterion with limits of every kind, beside a linear program written from the definitions.

Models, limits and most criteria are those of `tests/campaigns/program_check.py`, which also reads
programs back. Costs are whole numbers, or reals without a common unit: the reference tells every
(state, total) apart in exact fractions, a float being its shortest decimal. Where totals count
without a horizon, steps that cost something lead on, so that totals are finitely many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import pytest

from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR, LeastQuantity
from own_criteria import Lateness
from references import combined
from references.combined import Limit, Program, Task
from small_models import model_of
from ssp_lp import InfeasibleError, certify, evaluate, secondary_cost, solve
from tests.campaigns.program_check import (
    CRITERIA,
    Asked,
    Criterion,
    constraints_of,
    drawn_task,
    parts,
    worth,
)
from tests.support.compiled import Switch

ROOT = 2.0**0.5
COSTS = {
    "whole": (1, 2, 3),
    "rational": (Fraction(1, 3), Fraction(1, 7), 0.1, 2.5),
    "irrational": (ROOT, 3.0**0.5, float(np.pi), 1.0),
    "mixed": (1e-6, 1e6, ROOT * 5e-6, 3.3),
}
FAR = 10**12  # beyond all totals


def utility(scale: float) -> Callable[[Any], Any]:
    return lambda cost: 1.0 / (1.0 + 3.0 * np.asarray(cost, dtype=float) / scale)


class Scaled(NamedTuple):
    """What a criterion of the total cost may ask: bounds are totals, or between two."""

    level: float
    bound: float
    scale: float


EVERY = CRITERIA | {
    "LeastFuel": Criterion(
        lambda m, t, n, **k: LeastQuantity(
            m, t.start, secondary_cost(t.fuel), t.most_failure, n.discount, n.give_up, n.charged,
            **k,
        ),
        parts(fuel=1.0), ("fuel",), charges=True, discounts=True,
    ),
    "CVaR": Criterion(
        lambda m, t, n, **k: CVaR(m, t.start, n.level, t.most_failure, **k),
        lambda t, p, n: worth(lambda c, z: float(z + max(c - z, 0) / Fraction(1.0 - n.level))),
        None, ratio=True,
    ),
    "CostQuantile": Criterion(
        lambda m, t, n, **k: CostQuantile(m, t.start, n.level, t.most_failure, **k),
        lambda t, p, n: worth(lambda c, z: float(c > z)), None, ratio=True,
    ),
    "Lateness": Criterion(
        lambda m, t, n, **k: Lateness(m, t.start, n.bound, t.most_failure, **k),
        worth(lambda c, n: max(float(c) - n.bound, 0.0)), None, ratio=True,
    ),
    "CostBoundedReach": Criterion(
        lambda m, t, n, **k: CostBoundedReach(m, t.start, n.bound, t.most_failure, **k),
        worth(lambda c, n: -float(float(c) <= n.bound * (1.0 + 1e-13))), None, maximised=True,
    ),
    "GUBS": CRITERIA["GUBS"]._replace(
        pose=lambda m, t, n, **k: GUBS(m, t.start, utility(n.scale), 0.7, **k),
        objective=worth(lambda c, n: -float(utility(n.scale)(float(c))) - 0.7),
    ),
    "EGUBS": CRITERIA["EGUBS"]._replace(
        pose=lambda m, t, n, **k: EGUBS(m, t.start, -2.0 / n.scale, 0.7, **k),
        objective=worth(lambda c, n: -float(np.exp(-2.0 * float(c) / n.scale)) - 0.7),
    ),
}  # fmt: skip
OF_TOTALS = ("CVaR", "CostQuantile", "Lateness", "CostBoundedReach", "GUBS", "EGUBS")
OTHERS = [name for name in EVERY if name not in OF_TOTALS]


def exact(cost: float | Fraction) -> Fraction:
    return cost if isinstance(cost, Fraction) else Fraction(repr(float(cost)))


def recosted(task: Task, cost: Callable[[int], Any]) -> Task:
    """The task with another cost in place of each."""
    return task._replace(
        choices={
            state: {a: [(p, to, cost(paid)) for p, to, paid in outs] for a, outs in actions.items()}
            for state, actions in task.choices.items()
        }
    )


def going_on(task: Task) -> Task:
    """The task with a dead-end in which steps go on, and cost."""
    ditch = {"roll": [(1.0, "ditch", 2)], "sink": [(0.5, "bog", 1), (0.5, "wall", 3)]}
    bog = {"rest": [(1.0, "bog", 0)]}
    return task._replace(
        choices={**task.choices, "ditch": ditch, "bog": bog},
        fuel={**task.fuel, "ditch": {"roll": 1.0, "sink": 2.0}},
    )


class Draw(NamedTuple):
    """A problem of the library, and what the reference makes of it."""

    problem: Any
    task: Task
    written: Program
    optimum: float | None  # None: there is none
    ratio: bool  # whether it is given success


def drawn(name: str, costs: str, seed: int) -> Draw:
    rng, criterion = np.random.default_rng([seed, len(name), len(costs)]), EVERY[name]
    horizon = int(rng.integers(2, 4)) if rng.random() < 0.25 and costs == "whole" else None
    task = drawn_task(rng, loops=criterion.minimised is not None or horizon is not None)
    task = going_on(task) if rng.random() < 0.3 else task
    palette = COSTS[costs] if costs == "whole" else rng.permutation(np.array(COSTS[costs], object))
    task = recosted(task, lambda paid: palette[paid - 1] if paid else 0)
    model = model_of(task.choices, "home", {"wall": ["wall"]})
    asked = Asked(
        float(rng.choice([0.3, 0.5, 0.8])),
        int(rng.integers(1, 8)),
        float(rng.integers(1, 9)),
        criterion.gives_up or str(rng.choice(["anywhere", "attention", "dead_ends"])),
        criterion.charges and bool(rng.random() < 0.5),
        0.9 if criterion.discounts and rng.random() < 0.2 else None,
    )
    if asked.discount is not None:
        task = task._replace(most_failure=max(0.5, task.most_failure or 0.0))
    told = recosted(task, exact) if costs != "whole" else task
    told = told if horizon is None else combined.within_steps(told, horizon)
    written = combined.program(
        told,
        FAR if criterion.minimised is None else 0,
        give_up="attention" if name in OF_TOTALS else asked.give_up,
        charged=asked.charged,
        minimised=criterion.minimised or (),
        discount=asked.discount or 1.0,
    )
    totals = sorted({total for here in written.arrivals for _, total in here}) or [0]
    if name in OF_TOTALS:
        bound = float(totals[rng.integers(len(totals))]) * float(rng.choice([1.0, 1.1]))
        asked = Scaled(asked.level, bound, float(totals[-1]) or 1.0)
    beside = {"constraints": constraints_of(task), "horizon": horizon}
    problem = criterion.pose(model, task, asked, **beside)
    own = {
        "CostBudgetedMaxProb": (Limit({"cost": 1.0}, "<=", asked.bound / 2),),
        "ConstrainedCost": (Limit({"fuel": 1.0}, "<=", asked[2]),),
    }
    told = told._replace(
        limits=task.limits + own.get(name, ()), most_failure=criterion.budget(told, asked)
    )

    def least(objective: np.ndarray) -> float | None:
        return combined.least(told, written, objective, ratio=criterion.ratio)

    objective = criterion.objective(told, written, asked)
    if name == "CVaR":
        means = [least(objective(told, written, z)) for z in totals]
        optimum = None if None in means else min(means)
    elif name == "CostQuantile":
        most = 1.0 - asked.level + 1e-9
        late = [least(objective(told, written, z)) for z in totals]
        soon = [float(z) for z, p in zip(totals, late, strict=True) if p is not None and p <= most]
        optimum = min(soon, default=None)
    else:
        optimum = least(objective)
    if criterion.maximised and optimum is not None:
        optimum = -optimum
    return Draw(problem, told, written, optimum, criterion.ratio)


def check(draw: Draw, *, by_program: bool = False) -> None:
    """Optimum or conflict, certificate; limits are kept, at a price only where they are tight."""
    problem, expected = draw.problem, draw.optimum
    if expected is None:
        with pytest.raises(InfeasibleError) as caught:
            solve(problem)
        if caught.value.conflicting_rows:
            check_conflict(draw, caught.value)
        return
    solution = solve(problem)
    assert solution.objective == pytest.approx(expected, rel=1e-7, abs=1e-7)
    if by_program:
        assert solve(problem, "lp").objective == pytest.approx(expected, rel=1e-7, abs=1e-7)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap < 1e-8
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-15)
    if draw.task.most_failure is not None:
        failure = found.discounted_failure or found.failure_probability
        assert failure <= draw.task.most_failure + 1e-9
    tight = 1
    for condition in problem.conditions:
        for row in condition.rows:
            slack = row.bound - row.activity(found.secondary_costs[condition.name])
            assert slack >= -1e-8, row.name
            price = (solution.prices or {}).get(row.name, 0.0)
            assert price >= 0.0, row.name
            assert price * slack <= 1e-6 * (1.0 + abs(expected)), row.name
            tight += slack <= 1e-7
    assert len(solution.policy.policies) <= tight + 1  # a basic solution; the failure is a row too


def check_conflict(draw: Draw, error: InfeasibleError) -> None:
    """No policy keeps to the rows that are named, and each is needed for that."""
    named = error.conflicting_rows
    if not set(named) <= {f"limit {k}" for k in range(len(draw.task.limits))} | {"failure"}:
        return  # an equality has a row for each side

    def possible(rows: set[str]) -> bool:
        limits = tuple(x for k, x in enumerate(draw.task.limits) if f"limit {k}" in rows)
        at_least = error.failure_budget is None or draw.task.most_failure == 0.0  # is no row
        kept = at_least or "failure" in rows
        within = draw.task.most_failure if kept else 1.0
        task = draw.task._replace(limits=limits, most_failure=within)
        return (
            combined.least(task, draw.written, draw.written.parts["cost"], ratio=False) is not None
        )

    assert not possible(set(named))
    for name in named:
        assert possible(set(named) - {name}), name


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_many_models_each(name: str, accelerate: Switch) -> None:
    """By compiled loops, and every other one by numpy."""
    for seed in range(10):
        accelerate(seed % 2 == 0)
        check(drawn(name, "whole", seed), by_program=seed % 3 == 0)


@pytest.mark.parametrize("costs", COSTS)
@pytest.mark.parametrize("name", OF_TOTALS)
def test_totals_with_and_without_a_common_unit(name: str, costs: str, accelerate: Switch) -> None:
    for seed in range(3):
        accelerate(seed % 2 == 0)
        linear = costs == "whole" and name not in ("CVaR", "CostQuantile")
        check(drawn(name, costs, seed), by_program=linear)


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_TOTALS)
def test_few_levels_bound_the_optimum_from_both_sides(name: str) -> None:
    for seed in range(7, 9):
        draw = drawn(name, "irrational", seed)
        if draw.optimum is None:
            continue
        solution = solve(replace(draw.problem, cost_levels=3))
        low, high = solution.lower_bound, solution.objective
        if solution.upper_bound is not None:
            low, high = solution.objective, solution.upper_bound
        room = 1e-9 * max(abs(draw.optimum), 1.0)
        assert low - room <= draw.optimum <= high + room, seed
        assert certify(solution).accepted, seed
