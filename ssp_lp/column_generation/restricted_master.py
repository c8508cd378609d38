"""The restricted master with several rows: a small linear program over the known columns.

    minimise    sum_j w_j cost_j  (+ sum_k e_k)
    subject to  sum_j w_j (activity_kj - bound_k) (- scale_k e_k) <= 0
                sum_j w_j = 1,   w, e >= 0

Since the weights sum to one, the bounds are subtracted from the activities, so that small
differences between policies near a large bound are kept. With ``elastic`` the e_k measure the
violation of the rows in units of their scales, and costs are left out (phase 1).

The simplex method starts from one policy:

- The cheapest policy with the slacks of all rows is a dual feasible basis with prices 0: dual steps
  follow until no weight is negative.
- If elastic, the policy of least violation with the excesses of the rows that it violates is a
  primal feasible basis: primal steps follow.

If rounding makes the basis infeasible, steps of the other kind repair it. A basis is small (one
variable more than there are rows), so each step recomputes its inverse. If steps cycle, the rule
that chooses the entering variable changes. If cycling continues, the basis of least infeasibility
is returned.

The final basis is checked for primal feasibility, relative to each bound, and for dual feasibility.
If either fails, because a limit is tiny compared with the activities, exact steps in fractions
continue from that basis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray
from ssp_lp.errors import SolverError

_NEGATIVE = 1e-14
"""Tolerance of a negative basic weight, divided by the policy's largest entry."""

_BROKEN = 4.0 * MACHINE_EPSILON
"""Feasibility tolerance of a row, relative to its scale."""

_TIED = 1e-14  # relative to its summands: a smaller reduced cost is 0
_PIVOT = 1e-13  # relative to its summands: a smaller pivot is 0
_CIRCLES = 10  # most cycles of bases, each with other entering variables preferred
_GOLDEN = 0.618  # its multiples mod 1 are spread evenly: preferences of entering variables

_KEPT = 1e-13
"""Relative tolerance in floating point: of a row's bound, and between primal and dual value. A
tenth of the library's tolerance."""

_ROOM = 4.0 * MACHINE_EPSILON
"""Relative tolerance of a bound in fractions, since the policies' totals are rounded sums."""

_MOST_STEPS = 10_000  # in fractions, where Bland's rule excludes cycles


