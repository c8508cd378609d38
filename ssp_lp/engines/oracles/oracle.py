"""What column generation asks of a process, whatever its form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import Policy


@dataclass(frozen=True, eq=False)
class Column:
    """A deterministic policy with its exact expected cost and failure from the start.

    In case S ``cost`` is E[total cost; goal]; under discounting both are discounted.
    """

    cost: float
    failure: float
    choice: IntArray | None  # the oracle's own form of the policy
    policy: Policy | None = None  # the policy on the model, where it did not come from the oracle


def required(choice: IntArray | None) -> IntArray:
    """The choice of a column that an oracle made.

    Raises:
        ModelError: the column came from elsewhere.
    """
    if choice is None:
        raise ModelError("this column was not made by the oracle and carries no choice")
    return choice


class Oracle(Protocol):
    """Minimises ``cost + failure_price * failure`` and measures what it found.

    Nothing here assumes that the states of the process fit into one array: an implementation may
    be explicit, layered or distributed.
    """

    def minimise(self, failure_price: float, warm: Column | None = None) -> Column:
        """A policy of least priced cost, measured exactly; ``warm`` is a policy to start from."""
        ...

    def bound(self, failure_price: float, best: Column) -> tuple[float, FloatArray]:
        """A certified lower bound of the priced cost of every policy.

        Args:
            best: the policy found at this price.

        Returns:
            The bound, and the checked sub-solution that proves it.
        """
        ...

    def check(self, failure_price: float, values: FloatArray) -> tuple[float, FloatArray]:
        """Lower any values as far as is needed to make them a checked sub-solution.

        Returns:
            The bound at the start that they prove, and the checked values.
        """
        ...

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        ...
