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

    In case S ``cost`` is E[total cost; goal]; under discounting both are discounted.
    """

    cost: float
    failure: float
    goal: float  # 1 - failure, measured by itself: each is exact where it is small
    choice: IntArray | None  # the pricing problem's own form of the policy
    tail_price: float = 0.0  # case S: the price by which tails beyond the cap are chosen
    policy: Policy | None = None  # the policy on the model, where it did not come from pricing
    totals: FloatArray | None = None  # [states, rewards] the same from each state, a warm start
    found_at: float | None = None  # a price at which no policy of its process is worth less
    work: Work = field(default_factory=Work)  # what finding it took
    rows: tuple[float, ...] = ()  # what it takes of each row beside the failure row
    by_goal: bool = False  # the pricing counts success, as minus the goal, in place of failing
    by_layer: FloatArray | None = None
    """Case S, if begun in each layer as if nothing had been paid: the least cost - price * goal,
    and the cost, failure and goal of going on from the start's nodes, or nan, [layers, 4]."""
    swept: Column | None = None  # case S: whose sweep it was found in, where that is another one
    beyond: Column | None = None  # of layers without tails of their own: what is done beyond them

    @classmethod
    def of_figures(
        cls, figures: FloatArray, choice: IntArray | None, *, by_goal: bool = False, **more: Any
    ) -> Column:
        """A column from its rewards, verified: beyond 0 and 1 lies rounding."""
        cost, counted, *rows = figures.tolist()
        counted = min(max(-counted if by_goal else counted, 0.0), 1.0)
        failure, goal = (1.0 - counted, counted) if by_goal else (counted, 1.0 - counted)
        return cls(cost, failure, goal, choice, rows=tuple(rows), by_goal=by_goal, **more)

    @cached_property
    def figures(self) -> FloatArray:
        """Rewards of a column, [rewards]: cost, failure, and its coefficients in the rows."""
        return np.array([self.cost, -self.goal if self.by_goal else self.failure, *self.rows])


def excess_failure(risky: Column, safe: Column) -> float:
    """Failure of a column in excess of another's, without cancellation."""
    if max(risky.goal, safe.goal) < 0.5:
        return safe.goal - risky.goal
    return risky.failure - safe.failure


@dataclass(frozen=True, eq=False)
class Proof:
    """A certified lower bound of the value of every policy at a price of failure.

    A policy's value is ``cost + failing * failure - (price - failing) * goal``. With ``failing``
    equal to the price this is ``cost + price * failure``; with 0 it is ``cost - price * goal``,
    which is exact where it is best to fail and serves in case S where the budget is slack.
    """

    price: float
    failing: float
    bound: float  # at the start
    values: FloatArray  # the checked sub-solution behind it, in the pricing problem's own shape
    work: Work = field(default_factory=Work)
    choice: IntArray | None = None  # case S, where values were checked: whose they are
    by_layer: FloatArray | None = None  # [layers] the bound if an episode began in each


def required(part: _Array | None) -> _Array:
    """The choice or totals of a column that its pricing problem must have made.

    Raises:
        ModelError: the column came from elsewhere.
    """
    if part is None:
        raise ModelError("this column was not made by the pricing and carries no choice")
    return part


class PricingProblem(ABC):
    """Minimises ``cost + failure_price * failure`` and measures what it found.

    Nothing here assumes that the states of the process fit into one array: an implementation may
    be explicit, layered, or one whose states lie in several places.
    """

    by_goal: bool = False  # success, as minus the goal, is counted in place of failing

    @property
    @abstractmethod
    def n_rewards(self) -> int:
        """Number of rewards that a pricing problem counts: cost, failure and limits."""

    def counting_success(self) -> Self:
        """The pricing problem whose columns count success in place of failing, where it can."""
        return self

    @property
    @abstractmethod
    def value_shape(self) -> tuple[int, ...]:
        """Shape of the value functions that a pricing problem's ``check`` takes."""

    def incumbent(self, reached: Any) -> Column | None:
        """The column that a stopped pricing problem had come to, by its Stop; None: no policy."""
        return None

    @abstractmethod
    def first(self) -> Column:
        """A first column of the pricing problem, cheap to find, that reaches the goal if it can."""

    @abstractmethod
    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Solve the pricing problem: a column of least priced cost, measured exactly.

        Args:
            price: of failure, or the weight of each reward, [rewards].
            warm: policies to start from, the one that is thought to be nearest first; None: none.

        Raises:
            Stop: the time ended, with a policy that may do where one was known.
        """

    @property
    def covered(self) -> float:
        """Price of failure below which pricing a column prices all columns; 0: it does not."""
        return 0.0

    def beside(self, column: Column, row: FailureRow) -> tuple[Column, ...]:
        """Columns of other prices, next to the budget, that pricing a column found on its way."""
        return ()

    def policy_failing(self, column: Column, failure: float, *, above: bool) -> Policy | None:
        """Policy found on a column's way that fails about as often as is asked for; None: none."""
        return None

    def taken_on(self, columns: Sequence[Column]) -> list[Column] | None:
        """Columns of the process with a lower cap, measured in this one; None: it has no cap."""
        return None

    def true_cost(self, column: Column) -> float | None:
        """Cost of a column on the model, with what its process cuts off; None: unknown here."""
        return None

    def aligned(self, column: Column, price: float) -> Column:
        """A column with its tails, where it has any, chosen by this price; measured again."""
        return column

    @abstractmethod
    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound of every column's priced value.

        Args:
            price: of failure, or the weight of each reward, [rewards].
            best: a policy of least value at this price.
            slack: count failing as 0 and success as minus the price.
        """

    def prove_afresh(self, weights: FloatArray, warm: Column) -> Proof:
        """Best lower bound of the pricing problem at weights that nothing has been priced at."""
        return self.prove(weights, warm)

    @abstractmethod
    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values to a checked sub-solution of the pricing problem.

        Raises:
            ModelError: values of another shape.
        """

    @property
    def anything(self) -> FloatArray:
        """Values that ask for the best that can be proved."""
        return np.broadcast_to(np.inf, self.value_shape)

    def policy(self, column: Column) -> Policy:
        """A column's policy on the original states."""
        return self.pulled_back(column) if column.policy is None else column.policy

    @abstractmethod
    def pulled_back(self, column: Column) -> Policy:
        """The choice of a column of this pricing problem, on the original states."""

    def check_shape(self, values: FloatArray) -> None:
        """Raise :class:`ModelError` unless a pricing problem's values have their shape."""
        if values.shape != self.value_shape:
            raise ModelError(f"a value function of shape {self.value_shape} is needed")


