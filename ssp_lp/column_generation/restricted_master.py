"""The restricted master of column generation with several rows: a tiny program over known policies.

    minimise    sum_j w_j cost_j  (+ sum_k e_k)
    subject to  sum_j w_j (activity_kj - bound_k) (- scale_k e_k) <= 0
                sum_j w_j = 1,   w, e >= 0

As the weights sum to one, bounds are subtracted from the activities: what tells policies near a
bound apart is not lost in the size of the bound. With ``elastic`` the e_k measure by how much rows
are violated, in units of their scales, and costs are left out (phase 1).

The simplex method begins at one policy. The cheapest with the slacks of all rows is a basis whose
prices are 0 and at which nothing is worth entering: dual steps follow until no weight is negative.
Elastic, the least violating policy with the excesses of the rows that it breaks is a basis without
negative values: primal steps follow. Whatever rounding spoils, steps of the other kind repair. A
basis has one variable more than there are rows, so that each step inverts it afresh, and tells a 0
from its rounding. Where steps lead in a circle others enter first; should rounding alone lead on,
the basis that lacks least is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray
from ssp_lp.errors import SolverError

_NEGATIVE = 1e-14
"""A basic weight this far below 0, over the policy's greatest entry, is the rounding of a 0."""

_BROKEN = 4.0 * MACHINE_EPSILON
"""A row that is violated by so much of its scale is met but for rounding."""

_TIED = 1e-14  # of the numbers that a reduced cost is made of: then it is 0
_PIVOT = 1e-13  # of the numbers that an entry is made of: then it is 0
_CIRCLES = 10  # of bases, in each of which others enter first, after which rounding alone leads on
_GOLDEN = 0.618  # whose multiples are spread evenly: what enters first in a circle


@dataclass(frozen=True, eq=False)
class MasterOptimum:
    """Weights of the policies and prices of the rows; at most (tight rows + 1) weights are > 0."""

    value: float
    weights: FloatArray  # [columns]
    prices: FloatArray  # [rows] >= 0
    excess: FloatArray  # [rows] violation in units of the scales; 0 unless elastic


def solve_master(
    cost: FloatArray, activity: FloatArray, bounds: FloatArray, scales: FloatArray, *, elastic: bool
) -> MasterOptimum:
    """Solve the restricted master: weights of the columns and duals of the rows.

    Args:
        cost: [columns].
        activity: what each policy takes of each row, [rows, columns].
        bounds: [rows].
        scales: size of each row's numbers, > 0, [rows].
        elastic: minimise the violation instead of the cost.

    Raises:
        SolverError: numbers so far apart that a basis is singular.
    """
    n_rows, n_columns = activity.shape
    cost = np.zeros(n_columns) if elastic else cost
    unit = float(np.abs(cost).max(initial=0.0)) or 1.0
    beyond, units = activity - bounds[:, None], scales
    if not elastic:  # how far from its bound the policies take each row at most
        spread = np.abs(beyond).max(axis=1, initial=0.0)
        units = np.where(spread > MACHINE_EPSILON * scales, spread, scales)
    beyond = beyond / units[:, None]
    n_excess, broken = n_rows * elastic, _BROKEN * scales / units
    none = _NEGATIVE / np.maximum(np.abs(beyond).max(axis=0, initial=0.0), 1.0)
    # policies, excesses and slacks, all scaled; the last row says that weights sum to one
    priced = np.concatenate([cost / unit, np.ones(n_excess), np.zeros(n_rows)])
    rounding = np.concatenate([none, broken[:n_excess], broken])
    rows = np.hstack([beyond, -np.eye(n_rows, n_excess), np.eye(n_rows)])
    matrix = np.vstack([rows, np.append(np.ones(n_columns), np.zeros(n_excess + n_rows))])
    best = int(np.argmin(np.maximum(beyond, 0.0).sum(axis=0) if elastic else cost))
    basis = np.append(np.arange(n_rows) + (priced.size - n_rows), best)
    if elastic:
        basis[:-1] -= n_rows * (beyond[:, best] > 0.0)  # the excess in place of the slack
    x, dual = _by_simplex(priced, matrix, basis, rounding, np.append(broken, 0.0))
    weights = np.where(x[:n_columns] > _NEGATIVE, x[:n_columns], 0.0)
    weights /= weights.sum()
    excess = x[n_columns : n_columns + n_rows] if elastic else np.zeros(n_rows)
    return MasterOptimum(
        value=float(excess.sum()) if elastic else float(cost @ weights),
        weights=weights,
        prices=unit * np.maximum(-dual[:n_rows], 0.0) / units,
        excess=excess,
    )


def _by_simplex(
    cost: FloatArray, matrix: FloatArray, basis: IntArray, rounding: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Simplex on the restricted master: min ``cost @ x``, ``matrix @ x == (0, ..., 0, 1)``, x >= 0.

    Args:
        cost: [variables].
        matrix: [rows, variables].
        basis: variables to begin with, [rows]; moved on.
        rounding: a value so far below 0 is a 0, [variables].
        noise: of an entry, from what it is the difference of, [rows].

    Returns:
        The optimal values, [variables], and the rows' duals, [rows].
    """
    n_rows = len(matrix)
    right = np.eye(n_rows)[-1]
    visited, circles, least = set[bytes](), 0, np.inf
    while circles < _CIRCLES:
        if (key := np.sort(basis).tobytes()) in visited:
            visited, circles = set(), circles + 1
        visited.add(key)
        square = matrix[:, basis]
        try:
            inverse = np.asarray(np.linalg.inv(square), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise SolverError("the master program's basis is singular") from error
        values, x = _refined(inverse, square, right), np.zeros(cost.size)
        x[basis] = np.maximum(values, 0.0)
        dual = _refined(inverse.T, square.T, cost[basis])
        reduced = cost - dual @ matrix
        reduced[basis] = 0.0
        tied = np.abs(reduced) < _TIED * (np.abs(cost) + np.abs(dual) @ np.abs(matrix))
        reduced = np.where(tied, 0.0, reduced)
        short = values + rounding[basis]
        if not (lack := -min(short.min(), reduced.min())) >= least:
            least, optimum = lack, (x, dual)
        if short.min() < 0.0:  # a dual step
            leaving = int(np.argmin(short))
            among = _refined(inverse.T, square.T, np.eye(n_rows)[leaving])
            row = among @ matrix
            row[basis] = 0.0
            able = row < -np.abs(among) @ (_PIVOT * np.abs(matrix) + noise[:, None])
            entering = _least_ratio(reduced, -row, able)
        else:  # a primal step, if any
            preference = 1.0 + np.modf(_GOLDEN * circles * np.arange(cost.size))[0]
            entering = int(np.argmin(reduced * preference))
            if reduced[entering] >= 0.0:
                break
            entry = matrix[:, entering]
            column = _refined(inverse, square, entry)
            able = column > np.abs(inverse) @ (_PIVOT * np.abs(entry) + noise)
            leaving = _least_ratio(values, column, able)
        if not able.any():
            break
        basis[leaving] = entering
    return optimum


def _least_ratio(over: FloatArray, under: FloatArray, able: BoolArray) -> int:
    """Ratio test of the restricted master's simplex: of equal ratios the largest divisor."""
    ratio = np.where(able, np.maximum(over, 0.0), np.inf) / np.where(able, under, 1.0)
    return int(np.lexsort((-under, ratio))[0])


def _refined(inverse: FloatArray, square: FloatArray, right: FloatArray) -> FloatArray:
    """Dense solve of the restricted master's basis, with one step of refinement."""
    x = inverse @ right
    return np.asarray(x + inverse @ (right - square @ x))
