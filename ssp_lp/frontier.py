"""The whole trade-off between cost and failure: the turning points of the optimal frontier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP, FloatArray
from ssp_lp.engines.column_generation import Edge, search
from ssp_lp.engines.instance import Instance, checked_least_failure
from ssp_lp.engines.oracles.oracle import Column, Oracle
from ssp_lp.engines.row import Row
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem

_REFINEMENTS = 6


@dataclass(frozen=True, eq=False)
class Frontier:
    """Turning points of the lower convex hull of (failure, cost), by increasing failure.

    Between two of them the optimum is their lottery: cost is piecewise linear and convex in the
    failure. In case S ``cost`` is E[cost; goal], and the objective is cost / goal along a segment.
    Under a discount all three are discounted.
    """

    failure: FloatArray  # [points] increasing
    goal: FloatArray  # [points] 1 - failure
    cost: FloatArray  # [points] decreasing
    price: FloatArray  # [points - 1] price of failure on each segment, decreasing
    gap: float  # no policy lies below the frontier by more than this share of the cost
    ratio: bool  # case S
    oracle_calls: int
    _oracle: Oracle
    _columns: tuple[Column, ...]

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    def objective_at(self, budget: float) -> float:
        """Least objective within a failure budget; no oracle call is made.

        Raises:
            InfeasibleError: the budget is below the least failure.
        """
        number, weight = self._locate(budget)
        row = Row(budget, self.ratio)
        if weight == 0.0:
            return row.objective(float(self.cost[number]), float(self.goal[number]))
        ends = np.array([1.0 - weight, weight])
        pair = slice(number, number + 2)
        return row.objective(float(ends @ self.cost[pair]), float(ends @ self.goal[pair]))

    def policy_at(self, budget: float) -> MixedPolicy:
        """A policy that attains :meth:`objective_at`; no oracle call is made.

        Raises:
            InfeasibleError: the budget is below the least failure.
        """
        number, weight = self._locate(budget)
        if weight == 0.0:
            return MixedPolicy((self._oracle.policy(self._columns[number]),), np.ones(1))
        members = tuple(self._oracle.policy(c) for c in self._columns[number : number + 2])
        return MixedPolicy(members, np.array([1.0 - weight, weight]))

    def _locate(self, budget: float) -> tuple[int, float]:
        """The turning point at or before the budget, and the weight of the next one."""
        least = float(self.failure[0])
        if not budget >= least - LEAST_BUDGET:
            raise InfeasibleError(
                f"every policy fails with at least {least:.12g}, above the budget {budget!r}",
                failure_budget=budget,
                least_failure=least,
            )
        number = max(int(np.searchsorted(self.failure, budget, side="right")) - 1, 0)
        if number == len(self.failure) - 1 or budget <= least:
            return number, 0.0
        width = float(self.failure[number + 1] - self.failure[number])
        return number, (budget - float(self.failure[number])) / width


def trace_frontier(
    problem: Problem,
    *,
    gap: float = RELATIVE_GAP,
    point_limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Frontier:
    """Trace the frontier from the least failure to where more failure buys nothing.

    Each segment is priced at its own slope: either no policy lies below it and it is part of the
    frontier, or the policy found splits it. Case M ends at price 0; case S where the price falls
    to the ratio itself, beyond which failing more does not lower the cost given success.

    Args:
        problem: its failure budget does not matter.
        gap: share of the cost by which a policy may lie below the traced frontier.
        point_limit: stop splitting after so many turning points; ``gap`` is then what was reached.
        progress: called after each oracle call with (calls, turning points so far).

    Raises:
        ModelError: ``gap`` out of range.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    if not 0.0 < gap < 1.0:
        raise ModelError(f"gap must lie strictly between 0 and 1, not {gap!r}")
    instance = problem.instance()
    least = checked_least_failure(instance, None).column
    calls = 0
    for _ in range(_REFINEMENTS):
        traced = _trace(instance, least, gap, point_limit, progress)
        calls += traced.oracle_calls
        finer = None
        if len(traced.price) and _truncated(instance, traced, gap):
            finer = instance.refined(float(traced.price[0]))
        if finer is None:
            break
        instance = finer
    return replace(traced, oracle_calls=calls)


def _truncated(instance: Instance, traced: Frontier, gap: float) -> bool:
    """Whether the cap on accumulated cost may hide policies below the frontier."""
    lost = max(instance.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    return lost > gap * float(traced.cost.min(initial=np.inf))


def _trace(
    instance: Instance,
    least: Column,
    gap: float,
    point_limit: int | None,
    progress: Callable[[int, int], None] | None,
) -> Frontier:
    oracle, row = instance.oracle(), Row(1.0, instance.ratio)
    free = search(oracle, Edge(row, least), tolerance=gap)
    last, calls = free.columns[-1], free.rounds
    columns = [least] if last.failure <= least.failure else [least, last]
    waiting = [(least, last)] if len(columns) == 2 else []
    reached = 0.0
    while waiting:
        edge = Edge(Row(1.0, instance.ratio), *waiting.pop())
        if edge.outside is None or edge.slope == 0.0:
            continue
        found, calls = oracle.minimise(edge.slope, edge.outside), calls + 1
        below = _share_below(edge, found)
        if below > gap and (point_limit is None or len(columns) < point_limit):
            columns.append(found)
            waiting += [(edge.inside, found), (found, edge.outside)]
        else:
            reached = max(reached, below)
        if progress is not None:
            progress(calls, len(columns))
    return _frontier(oracle, columns, max(reached, gap), instance.ratio, calls)


def _share_below(edge: Edge, found: Column) -> float:
    """How far a column lies below the edge's line, relative to the cost; 0 outside of the edge."""
    if edge.outside is None or not edge.inside.failure < found.failure < edge.outside.failure:
        return 0.0
    below = edge.inside.cost - found.cost - edge.slope * (found.failure - edge.inside.failure)
    return max(below, 0.0) / max(edge.inside.cost, 1e-300)


def _frontier(
    oracle: Oracle, columns: list[Column], gap: float, ratio: bool, calls: int
) -> Frontier:
    ordered = sorted(columns, key=lambda c: c.failure)
    failure = np.array([c.failure for c in ordered])
    cost = np.array([c.cost for c in ordered])
    return Frontier(
        failure=failure,
        goal=np.array([c.goal for c in ordered]),
        cost=cost,
        price=-np.diff(cost) / np.diff(failure),
        gap=gap,
        ratio=ratio,
        oracle_calls=calls,
        _oracle=oracle,
        _columns=tuple(ordered),
    )
