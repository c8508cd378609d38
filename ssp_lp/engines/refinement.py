"""Search, and refine what was truncated until the certified gap meets the tolerance."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.engines.column_generation import HullSearch, search
from ssp_lp.engines.instance import Instance, LeastFailure, checked_least_failure
from ssp_lp.engines.lp import check_agreement, solve_program
from ssp_lp.engines.opening import Hint, Opening, open_at, open_by_pricing
from ssp_lp.engines.row import Row, relative_gap
from ssp_lp.policies import MixedPolicy

_PATIENCE = 3

_TRIAL_TOLERANCE = 1e-2
"""A trial only learns the price, from which the next instance's size follows."""

_NEAR = 1e-9  # of the budget: then it may be the least failure, whose own bound is exact
_SPREAD = 1e-6  # relative uncertainty of a price that a search or a program ended with


@dataclass(frozen=True)
class Effort:
    """How to search and for how long."""

    engine: str  # "columns" or "lp"
    backend: str | None
    tolerance: float
    deadline: float  # on the clock of time.perf_counter
    progress: Callable[[int, float, float], None] | None

    def after(self, calls: int) -> Effort:
        """The same, where so many oracle calls have been made before."""
        progress = self.progress
        if progress is None:
            return self
        return replace(self, progress=lambda more, *rest: progress(calls + more, *rest))


CERTIFYING = Effort("columns", None, RELATIVE_GAP, float("inf"), None)
"""The effort of a certificate that has to search for its bound."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The last search, the instance that it ran on, and the work done in all."""

    found: HullSearch
    instance: Instance
    row: Row
    least: LeastFailure | None = None  # where it had to be worked out
    calls: int = 0
    work: Work = field(default_factory=Work)
    program: str = ""  # report of the last linear program

    @property
    def lottery(self) -> MixedPolicy:
        """The lottery on the model that the search ended with."""
        oracle = self.instance.oracle()
        return MixedPolicy(tuple(oracle.policy(c) for c in self.found.columns), self.found.weights)

    def followed_by(self, other: Outcome) -> Outcome:
        """The other, with the work of both."""
        return replace(other, calls=self.calls + other.calls, work=self.work + other.work)


def optimise(instance: Instance, budget: float, effort: Effort) -> Outcome:
    """Search on finer and finer instances until the gap is met, or refining does not help.

    Args:
        instance: the instance to begin with.
        budget: failure budget.
        effort: engine, tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        SolverError: the linear program's answer fails its check.
    """
    gaps: list[float] = []
    instance = instance.for_program() if effort.engine == "lp" else instance
    row = Row(budget, instance.ratio, instance.lowest)
    outcome = _attempt(instance, row, None, effort, None)
    while True:
        found, here = outcome.found, outcome.instance
        gaps.append(relative_gap(found.objective, found.lower_bound))
        if gaps[-1] <= effort.tolerance:
            return outcome
        if time.perf_counter() > effort.deadline:
            return replace(outcome, found=replace(found, finished=False))
        if outcome.least is None and found.columns[0].failure >= outcome.row.budget - _NEAR:
            outcome = _at_the_edge(outcome, effort)
            if outcome.found is not found:
                continue
        if _is_stagnant(gaps) and here.tail_loss(found.price) == 0.0:
            return outcome
        finer = here.refined(found.price)
        if finer is None:
            return outcome
        spread = _TRIAL_TOLERANCE if here.is_trial else _SPREAD
        hint = Hint(found.price, spread, slack=len(found.columns) == 1)
        later = effort.after(outcome.calls)
        outcome = outcome.followed_by(_attempt(finer, outcome.row, outcome.least, later, hint))


def _at_the_edge(outcome: Outcome, effort: Effort) -> Outcome:
    """Work out the least failure; where the budget is equal to it, its policy is the answer."""
    least = checked_least_failure(outcome.instance, outcome.row.budget)
    if outcome.row.spare(least.column) > outcome.row.rounding:
        return replace(outcome, least=least)
    row = replace(outcome.row, budget=least.column.failure)
    later = effort.after(outcome.calls)
    return outcome.followed_by(_attempt(outcome.instance, row, least, later, None))


def _attempt(
    instance: Instance, row: Row, least: LeastFailure | None, effort: Effort, hint: Hint | None
) -> Outcome:
    """One search, started from the dual of the linear program where that is the engine.

    A budget equal to the least failure needs no program, whose feasibility would hang on rounding:
    the first column is the answer, and its own bound holds.
    """
    optimum = None
    if effort.engine == "lp":
        least = checked_least_failure(instance, row.budget) if least is None else least
        row = replace(row, budget=max(row.budget, least.column.failure))
        if row.budget > least.column.failure + LEAST_BUDGET:
            optimum = solve_program(instance, row, effort.backend, effort.deadline)
            hint = Hint(optimum.price, _SPREAD)
    if hint is None and row.budget >= 1.0 and not row.ratio:
        hint = Hint(0.0, _SPREAD, slack=True)  # nothing is limited: no price has to be found
    opening = _opening(instance, row, least, effort, hint)
    effort = effort.after(opening.calls)
    row, least = opening.edge.row, opening.least
    found = search(
        instance.oracle(),
        opening.edge,
        tolerance=_TRIAL_TOLERANCE if instance.is_trial else effort.tolerance,
        last=opening.last,
        deadline=effort.deadline,
        report=effort.progress,
    )
    if optimum is not None and found.finished:
        check_agreement(optimum, found.objective)
    if least is not None and row.budget <= least.column.failure < 1.0:
        found = replace(found, lower_bound=max(found.lower_bound, least.objective_bound))
    calls, work = opening.calls + found.rounds, opening.work + found.work
    report = "" if optimum is None else optimum.report
    return Outcome(found, instance, row, least, calls, work, report)


def _opening(
    instance: Instance, row: Row, least: LeastFailure | None, effort: Effort, hint: Hint | None
) -> Opening:
    """Columns to begin with, by pricing if that finds one that keeps to the budget."""
    if least is None or row.budget > least.column.failure:
        opening = open_by_pricing(instance, row, hint, effort.deadline, effort.progress)
        if opening is not None:
            return replace(opening, least=least)
    least = checked_least_failure(instance, row.budget) if least is None else least
    return open_at(least, row)


def _is_stagnant(gaps: list[float]) -> bool:
    """Whether the last refinements did not even halve the gap: perhaps it is rounding."""
    return len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