@dataclass(frozen=True, eq=False)
class MasterOptimum:
    """An optimum of the restricted master: weights of the policies and prices of the rows.

    The number of positive weights is at most one more than the number of tight rows.
    """

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
        activity: value of each policy in each row, [rows, columns].
        bounds: [rows].
        scales: magnitude of each row, > 0, [rows].
        elastic: minimise the violation instead of the cost.

    Raises:
        SolverError: a basis is singular, because its numbers differ too much in size.
    """
    n_rows, n_columns = activity.shape
    cost = np.zeros(n_columns) if elastic else cost
    unit = float(np.abs(cost).max(initial=0.0)) or 1.0
    beyond, units = activity - bounds[:, None], scales
    if not elastic:  # largest distance of the activities from each bound
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
    x, dual, basis = _by_simplex(priced, matrix, basis, rounding, np.append(broken, 0.0))
    weights = np.where(x[:n_columns] > _NEGATIVE, x[:n_columns], 0.0)
    prices = unit * np.maximum(-dual[:n_rows], 0.0) / units
    excess = x[n_columns : n_columns + n_rows] if elastic else np.zeros(n_rows)
    program = _Program(cost, activity, bounds, scales, elastic)
    optimum = program.optimum(weights / weights.sum(), prices, excess)
    if not program.is_settled(optimum):
        optimum = program.solved_in_fractions(basis.tolist()) or optimum
    return optimum


@dataclass(frozen=True, eq=False)
class _Program:
    """The restricted master before scaling, for exact checks and steps.

    Its variables are, in this order: the weights of the policies, the excesses of the rows (if
    elastic), and the slacks of the rows.
    """

    cost: FloatArray  # [columns]
    activity: FloatArray  # [rows, columns]
    bounds: FloatArray  # [rows]
    scales: FloatArray  # [rows] > 0
    elastic: bool

    def optimum(self, weights: FloatArray, prices: FloatArray, excess: FloatArray) -> MasterOptimum:
        """Return the weights, prices and excesses with their objective value."""
        value = float(excess.sum()) if self.elastic else float(self.cost @ weights)
        return MasterOptimum(value, weights, prices, excess)

    def is_settled(self, optimum: MasterOptimum) -> bool:
        """Return whether an optimum is primal and dual feasible, within relative tolerances."""
        weights, prices = optimum.weights, optimum.prices
        over = self.activity @ weights - self.bounds - optimum.excess * self.scales
        if not (over <= _KEPT * np.abs(self.bounds)).all():
            return False
        beyond = self.activity - self.bounds[:, None]
        worth, size = self.cost + prices @ beyond, np.abs(self.cost) + prices @ np.abs(beyond)
        least = float((worth + 2.0 * MACHINE_EPSILON * size).min())
        return bool(optimum.value - least <= _KEPT * abs(optimum.value))

    def solved_in_fractions(self, basis: list[int]) -> MasterOptimum | None:
        """Solve the program by simplex steps in fractions; return None if they find no optimum.

        Args:
            basis: indices of the variables of the first basis, [rows + 1].
        """
        n_rows, n_columns = self.activity.shape
        granted = self.bounds + _ROOM * np.abs(self.bounds)
        exact = ExactSimplex(self._entries(granted), self._costs())
        final = exact.solved(basis)
        if final is None:
            final = exact.solved(self._first_basis(granted))
        if final is None:
            return None
        x, dual = exact.values(final), exact.duals(final)
        stated = ExactSimplex(self._entries(self.bounds), exact.cost).values(final)
        values = np.zeros(len(exact.cost))
        values[final] = [float(max(each, Fraction(0))) for each in stated]
        if min(stated) < 0:  # feasible within the tolerance only: clip at 0 if that stays feasible
            left = values[:n_columns] / values[:n_columns].sum()
            excess = values[n_columns : n_columns + n_rows] * self.elastic
            if (self.activity @ left - excess * self.scales > granted).any():
                values[final] = [float(each) for each in x]
        weights = values[:n_columns]
        prices = np.array([max(-float(each), 0.0) for each in dual[:n_rows]])
        excess = values[n_columns : n_columns + n_rows] if self.elastic else np.zeros(n_rows)
        return self.optimum(weights / weights.sum(), prices, excess)

    def _entries(self, bounds: FloatArray) -> list[list[Fraction]]:
        """Return the entries of the variables in the rows, [variables][rows + 1]."""
        n_rows, zero, one = len(bounds), Fraction(0), Fraction(1)
        limits = [Fraction(bound) for bound in bounds.tolist()]

        def unit(row: int, entry: Fraction) -> list[Fraction]:
            return [entry if k == row else zero for k in range(n_rows + 1)]

        entries = [
            [*(Fraction(a) - b for a, b in zip(taken, limits, strict=True)), one]
            for taken in self.activity.T.tolist()
        ]
        if self.elastic:
            entries += [unit(k, -Fraction(s)) for k, s in enumerate(self.scales.tolist())]
        return entries + [unit(k, one) for k in range(n_rows)]

    def _costs(self) -> list[Fraction]:
        """Return the costs of the variables, [variables]."""
        n_rows = len(self.bounds)
        costs = [Fraction(c) for c in self.cost.tolist()] + [Fraction(1)] * (n_rows * self.elastic)
        return costs + [Fraction(0)] * n_rows

    def _first_basis(self, granted: FloatArray) -> list[int]:
        """Return the starting basis: one policy, with slacks or excesses, [rows + 1]."""
        n_rows, n_columns = self.activity.shape
        beyond = self.activity - granted[:, None]
        over = (np.maximum(beyond, 0.0) / self.scales[:, None]).sum(axis=0)
        best = int(np.argmin(over if self.elastic else self.cost))
        slacks = n_columns + n_rows * self.elastic + np.arange(n_rows)
        return [*(slacks - n_rows * self.elastic * (beyond[:, best] > 0.0)).tolist(), best]


class ExactSimplex:
    """Simplex in fractions: min ``cost @ x``, ``entries.T @ x == (0, ..., 0, 1)``, x >= 0.

    The first variable that may enter or leave is taken (Bland's rule), so that the steps end.
    """

    def __init__(self, entries: Sequence[Sequence[Fraction]], cost: Sequence[Fraction]) -> None:
        """Store the entries, [variables][rows], and the costs, [variables]."""
        self.entries, self.cost = entries, cost

    def values(self, basis: Sequence[int]) -> list[Fraction]:
        """Return the values of the basic variables, [rows]."""
        rows = list(zip(*(self.entries[j] for j in basis), strict=True))
        return _solved(rows, [Fraction(int(k == len(rows) - 1)) for k in range(len(rows))])

    def duals(self, basis: Sequence[int]) -> list[Fraction]:
        """Return the duals of the rows, [rows]."""
        return _solved([self.entries[j] for j in basis], [self.cost[j] for j in basis])

    def solved(self, basis: Sequence[int]) -> list[int] | None:
        """Return an optimal basis, [rows], by simplex steps from a given basis.

        The result is None if there is no optimal basis, or if a basis on the way is neither primal
        nor dual feasible.
        """
        basis = list(basis)
        for _ in range(_MOST_STEPS):
            try:
                values, dual = self.values(basis), self.duals(basis)
            except ZeroDivisionError:
                return None
            inside, reduced = set(basis), [c - _dot(dual, e) for c, e in self._variables()]
            short = (
                min((j, k) for k, j in enumerate(basis) if values[k] < 0)
                if min(values) < 0
                else None
            )
            cheaper = next((j for j, r in enumerate(reduced) if r < 0 and j not in inside), None)
            if short is None and cheaper is None:
                return basis
            if short is not None and cheaper is not None:
                return None
            rows = list(zip(*(self.entries[j] for j in basis), strict=True))
            if cheaper is not None:  # a primal step
                along = _solved(rows, list(self.entries[cheaper]))
                able = [(values[k] / a, basis[k], k) for k, a in enumerate(along) if a > 0]
                if not able:
                    return None
                basis[min(able)[2]] = cheaper
                continue
            place = short[1] if short is not None else 0
            unit = [Fraction(int(k == place)) for k in range(len(basis))]
            among = _solved([self.entries[j] for j in basis], unit)
            turns = [(j, _dot(among, e)) for j, (_, e) in enumerate(self._variables())]
            falling = [(reduced[j] / -t, j) for j, t in turns if t < 0 and j not in inside]
            if not falling:
                return None
            basis[place] = min(falling)[1]
        return None

    def _variables(self) -> zip[tuple[Fraction, Sequence[Fraction]]]:
        """Return pairs of cost and entries, one for each variable."""
        return zip(self.cost, self.entries, strict=True)


def _dot(one: Sequence[Fraction], other: Sequence[Fraction]) -> Fraction:
    return sum((a * b for a, b in zip(one, other, strict=True) if a and b), Fraction(0))


def _solved(rows: Sequence[Sequence[Fraction]], rhs: Sequence[Fraction]) -> list[Fraction]:
    """Solve linear equations in fractions; raise ZeroDivisionError if they are singular."""
    table = [[*row, b] for row, b in zip(rows, rhs, strict=True)]
    for k in range(len(table)):
        pivot = next((i for i in range(k, len(table)) if table[i][k]), k)
        table[k], table[pivot] = table[pivot], table[k]
        head = table[k][k]
        table[k] = [each / head for each in table[k]]
        for i, row in enumerate(table):
            if i != k and (factor := row[k]):
                table[i] = [a - factor * b if b else a for a, b in zip(row, table[k], strict=True)]
    return [row[-1] for row in table]


def _by_simplex(
    cost: FloatArray, matrix: FloatArray, basis: IntArray, rounding: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Simplex in floating point: min ``cost @ x``, ``matrix @ x == (0, ..., 0, 1)``, x >= 0.

    Args:
        cost: [variables].
        matrix: [rows, variables].
        basis: starting basis, [rows]; updated in place.
        rounding: tolerance of negative values, [variables].
        noise: rounding error of the entries of each row, [rows].

    Returns:
        The optimal values, [variables], the rows' duals, [rows], and the basis, [rows].
    """
    n_rows = len(matrix)
    rhs = np.eye(n_rows)[-1]
    visited, circles, least = set[bytes](), 0, np.inf
    while circles < _CIRCLES:
        if (key := np.sort(basis).tobytes()) in visited:
            visited, circles = set(), circles + 1
        visited.add(key)
        square = matrix[:, basis]
        try:
            inverse = np.asarray(np.linalg.inv(square), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise SolverError("limits differ too much in size: scale the quantities") from error
        values, x = _refined(inverse, square, rhs), np.zeros(cost.size)
        x[basis] = np.maximum(values, 0.0)
        dual = _refined(inverse.T, square.T, cost[basis])
        reduced = cost - dual @ matrix
        reduced[basis] = 0.0
        tied = np.abs(reduced) < _TIED * (np.abs(cost) + np.abs(dual) @ np.abs(matrix))
        reduced = np.where(tied, 0.0, reduced)
        short = values + rounding[basis]
        if not (lack := -min(short.min(), reduced.min())) >= least:
            least, optimum = lack, (x, dual, basis.copy())
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
    """Return the index of the least ``over / under`` among the entries of ``able`` (ratio test).

    Among equal ratios it is the index of the largest divisor.
    """
    ratio = np.where(able, np.maximum(over, 0.0), np.inf) / np.where(able, under, 1.0)
    return int(np.lexsort((-under, ratio))[0])


def _refined(inverse: FloatArray, square: FloatArray, rhs: FloatArray) -> FloatArray:
    """Return ``inverse @ rhs`` with one step of iterative refinement."""
    x = inverse @ rhs
    return np.asarray(x + inverse @ (rhs - square @ x))
