"""The whole trade-off between cost and failure: the turning points of the optimal frontier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.arrays import BELOW_RATIO, LEAST_BUDGET, FloatArray
from ssp_lp.column_generation.failure_row import FailureRow, least_of
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem, Proof
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import Argument, InfeasibleError, ModelError, SolverError, optional_module
from ssp_lp.model.tables import html_table
from ssp_lp.options import Status
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, check_numbers, pulled_back
from ssp_lp.processes.failure_semantics import as_percentage

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 5  # points that a repr lists


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
    below: FloatArray  # [points - 1] no policy lies further below, as a share of the safer cost
    tolerance: float  # share below a segment up to which it was not split
    hidden: float  # share by which what a cap on the accumulated cost hides may lie below
    ratio: bool  # case S
    complete: bool  # whether it begins at the least failure, not at the steepest price asked for
    pricing_calls: int
    work: Work  # passes over the process
    _pricing: PricingProblem
    _columns: tuple[Column, ...]
    _problem: Problem | None = None  # as stated
    ends_early: bool = False  # whether tracing was stopped before it found the other end
    status: Status = Status.OPTIMAL

    @classmethod
    def through(
        cls,
        columns: Sequence[Column],
        below: Mapping[float, float],
        pricing: PricingProblem,
        **told: Any,
    ) -> Frontier:
        """The frontier through some columns, in any order.

        Args:
            columns: its turning points.
            below: how far below each segment policies may lie, by the failure at its safer end.
            pricing: what made the columns.
            told: the other fields, by name.
        """
        ordered = tuple(sorted(columns, key=lambda c: c.failure))
        failure, cost = np.array([c.failure for c in ordered]), np.array([c.cost for c in ordered])
        return cls(
            failure=failure,
            goal=np.array([c.goal for c in ordered]),
            cost=cost,
            price=-np.diff(cost) / np.diff(failure),
            below=np.array([below[column.failure] for column in ordered[:-1]]),
            hidden=0.0,
            _pricing=pricing,
            _columns=ordered,
            **told,
        )

    @property
    def gap(self) -> float:
        """No policy lies below a segment by more than this share of its safer end's cost."""
        return max(self.tolerance, self.hidden, float(self.below.max(initial=0.0)))

    @property
    def priced(self) -> dict[float, Column]:
        """The turning points that were found by pricing, by price."""
        return {c.found_at: c for c in self._columns if c.found_at is not None}

    @property
    def open_segments(self) -> tuple[int, ...]:
        """Numbers of the segments below which points may be missing; k lies from point k on."""
        found = np.flatnonzero(self.below > self.tolerance).tolist()
        return (*found, len(self.price)) if self.ends_early else tuple(found)

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    def objective_at(self, budget: float) -> float:
        """The least objective within a failure budget; no pricing call is made.

        Too high by at most ``tolerance`` times the cost at the safer end of the segment, in case S
        divided by 1 - budget: at budgets near 1 that may be a larger share of what is returned.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
            SolverError: tracing was cut short there, and a cheaper policy is known to exist; the
                message has :meth:`bounds_at`.
        """
        number, weight = self._locate(budget)
        share = self.hidden if weight == 0.0 else max(self.hidden, float(self.below[number]))
        share = np.inf if self.ends_early and number == len(self.price) else share
        if share > self.tolerance:
            low, high = self.bounds_at(budget)
            raise SolverError(
                f"the frontier is not settled at the budget {budget:g}: the least objective lies "
                f"between {_apart_on_curve(low, high)} (bounds_at); policy_at attains the latter. "
                "A higher ",
                Argument("point_limit"),
                " or ",
                Argument("time_limit"),
                " of trace_frontier settles more",
            )
        return self._attained(number, weight, FailureRow(budget, self.ratio))

    def bounds_at(self, budget: float) -> tuple[float, float]:
        """What the least objective within a failure budget surely lies between.

        The upper bound is what :meth:`policy_at` attains. The lower one is proved afresh, at the
        price of the segment, and where that is not settled also at those at which its ends are
        best: one to three pricing calls, remembered for every budget.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        row = FailureRow(budget, self.ratio)
        high = self._attained(number, weight, row)
        low = max(row.lower_bound(proof) for proof in self._proofs_near(number, weight))
        return least_of(low, high), high

    def _attained(self, number: int, weight: float, row: FailureRow) -> float:
        """Objective of a lottery over a turning point and the next one."""
        if weight == 0.0:
            return row.objective(float(self.cost[number]), float(self.goal[number]))
        ends = np.array([1.0 - weight, weight])
        pair = slice(number, number + 2)
        return row.objective(float(ends @ self.cost[pair]), float(ends @ self.goal[pair]))

    def _proofs_near(self, number: int, weight: float) -> list[Proof]:
        """What is proved at the prices that matter between a turning point and the next."""
        last = len(self._columns) - 1
        segments = {number} if weight > 0.0 else {max(number - 1, 0), number}
        proofs = [self._segment_proof(k) for k in segments]
        if any(k < last and self.below[k] > self.tolerance for k in segments):
            for point in (number,) if weight == 0.0 else (number, number + 1):
                price = self._columns[point].found_at
                if point == last:
                    proofs.append(self._segment_proof(last))
                elif price is not None:
                    proofs.append(self._proof(price, self._columns[point]))
        return proofs

    def _segment_proof(self, segment: int) -> Proof:
        """What is proved at a segment's price; beyond the last, at the price of the best policy."""
        column = self._columns[segment]
        if segment < len(self._columns) - 1:
            return self._proof(float(self.price[segment]), column)
        price = float(self.objective[-1]) * BELOW_RATIO if self.ratio else 0.0
        return self._proof(price, column, slack=self.ratio)

    def _proof(self, price: float, column: Column, *, slack: bool = False) -> Proof:
        """What is proved at a price; ``column`` is a policy that may be near to the best."""
        if (price, slack) not in self._proofs:
            proof = self._pricing.prove(price, column, slack=slack)
            self._proofs[price, slack] = replace(proof, values=np.zeros(0))  # only bounds are asked
        return self._proofs[price, slack]

    @cached_property
    def _proofs(self) -> dict[tuple[float, bool], Proof]:
        """Proofs by price, filled as they are asked for."""
        return {}

    def policy_at(self, budget: float) -> MixedPolicy:
        """The lottery of the two turning points around a budget; no pricing call is made.

        It attains the upper end of :meth:`bounds_at`, which is :meth:`objective_at` where settled.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        weights = np.ones(1) if weight == 0.0 else np.array([1.0 - weight, weight])
        some = self._columns[number : number + len(weights)]
        found = MixedPolicy(tuple(self._pricing.policy(column) for column in some), weights)
        return found if self._problem is None else pulled_back(found, self._problem)

    def plot(self, budget: float | None = None, *, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw the frontier: :func:`ssp_lp.plotting.plot_frontier`."""
        from ssp_lp.plotting.curves import plot_frontier

        return plot_frontier(self, budget, ax=ax, **style)

    def to_frame(self) -> Any:
        """The turning points as a pandas ``DataFrame``, a row for each.

        Columns: failure, goal, cost, objective; price and below of the segment that begins at the
        point, nan at the last.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        columns = {
            "failure": self.failure,
            "goal": self.goal,
            "cost": self.cost,
            "objective": self.objective,
            "price": np.append(self.price, np.nan),
            "below": np.append(self.below, np.nan),
        }
        return optional_module("pandas", "frames").DataFrame(columns)

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
        failure, value, count = self.failure, self.objective, len(self.open_segments)
        told = f", {count} segment{'s' * (count != 1)} open: {self.status}" if count else ""
        return (
            f"{len(failure):,} points, failure {failure[0]:.6g} .. {failure[-1]:.6g}, "
            f"objective {value[0]:.6g} .. {value[-1]:.6g}, gap {self.gap:.1e}{told}"
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
        check_numbers(budget=budget)
        if budget > 1.0 + LEAST_BUDGET:
            raise ModelError(f"budget must be a probability, not {budget!r}{as_percentage(budget)}")
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


def _apart_on_curve(low: float, high: float) -> str:
    """Two numbers with as many digits as tell them apart, or all of them."""
    digits = next((k for k in range(9, 17) if f"{low:.{k}g}" != f"{high:.{k}g}"), 17)
    return f"{low:.{digits}g} and {high:.{digits}g}"
