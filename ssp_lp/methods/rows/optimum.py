"""Problems with rows: several quantities limited at once, and priced one by one.

Column generation with phase 1 and phase 2 (``column_generation.constrained_search``), or the full
linear program first, whose duals are then the prices to begin with. A cost given success is found
by Dinkelbach's iteration: the least of ``cost + ratio * failure`` falls to the ratio itself at the
optimum. Where accumulated cost is cut at a cap, the process bounds the optimum from below and the
policy's own value from above; the cap is doubled until they meet.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.constrained_search import (
    Generated,
    Pace,
    Pool,
    generate,
    without_trifles,
)
from ssp_lp.column_generation.failure_constraint import least_of, relative_gap
from ssp_lp.column_generation.pricing.constrained import Point
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement, solve_rows_program
from ssp_lp.methods.rows.opening import Opening, opening
from ssp_lp.methods.rows.proof import proved_bound
from ssp_lp.options import LinearProgramming, SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT

_RATIOS = 40  # steps of Dinkelbach's iteration
_SETTLED = 1e-14  # relative change of a ratio that is rounding
_STEEP = 1e3  # factor of a ratio at which nothing reached the goal
_STEEPEST = 1e15
_PATIENCE = 3  # refinements that need not even halve the gap
_COARSE = 0.5  # relative gap of a search that is only to find out whether there is an answer
_FINER = 1e-3  # of the tolerance, where a complement is minimised, which may be much larger


@dataclass(frozen=True, eq=False)
class RowsOptimum:
    """The best lottery that was found, with its proof."""

    compiled: CompiledConstrained
    value: float  # of the lottery, in what is minimised
    bound: float  # certified
    policy: MixedPolicy
    failure: float
    prices: dict[str, float]  # multiplier of each limited row, by name
    values: FloatArray  # the checked sub-solution
    calls: int
    work: Work
    finished: bool
    note: str
    program: str = ""

    @property
    def gap(self) -> float:
        """Relative gap, of what is asked for."""
        worth = self.compiled.worth
        attained, limit = worth(self.value), worth(self.bound)
        return relative_gap(max(attained, limit), min(attained, limit))


Truth = Callable[[MixedPolicy], float]
"""The true value of a lottery, in what is minimised, where the process truncates it."""


def optimum_of(problem: Problem, stated: CompiledConstrained, options: SolveOptions) -> RowsOptimum:
    """The best lottery within all rows, its value taken from its own evaluation."""
    return rows_optimum(stated, options, _truth(problem, stated))


def _truth(problem: Problem, stated: CompiledConstrained) -> Truth | None:
    """The true value of a lottery, where the process truncates it."""
    if stated.charge is None:
        return None

    def value(policy: MixedPolicy) -> float:
        attained = evaluate(policy, problem).objective
        return attained if stated.constant is None else stated.constant - attained

    return value


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
    while True:
        found = _attempt(stated, options.after(calls), truth)
        calls, work = calls + found.calls, work + found.work
        found = replace(found, calls=calls, work=work)
        late = time.perf_counter() > options.deadline
        if found.gap <= options.tolerance:
            return found
        if late:
            told = found.note or CUT_SHORT
            return replace(found, note=told)
        gaps.append(found.gap)
        stuck = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
        finer = None if stuck else found.compiled.refined()
        if finer is None and not stated.precise and options.program is None:
            finer = replace(stated, precise=True)
        if finer is None:
            return found
        stated = finer


def _attempt(
    stated: CompiledConstrained, options: SolveOptions, truth: Truth | None
) -> RowsOptimum:
    """One search, on the process and in the precision that the compiled problem says."""
    finer = 1.0 if stated.constant is None else _FINER
    pace = Pace(finer * options.tolerance, options.deadline, report=options.progress)
    compiled = stated.settled()
    opened = opening(compiled, stated, pace)
    program, centre = None, (np.zeros(len(opened.asked)), opened.unlimited)
    if options.program is not None:
        if compiled.ratio:  # whether any lottery within the rows succeeds is no solver's to say
            _generated(compiled, opened, replace(pace, tolerance=_COARSE), centre)
        program, opened, centre = _programmed(compiled, opened, options.program, options.deadline)
    found, ratio = _generated(compiled, opened, pace, centre)
    return _concluded(compiled, stated, opened, found, ratio, truth, program)


def _generated(
    compiled: CompiledConstrained,
    opened: Opening,
    pace: Pace,
    centre: tuple[FloatArray, float],
) -> tuple[Generated, float]:
    """The best lottery over columns, and in case S its ratio (Dinkelbach's iteration)."""
    if not compiled.ratio:
        return generate(opened.pool, opened.rows, pace, centre=centre), 0.0
    pool, ratio, best = opened.pool, opened.rows.ratio, None
    if ratio == 0.0:
        ratio = _first_ratio(pool, opened.weights)
    for _ in range(_RATIOS):
        rows = replace(opened.rows, ratio=ratio)
        found = generate(pool, rows, pace, centre=centre)
        attained = _ratio_of(pool, found.master.weights)
        if best is None and not np.isfinite(attained):
            ratio *= _STEEP
            if ratio > _STEEPEST:
                raise InfeasibleError(
                    "no policy that keeps to all limits reaches the goal: no cost given success "
                    "exists",
                    failure_budget=compiled.budget,
                    least_failure=max(1.0 - compiled.greatest_goal, 0.0),
                )
            continue
        if best is not None and not attained < ratio * (1.0 - _SETTLED):
            kept = replace(best.master, weights=_padded(best.master.weights, pool))
            return replace(found, master=kept), ratio
        best, ratio, centre = found, attained, (found.prices, 0.0)
        if not found.finished or ratio == 0.0:
            break
    if best is None:
        raise SolverError("no policy that reaches the goal was found within the time limit")
    return replace(
        best, master=replace(best.master, weights=_padded(best.master.weights, pool))
    ), ratio


def _first_ratio(pool: Pool, weights: FloatArray) -> float:
    """A ratio to begin with: that of the known lottery, or some policy's."""
    attained = _ratio_of(pool, weights)
    if np.isfinite(attained) and attained > 0.0:
        return attained
    with np.errstate(divide="ignore", invalid="ignore"):
        known = pool.figures[0] / (1.0 - pool.figures[1])
    known = known[np.isfinite(known) & (known > 0.0)]
    return float(known.max()) if known.size else 1.0


def _ratio_of(pool: Pool, weights: FloatArray) -> float:
    """Cost given success of a lottery over the first columns; infinite where there is none."""
    cost, failure = pool.figures[:2, : weights.size] @ weights
    return float(cost / (1.0 - failure)) if failure < 1.0 - 1e-12 else float("inf")


def _padded(weights: FloatArray, pool: Pool) -> FloatArray:
    return np.append(weights, np.zeros(len(pool.points) - weights.size))


def _programmed(
    compiled: CompiledConstrained,
    opened: Opening,
    asked: LinearProgramming,
    deadline: float,
) -> tuple[ProgramOptimum, Opening, tuple[FloatArray, float]]:
    """The optimum of the full linear program, and the bound at its duals."""
    pricing, rows = compiled.pricing, opened.rows
    limits = {
        compiled.names[index - 1]: (pricing.rewards[:, index], float(bound))
        for index, bound in zip(rows.index.tolist(), rows.bounds, strict=True)
    }
    process = replace(pricing.process, cost=np.ascontiguousarray(pricing.rewards[:, 0]))
    program = solve_rows_program(process, limits, asked.backend, deadline, ratio=compiled.ratio)
    prices = np.array([program.prices[name] for name in limits])
    rows = replace(rows, ratio=program.objective if compiled.ratio else 0.0)
    weights = rows.weights(prices, 1.0, pricing.rewards.shape[1])
    found = opened.pool.priced(weights)
    opened.pool.add(found)
    centre = prices, found.worth(weights) - float(prices @ rows.bounds)
    return program, replace(opened, rows=rows), centre


def _concluded(
    compiled: CompiledConstrained,
    stated: CompiledConstrained,
    opened: Opening,
    found: Generated,
    ratio: float,
    truth: Truth | None,
    program: ProgramOptimum | None,
) -> RowsOptimum:
    """The lottery, and a certified bound at the prices that the search ended with."""
    pool, rows, master = opened.pool, opened.rows, found.master
    cost, failure = (pool.figures[:2, : master.weights.size] @ master.weights).tolist()
    relaxed_value = cost / (1.0 - failure) if compiled.ratio else cost
    if program is not None and found.finished:
        check_agreement(program, relaxed_value)
    prices = without_trifles(found.prices, pool.sizes(rows), cost + ratio * failure)
    bound, proof = proved_bound(compiled, rows, prices, ratio, pool)
    used = np.flatnonzero(master.weights > 0.0)
    members: list[Point] = [pool.points[k] for k in used.tolist()]
    policy = MixedPolicy(
        tuple(compiled.pricing.policy(point) for point in members), master.weights[used]
    )
    value = relaxed_value if truth is None else truth(policy)
    named = dict.fromkeys(compiled.names, 0.0)
    named |= {
        compiled.names[index - 1]: float(price)
        for index, price in zip(rows.index.tolist(), prices, strict=True)
    }
    if compiled.budget is None:
        del named[FAILURE_ROW]
    return RowsOptimum(
        compiled=compiled,
        value=value,
        bound=compiled.settled_bound(value, least_of(bound, value)),
        policy=policy,
        failure=float(master.weights[used] @ [point.figures[1] for point in members]),
        prices=named,
        values=read_only(proof.values),
        calls=pool.calls,
        work=pool.work,
        finished=found.finished,
        note=_note(compiled, stated, opened, found.finished),
        program="" if program is None else program.report,
    )


def _note(
    compiled: CompiledConstrained, stated: CompiledConstrained, opened: Opening, finished: bool
) -> str:
    """What a reader should know: bounds that were raised to what is attainable, a cut search."""
    remarks = []
    if compiled.budget is None and stated.budget is not None:
        remarks.append("the failure budget counts as equal to the least failure")
    rows = opened.rows
    for index, asked, granted in zip(rows.index, opened.asked, rows.bounds, strict=True):
        if granted > asked:
            remarks.append(
                f"the bound of {compiled.names[int(index) - 1]!r} lies {granted - asked:.1e} below "
                "what is attainable and counts as equal to it"
            )
    if not finished:
        remarks.append(CUT_SHORT)
    return "; ".join(remarks)
