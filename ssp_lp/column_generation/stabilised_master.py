"""The price rule of any number of rows: duals of a master over known policies, stabilised.

For prices y >= 0 the least of ``cost + y @ activity`` over all policies, minus ``y @ bounds``, is a
lower bound of the optimum (Lagrange); the policy that attains it enters the master wherever it
lies below the master's own valuation. Far from the optimum the master's prices zig-zag, so that
pricing happens in between them and the best prices known (Wentges 1997, "Weighted Dantzig-Wolfe
decomposition"); where that finds nothing new, at the master's prices themselves. Phase 1 is the
same search with the violation of the rows in place of the cost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.generation import Generated
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.pricing.pricing_problem import Column
from ssp_lp.column_generation.restricted_master import MasterOptimum, solve_master

_IN_BETWEEN = 0.5  # share of the best known prices in those that are tried
_SLIGHT = 1e-6  # worth of a row, relative to the objective, that a price in between may neglect
_ROUNDING = 1e-15  # relative, of weighted totals
_FEASIBLE = 1e-15
"""Sum of the rows' violations, relative to their sizes, that is no more than rounding."""


@dataclass(eq=False)
class StabilisedMaster:
    """One phase on a pool of policies, some lottery over which keeps to the rows, unless elastic.

    Elastic: minimise the violation of the rows, each relative to its scale, not the cost.
    """

    pool: Pool
    rows: Rows
    prices: FloatArray  # [rows] the best that are known, or thought to be good
    bound: float = 0.0  # of the optimum at these prices, uncertified
    elastic: bool = False
    in_between: float = _IN_BETWEEN
    share: float = field(init=False)  # of the best known prices in those that are tried next
    master: MasterOptimum = field(init=False)
    tried: FloatArray = field(init=False)  # [rows] prices of the last pricing call

    most_rounds: ClassVar[int] = 2_000

    def __post_init__(self) -> None:
        """Begin with prices in between."""
        self.share = self.in_between

    @property
    def calls(self) -> int:
        """Pricing calls so far, those of earlier phases included."""
        return self.pool.calls

    def seek(self, tolerance: float) -> Column | None:
        """A best policy at prices in between; None where all rows are kept in phase 1."""
        self.master = self._solved()
        if self.master.value - self.bound <= self._near(tolerance):
            self.share = 0.0
        if self.elastic and self.master.value <= _FEASIBLE:
            self.prices = self.master.prices
            return None
        self.tried = self._between()
        weights = self.rows.weights(self.tried, 0.0 if self.elastic else 1.0)
        return self.pool.priced(weights)

    def told(self) -> tuple[float, float]:
        """The price of failure, and the objective so far."""
        failure = float(self.tried[self.rows.index == 1].sum())
        return failure, np.inf if self.elastic else self.master.value

    def learn(self, found: Column, tolerance: float) -> bool:
        """Keep the better bound and a policy that lies below the master's valuation."""
        best, near = self.master.value, self._near(tolerance)
        value = self._value(found, self.tried)
        beyond = np.abs(found.figures[self.rows.index] - self.rows.bounds)
        rounding = _ROUNDING * (self._objective(found) + float(self.master.prices @ beyond))
        below = best - self._value(found, self.master.prices)
        new = below > max(near, rounding) and self.pool.add(found)
        finished = self.share == 0.0 and (not new or best - value <= near)
        if finished or value > self.bound:
            self.prices, self.bound = self.tried, value
        self.share = self.in_between if new else 0.0
        return finished

    def concluded(self, tolerance: float, *, finished: bool) -> Generated:
        """The master's lottery, and the bound at the best prices."""
        master = self.master if finished else self._solved()
        used = np.flatnonzero(master.weights > 0.0)
        columns = tuple(self.pool.columns[k] for k in used.tolist())
        bound, weights = self.bound, master.weights[used]
        return Generated(
            columns, weights, self.prices, master.value, bound, finished, excess=master.excess
        )

    def _near(self, tolerance: float) -> float:
        """A gap that is small enough to go on without stabilisation, or to end."""
        return max(0.1 * tolerance * self.master.value, 0.0)

    def _between(self) -> FloatArray:
        """Prices between good ones and the master's; at a share of 0 the master's own, [rows]."""
        best, share = self.master.value, self.share
        own = without_trifles(self.master.prices, self.pool.sizes(self.rows), best)
        if share == 0.0:
            return own
        mixed = share * self.prices + (1.0 - share) * own
        return without_trifles(mixed, self.rows.scales, best, _SLIGHT)

    def _solved(self) -> MasterOptimum:
        """The best lottery over the policies of the pool."""
        figures, rows = self.pool.figures, self.rows
        kept = undominated(np.vstack([rows.objective(figures)[None, :], figures[rows.index]]))
        some = figures[:, kept]
        cost, taken = rows.objective(some), some[rows.index]
        best = solve_master(cost, taken, rows.bounds, rows.scales, elastic=self.elastic)
        weights = np.zeros(figures.shape[1])
        weights[kept] = best.weights
        return replace(best, weights=weights)

    def _value(self, found: Column, prices: FloatArray) -> float:
        """Lagrangian value of a policy; what it takes of a row is counted from the bound."""
        beyond = found.figures[self.rows.index] - self.rows.bounds
        return self._objective(found) + float(prices @ beyond)

    def _objective(self, found: Column) -> float:
        """The objective of a policy in the master."""
        return 0.0 if self.elastic else float(self.rows.objective(found.figures))


def violation_in_master(pool: Pool, rows: Rows) -> StabilisedMaster:
    """Phase 1: the lottery that violates the rows least is sought."""
    return StabilisedMaster(pool, rows, np.zeros(len(rows.index)), elastic=True)


def undominated(figures: FloatArray) -> IntArray:
    """Columns of a master such that no other is at most as large in every row.

    Args:
        figures: [rows, columns].
    """
    at_most = (figures[:, :, None] <= figures[:, None, :]).all(axis=0)  # [which, than which]
    equal = at_most & at_most.T
    earlier = np.triu(equal, 1)
    return np.flatnonzero(~((at_most & ~equal) | earlier).any(axis=0))


def without_trifles(
    prices: FloatArray, sizes: FloatArray, objective: float, trifle: float = 1e-12
) -> FloatArray:
    """The master's prices with those too small to matter as 0, [rows].

    Args:
        prices: [rows].
        sizes: of each row: what policies take of it, for a price that is to prove a bound; what is
            allowed of it is not enough, since the saving of a policy that takes more counts.
        objective: to which a price's worth is compared.
        trifle: share of it that does not matter.
    """
    return np.where(prices * sizes <= trifle * abs(objective), 0.0, prices)
