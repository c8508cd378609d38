"""Phase 1: a lottery that keeps to all rows, or the smallest set of rows that none keeps to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.conflict import Conflict, kept_to, proved_conflict, smallest_conflict
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.stabilised_master import StabilisedMaster, violation
from ssp_lp.compiled.deadline import Stop, closing
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.options import SolveOptions
from ssp_lp.processes.failure_semantics import survival_of
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.quantities.conditions import FAILURE_ROW


def opening(
    compiled: CompiledConstrained, stated: CompiledConstrained, options: SolveOptions
) -> StabilisedMaster:
    """The cheapest policy of all, and more until some lottery keeps to all rows (phase 1).

    Args:
        compiled: at least failure, where the stated budget is equal to that.
        stated: the problem with the budget that was stated.
        options: tolerance and limits.

    Returns:
        The search for the least cost to begin with: its rows raised where they lie below what is
        attainable by rounding, and in case S with the ratio of some lottery.
    """
    pricing = compiled.pricing
    pool = Pool(pricing, [pricing.first()])
    cheapest = pool.priced(np.eye(1, pricing.rewards.shape[1])[0])
    pool.add(cheapest)
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    _refuse_empty(compiled, stated, limited)
    rows = pool.rows(1 + limited, compiled.bounds[limited])
    ended = generate(violation(pool, rows), options)
    if kept_to(ended, rows):
        raised = rows.relaxed(ended.excess)
        ratio = _first_ratio(pool, ended) if compiled.ratio else 0.0
        at_none = np.zeros(len(limited)), cheapest.cost
        return StabilisedMaster(pool, replace(raised, ratio=ratio), *at_none)
    if compiled.budget is None and stated.budget is not None:
        anyhow = replace(stated, budget=1.0)
        opening(anyhow, anyhow, options)  # raises where the limits contradict each other anyhow
    with closing():
        first = proved_conflict(pool, rows, ended)
    if first is None and not ended.finished:
        raise Stop
    if first is None:
        raise SolverError(
            "no policy within all limits was found, and it was not proved that there is none: "
            "rounding ended the search"
        )
    conflict = smallest_conflict(pool, rows, first, options)
    raise _refusal(compiled, stated, conflict, rows)


def _first_ratio(pool: Pool, ended: Generated) -> float:
    """A ratio to begin with: that of the known lottery, or some policy's."""
    attained = ended.ratio
    if np.isfinite(attained) and attained > 0.0:
        return attained
    with np.errstate(divide="ignore", invalid="ignore"):
        known = pool.figures[0] / (1.0 - pool.figures[1])
    known = known[np.isfinite(known) & (known > 0.0)]
    return float(known.max()) if known.size else 1.0


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
