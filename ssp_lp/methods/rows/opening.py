"""Phase 1: a lottery that keeps to all rows, or the smallest set of rows that none keeps to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.conflict import Conflict, kept_to, proved_conflict, smallest_conflict
from ssp_lp.column_generation.constrained_search import (
    Pace,
    Pool,
    Rows,
    first_rows,
    generate,
    relaxed,
)
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.processes.failure_semantics import survival_of
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.quantities.conditions import FAILURE_ROW


@dataclass(frozen=True, eq=False)
class Opening:
    """Rows, raised where they lie below what is attainable by rounding, and a pool to begin with.

    Some lottery over the pool keeps to the rows.
    """

    pool: Pool
    rows: Rows
    asked: FloatArray  # [rows] the bounds as stated
    unlimited: float  # the least cost without any row: the bound at prices 0
    weights: FloatArray  # [columns] a lottery that keeps to the rows


def opening(compiled: CompiledConstrained, stated: CompiledConstrained, pace: Pace) -> Opening:
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
    _refuse_empty(compiled, stated, limited)
    rows = first_rows(pool, 1 + limited, compiled.bounds[limited])
    ended = generate(pool, rows, pace, elastic=True)
    if kept_to(ended, rows):
        raised = relaxed(rows, ended.master.excess)
        return Opening(pool, raised, rows.bounds, float(cheapest.figures[0]), ended.master.weights)
    if compiled.budget is None and stated.budget is not None:
        anyhow = replace(stated, budget=1.0)
        opening(anyhow, anyhow, pace)  # raises where the limits contradict each other anyhow
    first = proved_conflict(pool, rows, ended)
    if first is None:
        raise SolverError(
            "no policy within all limits was found, and it was not proved that there is none: "
            + ("rounding" if ended.finished else "the time limit")
            + " ended the search"
        )
    conflict = smallest_conflict(pool, rows, first, pace)
    raise _refusal(compiled, stated, conflict, rows)


def _refuse_empty(
    compiled: CompiledConstrained, stated: CompiledConstrained, limited: IntArray
) -> None:
    """Refuse rows that count nothing and may not even take that.

    Raises:
        InfeasibleError: naming the first.
    """
    for k in limited.tolist():
        if compiled.bounds[k] < 0.0 and not compiled.pricing.rewards[:, 1 + k].any():
            raise InfeasibleError(
                f"{compiled.told[k]!r} is 0 under every policy, {compiled.bounds[k]:.6g} allowed",
                failure_budget=stated.budget,
                least_failure=_least_failure(compiled, None),
                conflicting_rows=(compiled.names[k],),
            )


def _refusal(
    compiled: CompiledConstrained, stated: CompiledConstrained, conflict: Conflict, rows: Rows
) -> InfeasibleError:
    """The conflict as an error, with the least failure of all policies."""
    at_least, budget = compiled.budget is None, stated.budget
    places = [int(rows.index[k]) - 1 for k in conflict.rows]
    named = [compiled.names[k] for k in places]
    every = "every policy of least failure" if at_least else "every policy"
    told = conflict.told(
        [compiled.told[k] for k in places], rows.bounds[list(conflict.rows)], every
    )
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
