"""A constrained problem's process with its rows: the failure budget and the secondary costs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.compiled_problems.failure_label import CompiledFailureLabel
from ssp_lp.column_generation.pricing.constrained import ConstrainedPricing
from ssp_lp.model import SSP
from ssp_lp.processes.failure_label import label_failure, secondary_cost
from ssp_lp.processes.failure_semantics import FailureSemantics, survival_of
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.secondary_costs import FAILURE_ROW, SideRow

ATTAINABLE = 1e-10
"""A bound this much below the least attainable total, relative to it, counts as equal to it."""


@dataclass(frozen=True, eq=False)
class CompiledConstrained:
    """Minimise cost, failure and secondary costs limited; a budget of None: at least failure."""

    model: SSP
    start: FloatArray  # [states]
    semantics: FailureSemantics
    discount: float | None
    side: tuple[SideRow, ...]
    budget: float | None
    precise: bool = False  # compare pairs in twice the working precision

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: the failure row, limited or not, then the secondary costs."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each row, infinite where nothing is limited, [rows]."""
        unlimited = self.budget is None or self.budget >= 1.0
        budget = np.inf if unlimited or self.budget is None else max(self.budget, 0.0)
        return np.array([budget, *(row.bound for row in self.side)])

    @cached_property
    def least(self) -> LeastFailure:
        """The policy of least failure that is cheapest, whatever its secondary costs.

        Raises:
            InfeasibleError: the budget is below it.
        """
        label = CompiledFailureLabel(self.model, self.start, self.semantics, self.discount)
        return checked_least_failure(label, self.budget)

    def settled(self) -> CompiledConstrained:
        """The compiled at least failure, where the budget does not exceed that.

        However little it exceeds it, failing may be worth much more than that is.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding.
        """
        if self.budget is None or self.budget >= 1.0:
            return self
        at_least = self.budget <= self.least.column.failure
        return replace(self, budget=None) if at_least else self

    @cached_property
    def _usable(self) -> BoolArray | None:
        """Pairs that attain the least failure, where only they may be used, [model pairs]."""
        if self.budget is not None:
            return None
        return greatest_goal_reach(self.model, survival_of(self.discount)).usable

    @cached_property
    def pricing(self) -> ConstrainedPricing:
        """Policy iteration on the process, in which only what is free in all costs is collapsed."""
        shared = np.ones(self.model.n_pairs, dtype=np.bool_)
        for row in self.side:
            shared &= row.free
        setting = self.start, self.semantics, self.discount
        labelled = label_failure(self.model, *setting, self._usable, shared)
        process = labelled.process
        costs = [secondary_cost(labelled, row.model, *setting) for row in self.side]
        rewards = np.stack([process.cost, process.failure, *costs], axis=1)
        return ConstrainedPricing(labelled, rewards, self.precise)


def lagrange_bound(least: float, prices: FloatArray, bounds: FloatArray) -> float:
    """The lower bound ``least - prices @ bounds``, rounding counted against it.

    Args:
        least: certified bound of ``cost + prices @ activity`` of every policy.
        prices: >= 0, [rows].
        bounds: [rows].
    """
    paid = float(prices @ bounds)
    return least - paid - (len(prices) + 1.0) * MACHINE_EPSILON * paid
