"""Column generation (Dantzig-Wolfe) for one failure row: a secant search on its price.

Deterministic policies are the columns; the master program has the failure row and convexity, so
its optimum lies on an edge of the lower convex hull of the points (failure, cost). The search
keeps a feasible column A and an infeasible column B, prices failure at the slope between them,
and ends when no policy lies below their line. In case S the objective is the ratio
``cost / (1 - failure)`` (paper, eq. s3p_gamma_j_obj): as long as no column is infeasible the
price is the ratio itself (Dinkelbach's iteration).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.engines.oracles.oracle import Column, Oracle, Proof, excess_failure
from ssp_lp.engines.row import Row

_ROUNDS = 200
_SAME_FAILURE = 1e-15
_STRADDLE = 1e-6  # relative step to the other side of a hinted price, to bracket it at once


@dataclass(frozen=True, eq=False)
class HullSearch:
    """What the search found: an edge of the hull, the price there, and a certified bound."""

    columns: tuple[Column, ...]  # one or two
    weights: FloatArray  # [columns]
    price: float  # kappa: price of failure at which the columns are optimal
    objective: float  # cost, or cost / (1 - failure)
    lower_bound: float
    proof: Proof  # behind the bound
    rounds: int  # oracle calls
    finished: bool  # false: stopped by the time limit


def search(
    oracle: Oracle,
    first: Column,
    row: Row,
    *,
    tolerance: float,
    hint: float | None = None,
    deadline: float = np.inf,
    report: Callable[[int, float, float], None] | None = None,
) -> HullSearch:
    """Find the best lottery over policies whose failure keeps to the budget.

    Args:
        oracle: minimises and measures at a price.
        first: a column of least failure, at most the budget.
        row: budget and form of the objective.
        tolerance: relative gap at which pricing stops.
        hint: a price to begin with, such as the dual of a linear program.
        deadline: on the clock of ``time.perf_counter``.
        report: called after each oracle call with (calls, price, objective).
    """
    inside, outside = first, None  # columns within and beyond the budget
    price, calls, finished = _next_price(row, inside, outside), 0, True
    price = price if hint is None else hint
    warm: Column | None = None
    while calls < _ROUNDS:
        found = oracle.minimise(price, warm)
        calls, warm = calls + 1, found
        below = inside.cost - found.cost - price * excess_failure(found, inside)
        scale = _best(row, inside, outside) * (inside.goal if row.ratio else 1.0)
        if report is not None:
            report(calls, price, _best(row, inside, outside))
        if below <= 0.1 * tolerance * max(scale, 1e-300):
            if price == _next_price(row, inside, outside):
                if outside is None or not row.ratio or price >= _best(row, inside, outside):
                    break
                outside = None  # the budget is slack: go on with Dinkelbach's iteration
        elif found.failure <= row.budget + MACHINE_EPSILON:
            if row.objective(found.cost, found.goal) < np.inf:  # else the price was too low
                inside = found
        elif _is_stalled(row, inside, outside, found, price):
            break
        else:
            outside = found
        price = _next_price(row, inside, outside)
        if hint and calls == 1 and price > 0.0:
            price = hint * (1.0 - _STRADDLE if found is inside else 1.0 + _STRADDLE)
        if time.perf_counter() > deadline:
            finished = False
            break
    return _conclude(oracle, row, inside, outside, price, warm, calls, finished, tolerance)


def _is_stalled(
    row: Row, inside: Column, outside: Column | None, found: Column, price: float
) -> bool:
    """Whether pricing at the slope only found the column beyond the budget again (rounding)."""
    if outside is None or price != _next_price(row, inside, outside):
        return False
    same = abs(found.failure - outside.failure) <= _SAME_FAILURE
    return same and found.cost >= outside.cost * (1.0 - _SAME_FAILURE)


def _next_price(row: Row, inside: Column, outside: Column | None) -> float:
    if outside is not None:
        return max((inside.cost - outside.cost) / excess_failure(outside, inside), 0.0)
    return row.objective(inside.cost, inside.goal) if row.ratio else 0.0


def _weight(row: Row, inside: Column, outside: Column | None) -> float:
    """Weight of the column beyond the budget at which the lottery meets the budget."""
    if outside is None:
        return 0.0
    share = (row.budget - inside.failure) / excess_failure(outside, inside)
    return float(min(max(share, 0.0), 1.0))


def _best(row: Row, inside: Column, outside: Column | None) -> float:
    """Objective of the lottery over the two columns."""
    w = _weight(row, inside, outside)
    if outside is None or w == 0.0:
        return row.objective(inside.cost, inside.goal)
    cost = (1.0 - w) * inside.cost + w * outside.cost
    return row.objective(cost, (1.0 - w) * inside.goal + w * outside.goal)


def _aligned(
    oracle: Oracle, row: Row, inside: Column, outside: Column, price: float
) -> tuple[Column, Column]:
    """Both columns with what they fix by a price fixed at the same one, if they still bracket."""
    pair = oracle.aligned(inside, price), oracle.aligned(outside, price)
    bracket = pair[0].failure <= row.budget < pair[1].failure
    return pair if bracket else (inside, outside)


def _conclude(
    oracle: Oracle,
    row: Row,
    inside: Column,
    outside: Column | None,
    price: float,
    warm: Column | None,
    calls: int,
    finished: bool,
    tolerance: float,
) -> HullSearch:
    if outside is not None:
        inside, outside = _aligned(oracle, row, inside, outside, price)
    weight = _weight(row, inside, outside)
    best = _best(row, inside, outside)
    columns: tuple[Column, ...] = (inside,)
    weights = np.ones(1)
    if outside is not None and weight > 0.0:
        columns, weights = (inside, outside), np.array([1.0 - weight, weight])
    price = max(price, best) if row.ratio else price
    slack = row.ratio and price <= best  # then bound just below the ratio: see Row.lower_bound
    bound_price = price * (1.0 - 0.25 * tolerance) if slack else price
    start = warm if warm is not None else inside
    proof = oracle.prove(bound_price, start, slack=slack)
    return HullSearch(
        columns=columns,
        weights=weights,
        price=price,
        objective=best,
        lower_bound=min(row.lower_bound(proof), best),
        proof=proof,
        rounds=calls,
        finished=finished,
    )
