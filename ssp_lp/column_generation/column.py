"""Columns, the pricing problem that makes them, and the failure row that limits them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.failure_semantics import RARE_GOAL, GoalShare

_Array = TypeVar("_Array", bound=npt.NDArray[Any])


@dataclass(frozen=True, eq=False)
class Column:
    """A deterministic policy with its exact expected cost and failure from the start.

    In case S ``cost`` is E[total cost; goal]. With a discount, cost and failure are discounted.
    """

    cost: float
    failure: float
    goal: float  # 1 - failure, computed separately: the smaller of the two is exact
    choice: IntArray | None  # the policy, as an array of the pricing problem
    tail_price: float = 0.0  # case S: the failure price at which tails beyond the cap are chosen
    policy: Policy | None = None  # the policy on the model, if pricing did not find it
    totals: FloatArray | None = None  # [states, rewards] expected from each state; a warm start
    found_at: float | None = None  # a price at which it is optimal in its process
    work: Work = field(default_factory=Work)  # the work of finding it
    rows: tuple[float, ...] = ()  # its value in each row other than the failure row
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure
    by_layer: FloatArray | None = None
    """Case S, for an episode that begins in each layer with nothing paid: the least cost - price *
    goal, and the cost, failure and goal from the start's nodes, or nan, [layers, 4]."""
    swept: Column | None = None  # case S: the column of the sweep that found it, if another one
    beyond: Column | None = None  # the policy beyond the layers, if these have no tails

    @classmethod
    def of_rewards(
        cls, rewards: FloatArray, choice: IntArray | None, *, by_goal: bool = False, **more: Any
    ) -> Column:
        """Return a column with given rewards.

        Args:
            rewards: cost, failure (or minus goal) and further rows, [rewards]; failure and goal are
                clipped to [0, 1].
            choice: the policy, as an array of the pricing problem, or None.
            by_goal: whether the second reward is minus the goal probability.
            more: further fields of the column.
        """
        cost, counted, *rows = rewards.tolist()
        counted = min(max(-counted if by_goal else counted, 0.0), 1.0)
        failure, goal = (1.0 - counted, counted) if by_goal else (counted, 1.0 - counted)
        return cls(cost, failure, goal, choice, rows=tuple(rows), by_goal=by_goal, **more)

    @cached_property
    def rewards(self) -> FloatArray:
        """Rewards, [rewards]: cost, failure (or minus success), and value of each further row."""
        return np.array([self.cost, -self.goal if self.by_goal else self.failure, *self.rows])


def excess_failure(risky: Column, safe: Column) -> float:
    """Return ``risky.failure - safe.failure`` without cancellation."""
    if max(risky.goal, safe.goal) < 0.5:
        return safe.goal - risky.goal
    return risky.failure - safe.failure


@dataclass(frozen=True, eq=False)
class Proof:
    """A certified dual bound: no policy has a lower value at this price of failure.

    The value of a policy is ``cost + failing * failure - (price - failing) * goal``. There are two
    forms:

    - ``failing == price``: the value is ``cost + price * failure``.
    - ``failing == 0``: the value is ``cost - price * goal``. This form is used in case S if the
      budget is slack, because it loses no digits where failing is optimal.
    """

    price: float
    failing: float
    bound: float  # at the start
    values: FloatArray  # the checked sub-solution that gives it, [value_shape]
    work: Work = field(default_factory=Work)
    choice: IntArray | None = None  # case S, if values were checked: their policy
    by_layer: FloatArray | None = None  # [layers] the bound for an episode that begins in each


def required(part: _Array | None) -> _Array:
    """Return a field of a column, the choice or the totals, after a check that it is not None.

    Raises:
        ModelError: the field is None, because the column was not made by a pricing problem.
    """
    if part is None:
        raise ModelError("the column has no choice or totals: pass one that pricing returned")
    return part


