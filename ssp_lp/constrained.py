"""The road from a constrained problem to its solution: several rows, priced one by one.

Column generation with phase 1 and phase 2 (``engines.rows_generation``), or the full linear program
first, whose duals are then the prices to begin with.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.engines.conflict import Conflict, kept_to, proved_conflict, smallest_conflict
from ssp_lp.engines.lp import check_agreement, solve_rows_program
from ssp_lp.engines.lp.engine import ProgramOptimum
from ssp_lp.engines.oracles.goal_reach import greatest_goal_reach
from ssp_lp.engines.oracles.priced import Point
from ssp_lp.engines.refinement import Effort
from ssp_lp.engines.row import least_of
from ssp_lp.engines.rows_generation import (
    Generated,
    Pace,
    Pool,
    Rows,
    first_rows,
    generate,
    relaxed,
    without_trifles,
)
from ssp_lp.engines.rows_instance import RowsInstance, lagrange_bound
from ssp_lp.errors import InfeasibleError, ModelError, SolverError
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import LimitedProblem, rows_instance
from ssp_lp.process.semantics import survival_of
from ssp_lp.process.side_rows import FAILURE_ROW
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


def solve_constrained(problem: LimitedProblem, effort: Effort) -> Solution:
    """Solve a problem with secondary costs.

    Args:
        problem: the problem.
        effort: engine, tolerance and limits.

    Raises:
        ModelError: an engine or a backend that does not go with side rows.
        InfeasibleError: no policy keeps to the failure budget and the limits; names the smallest
            conflict that was found.
        SolverError: the time ran out before any such policy was found, or the linear program's
            answer fails its check.
    """
    _check(problem, effort)
    stated = rows_instance(problem)
    solution = _solved(problem, stated, effort)
    late = time.perf_counter() > effort.deadline
    if late or solution.gap <= effort.tolerance or effort.engine == "lp":
        return solution
    return _solved(problem, replace(stated, precise=True), effort)


def _solved(problem: LimitedProblem, stated: RowsInstance, effort: Effort) -> Solution:
    """One search, in the precision that the instance says."""
    pace = Pace(effort.tolerance, effort.deadline, report=effort.progress)
    instance = stated.settled()
    opened = _opened(instance, stated, pace)
    program, centre = None, (np.zeros(len(opened.asked)), opened.unlimited)
    if effort.engine == "lp":
        program, centre = _programmed(instance, opened, effort)
    found = generate(opened.pool, opened.rows, pace, centre=centre)
    if program is not None and found.finished:
        check_agreement(program, found.master.value)
    calls = opened.pool.calls
    reason = f"column generation with {len(opened.asked)} rows, {calls} oracle calls"
    if program is not None:
        reason = f"the full linear program, as asked, then {reason}"
    run = Run(
        engine=effort.engine,
        reason=reason,
        oracle_calls=calls,
        seconds=0.0,
        work=opened.pool.work,
        program="" if program is None else program.report,
    )
    return _concluded(problem, instance, opened, found, run)


def _check(problem: LimitedProblem, effort: Effort) -> None:
    name = type(problem).__name__
    if effort.engine == "game":
        raise ModelError(f"engine='game' knows one row only, not {name}: take 'columns' or 'lp'")
    if effort.backend == "highs-warm":
        raise ModelError("backend='highs-warm' checks programs with one row: take another backend")


def _opened(instance: RowsInstance, stated: RowsInstance, pace: Pace) -> _Opened:
    """The cheapest policy of all, and more until some lottery keeps to all rows (phase 1).

    Args:
        instance: at least failure, where the stated budget is equal to that.
        stated: the instance with the budget that was stated.
        pace: tolerance and limits.
    """
    oracle = instance.oracle
    pool = Pool(oracle, [oracle.first()])
    weights = np.zeros(oracle.rewards.shape[1])
    weights[0] = 1.0
    cheapest = pool.priced(weights)
    pool.add(cheapest)
    limited = np.flatnonzero(np.isfinite(instance.bounds))
    rows = first_rows(pool, 1 + limited, instance.bounds[limited])
    ended = generate(pool, rows, pace, elastic=True)
    if kept_to(ended, rows):
        raised = relaxed(rows, ended.master.excess)
        return _Opened(pool, raised, rows.bounds, float(cheapest.figures[0]))
    if instance.budget is None and stated.budget is not None:
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
    raise _refusal(instance, stated, conflict, rows)


def _refusal(
    instance: RowsInstance, stated: RowsInstance, conflict: Conflict, rows: Rows
) -> InfeasibleError:
    """The conflict as an error, with the least failure of all policies."""
    at_least, budget = instance.budget is None, stated.budget
    named = [instance.names[int(rows.index[k]) - 1] for k in conflict.rows]
    every = "every policy of least failure" if at_least else "every policy"
    told = conflict.told(named, rows.bounds[list(conflict.rows)], every)
    if at_least and budget is not None:
        told = f"no policy keeps to {FAILURE_ROW!r} <= {budget:.12g} and the limits: {told}"
        named = [FAILURE_ROW, *named]
    discount = instance.discount
    return InfeasibleError(
        told,
        failure_budget=budget,
        least_failure=_least_failure(instance, None),
        least_discounted_failure=None if discount is None else _least_failure(instance, discount),
        conflicting_rows=tuple(named),
    )


def _least_failure(instance: RowsInstance, discount: float | None) -> float:
    reach = greatest_goal_reach(instance.model, survival_of(discount)).goal
    return max(1.0 - float(instance.start @ reach), 0.0)


def _programmed(
    instance: RowsInstance, opened: _Opened, effort: Effort
) -> tuple[ProgramOptimum, tuple[FloatArray, float]]:
    """The optimum of the full linear program, and the bound at its duals."""
    oracle, rows = instance.oracle, opened.rows
    limits = {
        instance.names[index - 1]: (oracle.rewards[:, index], float(bound))
        for index, bound in zip(rows.index.tolist(), rows.bounds, strict=True)
    }
    program = solve_rows_program(oracle.process, limits, effort.backend, effort.deadline)
    prices = np.array([program.prices[name] for name in limits])
    weights = rows.weights(prices, 1.0, oracle.rewards.shape[1])
    found = opened.pool.priced(weights)
    opened.pool.add(found)
    return program, (prices, found.worth(weights) - float(prices @ rows.bounds))


def _concluded(
    problem: LimitedProblem, instance: RowsInstance, opened: _Opened, found: Generated, run: Run
) -> Solution:
    """The lottery, and a certified bound at the prices that the search ended with."""
    pool, rows, master = opened.pool, opened.rows, found.master
    objective = float(master.weights @ pool.figures[0, : master.weights.size])
    prices = without_trifles(found.prices, pool.sizes(rows), objective)
    weights = rows.weights(prices, 1.0, instance.oracle.rewards.shape[1])
    best = pool.points[int(np.argmin(weights @ pool.figures))]
    proof = instance.oracle.prove(weights, best)
    bound = max(lagrange_bound(proof.bound, prices, rows.bounds), 0.0)
    used = np.flatnonzero(master.weights > 0.0)
    members: list[Point] = [pool.points[k] for k in used.tolist()]
    named = dict.fromkeys(instance.names, 0.0)
    named |= {
        instance.names[index - 1]: float(price)
        for index, price in zip(rows.index.tolist(), prices, strict=True)
    }
    if instance.budget is None:
        del named[FAILURE_ROW]
    return Solution(
        problem=problem,
        policy=MixedPolicy(
            tuple(instance.oracle.policy(point) for point in members), master.weights[used]
        ),
        objective=objective,
        lower_bound=least_of(bound, objective),
        failure_price=named.get(FAILURE_ROW),
        value_function=read_only(proof.values),
        budget_used=float(master.weights[used] @ [point.figures[1] for point in members]),
        run=run,
        note=_note(problem, instance, opened, found.finished),
        prices=named,
    )


def _note(problem: LimitedProblem, instance: RowsInstance, opened: _Opened, finished: bool) -> str:
    """What a reader should know: bounds that were raised to what is attainable, a cut search."""
    remarks = []
    if instance.budget is None and problem.failure_budget is not None:
        remarks.append("the failure budget counts as equal to the least failure")
    rows = opened.rows
    for index, asked, granted in zip(rows.index, opened.asked, rows.bounds, strict=True):
        if granted > asked:
            remarks.append(
                f"the bound of {instance.names[int(index) - 1]!r} lies {granted - asked:.1e} below "
                "what is attainable and counts as equal to it"
            )
    if not finished:
        remarks.append(CUT_SHORT)
    return "; ".join(remarks)
