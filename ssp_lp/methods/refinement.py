"""Search, and refine what was truncated until the certified gap meets the tolerance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.column_generation.compiled_problems.compiled_failure_label import CompiledFailureLabel
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.failure_row import FailureRow, relative_gap
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.initial_columns import DualGuess, columns_at, columns_by_pricing
from ssp_lp.compiled.deadline import STOPS, Stop, closing, has_answer, heed, is_late, prepared
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.methods.assembling import Found
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.processes.failure_semantics import FailureSemantics
from ssp_lp.solution import Run

_PATIENCE = 3

_TRIAL_TOLERANCE = 1e-2
"""A trial only learns the price, from which the next one's size follows."""

_LABEL_SPREAD = 0.25  # relative uncertainty of a price of case M in case S
_LABEL_MARGIN = 1.5  # cap, as a multiple of it

_NEAR = 1e-9  # of the budget: then it may be the least failure, whose own bound is exact
_SPREAD = 1e-6  # relative uncertainty of a price that a search or a program ended with


@dataclass(frozen=True, eq=False)
class RefinedOutcome:
    """The last search, the compiled problem that it ran on, and the work done in all."""

    found: Generated
    compiled: CompiledProblem
    row: FailureRow
    least: LeastFailure | None = None  # where it had to be worked out
    calls: int = 0
    work: Work = field(default_factory=Work)
    program: str = ""  # report of the last linear program

    @property
    def gap(self) -> float:
        """Relative gap of what refinement has come to."""
        return relative_gap(self.found.objective, self.found.lower_bound)

    @property
    def lottery(self) -> MixedPolicy:
        """The lottery on the model that the search ended with."""
        return self.found.lottery(self.compiled.pricing())

    def answer(self, price: float, note: str) -> Found:
        """What was found, as an answer.

        Args:
            price: multiplier of the failure row.
            note: what a reader should know.
        """
        found = self.found
        lottery, bound = self.lottery, found.lower_bound
        return Found(lottery, found.objective, bound, found.failure, price, found.values, note=note)

    def run(self, options: SolveOptions, reason: str) -> Run:
        """What was done, and why."""
        return Run(options.method, reason, self.calls, 0.0, self.work, self.program)

    def followed_by(self, other: RefinedOutcome) -> RefinedOutcome:
        """The other, with the work of both."""
        return replace(other, calls=self.calls + other.calls, work=self.work + other.work)


def refined_optimum(
    compiled: CompiledProblem,
    budget: float,
    options: SolveOptions,
    guess: DualGuess | None = None,
) -> RefinedOutcome:
    """Search on finer and finer compiled problems until the gap is met, or refining does not help.

    Args:
        compiled: the problem to begin with.
        budget: failure budget.
        options: method, tolerance and limits.
        guess: of the price; None: nothing is known.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        SolverError: the linear program's answer fails its check.
        Stop: the time ended before a policy that keeps to the budget was found.
    """
    gaps: list[float] = []
    compiled = compiled if options.program is None else compiled.for_program()
    row = FailureRow(budget, compiled.ratio)
    try:
        row = replace(row, lowest=compiled.lowest)
        if guess is None and options.program is None:
            compiled, guess = _begun_by_label(compiled, budget)
        outcome = _refined_attempt(compiled, row, None, options, guess)
    except STOPS as stop:
        heed(stop)
        return _safest_refined(compiled, row, stop)
    while True:
        gaps.append(outcome.gap)
        if gaps[-1] <= options.tolerance:
            return outcome
        try:
            refined = outcome if is_late() else _refined_outcome(outcome, gaps, options)
        except STOPS as stop:
            heed(stop)
            refined = outcome
        if is_late():
            best = refined if refined.gap <= outcome.gap else outcome
            met = best.gap <= options.tolerance
            return replace(best, found=replace(best.found, finished=met))
        if refined.found is outcome.found:
            return refined
        outcome = refined


