"""Every criterion with limits of every kind, beside a linear program written from the definitions.

Models, limits and criteria are those of `tests/campaigns/program_check.py`, which also reads
programs back. Costs are whole numbers, or reals without a common unit: the reference tells every
(state, total) apart in exact fractions. Where totals count without a horizon, steps that cost
something lead on, so that totals are finitely many.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from references import combined
from ssp_lp import InfeasibleError, certify, evaluate, solve
from tests.campaigns.program_check import (
    CRITERIA,
    LAWS,
    OWN,
    PALETTES,
    Draw,
    drawn_case,
    posed,
    with_costs,
)
from tests.support.compiled import Switch

OF_TOTALS = ("CVaR", "CostQuantile", "Lateness", "CostBoundedReach", "GUBS", "EGUBS")
OTHERS = [name for name in CRITERIA | OWN if name not in OF_TOTALS]
COSTS = {"whole": None} | dict(
    zip(("decimal", "irrational", "mixed", "rational"), PALETTES, strict=True)
)


def drawn(name: str, seed: int, costs: str = "whole") -> Draw:
    """A draw of one criterion; every third one counts what happens after failing."""
    task, setting = drawn_case(seed, (name,), after_failing=seed % 3 == 2)
    palette = COSTS[costs]
    return posed(task if palette is None else with_costs(task, palette), setting)


def check(draw: Draw, *, by_program: bool = False) -> None:
    """Optimum or conflict, certificate; limits are kept, at a price only where they are tight."""
    problem, expected = draw.problem, draw.known
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
        at_least = error.failure_budget is None or draw.task.most_failure == 0.0  # is not a row
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
        check(drawn(name, seed), by_program=seed % 3 == 0)


@pytest.mark.parametrize("costs", COSTS)
@pytest.mark.parametrize("name", OF_TOTALS)
def test_totals_with_and_without_a_common_unit(name: str, costs: str, accelerate: Switch) -> None:
    for seed in range(3):
        accelerate(seed % 2 == 0)
        check(drawn(name, seed, costs), by_program=costs == "whole" and name not in LAWS)


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_TOTALS)
def test_few_levels_bound_the_optimum_from_both_sides(name: str) -> None:
    for seed in range(7, 9):
        draw = drawn(name, seed, "irrational")
        if (known := draw.known) is None:
            continue
        solution = solve(replace(draw.problem, cost_levels=3))
        low, high = solution.lower_bound, solution.objective
        if solution.upper_bound is not None:
            low, high = solution.objective, solution.upper_bound
        room = 1e-9 * max(abs(known), 1.0)
        assert low - room <= known <= high + room, seed
        assert certify(solution).accepted, seed
