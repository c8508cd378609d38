"""The road from a constrained problem to its solution: several rows, priced one by one.

Column generation with phase 1 and phase 2 (``column_generation.constrained_search``), or the full
linear program first, whose duals are then the prices to begin with.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.constrained import (
    CompiledConstrained,
    lagrange_bound,
)
from ssp_lp.column_generation.conflict import Conflict, kept_to, proved_conflict, smallest_conflict
from ssp_lp.column_generation.constrained_search import (
    Generated,
    Pace,
    Pool,
    Rows,
    first_rows,
    generate,
    relaxed,
    without_trifles,
)
from ssp_lp.column_generation.failure_constraint import least_of
from ssp_lp.column_generation.pricing.constrained import Point
from ssp_lp.errors import InfeasibleError, ModelError, SolverError
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement, solve_rows_program
from ssp_lp.methods.refinement import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import LimitedProblem, compiled_constrained
from ssp_lp.processes.failure_semantics import survival_of
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.secondary_costs import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT, Run, Solution


@dataclass(frozen=True, eq=False)
class _Opened:
    """Rows, raised where they lie below what is attainable by rounding, and a pool to begin with.

    Some lottery over the pool keeps to the rows.
    """

    pool: Pool
    rows: Rows
    asked: FloatArray  # [rows] the bounds as stated
    unlimited: float  # the least cost without any row: the bound at prices 0


def solve_constrained(problem: LimitedProblem, options: SolveOptions) -> Solution:
    """Solve a problem with secondary costs.

    Args:
        problem: the problem.
        options: engine, tolerance and limits.

    Raises:
        ModelError: an engine or a backend that does not go with side rows.
        InfeasibleError: no policy keeps to the failure budget and the limits; names the smallest
            conflict that was found.
        SolverError: the time ran out before any such policy was found, or the linear program's
            answer fails its check.
    """
    _check(problem, options)
    stated = compiled_constrained(problem)
    solution = _solved(problem, stated, options)
    late = time.perf_counter() > options.deadline
    if late or solution.gap <= options.tolerance or options.engine == "lp":
        return solution
    return _solved(problem, replace(stated, precise=True), options)


def _solved(
    problem: LimitedProblem, stated: CompiledConstrained, options: SolveOptions
) -> Solution:
    """One search, in the precision that the compiled problem says."""
    pace = Pace(options.tolerance, options.deadline, report=options.progress)
    compiled = stated.settled()
    opened = _opened(compiled, stated, pace)
    program, centre = None, (np.zeros(len(opened.asked)), opened.unlimited)
    if options.engine == "lp":
        program, centre = _programmed(compiled, opened, options)
    found = generate(opened.pool, opened.rows, pace, centre=centre)
    if program is not None and found.finished:
        check_agreement(program, found.master.value)
    calls = opened.pool.calls
    reason = f"column generation with {len(opened.asked)} rows, {calls} pricing calls"
    if program is not None:
        reason = f"the full linear program, as asked, then {reason}"
    run = Run(
        engine=options.engine,
        reason=reason,
        pricing_calls=calls,
        seconds=0.0,
        work=opened.pool.work,
        program="" if program is None else program.report,
    )
    return _concluded(problem, compiled, opened, found, run)


def _check(problem: LimitedProblem, options: SolveOptions) -> None:
    name = type(problem).__name__
    if options.engine == "game":
        raise ModelError(f"engine='game' knows one row only, not {name}: take 'columns' or 'lp'")
    if options.backend == "highs-warm":
        raise ModelError("backend='highs-warm' checks programs with one row: take another backend")


def _opened(compiled: CompiledConstrained, stated: CompiledConstrained, pace: Pace) -> _Opened:
    """The cheapest policy of all, and more until some lottery keeps to all rows (phase 1).

    Args:
        compiled: at least failure, where the stated budget is equal to that.
        stated: the problem with the budget that was stated.
        pace: tolerance and limits.
    """
    pricing = compiled.pricing
    pool = Pool(pricing, [pricing.first()])
    weights = np.zeros(pricing.rewards.shape[1])
    weights[0] = 1.0
    cheapest = pool.priced(weights)
    pool.add(cheapest)
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    rows = first_rows(pool, 1 + limited, compiled.bounds[limited])
    ended = generate(pool, rows, pace, elastic=True)
    if kept_to(ended, rows):
        raised = relaxed(rows, ended.master.excess)
        return _Opened(pool, raised, rows.bounds, float(cheapest.figures[0]))
    if compiled.budget is None and stated.budget is not None:
        anyhow = replace(stated, budget=1.0)
        _opened(anyhow, anyhow, pace)  # raises where the limits contradict each other anyhow
    first = proved_conflict(pool, rows, ended)
    if first is None:
        raise SolverError(
            "no policy within all limits was found, and it was not proved that there is none: "
            + ("rounding" if ended.finished else "the time limit")
            + " ended the search"
        )
    conflict = smallest_conflict(pool, rows, first, pace)
    raise _refusal(compiled, stated, conflict, rows)


def _refusal(
    compiled: CompiledConstrained, stated: CompiledConstrained, conflict: Conflict, rows: Rows
) -> InfeasibleError:
    """The conflict as an error, with the least failure of all policies."""
    at_least, budget = compiled.budget is None, stated.budget
    named = [compiled.names[int(rows.index[k]) - 1] for k in conflict.rows]
    every = "every policy of least failure" if at_least else "every policy"
    told = conflict.told(named, rows.bounds[list(conflict.rows)], every)
    if at_least and budget is not None:
        told = f"no policy keeps to {FAILURE_ROW!r} <= {budget:.12g} and the limits: {told}"
        named = [FAILURE_ROW, *named]
    discount = compiled.discount
    return InfeasibleError(
        told,
        failure_budget=budget,
        least_failure=_least_failure(compiled, None),
        least_discounted_failure=None if discount is None else _least_failure(compiled, discount),
        conflicting_rows=tuple(named),
    )


def _least_failure(compiled: CompiledConstrained, discount: float | None) -> float:
    reach = greatest_goal_reach(compiled.model, survival_of(discount)).goal
    return max(1.0 - float(compiled.start @ reach), 0.0)


def _programmed(
    compiled: CompiledConstrained, opened: _Opened, options: SolveOptions
) -> tuple[ProgramOptimum, tuple[FloatArray, float]]:
    """The optimum of the full linear program, and the bound at its duals."""
    pricing, rows = compiled.pricing, opened.rows
    limits = {
        compiled.names[index - 1]: (pricing.rewards[:, index], float(bound))
        for index, bound in zip(rows.index.tolist(), rows.bounds, strict=True)
    }
    program = solve_rows_program(pricing.process, limits, options.backend, options.deadline)
    prices = np.array([program.prices[name] for name in limits])
    weights = rows.weights(prices, 1.0, pricing.rewards.shape[1])
    found = opened.pool.priced(weights)
    opened.pool.add(found)
    return program, (prices, found.worth(weights) - float(prices @ rows.bounds))


def _concluded(
    problem: LimitedProblem,
    compiled: CompiledConstrained,
    opened: _Opened,
    found: Generated,
    run: Run,
) -> Solution:
    """The lottery, and a certified bound at the prices that the search ended with."""
    pool, rows, master = opened.pool, opened.rows, found.master
    objective = float(master.weights @ pool.figures[0, : master.weights.size])
    prices = without_trifles(found.prices, pool.sizes(rows), objective)
    weights = rows.weights(prices, 1.0, compiled.pricing.rewards.shape[1])
    best = pool.points[int(np.argmin(weights @ pool.figures))]
    proof = compiled.pricing.prove(weights, best)
    bound = max(lagrange_bound(proof.bound, prices, rows.bounds), 0.0)
    used = np.flatnonzero(master.weights > 0.0)
    members: list[Point] = [pool.points[k] for k in used.tolist()]
    named = dict.fromkeys(compiled.names, 0.0)
    named |= {
        compiled.names[index - 1]: float(price)
        for index, price in zip(rows.index.tolist(), prices, strict=True)
    }
    if compiled.budget is None:
        del named[FAILURE_ROW]
    return Solution(
        problem=problem,
        policy=MixedPolicy(
            tuple(compiled.pricing.policy(point) for point in members), master.weights[used]
        ),
        objective=objective,
        lower_bound=least_of(bound, objective),
        failure_price=named.get(FAILURE_ROW),
        value_function=read_only(proof.values),
        budget_used=float(master.weights[used] @ [point.figures[1] for point in members]),
        run=run,
        note=_note(problem, compiled, opened, found.finished),
        prices=named,
    )


def _note(
    problem: LimitedProblem, compiled: CompiledConstrained, opened: _Opened, finished: bool
) -> str:
    """What a reader should know: bounds that were raised to what is attainable, a cut search."""
    remarks = []
    if compiled.budget is None and problem.failure_budget is not None:
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
