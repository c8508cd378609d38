"""Problems with rows: several quantities limited at once, and priced one by one.

Column generation with phase 1 and phase 2 (``column_generation.stabilised_master``), or the full
linear program first, whose duals are then the prices to begin with. A cost given success is found
by Dinkelbach's iteration: the least of ``cost + ratio * failure`` falls to the ratio itself at the
optimum. Where accumulated cost is cut at a cap, the process bounds the optimum from below and the
policy's own value from above; the cap is doubled until they meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.failure_row import least_of, relative_gap
from ssp_lp.column_generation.generation import Generated
from ssp_lp.column_generation.pool import Rows
from ssp_lp.column_generation.stabilised_master import StabilisedMaster, without_trifles
from ssp_lp.compiled.deadline import STOPS, Stop, heed, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import Argument, SolverError
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement
from ssp_lp.methods.rows.lottery import Truth, best_lottery, true_lottery, truth_of
from ssp_lp.methods.rows.phase_one import begun_at_duals, begun_at_guess, by_name, phase_one_opening
from ssp_lp.methods.rows.proof import bound_in_time
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, compiled_constrained
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.processes.totals.ladder import Rungs
from ssp_lp.solution import CUT_SHORT, Run, Solution

_PATIENCE = 6  # refinements that need not even halve the gap
_COARSE_RUNGS = 64  # of the grid that a search on totals begins with
_COARSE_GAP = 1e-4  # and how exactly it is solved
_COARSE = 0.5  # relative gap of a search that is only to find out whether there is an answer
_FINER = 1e-3  # of the tolerance, where a complement is minimised, which may be much larger


@dataclass(frozen=True, eq=False, kw_only=True)
class RowsOptimum(Found):
    """The best lottery that was found, with its proof, and what it took."""

    policy: MixedPolicy
    compiled: CompiledConstrained
    calls: int
    work: Work
    program: str = ""

    @property
    def kappa(self) -> float:
        """What a failure may cost: the failure row's price, in case S with the ratio."""
        ratio = self.value if self.compiled.ratio else 0.0
        return ratio + self.prices.get(FAILURE_ROW, 0.0)

    @property
    def gap(self) -> float:
        """Relative gap, of what is asked for."""
        worth = self.compiled.sense.worth
        attained, limit = worth(self.value), worth(self.bound)
        return relative_gap(max(attained, limit), min(attained, limit))


def solve_constrained(problem: Problem, options: SolveOptions) -> Solution:
    """Solve a problem with constraints beside its failure budget.

    Args:
        problem: the problem; no measure of risk.
        options: method, tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the failure budget and the limits; names the smallest
            conflict that was found.
        SolverError: the time ran out before any such policy was found, or the linear program's
            answer fails its check.
    """
    stated = compiled_constrained(problem)
    found = rows_optimum(stated, options, truth_of(problem, stated))
    compiled = found.compiled
    many = int(np.isfinite(compiled.bounds).sum())
    reason = f"column generation with {many} rows, {found.calls} pricing calls"
    if found.program:
        reason = f"the full linear program, as asked, then {reason}"
    if compiled.charge is not None:
        reason = f"{reason}, {compiled.layers:,} layers of accumulated cost"
    run = Run(options.method, reason, found.calls, 0.0, found.work, found.program)
    return assembled(problem, found, run, compiled.sense)


def rows_optimum(
    stated: CompiledConstrained, options: SolveOptions, truth: Truth | None = None
) -> RowsOptimum:
    """The best lottery that keeps to all rows, refined until the gap meets the tolerance.

    Args:
        stated: the problem.
        options: method, tolerance and limits.
        truth: where accumulated cost is told apart, the true value of a lottery.

    Raises:
        InfeasibleError: no policy keeps to all rows; names the smallest conflict that was found.
        SolverError: the time ran out before any such policy was found, or the linear program's
            answer fails its check.
    """
    calls, work, gaps = 0, Work(), list[float]()
    best: RowsOptimum | None = None
    guess: RowsOptimum | None = None
    if stated.rungs is not None:
        coarse = replace(stated, rungs=Rungs(grid=_COARSE_RUNGS, most=_COARSE_RUNGS))
        guess = _rows_attempt(coarse, SolveOptions(_COARSE_GAP, options.deadline), None, None)
        stated = stated.up_to(guess.kappa)
    while True:
        try:
            found = _rows_attempt(stated, options.after(calls), truth, guess)
        except STOPS as stop:
            heed(stop)
            if best is None:
                raise Stop from stop
            return _optimum_with_value(replace(best, note=best.note or CUT_SHORT))
        except SolverError:
            if best is None or not is_late():
                raise
            return _optimum_with_value(replace(best, note=best.note or CUT_SHORT))
        calls, work = calls + found.calls, work + found.work
        gaps.append(found.gap)
        best = found if best is None or found.gap < best.gap else best
        best = replace(best, calls=calls, work=work)
        if best.gap <= options.tolerance:
            return best
        if is_late():
            return _optimum_with_value(replace(best, note=best.note or CUT_SHORT))
        stuck = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
        finer = None if stuck else found.compiled.refined(found.kappa)
        if finer is None and not (stated.precise or found.compiled.is_rounded or options.program):
            finer = replace(stated, precise=True)
        if finer is None:
            return _optimum_with_value(best)
        stated = finer
        if found.compiled.ladder is not None and np.isfinite(found.value):
            guess = found