class PricingProblem(ABC):
    """Minimises ``cost + failure_price * failure`` over policies, and evaluates the policy found.

    Implementations work on an explicit process, on layers of accumulated cost, or on states that
    are distributed over several computers.
    """

    by_goal: bool = False  # the second reward is minus the goal probability instead of failure

    @property
    @abstractmethod
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and one per further limit."""

    def counting_success(self) -> Self:
        """Return this pricing problem with failure replaced by minus success, if supported."""
        return self

    @property
    @abstractmethod
    def value_shape(self) -> tuple[int, ...]:
        """Shape of the value functions that ``check`` takes."""

    def incumbent(self, reached: Any) -> Column | None:
        """Return the column of the policy that a stopped pricing call had reached, or None.

        Args:
            reached: the stopped computation, as the Stop exception carries it.
        """
        return None

    @abstractmethod
    def first(self) -> Column:
        """Return a column that is cheap to find and reaches the goal if possible."""

    @abstractmethod
    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Solve the pricing problem: return a column of least priced cost, evaluated exactly.

        Args:
            price: price of failure, or the weight of each reward, [rewards].
            warm: policies to start from, the presumably nearest first; None entries are ignored.

        Raises:
            Stop: the time limit was reached; it carries the incumbent policy, if any.
        """

    @property
    def covered_price(self) -> float:
        """Greatest price of failure at which a pricing call also solves all lower prices, or 0."""
        return 0.0

    def nearby_columns(self, column: Column, row: FailureRow) -> tuple[Column, ...]:
        """Return columns that are optimal at lower prices, and fail about as often as allowed.

        They are by-products of the pricing call that found ``column``.
        """
        return ()

    def policy_failing(
        self, column: Column, failure: float, tried: set[int], *, above: bool
    ) -> Policy | None:
        """Return a policy of about a given failure probability, or None if none is known.

        The policy is a by-product of the pricing call that found ``column``.
        """
        return None

    def reevaluated(self, columns: Sequence[Column]) -> list[Column] | None:
        """Return columns of a process with a lower cap, re-evaluated for this process.

        The result is None if the process has no cap on accumulated cost.
        """
        return None

    def true_cost(self, column: Column) -> float | None:
        """Return the exact cost of a column on the model, without a cap; None if it is unknown."""
        return None

    @abstractmethod
    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove a dual bound: a lower bound of the priced value of every column.

        Args:
            price: price of failure, or the weight of each reward, [rewards].
            best: an optimal policy at this price.
            slack: use the form ``cost - price * goal`` (:class:`Proof`).
        """

    def minimise_and_prove(self, weights: FloatArray, warm: Column) -> Proof:
        """Solve the pricing problem at new weights, and prove the dual bound there."""
        return self.prove(weights, warm)

    @abstractmethod
    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Prove a dual bound from a given value function.

        The values are lowered until they are a sub-solution: no backup decreases them. Then they
        bound the priced value of every policy from below.

        Args:
            price: price of failure.
            values: near-optimal values, of shape ``value_shape``.
            slack: use the form ``cost - price * goal`` (:class:`Proof`).

        Raises:
            ModelError: values have the wrong shape.
        """

    @property
    def infinite(self) -> FloatArray:
        """Infinite values, for a ``check`` without a value function, [value_shape].

        ``check`` lowers them to the best bound that it can prove.
        """
        return np.broadcast_to(np.inf, self.value_shape)

    def policy(self, column: Column) -> Policy:
        """Return the policy of a column, on the states of the model."""
        return self.pulled_back(column) if column.policy is None else column.policy

    @abstractmethod
    def pulled_back(self, column: Column) -> Policy:
        """Translate the choice of a column to a policy on the states of the model."""

    def check_shape(self, values: FloatArray) -> None:
        """Check that values have the shape ``value_shape``; else raise :class:`ModelError`."""
        if values.shape != self.value_shape:
            raise ModelError(f"values of a wrong shape: pass an array of {self.value_shape}")


def pricing_weights(price: float | FloatArray) -> FloatArray:
    """Return the weight of each reward, [rewards], for a price of failure or weights."""
    return price if isinstance(price, np.ndarray) else np.array([1.0, price])


_ROUNDED = 4.0 * MACHINE_EPSILON  # relative rounding error of a bound and of price * budget
_TINY = 1e-12  # absolute tolerance of costs near 0
_SAME = 4.0 * MACHINE_EPSILON
"""Relative difference of failures, or rare successes, due to the order of summation."""


