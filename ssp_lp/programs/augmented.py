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

from ssp_lp.accumulated_cost.process import AccumulatedCost, spread_layer
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.product import ProductSSP
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP, DeterministicPolicy, StochasticPolicy
from ssp_lp.processes.conditions import Term
from ssp_lp.processes.explicit_process import ExplicitProcess, ReachablePart
from ssp_lp.processes.failure_label import FailureLabelled, counting_of
from ssp_lp.processes.failure_semantics import FailureSemantics
from ssp_lp.processes.quotient import (
    ModelFlow,
    Quotient,
    Spread,
    decisions,
    model_flow,
    moving_within,
)


class ColumnLabel(NamedTuple):
    """Label of a column: an action taken in a state, at an accumulated cost."""

    state: Hashable  # of a collapsed component the member that acts, or the first one
    action: Hashable  # an action of the model, ``GIVE_UP``, or one of the words below
    cost: float | None = None  # the cost paid before, where the process counts it

    @property
    def paid(self) -> str:
        """The cost paid before a column of the augmented process, in words, where there is one."""
        return "" if self.cost is None else f" at cost {self.cost:g}"

    def __str__(self) -> str:
        """The state and the action, and the cost where there is one."""
        action = "give up" if self.action is GIVE_UP else self.action
        return f"({self.state}, {action}){self.paid}"


START = "start"
"""Action of the column by which start mass on goals and dead-ends enters; its state is None."""

STAY = "stay for ever"
"""Action of the column by which a policy wanders for ever, at no cost, from one of its states."""


