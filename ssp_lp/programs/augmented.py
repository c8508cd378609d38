"""What a program needs of an augmented process: names of its pairs, and the way back.

Case M's process, the failure label of the paper's section 3.1.2, is the first that has it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.policies.policy import GIVE_UP, Policy
from ssp_lp.policies.stationary import DeterministicPolicy, StochasticPolicy, find_pair
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled, counting_of
from ssp_lp.processes.failure_semantics import FailureSemantics
from ssp_lp.processes.flow import (
    ModelFlow,
    Spread,
    decisions,
    model_flow,
    moving_within,
)
from ssp_lp.processes.quantities.conditions import Term
from ssp_lp.processes.quotient import Quotient


class ColumnLabel(NamedTuple):
    """What a column counts: how often an action is taken in a state, at an accumulated cost."""

    state: Hashable  # of a collapsed component the member that acts, or the first one
    action: Hashable  # an action of the model, ``GIVE_UP``, or one of the words below
    cost: float | None = None  # the cost paid before, where the process counts it

    @property
    def paid(self) -> str:
        """The cost paid before in words, where there is one."""
        return "" if self.cost is None else f" at cost {self.cost:g}"

    def __str__(self) -> str:
        """The state and the action, and the cost where there is one."""
        action = "give up" if self.action is GIVE_UP else self.action
        return f"({self.state}, {action}){self.paid}"


START = "start"
"""Action of the column by which start mass on goals and dead-ends enters; its state is None."""

STAY = "stay for ever"
"""Action of the column by which a policy wanders for ever, at no cost, from one of its states."""


class Augmented(ABC):
    """A process written out, with its way back to the model.

    Its pairs are copies of the live part's, one after another, and then what lies beyond them.
    """

    start: FloatArray  # [states] distribution

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

    @property
    @abstractmethod
    def departs(self) -> FloatArray:
        """What rows of a copy were divided by, see ``live_rows``, [quotient pairs]."""

    @abstractmethod
    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """The model's flow in each copy, moves within collapsed components included.

        Args:
            visits: expected visits, [process pairs].
        """

    @abstractmethod
    def spread(self, spread: Spread) -> Augmented:
        """The same with nothing collapsed and every self-loop in its place."""

    @abstractmethod
    def counted(self, term: Term) -> FloatArray:
        """How much of what a quantity counts each pair takes, [process pairs]."""

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
        """What a pair of the process stands for; one beyond the copies is the start."""
        width = len(self.quotient.pair_at)
        if pair >= self.copies * width:
            return ColumnLabel(None, START, self.paid(0))
        copy, inner = divmod(pair, width)
        return ColumnLabel(*self.quotient.named(inner), self.paid(copy))

    def pairs_of(self, states: IntArray, action: Hashable | None) -> IntArray:
        """The process's pairs that act in some states of the model, an action or any.

        Args:
            states: of the model.
            action: an action that each of them has, ``GIVE_UP``, ``STAY``, or None for all.
        """
        quotient, model = self.quotient, self.model
        inner = np.isin(quotient.pair_node, quotient.node_of[states][quotient.node_of[states] >= 0])
        if action is GIVE_UP or action == STAY:
            inner &= quotient.gives_up
        elif action is not None:
            inner &= np.isin(quotient.pair_at, [find_pair(model, s, action) for s in states])
        firsts = np.arange(self.copies)[:, None] * len(quotient.pair_at)
        return np.asarray((firsts + inner.nonzero()[0]).ravel())

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
    semantics: FailureSemantics
    discount: float | None
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

    @property
    def departs(self) -> FloatArray:
        """As the rows of the label were divided."""
        return self.labelled.departs

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """One flow."""
        quotient = self.quotient
        flow = model_flow(quotient, visits[: len(quotient.pair_at)] / self.departs)
        yield moving_within(quotient, flow, self.start + flow.entering(quotient))

    def spread(self, spread: Spread) -> LabelledModel:
        """Rows of the live states themselves; what pairs take, whenever they are taken."""
        process, single, width = self.process, spread.quotient, len(self.quotient.pair_at)
        survival = 1.0  # a discount collapses nothing
        rows, start = (
            single.transitions(survival, departing=False).matrix,
            single.gather(self.start),
        )
        beyond, offsets, shape = process.n_pairs - width, single.pair_offsets, rows.shape
        if beyond:  # the source
            entry = sp.csr_array(np.append(start, 0.0)[None, :])
            rows = sp.csr_array(
                (rows.data, rows.indices, rows.indptr), shape=(shape[0], shape[1] + 1)
            )
            rows, offsets = sp.csr_array(sp.vstack([rows, entry])), np.append(offsets, shape[0] + 1)
            start = np.append(np.zeros(shape[1]), 1.0)
        cost, failure, goal = (
            np.append(spread.per_taking(taken[:width]), taken[width:])
            for taken in (process.cost, process.failure, process.goal)
        )
        whole = ExplicitProcess(offsets, rows, start, cost, failure, goal)
        ones = np.ones(len(single.pair_at))
        return replace(self, labelled=FailureLabelled(whole, single, ones))

    def may_start(self, start: FloatArray) -> bool:
        """Whether start mass enters at places alone, here and from elsewhere, [states]."""
        ends = self.quotient.node_of < 0
        return not start[ends].any() and not self.start[ends].any()

    def started(self, start: FloatArray) -> LabelledModel:
        """The same from another start, which may be one."""
        process = replace(self.process, start=self.quotient.gather(start))
        return replace(self, labelled=replace(self.labelled, process=process), start=start)

    def counted(self, term: Term) -> FloatArray:
        """Counted under the label of failing, [process pairs]."""
        counting = counting_of(self.labelled, self.start, self.semantics, self.discount)
        return np.append(*term.at(counting))[: self.process.n_pairs]

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A stationary policy on the model's states."""
        (flow,) = self.flows(visits)
        otherwise = self.policy(choice).decision.astype(np.int64)
        return StochasticPolicy.from_flows(self.model, *decisions(self.quotient, flow, otherwise))