@dataclass(frozen=True)
class FailureRow:
    """The failure row of the restricted master, and whether the objective is a ratio."""

    budget: float
    ratio: bool
    lowest: float = 0.0  # a lower bound of every objective
    required: float = field(init=False)  # least goal probability that the budget requires
    by_goal: bool = field(init=False)  # columns count the goal: the smaller number is exact
    is_rare: bool = field(init=False)  # demanded is small: the goal replaces failure in the rewards
    rounding: float = field(init=False)  # feasibility tolerance: rounding of failure and budget

    def __post_init__(self) -> None:
        budget = self.budget
        demanded = budget.required if isinstance(budget, GoalShare) else 1.0 - budget
        follows = vars(self)
        follows["by_goal"] = demanded < 0.5
        follows["required"], follows["is_rare"] = demanded, 0.0 < demanded < RARE_GOAL
        follows["rounding"] = _SAME * max(min(budget, demanded), 0.0)

    def raised_to(self, least: Column) -> FailureRow:
        """Return the failure row with a budget of at least the least failure."""
        return self if self.slack(least) >= 0.0 else self.with_budget_of(least)

    def with_budget_of(self, least: Column) -> FailureRow:
        """Return the failure row whose budget is the failure of the safest column."""
        return replace(self, budget=GoalShare(least.goal) if self.is_rare else least.failure)

    def slack(self, column: Column) -> float:
        """Return the budget minus a column's failure; negative if the budget is violated.

        For budgets near 1 it is computed from goal probabilities, without cancellation.
        """
        return column.goal - self.required if self.by_goal else self.budget - column.failure

    def equals_least(self, least: Column) -> bool:
        """Return whether the budget equals the least failure within rounding."""
        return self.slack(least) <= self.rounding

    def is_violated_by(self, column: Column) -> bool:
        """Return whether a column violates the budget by more than rounding."""
        return self.slack(column) < -self.rounding

    def objective(self, cost: float, goal: float) -> float:
        """Return the objective of a lottery with this cost and goal probability."""
        if not self.ratio:
            return cost
        return cost / goal if goal > 0.0 else np.inf

    def lower_bound(self, proof: Proof) -> float:
        """Return a lower bound of the objective of all policies within the budget, from a proof.

        Case M: cost + price * failure >= bound gives cost >= bound - price * budget.

        Case S: the proof gives cost >= c * goal, a bound c of the ratio. If bound >= price, c is
        the bound. Otherwise c = (bound - price * budget) / (1 - budget), since failure <= budget.

        With ``proof.failing == 0`` the proof bounds cost - price * goal, which is lower by the
        price, as failure is 1 - goal. This form loses no digits if the budget is slack or success
        is rare.
        """
        bound, price, share = proof.bound, proof.price, self.required
        worth = price * (share if proof.failing == 0.0 else self.budget)
        rounding = _ROUNDED * (abs(bound) + worth) if worth > 0.0 else 0.0
        if not self.ratio:
            lower_bound = bound - rounding + (worth if proof.failing == 0.0 else -worth)
        elif proof.failing == 0.0:
            beyond = bound if bound >= 0.0 else _per_success(bound, share)
            lost = _ROUNDED * (price - beyond) if beyond < 0.0 and share > 0.0 else 0.0
            lower_bound = price + beyond - lost
        else:
            lower_bound = bound if bound >= price else _per_success(bound - worth - rounding, share)
        return max(lower_bound, self.lowest)


def _per_success(rest: float, share: float) -> float:
    """Return ``rest / share``; -inf if the required goal probability ``share`` is 0."""
    return rest / share if share > 0.0 else -np.inf


def relative_gap(objective: float, lower_bound: float) -> float:
    """Return (objective - lower_bound) / abs(objective), at least 0; 0 / 0 is 0."""
    difference = max(objective - lower_bound, 0.0)
    return 0.0 if difference == 0.0 else difference / max(abs(objective), 1e-300)


def two_sided_gap(one: float, other: float) -> float:
    """Return the relative gap between an objective and its bound, given in any order."""
    return relative_gap(max(one, other), min(one, other))


CONTRADICTION = 1e-9
"""Relative excess of a lower bound over an objective that rounding cannot explain."""


def least_of(lower_bound: float, objective: float) -> float:
    """Return the smaller of a lower bound and the objective of a policy that satisfies the limits.

    Raises:
        SolverError: the bound exceeds the objective by more than rounding, so one of them is wrong.
    """
    if lower_bound > objective + CONTRADICTION * max(abs(objective), abs(lower_bound)) + _TINY:
        raise SolverError(
            f"the value of a policy, {objective!r}, lies below the lower bound of all policies, "
            f"{lower_bound!r}: the model is too ill-conditioned for double precision"
        )
    return min(lower_bound, objective)