@dataclass(frozen=True, eq=False)
class Augmented(ABC):
    """A process written out, with its way back to the model.

    Its pairs are numbered as those of all copies of the live part, one copy after another, and then
    the source's. The process has those of them that some policy comes to.
    """

    inner: FailureLabelled | OpenEnded  # what is written out
    start: FloatArray  # [states] distribution
    semantics: FailureSemantics  # who may give up
    part: ReachablePart  # the process, with the numbers of its states and pairs

    @property
    def process(self) -> ExplicitProcess:
        """The augmented process, whose pairs are the program's columns."""
        return self.part.process

    @property
    @abstractmethod
    def live(self) -> FailureLabelled | AccumulatedCost:
        """The live part of the augmented process, once for each cost told apart."""

    @property
    def copies(self) -> int:
        """Number of copies of the live part in the augmented process."""
        return 1

    @property
    def quotient(self) -> Quotient:
        """The live part of the augmented model."""
        return self.live.quotient

    @property
    def departs(self) -> FloatArray:
        """Divisors of the rows of an augmented copy, see ``live_rows``, [quotient pairs]."""
        return self.live.departs

    @abstractmethod
    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """The model's flow in each augmented copy, moves within collapsed components included.

        Args:
            visits: expected visits, [process pairs].
        """

    @abstractmethod
    def spread(self, spread: Spread) -> Augmented:
        """The augmented process with nothing collapsed and every self-loop in its place."""

    @abstractmethod
    def counted(self, term: Term) -> FloatArray:
        """Coefficient of a quantity at each pair of the augmented process, [process pairs]."""

    @property
    def width(self) -> int:
        """Number of pairs of a copy of the live part of the augmented model."""
        return len(self.quotient.pair_at)

    def in_all_copies(self, values: FloatArray) -> FloatArray:
        """Numbers per pair of the process, [process pairs], with 0 for augmented pairs left out.

        [copies * width + 1].
        """
        every = np.zeros(self.copies * self.width + 1)
        every[self.part.pairs] = values
        return every

    def paid(self, copy: int) -> float | None:
        """The cost paid before, in one of the augmented copies; None: it is not counted."""
        return None

    @property
    def model(self) -> SSP:
        """The model that is augmented."""
        return self.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs of the augmented process by which a policy gives up, [process pairs]."""
        return self._of_copies(self.quotient.gives_up)

    def _of_copies(self, chosen: BoolArray) -> BoolArray:
        """Pairs of the augmented process that are copies of some, [process pairs] of [width]."""
        return np.append(np.tile(chosen, self.copies), False)[self.part.pairs]

    def label(self, number: int) -> ColumnLabel:
        """The column label of a pair among those of all augmented copies; of the source, last."""
        if number >= self.copies * self.width:
            return ColumnLabel(None, START, self.paid(0))
        copy, inner = divmod(number, self.width)
        return ColumnLabel(*self.quotient.named(inner), self.paid(copy))

    def pairs_of(self, states: IntArray, action: Hashable | None) -> IntArray:
        """Pairs of the augmented process in some states of the model, by an action or any.

        Args:
            states: of the model.
            action: an action that one of them has, ``GIVE_UP``, ``STAY``, or None for all.

        Raises:
            ModelError: none has the action.
        """
        quotient, live = self.quotient, states[self.quotient.node_of[states] >= 0]
        inner = np.isin(quotient.pair_node, quotient.node_of[live])
        if action is GIVE_UP or action == STAY:
            inner &= quotient.gives_up
        elif action is not None:
            model = self.model
            named = np.array([name == action for name in model.action_names], dtype=np.bool_)
            taken = np.flatnonzero(np.isin(model.pair_state, states) & named[model.pair_action])
            acts = np.diff(model.pair_offsets)[states] > 0  # no copy that is out of time does
            if not taken.size and (acts.any() or not isinstance(model, ProductSSP)):
                raise ModelError(model.no_such_action(int(states[np.argmax(acts)]), action))
            inner &= np.isin(quotient.pair_at, taken)
        return np.flatnonzero(self._of_copies(inner))

    def policy(self, choice: IntArray) -> DeterministicPolicy | CostAwarePolicy:
        """A deterministic choice in the augmented process as a policy on the model.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        return self.inner.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """The policy on the model by shares of the augmented process's visits.

        Args:
            visits: expected visits, [process pairs].
            choice: pairs for the states that are never visited, [process states].
        """
        carrier, n_states, drawn = self.policy(choice), self.model.n_states, []
        for copy, flow in enumerate(self.flows(visits)):
            otherwise = carrier.branches(np.arange(n_states), np.full(n_states, copy)).pair
            state, pair, share = decisions(self.quotient, flow, otherwise)
            drawn.append((copy * n_states + state, pair, share))
        keys, pairs, shares = map(np.concatenate, zip(*drawn, strict=True))
        remembering = None if self.copies == 1 else carrier
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, remembering)


@dataclass(frozen=True, eq=False)
class LabelledModel(Augmented):
    """The states that have not failed yet; what fails leaves the process."""

    inner: FailureLabelled
    discount: float | None

    @classmethod
    def of(
        cls,
        inner: FailureLabelled,
        start: FloatArray,
        semantics: FailureSemantics,
        discount: float | None,
    ) -> LabelledModel:
        """The augmented model of labelled states, all of them.

        Args:
            inner: the labelled states.
            start: distribution over states, [states].
            semantics: who may give up.
            discount: None: none.
        """
        every = np.arange(inner.process.n_states), np.arange(inner.process.n_pairs)
        return cls(inner, start, semantics, ReachablePart(inner.process, *every), discount)

    @property
    def live(self) -> FailureLabelled:
        """The labelled states, the augmented model's live part where no cost counts."""
        return self.inner

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """The augmented model's one flow with labels."""
        quotient = self.quotient
        flow = model_flow(quotient, visits[: self.width] / self.departs)
        yield moving_within(quotient, flow, self.start + flow.entering(quotient))

    def spread(self, spread: Spread) -> LabelledModel:
        """Rows of the augmented model's live states themselves, nothing collapsed."""
        process, single, width = self.process, spread.quotient, self.width
        rows = single.transitions(1.0, departing=False).matrix  # a discount collapses nothing
        start, offsets, shape = single.gather(self.start), single.pair_offsets, rows.shape
        beyond = process.n_pairs - width
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
        labelled = FailureLabelled(whole, single, ones)
        return LabelledModel.of(labelled, self.start, self.semantics, self.discount)

    def started(self, start: FloatArray) -> LabelledModel | None:
        """The augmented model from another start; None: an episode may end where it begins."""
        ends = self.quotient.node_of < 0
        if start[ends].any() or self.start[ends].any():
            return None
        process = replace(self.process, start=self.quotient.gather(start))
        labelled = replace(self.inner, process=process)
        return LabelledModel.of(labelled, start, self.semantics, self.discount)

    def counted(self, term: Term) -> FloatArray:
        """Coefficient of a quantity in the augmented model with labels, [process pairs]."""
        counting = counting_of(self.inner, self.start, self.semantics, self.discount)
        return np.append(*term.at(counting))[: self.process.n_pairs]


