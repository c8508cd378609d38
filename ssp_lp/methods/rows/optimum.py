"""Problems with rows: several quantities limited at once, and priced one by one.

Column generation with phase 1 and phase 2 (``column_generation.stabilised_master``), or the full
linear program first, whose duals are then the prices to begin with. A cost given success is found
by Dinkelbach's iteration: the least of ``cost + ratio * failure`` falls to the ratio itself at the
optimum. Where accumulated cost is cut at a cap, the process bounds the optimum from below and the
policy's own value from above; the cap is doubled until they meet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.failure_constraint import least_of, relative_gap
from ssp_lp.column_generation.generation import Generated
from ssp_lp.column_generation.pool import Rows
from ssp_lp.column_generation.stabilised_master import StabilisedMaster, without_trifles
from ssp_lp.compiled.deadline import STOPS, Stop, heed, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import SolverError
from ssp_lp.methods.assembling import Found
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement, solve_rows_program
from ssp_lp.methods.rows.opening import opening
from ssp_lp.methods.rows.proof import bound_in_time
from ssp_lp.methods.rows.ratio import generated
from ssp_lp.methods.rows.rounded import true_lottery
from ssp_lp.options import LinearProgramming, SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.processes.totals.ladder import Rungs
from ssp_lp.solution import CUT_SHORT

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
        """What failing is worth."""
        ratio = self.value if self.compiled.ratio else 0.0
        return ratio + self.prices.get(FAILURE_ROW, 0.0)

    @property
    def gap(self) -> float:
        """Relative gap, of what is asked for."""
        worth = self.compiled.sense.worth
        attained, limit = worth(self.value), worth(self.bound)
        return relative_gap(max(attained, limit), min(attained, limit))


@dataclass(frozen=True, eq=False)
class Truth:
    """What a policy is worth by itself, where the process truncates or rounds it."""

    value: Callable[[MixedPolicy], float]  # of a lottery, in what is minimised
    figures: Callable[[Policy], FloatArray] | None = None  # cost, failure and rows of one policy


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
        guess = _coarse_guess(stated, options)
        stated = stated.up_to(guess.kappa)
    while True:
        try:
            found = _attempt(stated, options.after(calls), truth, guess)
        except STOPS as stop:
            heed(stop)
            if best is None:
                raise Stop from stop
            return _with_value(replace(best, note=best.note or CUT_SHORT))
        except SolverError:
            if best is None or not is_late():
                raise
            return _with_value(replace(best, note=best.note or CUT_SHORT))
        calls, work = calls + found.calls, work + found.work
        gaps.append(found.gap)
        best = found if best is None or found.gap < best.gap else best
        best = replace(best, calls=calls, work=work)
        if best.gap <= options.tolerance:
            return best
        if is_late():
            return _with_value(replace(best, note=best.note or CUT_SHORT))
        stuck = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
        finer = None if stuck else found.compiled.refined(found.kappa)
        if finer is None and not (stated.precise or found.compiled.is_rounded or options.program):
            finer = replace(stated, precise=True)
        if finer is None:
            return _with_value(best)
        stated = finer
        if found.compiled.ladder is not None and np.isfinite(found.value):
            guess = found


def _with_value(found: RowsOptimum) -> RowsOptimum:
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
            f"no policy on {levels} of accumulated cost keeps to the limits: more cost_levels, or "
            "more time, make them finer"
        )
    told = f"totals are rounded to {levels}: more cost_levels leave a smaller gap"
    return replace(found, note=told)


def _coarse_guess(stated: CompiledConstrained, options: SolveOptions) -> RowsOptimum:
    """Ratio and prices on a coarse grid of totals: from these the true ones are near."""
    coarse = replace(stated, rungs=Rungs(grid=_COARSE_RUNGS, most=_COARSE_RUNGS))
    return _attempt(coarse, SolveOptions(_COARSE_GAP, options.deadline), None, None)


def _attempt(
    stated: CompiledConstrained,
    options: SolveOptions,
    truth: Truth | None,
    guess: RowsOptimum | None,
) -> RowsOptimum:
    """One search, on the process and in the precision that the compiled problem says."""
    finer = 1.0 if stated.sense.constant is None else _FINER
    options = replace(options, tolerance=finer * options.tolerance)
    compiled = stated.settled()
    opened, program = opening(compiled, stated, options), None
    if guess is not None:
        opened = _guessed(compiled, opened, guess)
    if options.program is not None:
        if compiled.ratio:  # whether any lottery within the rows succeeds is no solver's to say
            generated(compiled, opened, replace(options, tolerance=_COARSE))
        program, opened = _programmed(compiled, opened, options.program, options.deadline)
    found, ratio = generated(compiled, opened, options)
    return _concluded(compiled, stated, opened, found, ratio, truth, program)


def _guessed(
    compiled: CompiledConstrained, opened: StabilisedMaster, guess: RowsOptimum
) -> StabilisedMaster:
    """The same search, begun at the ratio and the prices of another one."""
    ratio = guess.value if compiled.ratio else 0.0
    rows = replace(opened.rows, ratio=ratio or opened.rows.ratio)
    named = by_name(compiled, rows, np.zeros(len(rows.index)))
    prices = np.array([guess.prices.get(name, 0.0) for name in named])
    return replace(opened, rows=rows, prices=prices, bound=0.0)


def _programmed(
    compiled: CompiledConstrained,
    opened: StabilisedMaster,
    asked: LinearProgramming,
    deadline: float,
) -> tuple[ProgramOptimum, StabilisedMaster]:
    """The optimum of the full linear program, and the search begun at its duals."""
    pricing, rows = compiled.pricing, opened.rows
    limits = {
        compiled.names[index - 1]: (pricing.rewards[:, index], float(bound))
        for index, bound in zip(rows.index.tolist(), rows.bounds, strict=True)
    }
    process = replace(pricing.process, cost=np.ascontiguousarray(pricing.rewards[:, 0]))
    program = solve_rows_program(process, limits, asked.backend, deadline, ratio=compiled.ratio)
    prices = np.array([program.prices[name] for name in limits])
    if compiled.ratio:
        rows = replace(rows, ratio=program.objective or rows.ratio)
    weights = rows.weights(prices)
    found = opened.pool.priced(weights)
    opened.pool.add(found)
    bound = float(found.figures @ weights) - float(prices @ rows.bounds)
    return program, replace(opened, rows=rows, prices=prices, bound=bound)


def _concluded(
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
    value = cost / (1.0 - failure) if compiled.ratio else cost
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
        bound=compiled.sense.settled_bound(value, least_of(bound, value)),
        policy=policy,
        failure=failure,
        price=named.get(FAILURE_ROW),
        prices=named,
        values=values,
        calls=pool.calls,
        work=pool.work,
        note=_note(compiled, stated, rows, found.finished),
        program="" if program is None else program.report,
    )


def by_name(compiled: CompiledConstrained, rows: Rows, values: FloatArray) -> dict[str, float]:
    """A value of each limited row, by its name."""
    names = [compiled.names[index - 1] for index in rows.index.tolist()]
    return dict(zip(names, values.tolist(), strict=True))


def _note(
    compiled: CompiledConstrained, stated: CompiledConstrained, rows: Rows, finished: bool
) -> str:
    """What a reader should know: bounds that were raised to what is attainable, a cut search."""
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
