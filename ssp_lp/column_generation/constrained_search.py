"""Column generation (Dantzig-Wolfe) for several rows: prices from a master over known policies.

For prices y >= 0 the least of ``cost + y @ activity`` over all policies, minus ``y @ bounds``, is a
lower bound of the optimum (Lagrange); the policy that attains it enters the master wherever it
lies below the master's own valuation. Far from the optimum the master's prices zig-zag, so that
pricing happens in between them and the best prices known (Wentges 1997, "Weighted Dantzig-Wolfe
decomposition"); where that finds nothing new, at the master's prices themselves. Phase 1 is the
same search with the violation of the rows in place of the cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.master_optimum import MasterOptimum
from ssp_lp.column_generation.pricing.explicit import ExplicitPricing
from ssp_lp.column_generation.pricing.pricing_problem import Column
from ssp_lp.dynamic_programming.deadline import NEVER, Deadline, OutOfTimeError
from ssp_lp.dynamic_programming.work import Work

_ROUNDS = 2_000
_IN_BETWEEN = 0.5  # share of the best known prices in those that are tried

_TRIFLE = 1e-9  # of what policies take of a row: no bound is taken to be smaller
_SLIGHT = 1e-6  # worth of a row, relative to the objective, that a price in between may neglect
_ROUNDING = 1e-15  # relative, of weighted totals
_FEASIBLE = 1e-15
"""Sum of the rows' violations, relative to their sizes, that is no more than rounding."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows that are limited: which, by how much, and the size of their numbers."""

    index: IntArray  # [rows] position among the pricing problem's rewards
    bounds: FloatArray  # [rows]
    scales: FloatArray  # [rows] > 0
    ratio: float = 0.0  # what failing counts in the objective besides (Dinkelbach)

    def among(self, some: tuple[int, ...]) -> Rows:
        """Some of the rows, by position."""
        kept = list(some)
        return Rows(self.index[kept], self.bounds[kept], self.scales[kept], self.ratio)

    def objective(self, figures: FloatArray) -> FloatArray:
        """What is minimised of totals, the first of which are cost and failure, [...]."""
        return np.asarray(figures[0] + self.ratio * figures[1] if self.ratio else figures[0])

    def weights(self, prices: FloatArray, cost: float, n_rewards: int) -> FloatArray:
        """The weight of each reward at these prices, [rewards]."""
        weights = np.zeros(n_rewards)
        weights[self.index] = prices
        weights[0] = cost
        weights[1] += cost * self.ratio
        return weights


@dataclass(frozen=True)
class Pace:
    """How exactly to search, for how long, and whether the prices are stabilised."""

    tolerance: float  # relative gap
    deadline: float = np.inf  # on the clock of time.perf_counter
    in_between: float = _IN_BETWEEN
    report: Callable[[int, float, float], None] | None = None


@dataclass(eq=False)
class Pool:
    """The policies found so far, in every phase, and the work that it took."""

    pricing: ExplicitPricing
    columns: list[Column]
    calls: int = 0
    work: Work = field(default_factory=Work)

    @property
    def figures(self) -> FloatArray:
        """Totals of all policies, [rewards, columns]."""
        return np.stack([column.figures for column in self.columns], axis=1)

    def sizes(self, rows: Rows) -> FloatArray:
        """What is allowed of each row, or the most that a policy takes of it, [rows]."""
        taken = self.figures[rows.index].max(axis=1, initial=0.0)
        return np.asarray(np.maximum(rows.bounds, taken))

    def priced(self, weights: FloatArray, deadline: Deadline = NEVER) -> Column:
        """A policy of least weighted totals, from the known one that is best."""
        warm = self.columns[int(np.argmin(weights @ self.figures))]
        found = self.pricing.minimise(weights, warm, deadline=deadline)
        self.calls, self.work = self.calls + 1, self.work + found.work
        return found

    def add(self, found: Column) -> bool:
        """Keep a policy; false where one with the same totals is known."""
        if any(np.array_equal(found.figures, known.figures) for known in self.columns):
            return False
        self.columns.append(found)
        return True


@dataclass(frozen=True, eq=False)
class Generated:
    """The master's optimum when the search ended, and the prices of the best bound."""

    master: MasterOptimum
    prices: FloatArray  # [rows]
    bound: float  # of the optimum at these prices, uncertified
    finished: bool  # false: stopped by the time limit


def generate(
    pool: Pool,
    rows: Rows,
    pace: Pace,
    *,
    elastic: bool = False,
    centre: tuple[FloatArray, float] | None = None,
) -> Generated:
    """Add policies until the bound meets the master's optimum or nothing improves it.

    Args:
        pool: policies to begin with, some lottery over which keeps to the rows, unless elastic.
        rows: what is limited.
        pace: tolerance and limits.
        elastic: minimise the violation of the rows, each relative to its scale, not the cost.
        centre: prices that are thought to be good, [rows], and the bound there.
    """
    search = _Search(pool, rows, pace, 0.0 if elastic else 1.0)
    prices, bound = (np.zeros(len(rows.index)), 0.0) if centre is None else centre
    share = pace.in_between
    for _ in range(_ROUNDS):
        master = search.master(elastic)
        near = max(0.1 * pace.tolerance * master.value, 0.0)
        if master.value - bound <= near:
            share = 0.0
        tried = _between(prices, master, rows, pool.sizes(rows), share)
        if elastic and master.value <= _FEASIBLE:
            return Generated(master, master.prices, bound, finished=True)
        try:
            found, value = search.price(tried)
        except OutOfTimeError:
            break
        search.tell(tried, master.value)
        if value > bound:
            prices, bound = tried, value
        below = master.value - search.value(found, master.prices)
        new = below > max(near, search.rounding(found, master.prices)) and pool.add(found)
        if share == 0.0 and (not new or master.value - value <= near):
            return Generated(master, tried, value, finished=True)
        share = pace.in_between if new else 0.0
        if time.perf_counter() > pace.deadline:
            break
    return Generated(search.master(elastic), prices, bound, finished=False)