def _begun_by_label(
    compiled: CompiledProblem, budget: float
) -> tuple[CompiledProblem, DualGuess | None]:
    """The price, and with it the cap, of case M, where no policy at hand tells of either.

    Its process has one layer, and failing early saves about as much in both.
    """
    if not (isinstance(compiled, CompiledAccumulatedCost) and compiled.is_long_shot):
        return compiled, None
    has_answer()
    outcome, semantics = prepared(), FailureSemantics(charge_failing_step=False)
    if not isinstance(outcome, RefinedOutcome):
        model, start, discount = compiled.model, compiled.start, compiled.discount
        label = CompiledFailureLabel(model, start, semantics, discount)
        outcome = refined_optimum(label, budget, SolveOptions(_TRIAL_TOLERANCE))
    price = max(outcome.found.price, outcome.found.ratio)
    if not np.isfinite(price):
        return compiled, None
    return compiled.capped_at(_LABEL_MARGIN * price), DualGuess(
        price, _LABEL_SPREAD, slack=len(outcome.found.columns) == 1
    )


def _refined_outcome(
    outcome: RefinedOutcome, gaps: list[float], options: SolveOptions
) -> RefinedOutcome:
    """A finer search's outcome; with what was found before where refining does not help."""
    found, here = outcome.found, outcome.compiled
    if outcome.least is None and found.columns[0].failure >= outcome.row.budget - _NEAR:
        outcome = _refined_at_the_edge(outcome, options)
        if outcome.found is not found:
            return outcome
    is_stagnant = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]  # rounding?
    if is_stagnant and here.tail_loss(found.price) == 0.0:
        return outcome
    finer = here.refined(found.price)
    if finer is None:
        return outcome
    spread = _TRIAL_TOLERANCE if here.is_trial else _SPREAD
    guess = DualGuess(found.price, spread, slack=len(found.columns) == 1)
    later = options.after(outcome.calls)
    return outcome.followed_by(_refined_attempt(finer, outcome.row, outcome.least, later, guess))


def _safest_refined(
    compiled: CompiledProblem, row: FailureRow, stop: BaseException
) -> RefinedOutcome:
    """The policy of least failure, where the time ended before any other within the budget.

    Raises:
        Stop: there is no time for it either.
    """
    if prepared() is not None:  # there is a better one already
        raise Stop from stop
    try:
        with closing():
            least = checked_least_failure(compiled, row.budget)
            rule = columns_at(compiled.pricing(), least, row)
            found = generate(rule, SolveOptions(_TRIAL_TOLERANCE))
    except STOPS as again:
        heed(again)
        told = stop.told if isinstance(stop, Stop) else ""
        raise Stop(told=told or "no policy was measured by then") from stop
    return RefinedOutcome(replace(found, finished=False), compiled, rule.row, least)


def _refined_at_the_edge(outcome: RefinedOutcome, options: SolveOptions) -> RefinedOutcome:
    """Work out the least failure; where the budget is equal to it, its policy is the answer."""
    least = checked_least_failure(outcome.compiled, outcome.row.budget)
    if not outcome.row.leaves_only(least.column):
        return replace(outcome, least=least)
    row = replace(outcome.row, budget=least.column.failure)
    later = options.after(outcome.calls)
    return outcome.followed_by(_refined_attempt(outcome.compiled, row, least, later, None))


def _refined_attempt(
    compiled: CompiledProblem,
    row: FailureRow,
    least: LeastFailure | None,
    options: SolveOptions,
    guess: DualGuess | None,
) -> RefinedOutcome:
    """One search, started from the dual of the linear program where that is the method.

    A budget equal to the least failure needs no program, whose feasibility would hang on rounding:
    the first column is the answer, and its own bound holds.
    """
    optimum = None
    if options.program is not None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        row = replace(row, budget=max(row.budget, least.column.failure))
        if row.budget > least.column.failure + LEAST_BUDGET:
            optimum = solve_program(compiled, row, options.program.backend, options.deadline)
            guess = DualGuess(optimum.price, _SPREAD)
    if guess is None and row.budget >= 1.0 and not row.ratio:
        guess = DualGuess(0.0, _SPREAD, slack=True)  # nothing is limited: no price has to be found
    rule = None
    if least is None or row.budget > least.column.failure:
        rule = columns_by_pricing(compiled, row, guess, options)
    if rule is None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        rule = columns_at(compiled.pricing(), least, row)
    finer = _TRIAL_TOLERANCE if compiled.is_trial else options.tolerance
    found = generate(rule, replace(options, tolerance=finer))
    if optimum is not None and found.finished:
        check_agreement(optimum, found.objective)
    if least is not None and rule.row.budget <= least.column.failure < 1.0:
        found = replace(found, lower_bound=max(found.lower_bound, least.objective_bound))
    report = "" if optimum is None else optimum.report
    return RefinedOutcome(found, compiled, rule.row, least, rule.calls, rule.work, report)
