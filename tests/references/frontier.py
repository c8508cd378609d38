"""The lower frontier of finitely many policies, and the best lottery over two of them.

A policy is a point: (failure, cost) for a plain expectation, (failure, cost on success) for a
conditional one, whose normaliser is 1 - failure.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

INFEASIBLE_BELOW = 1e-10
"""How far below the least failure a budget still counts as equal to it (as in the library)."""
SAME_FAILURE = 1e-12
"""Failures nearer than this are one number computed twice: they differ by solver rounding only."""


class Point(NamedTuple):
    """One policy: its failure, and its expected cost (or its cost on success)."""

    failure: float
    cost: float


def distinct(points: Sequence[Point]) -> list[Point]:
    """One finite point for each pair of numbers that differ by more than rounding."""
    rounded = {(round(p.failure, 13), round(p.cost, 11)): p for p in points if np.isfinite(p.cost)}
    return [rounded[key] for key in sorted(rounded)]


def least_failure(points: Sequence[Point]) -> float:
    """The least failure that any of the policies has."""
    return min(point.failure for point in points)


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """The lower convex hull, from the least failure to the least cost (Andrew's monotone chain)."""
    hull: list[Point] = []
    for point in distinct(points):
        while len(hull) >= 2 and _above(hull[-2], hull[-1], point):
            hull.pop()
        if len(hull) == 1 and point.failure - hull[0].failure <= SAME_FAILURE:
            hull = [min(hull[0], point, key=lambda p: p.cost)]
        else:
            hull.append(point)
    cheapest = min(range(len(hull)), key=lambda i: (hull[i].cost, i))
    return hull[: cheapest + 1]


def _above(left: Point, middle: Point, right: Point) -> bool:
    """Whether `middle` lies on or above the segment from `left` to `right`."""
    cross = (middle.failure - left.failure) * (right.cost - left.cost) - (
        middle.cost - left.cost
    ) * (right.failure - left.failure)
    return cross <= 0.0


def constrained_optimum(points: Sequence[Point], budget: float) -> float | None:
    """Least mean cost of a lottery whose mean failure is at most `budget`; None if there is none.

    Brute force over all pairs: a lottery over two policies is enough for one constraint.
    """
    cheap, dear, share = _lotteries(points, budget)
    if cheap is None:
        return None
    costs = (1 - share) * cheap[None, :, 1] + share * dear[:, None, 1]
    return float(min(cheap[:, 1].min(), costs.min(initial=np.inf)))


def constrained_ratio(points: Sequence[Point], budget: float) -> float | None:
    """Least cost-on-success over success of a lottery with failure at most `budget`.

    None if no lottery within the budget succeeds with positive probability. Along a lottery the
    ratio is monotone, so only single policies and lotteries that use up the budget matter.
    """
    inside, outside, share = _lotteries(points, budget)
    if inside is None:
        return None
    success, cost = 1 - inside[:, 0], inside[:, 1]
    best = min(
        (c / s for c, s in zip(cost, success, strict=True) if s > SAME_FAILURE), default=None
    )
    costs = (1 - share) * inside[None, :, 1] + share * outside[:, None, 1]
    mixed = 1 - ((1 - share) * inside[None, :, 0] + share * outside[:, None, 0])
    ratios = costs[mixed > SAME_FAILURE] / mixed[mixed > SAME_FAILURE]
    if best is None and not ratios.size:
        return None
    return float(min(np.inf if best is None else best, ratios.min(initial=np.inf)))


def _lotteries(
    points: Sequence[Point], budget: float
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
    """Policies inside and outside the budget, and the shares that use it up, [outside, inside]."""
    table = np.array(distinct(points))
    within = table[:, 0] <= budget + INFEASIBLE_BELOW
    if not within.any():
        return None, table, table
    inside, outside = table[within], table[~within]
    gap = outside[:, None, 0] - inside[None, :, 0]
    share = np.clip((budget - inside[None, :, 0]) / gap, 0.0, 1.0)
    return inside, outside, share


def price_interval(points: Sequence[Point], budget: float, value: float) -> tuple[float, float]:
    """All prices p >= 0 with cost + p * (failure - budget) >= value for every policy."""
    low, high = 0.0, np.inf
    for failure, cost in distinct(points):
        if failure > budget + SAME_FAILURE:
            low = max(low, (value - cost) / (failure - budget))
        elif failure < budget - SAME_FAILURE:
            high = min(high, (cost - value) / (budget - failure))
    return low, high