def pricing_weights(price: float | FloatArray) -> FloatArray:
    """The weight of each reward in a pricing problem, [rewards]."""
    return price if isinstance(price, np.ndarray) else np.array([1.0, price])


_ROUNDED = 4.0 * MACHINE_EPSILON  # of a bound and of what the budget is worth at its price
_TINY = 1e-12  # costs below this are compared with 0
_SAME = 4.0 * MACHINE_EPSILON
"""Relative distance of two failures, or of two rare successes, that are one summed in two ways."""


@dataclass(frozen=True)
class FailureRow:
    """The failure row and the objective's form."""

    budget: float
    ratio: bool
    lowest: float = 0.0  # no objective is less
    demanded: float = field(init=False)  # goal probability that the budget leaves
    is_rare: bool = field(init=False)  # so little that it is counted in place of failing
    rounding: float = field(init=False)  # by which a column may seem to miss a budget it meets

    def __post_init__(self) -> None:
        budget = self.budget
        demanded = budget.demanded if isinstance(budget, GoalShare) else 1.0 - budget
        follows = vars(self)
        follows["demanded"], follows["is_rare"] = demanded, 0.0 < demanded < RARE_GOAL
        follows["rounding"] = _SAME * max(min(budget, demanded), 0.0)

    def raised_to(self, least: Column) -> FailureRow:
        """The failure row with a budget that the column of least failure keeps to."""
        return self if self.spare(least) >= 0.0 else self.equal_to(least)

    def equal_to(self, least: Column) -> FailureRow:
        """The failure row whose budget is what the column of least failure takes."""
        return replace(self, budget=GoalShare(least.goal) if self.is_rare else least.failure)

    def spare(self, column: Column) -> float:
        """Failure that a column leaves of the budget, without cancellation; below 0: it breaks."""
        demanded = self.demanded
        return column.goal - demanded if demanded < 0.5 else self.budget - column.failure

    def leaves_only(self, least: Column) -> bool:
        """Whether the budget exceeds the least failing column's failure by rounding at most."""
        return self.spare(least) <= self.rounding

    def breaks(self, column: Column) -> bool:
        """Whether a column breaks the failure row's budget by more than rounding."""
        return self.spare(column) < -self.rounding

    def objective(self, cost: float, goal: float) -> float:
        """Objective of a mixture of columns by its cost and failure."""
        if not self.ratio:
            return cost
        return cost / goal if goal > 0.0 else np.inf

    def lower_bound(self, proof: Proof) -> float:
        """Lower bound of the objective within the failure row, from a proof about every column.

        Case M: cost + price * failure >= bound gives cost >= bound - price * budget. Case S:
        cost >= c * goal follows for c = bound if bound >= price, else, as failure <= budget, for
        c = (bound - price * budget) / (1 - budget). With failing counted 0 the value is shifted
        by the price, which is exact where the budget is slack, or success rare.
        """
        bound, price, share = proof.bound, proof.price, self.demanded
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
    """The rest of a bound on columns, over the success that is required; unknown where none is."""
    return rest / share if share > 0.0 else -np.inf


def relative_gap(objective: float, lower_bound: float) -> float:
    """Relative gap of a column's objective: (objective - lower_bound) / |objective|; 0 / 0 is 0."""
    difference = max(objective - lower_bound, 0.0)
    return 0.0 if difference == 0.0 else difference / max(abs(objective), 1e-300)


def two_sided_gap(one: float, other: float) -> float:
    """Relative gap between columns' objective and its bound, on whichever side that lies."""
    return relative_gap(max(one, other), min(one, other))


CONTRADICTION = 1e-9
"""Relative excess of a lower bound over a value that no rounding explains."""


def least_of(lower_bound: float, objective: float) -> float:
    """The failure row's lower bound, or the objective where rounding puts the bound above it.

    Raises:
        SolverError: the bound lies above by more than rounding; then one of them is wrong.
    """
    if lower_bound > objective + CONTRADICTION * max(abs(objective), abs(lower_bound)) + _TINY:
        raise SolverError(
            f"a policy's value, {objective!r}, lies below a bound of all policies, "
            f"{lower_bound!r}: the model is too ill-conditioned for double precision"
        )
    return min(lower_bound, objective)
