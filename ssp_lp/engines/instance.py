"""An instance: a problem's augmented process together with everything that engines ask of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ssp_lp.arrays import FloatArray
from ssp_lp.engines.oracles.oracle import Column, Oracle
from ssp_lp.policies.policy import Policy
from ssp_lp.process.explicit import ExplicitProcess


@dataclass(frozen=True, eq=False)
class LeastFailure:
    """The cheapest policy among those that fail least (DESIGN, section 4: two stages)."""

    policy: Policy
    column: Column  # its cost and failure, both discounted under a discount
    objective_bound: float  # certified lower bound of the objective of every such policy


class Instance(Protocol):
    """What an engine asks of a problem; a user's own formulation may bring its own."""

    @property
    def ratio(self) -> bool:
        """Whether the objective is cost / (1 - failure) (case S) rather than cost (case M)."""
        ...

    def least_failure(self) -> LeastFailure:
        """The first column: feasibility is decided by it, never by the status of an LP."""
        ...

    def oracle(self) -> Oracle:
        """The oracle of the process as it stands."""
        ...

    def explicit(self) -> ExplicitProcess:
        """The process written out, for the linear program."""
        ...

    def refined(self, price: float) -> Instance | None:
        """A larger instance with a smaller truncation error, or None where there is none.

        Args:
            price: price of failure at the optimum of this instance.
        """
        ...

    def matching(self, values: FloatArray) -> Instance:
        """The instance whose value functions have the shape of this one.

        Raises:
            ModelError: no instance of the problem has such value functions.
        """
        ...

    def tail_loss(self, price: float, *, slack: bool = False) -> float:
        """How much of a bound at this price is lost to truncation; 0 where nothing is."""
        ...