def _between(
    prices: FloatArray, master: MasterOptimum, rows: Rows, sizes: FloatArray, share: float
) -> FloatArray:
    """Prices between good ones and the master's; at a share of 0 the master's own, [rows]."""
    own = without_trifles(master.prices, sizes, master.value)
    if share == 0.0:
        return own
    return without_trifles(share * prices + (1.0 - share) * own, rows.scales, master.value, _SLIGHT)


@dataclass(frozen=True, eq=False)
class _Search:
    """One phase on a pool of policies."""

    pool: Pool
    rows: Rows
    pace: Pace
    cost: float  # weight of the cost: 0 in phase 1

    def master(self, elastic: bool) -> MasterOptimum:
        """The best lottery over the policies of the pool."""
        from ssp_lp.column_generation.restricted_master import solve_master

        figures, rows = self.pool.figures, self.rows
        kept = undominated(np.vstack([rows.objective(figures)[None, :], figures[rows.index]]))
        some = figures[:, kept]
        cost, taken = rows.objective(some), some[rows.index]
        best = solve_master(cost, taken, rows.bounds, rows.scales, elastic=elastic)
        weights = np.zeros(figures.shape[1])
        weights[kept] = best.weights
        return replace(best, weights=weights)

    def value(self, found: Column, prices: FloatArray) -> float:
        """Lagrangian value of a policy; what it takes of a row is counted from the bound."""
        beyond = found.figures[self.rows.index] - self.rows.bounds
        return self._objective(found) + float(prices @ beyond)

    def rounding(self, found: Column, prices: FloatArray) -> float:
        """Rounding of a policy's Lagrangian value."""
        beyond = np.abs(found.figures[self.rows.index] - self.rows.bounds)
        return _ROUNDING * (self._objective(found) + float(prices @ beyond))

    def _objective(self, found: Column) -> float:
        return self.cost * float(self.rows.objective(found.figures))

    def price(self, prices: FloatArray) -> tuple[Column, float]:
        """A best policy at these prices, and its Lagrangian value: a bound."""
        n_rewards = self.pool.pricing.rewards.shape[1]
        weights = self.rows.weights(prices, self.cost, n_rewards)
        found = self.pool.priced(weights, Deadline(self.pace.deadline))
        return found, self.value(found, prices)

    def tell(self, prices: FloatArray, value: float) -> None:
        """Report progress: calls, price of failure, objective so far."""
        if self.pace.report is not None:
            failure = float(prices[self.rows.index == 1].sum())
            objective = value if self.cost > 0.0 else np.inf
            self.pace.report(self.pool.calls, failure, objective)


def undominated(figures: FloatArray) -> IntArray:
    """Columns such that no other is at most as large in every row; the first of equal ones.

    Args:
        figures: [rows, columns].
    """
    at_most = (figures[:, :, None] <= figures[:, None, :]).all(axis=0)  # [which, than which]
    equal = at_most & at_most.T
    earlier = np.triu(equal, 1)
    return np.flatnonzero(~((at_most & ~equal) | earlier).any(axis=0))


def first_rows(pool: Pool, index: IntArray, bounds: FloatArray) -> Rows:
    """Rows with their scales: the bound, but no less than a trifle of what known policies take.

    Args:
        pool: some policies.
        index: of the limited rows among the rewards, [rows].
        bounds: [rows].
    """
    taken = pool.figures[index].max(axis=1, initial=0.0)
    scales = np.where(bounds > 0.0, np.maximum(bounds, _TRIFLE * taken), taken)
    return Rows(index, bounds, np.where(scales > 0.0, scales, 1.0))


def without_trifles(
    prices: FloatArray, sizes: FloatArray, objective: float, trifle: float = 1e-12
) -> FloatArray:
    """Prices too small to matter as 0: the rounding of a 0 would be a cycle's only cost, [rows].

    Args:
        prices: [rows].
        sizes: of each row: what policies take of it, for a price that is to prove a bound; what is
            allowed of it is not enough, since the saving of a policy that takes more counts.
        objective: to which a price's worth is compared.
        trifle: share of it that does not matter.
    """
    return np.where(prices * sizes <= trifle * abs(objective), 0.0, prices)


def relaxed(rows: Rows, excess: FloatArray) -> Rows:
    """Rows with their bounds raised by an excess in units of the scales, [rows]."""
    return replace(rows, bounds=rows.bounds + np.maximum(excess, 0.0) * rows.scales)
