"""What is limited, and the policies that are known to a search within it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, weighted
from ssp_lp.column_generation.pricing.explicit_pricing import ExplicitPricing
from ssp_lp.column_generation.pricing.pricing_problem import Column, Proof, required
from ssp_lp.dynamic_programming.bellman import Work

_TRIFLE = 1e-9  # of what policies take of a row: no bound is taken to be smaller


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows that are limited: which, by how much, and the size of their numbers."""

    index: IntArray  # [rows] position among the pricing problem's rewards
    bounds: FloatArray  # [rows]
    scales: FloatArray  # [rows] > 0
    n_rewards: int
    ratio: float = 0.0  # what failing counts in the objective besides (Dinkelbach)

    def among(self, some: tuple[int, ...]) -> Rows:
        """Some of the pool's rows, by position."""
        kept = list(some)
        limited = self.index[kept], self.bounds[kept], self.scales[kept]
        return Rows(*limited, self.n_rewards, self.ratio)

    def relaxed(self, excess: FloatArray) -> Rows:
        """The rows with their bounds raised by an excess in units of the scales, [rows]."""
        return replace(self, bounds=self.bounds + np.maximum(excess, 0.0) * self.scales)

    def objective(self, figures: FloatArray) -> FloatArray:
        """What is minimised of totals in a pool, the first of which are cost and failure, [...]."""
        return np.asarray(figures[0] + self.ratio * figures[1] if self.ratio else figures[0])

    def weights(self, prices: FloatArray, cost: float = 1.0) -> FloatArray:
        """The weight of each reward at these prices, and at a weight of the cost, [rewards]."""
        weights = np.zeros(self.n_rewards)
        weights[self.index] = prices
        weights[0] = cost
        weights[1] += cost * self.ratio
        return weights


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
        """The size of each row's bound, or the most that a policy takes of it, [rows]."""
        taken = self.figures[rows.index].max(axis=1, initial=0.0)
        return np.asarray(np.maximum(np.abs(rows.bounds), taken))

    def best(self, weights: FloatArray) -> Column:
        """The known policy of least weighted totals."""
        return self.columns[int(np.argmin(weights @ self.figures))]

    def priced(self, weights: FloatArray) -> Column:
        """Price anew: a policy of least weighted totals, improved from the best known one."""
        found = self.pricing.minimise(weights, self.best(weights))
        self.calls, self.work = self.calls + 1, self.work + found.work
        return found

    def proved(self, weights: FloatArray) -> Proof:
        """A checked lower bound of every policy's weighted totals, lowered as little as can be."""
        best = self.pricing.minimise(weights, self.best(weights))
        return self.pricing.check(weights, weighted(required(best.totals), weights))

    def add(self, found: Column) -> bool:
        """Keep a policy; false where one with the same totals is known."""
        if any(np.array_equal(found.figures, known.figures) for known in self.columns):
            return False
        self.columns.append(found)
        return True

    def rows(self, index: IntArray, bounds: FloatArray) -> Rows:
        """Rows with their scales: the bound, but at least a trifle of what known policies take.

        Args:
            index: of the limited rows among the rewards, [rows].
            bounds: [rows].
        """
        taken = self.figures[index].max(axis=1, initial=0.0)
        shares = np.where(bounds > 0.0, _TRIFLE, 1.0)  # nothing can be kept to less than nothing
        scales = np.maximum(np.abs(bounds), shares * taken)
        scales = np.where(scales > 0.0, scales, 1.0)
        return Rows(index, bounds, scales, self.pricing.rewards.shape[1])