def _optimum_with_value(found: RowsOptimum) -> RowsOptimum:
    """The optimum with a remark on rounded totals, if some policy keeps to the rows.

    Raises:
        SolverError: none was found that does so on the model itself.
    """
    if np.isfinite(found.value) and (found.note or not found.compiled.is_rounded):
        return found
    levels = f"{found.compiled.layers:,} levels"
    if found.compiled.ladder is not None:
        levels = f"{levels} up to {found.compiled.ladder.rungs[-1]:.6g}"
    if not np.isfinite(found.value):
        raise SolverError(
            f"no policy on {levels} of accumulated cost keeps to the limits: more ",
            Argument("cost_levels"),
            ", or more time, make them finer",
        )
    told = f"totals are rounded to {levels}: more of them leave a smaller gap"
    return replace(found, note=told)


def _rows_attempt(
    stated: CompiledConstrained,
    options: SolveOptions,
    truth: Truth | None,
    guess: RowsOptimum | None,
) -> RowsOptimum:
    """One search for the rows' optimum, in the precision that the compiled problem says."""
    finer = 1.0 if stated.sense.constant is None else _FINER
    options = replace(options, tolerance=finer * options.tolerance)
    compiled = stated.settled()
    opened, program = phase_one_opening(compiled, stated, options), None
    if guess is not None:
        opened = begun_at_guess(compiled, opened, guess)
    if options.program is not None:
        if compiled.ratio:  # whether any lottery within the rows succeeds is no solver's to say
            best_lottery(compiled, opened, replace(options, tolerance=_COARSE))
        program, opened = begun_at_duals(compiled, opened, options.program, options.deadline)
    found, ratio = best_lottery(compiled, opened, options)
    return _concluded_for_rows(compiled, stated, opened, found, ratio, truth, program)


def _concluded_for_rows(
    compiled: CompiledConstrained,
    stated: CompiledConstrained,
    opened: StabilisedMaster,
    found: Generated,
    ratio: float,
    truth: Truth | None,
    program: ProgramOptimum | None,
) -> RowsOptimum:
    """The lottery, and a certified bound at the prices that the search ended with."""
    pool, rows = opened.pool, opened.rows
    cost, failure = found.figures[:2].tolist()
    value = found.ratio if compiled.ratio else cost
    if program is not None and found.finished:
        check_agreement(program, value)
    prices = without_trifles(found.prices, pool.sizes(rows), cost + ratio * failure)
    bound, values = bound_in_time(compiled, rows, prices, ratio, pool)
    policy = found.lottery(compiled.pricing)
    if truth is not None and truth.figures is not None and compiled.is_rounded:
        kept = true_lottery(compiled, rows, pool, rows.weights(prices), truth.figures)
        policy, failure = kept or (policy, failure)
        value = truth.value(policy) if kept else np.inf
    elif truth is not None:
        value = truth.value(policy)
    named = dict.fromkeys(compiled.names, 0.0) | by_name(compiled, rows, prices)
    if compiled.budget is None:
        del named[FAILURE_ROW]
    return RowsOptimum(
        compiled=compiled,
        value=value,
        bound=compiled.sense.settled_bound(
            value, least_of(bound, value), float(prices @ np.abs(rows.bounds))
        ),
        policy=policy,
        failure=failure,
        price=named.get(FAILURE_ROW),
        prices=named,
        values=values,
        calls=pool.calls,
        work=pool.work,
        note=_note_on_rows(compiled, stated, rows, found.finished),
        program="" if program is None else program.report,
    )


def _note_on_rows(
    compiled: CompiledConstrained, stated: CompiledConstrained, rows: Rows, finished: bool
) -> str:
    """What a reader should know of an optimum within rows: raised bounds, a cut search."""
    remarks = []
    if compiled.budget is None and stated.budget is not None:
        remarks.append("the failure budget counts as equal to the least failure")
    for place, granted in zip((rows.index - 1).tolist(), rows.bounds, strict=True):
        if granted > (asked := compiled.bounds[place]):
            remarks.append(
                f"the bound of {compiled.names[place]!r} lies {granted - asked:.1e} below "
                "what is attainable and counts as equal to it"
            )
    if not finished:
        remarks.append(CUT_SHORT)
    return "; ".join(remarks)
