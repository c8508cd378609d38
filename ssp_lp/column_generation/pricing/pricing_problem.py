"""What column generation asks of a process, whatever its form."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import Policy

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
    runs: FloatArray | None = None  # [states] twice this is at least the expected number of steps
    found_at: float | None = None  # a price at which no policy of its process is worth less
    work: Work = field(default_factory=Work)  # what finding it took
    rows: tuple[float, ...] = ()  # what it takes of each row beside the failure row

    @cached_property
    def figures(self) -> FloatArray:
        """All that it is priced by, [rewards]: cost, failure, and what it takes of the rows."""
        return np.array([self.cost, self.failure, *self.rows])


def excess_failure(risky: Column, safe: Column) -> float:
    """How much more a column fails than another, without cancellation."""
    if max(risky.goal, safe.goal) < 0.5 and safe.goal > risky.goal:
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
    """The choice or totals of a column that a pricing problem made, which must be there.

    Raises:
        ModelError: the column came from elsewhere.
    """
    if part is None:
        raise ModelError("this column was not made by the pricing and carries no choice")
    return part


class PricingProblem(Protocol):
    """Minimises ``cost + failure_price * failure`` and measures what it found.

    Nothing here assumes that the states of the process fit into one array: an implementation may
    be explicit, layered or distributed.
    """

    @property
    def value_shape(self) -> tuple[int, ...]:
        """The shape of the value functions that ``check`` takes."""
        ...

    def incumbent(self, reached: Any) -> Column | None:
        """What a stopped ``minimise`` had come to, as its Stop says; None: that is no policy."""
        ...

    def first(self) -> Column:
        """A policy from which the goal is reached if it can be; cheap to find."""
        ...

    def minimise(self, failure_price: float, *warm: Column | None) -> Column:
        """A policy of least priced cost, measured exactly.

        Args:
            failure_price: price of failure.
            warm: policies to start from, the one that is thought to be nearest first; None: none.

        Raises:
            Stop: the time ended, with a policy that may do where one was known.
        """
        ...

    def aligned(self, column: Column, price: float) -> Column:
        """The column with its tails, where it has any, chosen by this price; measured again."""
        ...

    def prove(self, price: float, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound of the value of every policy.

        Args:
            price: of failure.
            best: a policy of least value at this price.
            slack: count failing as 0 and success as minus the price.
        """
        ...

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower any values as far as is needed to make them a checked sub-solution."""
        ...

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        ...
