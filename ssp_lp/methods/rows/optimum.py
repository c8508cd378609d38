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

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.constrained_search import (
    Generated,
    Pace,
    Pool,
    without_trifles,
)
from ssp_lp.column_generation.failure_constraint import least_of, relative_gap
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import SolverError
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement, solve_rows_program
from ssp_lp.methods.rows.guess import Guess, by_name, coarse_guess
from ssp_lp.methods.rows.opening import Opening, opening
from ssp_lp.methods.rows.proof import proved_bound
from ssp_lp.methods.rows.ratio import generated
from ssp_lp.methods.rows.rounded import true_lottery
from ssp_lp.options import LinearProgramming, SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT

_PATIENCE = 6  # refinements that need not even halve the gap
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
    note: str
    program: str = ""

    @property
    def guess(self) -> Guess:
        """Where a finer search may begin."""
        return Guess(self.value, self.prices)

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


def optimum_of(problem: Problem, stated: CompiledConstrained, options: SolveOptions) -> RowsOptimum:
    """The best lottery within all rows, its value taken from its own evaluation."""
    return rows_optimum(stated, options, _truth(problem, stated))


def _truth(problem: Problem, stated: CompiledConstrained) -> Truth | None:
    """What policies are worth on the model itself, where the process truncates them."""
    if stated.charge is None:
        return None

    def value(policy: MixedPolicy) -> float:
        """Of a lottery, in what is minimised."""
        attained = evaluate(policy, problem).objective
        return attained if stated.sense.constant is None else stated.sense.constant - attained

    def figures(policy: Policy) -> FloatArray:
        """Cost, failure and rows of one policy."""
        found = evaluate(policy, problem)
        failure = found.discounted_failure
        failure = found.failure_probability if failure is None else failure
        cost = found.objective * (1.0 - failure) if failure < 1.0 else 0.0
        if not stated.ratio:
            cost = value(MixedPolicy((policy,), np.ones(1)))
        return np.array([cost, failure, *taken(stated, found)])

    return Truth(value, figures)


def taken(stated: CompiledConstrained, found: Evaluation) -> list[float]:
    """What a policy takes of each row beside failure."""
    spent = found.secondary_costs
    return [row.activity(spent[row.condition.name]) for row in stated.side]


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
    calls, work, gaps, best = 0, Work(), list[float](), None
    guess = None if stated.rungs is None else coarse_guess(stated, options)
    if guess is not None and stated.rungs is not None:
        stated = stated.up_to(guess.kappa)
    while True:
        try:
            found = _attempt(stated, options.after(calls), truth, guess)
        except SolverError:
            if best is None or time.perf_counter() < options.deadline:
                raise
            return _with_value(replace(best, note=best.note or CUT_SHORT))
        calls, work = calls + found.calls, work + found.work
        gaps.append(found.gap)
        best = found if best is None or found.gap < best.gap else best
        best = replace(best, calls=calls, work=work)
        if best.gap <= options.tolerance:
            return best
        if time.perf_counter() > options.deadline:
            return _with_value(replace(best, note=best.note or CUT_SHORT))
        stuck = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
        finer = None if stuck else found.compiled.refined(found.guess.kappa)
        if finer is None and not (stated.precise or found.compiled.is_rounded or options.program):
            finer = replace(stated, precise=True)
        if finer is None:
            return _with_value(best)
        stated = finer
        if found.compiled.ladder is not None and np.isfinite(found.value):
            guess = found.guess


def _with_value(found: RowsOptimum) -> RowsOptimum:
    """The optimum with a remark on rounded totals, if some policy keeps to the rows.

    Raises:
        SolverError: none was found that does so on the model itself.
    """
    levels = f"{found.compiled.layers:,} levels"
    if found.compiled.ladder is not None:
        levels = f"{levels} up to {found.compiled.ladder.rungs[-1]:.6g}"
    if not np.isfinite(found.value):
        raise SolverError(
            f"no policy on {levels} of accumulated cost keeps to the limits: more cost_levels, or "
            "more time, make them finer"
        )
    if found.compiled.is_rounded and not found.note:
        told = f"totals are rounded to {levels}: more cost_levels leave a smaller gap"
        return replace(found, note=told)
    return found


def _attempt(
    stated: CompiledConstrained,
    options: SolveOptions,
    truth: Truth | None,
    guess: Guess | None,
) -> RowsOptimum:
    """One search, on the process and in the precision that the compiled problem says."""
    finer = 1.0 if stated.sense.constant is None else _FINER
    pace = Pace(finer * options.tolerance, options.deadline, report=options.progress)
    compiled = stated.settled()
    opened = opening(compiled, stated, pace)
    program, centre = None, (np.zeros(len(opened.asked)), opened.unlimited)
    if guess is not None:
        opened, prices = guess.of(compiled, opened)
        centre = prices, 0.0
    if options.program is not None:
        if compiled.ratio:  # whether any lottery within the rows succeeds is no solver's to say
            generated(compiled, opened, replace(pace, tolerance=_COARSE), centre)
        program, opened, centre = _programmed(compiled, opened, options.program, options.deadline)
    found, ratio = generated(compiled, opened, pace, centre)
    return _concluded(compiled, stated, opened, found, ratio, truth, program)


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
    value = cost / (1.0 - failure) if compiled.ratio else cost
    if program is not None and found.finished:
        check_agreement(program, value)
    prices = without_trifles(found.prices, pool.sizes(rows), cost + ratio * failure)
    bound, proof = proved_bound(compiled, rows, prices, ratio, pool)
    policy = _lottery(compiled, pool, master.weights)
    if truth is not None and truth.figures is not None and compiled.is_rounded:
        weights = rows.weights(prices, 1.0, pool.figures.shape[0])
        kept = true_lottery(compiled, rows, pool, weights, truth.figures)
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
        prices=named,
        values=read_only(proof.values),
        calls=pool.calls,
        work=pool.work,
        note=_note(compiled, stated, opened, found.finished),
        program="" if program is None else program.report,
    )


def _lottery(compiled: CompiledConstrained, pool: Pool, weights: FloatArray) -> MixedPolicy:
    """The lottery over the first policies of a pool, without those of no weight."""
    used = np.flatnonzero(weights > 0.0)
    members = [compiled.pricing.policy(pool.points[k]) for k in used.tolist()]
    return MixedPolicy(tuple(members), weights[used])


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
