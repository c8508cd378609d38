"""The whole trade-off between cost and failure: the turning points of the optimal frontier."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, FloatArray
from ssp_lp.column_generation.failure_constraint import Row, least_of
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem, Proof
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.model.html_table import html_table
from ssp_lp.policies import MixedPolicy

_SHOWN = 5  # points that a repr lists

_BELOW = 1.0 - 2.5e-10
"""The share of the best ratio at which it is proved: there it is strictly best to fail."""


@dataclass(frozen=True, eq=False, repr=False)
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
    gap: float  # no policy lies below a segment by more than this share of its safer end's cost
    ratio: bool  # case S
    complete: bool  # whether it begins at the least failure, not at the steepest price asked for
    pricing_calls: int
    work: Work  # passes over the process
    _pricing: PricingProblem
    _columns: tuple[Column, ...]

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    def objective_at(self, budget: float) -> float:
        """Objective of :meth:`policy_at` within a failure budget; no pricing call is made.

        That is the least objective to ``gap``, and at a turning point exactly. Where tracing was
        cut short it may lie above the least one by more: :meth:`bounds_at` says between what.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        row = Row(budget, self.ratio)
        if weight == 0.0:
            return row.objective(float(self.cost[number]), float(self.goal[number]))
        ends = np.array([1.0 - weight, weight])
        pair = slice(number, number + 2)
        return row.objective(float(ends @ self.cost[pair]), float(ends @ self.goal[pair]))

    def bounds_at(self, budget: float) -> tuple[float, float]:
        """What the least objective within a failure budget surely lies between.

        The upper bound is :meth:`objective_at`. The lower one is proved afresh, at the price of
        the segment: one or two pricing calls, remembered for every budget on the segment.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        high, row = self.objective_at(budget), Row(budget, self.ratio)
        number, _ = self._locate(budget)
        segments = {number, number - 1} if budget <= float(self.failure[number]) else {number}
        low = max(row.lower_bound(self._proof(k)) for k in segments if k >= 0)
        return least_of(low, high), high

    def _proof(self, segment: int) -> Proof:
        """What is proved at a segment's price; beyond the last, at the price of the best policy."""
        if segment not in self._proofs:
            column = self._columns[segment]
            last = segment == len(self._columns) - 1
            price = 0.0 if last else float(self.price[segment])
            if last and self.ratio:
                price = float(self.objective[-1]) * _BELOW
            slack = last and self.ratio
            self._proofs[segment] = self._pricing.prove(price, column, slack=slack)
        return self._proofs[segment]

    @cached_property
    def _proofs(self) -> dict[int, Proof]:
        """Proofs by segment, filled as they are asked for."""
        return {}

    def policy_at(self, budget: float) -> MixedPolicy:
        """A policy that attains :meth:`objective_at`; no pricing call is made.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        if weight == 0.0:
            return MixedPolicy((self._pricing.policy(self._columns[number]),), np.ones(1))
        members = tuple(self._pricing.policy(c) for c in self._columns[number : number + 2])
        return MixedPolicy(members, np.array([1.0 - weight, weight]))

    def __repr__(self) -> str:
        """One line, and a few of the points."""
        rows = "".join(
            f"\n  failure {failure:<12} objective {objective:<12} price {price}"
            for failure, objective, price in self._some()
        )
        return f"Frontier({self._title}){rows}"

    def _repr_html_(self) -> str:
        """A few of the points as a table, for notebooks."""
        head = ("failure", "objective", "price from here on")
        return html_table(f"Frontier: {self._title}", self._some(), head)

    @property
    def _title(self) -> str:
        """How many points, from where to where, and how near."""
        failure, value = self.failure, self.objective
        return (
            f"{len(failure):,} points, failure {failure[0]:.6g} .. {failure[-1]:.6g}, "
            f"objective {value[0]:.6g} .. {value[-1]:.6g}, gap {self.gap:.1e}"
        )

    def _some(self) -> list[tuple[str, str, str]]:
        """Failure, objective and price from there on, of a few points from first to last."""
        count = len(self.failure)
        shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).round().astype(int))
        price = [f"{p:.6g}" for p in self.price] + ["-"]
        return [
            (f"{self.failure[k]:.6g}", f"{self.objective[k]:.6g}", price[k]) for k in shown.tolist()
        ]

    def _locate(self, budget: float) -> tuple[int, float]:
        """The turning point at or before the budget, and the weight of the next one."""
        least = float(self.failure[0])
        if not self.complete and not budget >= least:
            raise ModelError(
                f"the frontier was traced from failure {least:.12g} on, which the budget "
                f"{budget!r} is below; a steeper steepest_price traces more of it"
            )
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