@dataclass(frozen=True, eq=False)
class LayeredModel(Augmented):
    """States and the cost paid so far; from the cap on one policy for all costs.

    The process has the totals that a run can come to.
    """

    inner: OpenEnded

    @classmethod
    def of(cls, inner: OpenEnded, start: FloatArray, semantics: FailureSemantics) -> LayeredModel:
        """The augmented model of a table of layers, of which nothing else is kept written out.

        Args:
            inner: the table.
            start: distribution over states, [states].
            semantics: who may give up.
        """
        return cls(replace(inner), start, semantics, inner.reachable_part())

    @property
    def live(self) -> AccumulatedCost:
        """A layer, the augmented model's live part where the cost paid counts."""
        return self.inner.base

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """The augmented model's flow in each layer; what enters a layer left another."""
        base, quotient, n_pairs = self.inner.base, self.quotient, self.width
        model, merged = quotient.model, bool(quotient.merged.any())
        entering = np.zeros((self.copies + base.width if merged else 0, model.n_states))
        entering[:1] = self.inner.start
        kinds, kind = np.unique(base.step_classes.ahead, return_inverse=True)
        below = self.inner.leads(kinds)[0] if merged else kinds
        visits = self.in_all_copies(visits)
        for layer in range(self.copies):
            taken = visits[layer * n_pairs : (layer + 1) * n_pairs] / base.departs
            flow = model_flow(quotient, taken)
            if merged:
                mass = np.repeat(flow.pairs, np.diff(model.outcome_offsets)) * model.probabilities
                moved = np.flatnonzero(mass)
                reached = below[layer, kind[moved]]
                np.add.at(entering, (reached, model.successors[moved]), mass[moved])
                flow = moving_within(quotient, flow, entering[layer])
            yield flow

    def spread(self, spread: Spread) -> LayeredModel:
        """The augmented model's layers with nothing collapsed."""
        base = spread_layer(self.inner.base, spread, self.start)
        return LayeredModel.of(replace(self.inner, base=base), self.start, self.semantics)

    def counted(self, term: Term) -> FloatArray:
        """Coefficient of a quantity in all layers of the augmented model, [process pairs]."""
        taken = self.inner.everywhere(*term.at(self.inner.counting(self.semantics)))
        return taken[self.part.pairs]

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """The cost-aware policy of a choice in the augmented process.

        At a total that no run comes to it decides as at the one before.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        shape = self.copies, self.inner.n_nodes
        own = self.part.states < shape[0] * shape[1]
        states, pairs = self.part.states[own], self.part.pairs[choice[own]]
        decided, every = (
            np.tile(per_node, shape[0])
            for per_node in (np.arange(shape[1]), self.quotient.pair_offsets[:-1])
        )
        decided[states], every[states] = states, pairs
        before = np.maximum.accumulate(decided.reshape(shape), axis=0)
        return self.inner.policy(every[before.ravel()])

    @property
    def copies(self) -> int:
        """Layers of the augmented model, up to the cap, which stands for all beyond it."""
        return self.inner.cap + 1

    def paid(self, copy: int) -> float:
        """The cost paid in a layer of the augmented model; the last stands for more."""
        return float(self.inner.totals.values[copy])
