"""What a program needs of an augmented process: names of its pairs, and the way back.

Case M's process, the failure label of the paper's section 3.1.2, is the first that has it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.policies.policy import GIVE_UP, Policy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled
from ssp_lp.processes.flow import decisions, model_flow, moving_within
from ssp_lp.processes.quotient import Quotient


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


class Augmented(ABC):
    """A process written out, with its way back to the model.

    Its pairs are copies of the live part's, one after another, and then what lies beyond them.
    """

    @property
    @abstractmethod
    def process(self) -> ExplicitProcess:
        """The process, whose pairs are the columns."""

    @property
    @abstractmethod
    def quotient(self) -> Quotient:
        """The live part of the model."""

    @property
    @abstractmethod
    def copies(self) -> int:
        """How often it stands in the process: once for each cost that is told apart."""

    @abstractmethod
    def paid(self, copy: int) -> float | None:
        """The cost paid before, in one of the copies; None: it is not counted."""

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        return self.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        own = np.tile(self.quotient.gives_up, self.copies)
        return np.append(own, np.zeros(self.process.n_pairs - own.size, dtype=np.bool_))

    def label(self, pair: int) -> ColumnLabel:
        """What a pair of the process stands for."""
        width = len(self.quotient.pair_at)
        if pair >= self.copies * width:
            return self.label_beyond(pair)
        copy, inner = divmod(pair, width)
        return ColumnLabel(*self.quotient.named(inner), self.paid(copy))

    def label_beyond(self, pair: int) -> ColumnLabel:
        """What a pair beyond the copies stands for: the start, unless there is more."""
        del pair
        return ColumnLabel(None, START, self.paid(0))

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """The process's pairs that take a pair of the model, or give up in a state.

        Args:
            pair: pair of the model or GIVE_UP_CODE.
            state: state of the model.
        """
        firsts = np.arange(self.copies)[:, None] * len(self.quotient.pair_at)
        return np.asarray((firsts + self.quotient.places_of(pair, state)).ravel())

    @abstractmethod
    def policy(self, choice: IntArray) -> Policy:
        """A deterministic choice as a policy on the model.

        Args:
            choice: one pair of each state of the process, [process states].
        """

    @abstractmethod
    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """The policy that draws each pair with its share of its state's visits.

        Args:
            visits: expected visits, [process pairs].
            choice: pairs for the states that are never visited, [process states].
        """


@dataclass(frozen=True, eq=False)
class LabelledModel(Augmented):
    """The states that have not failed yet; what fails leaves the process."""

    labelled: FailureLabelled
    start: FloatArray  # [states]
    copies = 1

    @property
    def process(self) -> ExplicitProcess:
        """The process of the label."""
        return self.labelled.process

    @property
    def quotient(self) -> Quotient:
        """The live part."""
        return self.labelled.quotient

    def paid(self, copy: int) -> None:
        """Costs are not counted."""

    def policy(self, choice: IntArray) -> DeterministicPolicy:
        """One decision per state."""
        return self.labelled.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A stationary policy on the model's states."""
        quotient = self.quotient
        flow = model_flow(quotient, visits[: len(quotient.pair_at)] / self.labelled.departs)
        flow = moving_within(quotient, flow, self.start + flow.entering(quotient))
        otherwise = self.policy(choice).decision.astype(np.int64)
        return StochasticPolicy.from_flows(self.model, *decisions(quotient, flow, otherwise))
