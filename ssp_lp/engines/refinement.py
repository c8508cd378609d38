"""Search, and refine what was truncated until the certified gap meets the tolerance."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.engines.column_generation import HullSearch, search
from ssp_lp.engines.instance import Instance, LeastFailure
from ssp_lp.engines.lp import check_agreement, solve_program
from ssp_lp.engines.row import Row, relative_gap

_PATIENCE = 3


@dataclass(frozen=True)
class Effort:
    """How to search and for how long."""

    engine: str  # "columns" or "lp"
    backend: str | None
    tolerance: float
    deadline: float  # on the clock of time.perf_counter
    progress: Callable[[int, float, float], None] | None


@dataclass(frozen=True, eq=False)
class Outcome:
    """The last search, the instance that it ran on, and the work done in all."""

    found: HullSearch
    instance: Instance
    calls: int = 0
    program: str = ""  # report of the last linear program


def optimise(instance: Instance, least: LeastFailure, row: Row, effort: Effort) -> Outcome:
    """Search on finer and finer instances until the gap is met, or refining does not help.

    Args:
        instance: the instance to begin with.
        least: its least-failure column, from which every search starts.
        row: failure budget, at least the least failure, and form of the objective.
        effort: engine, tolerance and limits.

    Raises:
        SolverError: the linear program's answer fails its check.
    """
    gaps: list[float] = []
    outcome = _attempt(instance, least, row, effort, None)
    while True:
        gaps.append(relative_gap(outcome.found.objective, outcome.found.lower_bound))
        if gaps[-1] <= effort.tolerance or time.perf_counter() > effort.deadline:
            return outcome
        price = outcome.found.price
        if _is_stagnant(gaps) and outcome.instance.tail_loss(price) == 0.0:
            return outcome
        finer = outcome.instance.refined(price)
        if finer is None:
            return outcome
        following = _attempt(finer, least, row, effort, price)
        outcome = replace(following, calls=outcome.calls + following.calls)


def _attempt(
    instance: Instance, least: LeastFailure, row: Row, effort: Effort, hint: float | None
) -> Outcome:
    """One search, started from the dual of the linear program where that is the engine.

    A budget equal to the least failure needs no program, whose feasibility would hang on rounding:
    the first column is the answer, and its own bound holds.
    """
    tight, optimum = row.budget <= least.column.failure, None
    if effort.engine == "lp" and row.budget > least.column.failure + LEAST_BUDGET:
        optimum = solve_program(instance, row, effort.backend, effort.deadline)
        hint = optimum.price
    found = search(
        instance.oracle(),
        least.column,
        row,
        tolerance=effort.tolerance,
        hint=hint,
        deadline=effort.deadline,
        report=effort.progress,
    )
    if optimum is not None:
        check_agreement(optimum, found.objective)
    if tight:
        found = replace(found, lower_bound=max(found.lower_bound, least.objective_bound))
    return Outcome(found, instance, found.rounds, "" if optimum is None else optimum.report)


def _is_stagnant(gaps: list[float]) -> bool:
    """Whether the last refinements did not even halve the gap: perhaps it is rounding."""
    return len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
