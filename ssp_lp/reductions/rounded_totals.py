"""Limits on totals with too many values: amounts are rounded up for a policy, down for a bound.

A policy that satisfies ``within(fuel, 10) >= 0.95`` with every amount rounded up also satisfies it
with the exact amounts. A policy that satisfies it with the exact amounts also satisfies it with
every amount rounded down, so the optimum with amounts rounded down is a bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.model.tracked_product import rounded_in
from ssp_lp.options import Status
from ssp_lp.problem import Problem, as_stated
from ssp_lp.processes.quantities import RunEvent
from ssp_lp.solution import Solution


def rounded_down(problem: Problem) -> Problem | None:
    """Return the problem with amounts rounded down instead of up; None if it rounds none."""
    rounded = rounded_in(problem.tracked.model)
    if not rounded:
        return None
    limits = {
        name: replace(limit, quantity=replace(limit.quantity, terms=tuple(
            (weight, counted.rounded_down() if isinstance(counted, RunEvent) else counted)
            for weight, counted in limit.quantity.terms
        )))
        for name, limit in problem.constraints.items()
    }  # fmt: skip
    return cast("Problem", replace(cast("Any", problem), constraints=limits, **as_stated(problem)))


def solve_rounded(
    problem: Problem, down: Problem, solve: Callable[..., Solution], tolerance: float
) -> Solution:
    """Solve a problem with amounts rounded up, and bound its optimum with amounts rounded down.

    Args:
        problem: the problem with amounts rounded up.
        down: the problem with amounts rounded down.
        solve: function that solves either problem.
        tolerance: relative gap above which the solution does not count as optimal.

    Raises:
        InfeasibleError: no policy satisfies the limits, even with amounts rounded down.
        SolverError: the limits are feasible with amounts rounded down, but not rounded up.
    """
    looser = solve(down)
    unit = max(rounded_in(problem.tracked.model).values())
    try:
        found = solve(problem)
    except InfeasibleError as error:
        raise SolverError(
            "the limits' feasibility is undecided: no policy satisfies them with totals rounded up "
            f"to multiples of {unit:.3g}, but one does with totals rounded down; round the amounts "
            "to fewer values, or relax the limits"
        ) from error
    upper = found.upper_bound
    if upper is not None and looser.upper_bound is not None:
        upper = max(upper, looser.upper_bound)
    found = replace(
        found, upper_bound=upper, lower_bound=min(found.lower_bound, looser.lower_bound)
    )
    told = (f"totals are rounded to multiples of {unit:.3g}, up for the policy, down for the bound:"
            f" the gap is {found.gap:.1e}")  # fmt: skip
    is_wide = found.gap > tolerance and found.status is Status.OPTIMAL
    status = Status.TOLERANCE_MISSED if is_wide else found.status
    return replace(found, status=status, note="; ".join(filter(None, (found.note, told))))
