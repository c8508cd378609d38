"""The best lottery over finitely many policies, in exact fractions."""

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

Lexicographic = tuple[Fraction, Fraction]


class Point(NamedTuple):
    """A policy as a lottery sees it."""

    failure: Fraction
    cost: Fraction
    second: Fraction = Fraction(0)


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """The lower convex hull in (failure, cost), from least failure down to least cost."""
    hull: list[Point] = []
    for point in sorted(points):
        if hull and point.cost >= hull[-1].cost:
            continue
        while len(hull) >= 2 and _above(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _above(left: Point, middle: Point, right: Point) -> bool:
    """Whether the middle point lies on or above the segment between the others."""
    rise = (right.cost - left.cost) * (middle.failure - left.failure)
    return (middle.cost - left.cost) * (right.failure - left.failure) >= rise


def at_budget(hull: Sequence[Point], budget: Fraction) -> Fraction | None:
    """The hull's cost at a budget; None below the least failure."""
    if budget < hull[0].failure:
        return None
    for left, right in pairwise(hull):
        if budget < right.failure:
            share = (budget - left.failure) / (right.failure - left.failure)
            return left.cost + share * (right.cost - left.cost)
    return hull[-1].cost


def best_lottery(points: Sequence[Point], budget: Fraction, bound: Fraction) -> Fraction | None:
    """Least mean cost with mean failure <= budget and mean second cost <= bound; None: none.

    The simplex method with Bland's rule on three rows: the weights' sum, the budget, the bound.
    Breaking the budget costs infinitely much, by a cost of two parts compared in order.
    """
    zero, one = Fraction(0), Fraction(1)
    columns = [((one, p.failure, p.second), (zero, p.cost)) for p in dict.fromkeys(points)]
    first = min(range(len(columns)), key=lambda k: columns[k][0][2])
    slack = len(columns)
    columns += [
        ((zero, one, zero), (zero, zero)),  # unused budget
        ((zero, zero, one), (zero, zero)),  # unused bound
        ((zero, -one, zero), (one, zero)),  # budget broken
    ]
    if columns[first][0][2] > bound:
        return None
    basis = [first, slack if columns[first][0][1] <= budget else slack + 2, slack + 1]
    right = [one, budget, bound]
    while True:
        matrix = [[columns[k][0][row] for k in basis] for row in range(3)]
        inverse = _inverse(matrix)
        shares = [sum(a * b for a, b in zip(line, right, strict=True)) for line in inverse]
        duals = [
            tuple(
                sum(columns[k][1][part] * inverse[i][row] for i, k in enumerate(basis))
                for row in range(3)
            )
            for part in range(2)
        ]
        entering = _entering(columns, duals, basis)
        if entering is None:
            break
        change = [_dot(line, columns[entering][0]) for line in inverse]
        ratios = [(shares[i] / d, basis[i], i) for i, d in enumerate(change) if d > 0]
        basis[min(ratios)[2]] = entering
    totals = [sum(columns[k][1][part] * shares[i] for i, k in enumerate(basis)) for part in (0, 1)]
    return totals[1] if totals[0] == 0 else None


def _entering(columns: list, duals: list[tuple[Fraction, ...]], basis: list[int]) -> int | None:
    """The first column of negative reduced cost."""
    for k, (column, cost) in enumerate(columns):
        if k not in basis:
            reduced = tuple(cost[part] - _dot(duals[part], column) for part in range(2))
            if reduced < (0, 0):
                return k
    return None


def _dot(left: Sequence[Fraction], right: Sequence[Fraction]) -> Fraction:
    return sum((a * b for a, b in zip(left, right, strict=True)), Fraction(0))


def _inverse(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """The inverse of a small regular matrix, by Gauss and Jordan."""
    n = len(matrix)
    rows = [[*line, *(Fraction(i == j) for j in range(n))] for i, line in enumerate(matrix)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k] != 0)
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [a / rows[k][k] for a in rows[k]]
        for i in range(n):
            if i != k and rows[i][k] != 0:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]
