"""What a program needs of an augmented process: names of its pairs, and the way back."""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple, Protocol

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.policies.policy import GIVE_UP, Policy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess


class ColumnLabel(NamedTuple):
    """What a column counts: how often an action is taken in a state, at an accumulated cost."""

    state: Hashable  # of a collapsed component the member that acts, or the first one
    action: Hashable  # an action of the model, ``GIVE_UP``, or one of the words below
    cost: float | None = None  # the cost paid before, where the process counts it

    def __str__(self) -> str:
        """The state and the action, and the cost where there is one."""
        paid = "" if self.cost is None else f" at cost {self.cost:g}"
        action = "give up" if self.action is GIVE_UP else self.action
        return f"({self.state}, {action}){paid}"


START = "start"
"""Action of the column by which start mass on goals and dead-ends enters; its state is None."""

GO_FOR_GOAL = "go for the goal"
"""Action beyond the last accumulated cost that is told apart: the policy of greatest success."""

FAIL = "fail"
"""Action there: the policy that fails most."""


class Augmented(Protocol):
    """A process written out, with its way back to the model."""

    @property
    def process(self) -> ExplicitProcess:
        """The process, whose pairs are the columns."""
        ...

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        ...

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        ...

    def label(self, pair: int) -> ColumnLabel:
        """What a pair of the process stands for."""
        ...

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """The process's pairs that take a pair of the model, or give up in a state.

        Args:
            pair: pair of the model or GIVE_UP_CODE.
            state: state of the model.
        """
        ...

    def policy(self, choice: IntArray) -> Policy:
        """A deterministic choice as a policy on the model.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        ...

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """The policy that draws each pair with its share of its state's visits.

        Args:
            visits: expected visits, [process pairs].
            choice: pairs for the states that are never visited, [process states].
        """
        ...
