"""The processes behind occupation programs: names of their columns, and their policies.

`LabelledModel` is the process of case M, with the failure label of the paper's section 3.1.2.
`LayeredModel` is the process of case S, whose states include the accumulated cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

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
from ssp_lp.processes.failure_label import LabelledProcess, counting_of, with_start
from ssp_lp.processes.failure_semantics import FailureSemantics, start_distribution
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

    state: Hashable  # for a collapsed component: the member that acts, or its first member
    action: Hashable  # an action of the model, ``GIVE_UP``, or one of the words below
    cost: float | None = None  # accumulated cost, if the process counts it

    @property
    def paid(self) -> str:
        """The accumulated cost as a phrase, such as " at cost 3"; empty in case M."""
        return "" if self.cost is None else f" at cost {self.cost:g}"

    def __str__(self) -> str:
        """Return the state, the action and, if it is counted, the accumulated cost."""
        action = "give up" if self.action is GIVE_UP else self.action
        return f"({self.state}, {action}){self.paid}"


START = "start"
"""Action of the column through which start mass on goals and dead-ends enters; state None."""

STAY = "stay for ever"
"""Action of the column by which a policy wanders for ever at no cost."""

BOUND_TO_START = (
    "the columns of this program depend on its start, and its rows were changed: build a program "
    "from the new start, replace(problem, start=...).program()"
)
"""Message of the error that a program with changed rows cannot start elsewhere."""


@dataclass(frozen=True, eq=False)
class AugmentedProcess(ABC):
    """The process whose pairs are a program's columns, and the translation of its policies.

    The *live part* is the model without goals and dead-ends. In case S there is a copy of it for
    each accumulated cost, in case M there is one copy. Pairs are numbered copy by copy. The last
    pair is that of the source, a state in which episodes begin if some of them may end at once. The
    process contains only the pairs that some policy reaches.
    """

    inner: LabelledProcess | OpenEnded  # the process in its compact form
    start: FloatArray  # [states] distribution
    semantics: FailureSemantics  # where giving up is allowed
    part: ReachablePart  # the process, with the numbers of its states and pairs

    @property
    def process(self) -> ExplicitProcess:
        """The explicit augmented process."""
        return self.part.process

    @property
    @abstractmethod
    def live(self) -> LabelledProcess | AccumulatedCost:
        """One copy of the live part: the model without goals and dead-ends."""

    @property
    def copies(self) -> int:
        """Number of copies of the model without goals and dead-ends."""
        return 1

    @property
    def quotient(self) -> Quotient:
        """Nodes and pairs of one copy; end components of cost 0 may be merged."""
        return self.live.quotient

    @abstractmethod
    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """Yield the expected visits of the model's pairs in each copy.

        Moves within merged components are included.

        Args:
            visits: expected visits, [process pairs].
        """

    @abstractmethod
    def spread(self, spread: Spread) -> AugmentedProcess:
        """Return the process in which no component is merged and self-loops are pairs.

        Args:
            spread: the quotient without merged components.
        """

    @abstractmethod
    def counted(self, term: Term) -> FloatArray:
        """Return the coefficient of a term for each pair of the process, [process pairs]."""

    def started(self, start: Hashable | Mapping[Hashable, float]) -> AugmentedProcess | None:
        """Return the process with another start; None if its pairs depend on the start."""
        return None

    @property
    def width(self) -> int:
        """Number of pairs in each copy of the model without goals and dead-ends."""
        return len(self.quotient.pair_at)

    @property
    def is_late(self) -> BoolArray:
        """Mask of the process's pairs in the last of several copies, at the cap or above."""
        in_last = self.part.pairs // max(self.width, 1) == self.copies - 1
        return np.asarray(in_last & (self.copies > 1))

    def in_all_copies(self, values: FloatArray) -> FloatArray:
        """Extend values of the process's pairs to all pairs of all copies.

        Args:
            values: [process pairs].

        Returns:
            Values, [copies * width + 1]; 0 for pairs that no policy reaches; the source is last.
        """
        every = np.zeros(self.copies * self.width + 1)
        every[self.part.pairs] = values
        return every

    def paid(self, copy: int) -> float | None:
        """Return the accumulated cost of a copy; None in case M."""
        return None

    @property
    def model(self) -> SSP:
        """The model that the process augments."""
        return self.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Mask of the pairs by which a policy gives up, [process pairs]."""
        return self._of_copies(self.quotient.gives_up)

    def _of_copies(self, chosen: BoolArray) -> BoolArray:
        """Return a mask of the process's pairs, [process pairs], given one copy's mask, [width]."""
        return np.append(np.tile(chosen, self.copies), False)[self.part.pairs]

    def label(self, number: int) -> ColumnLabel:
        """Return the label of a pair, given its number among the pairs of all copies."""
        if number >= self.copies * self.width:
            return ColumnLabel(None, START, self.paid(0))
        copy, inner = divmod(number, self.width)
        return ColumnLabel(*self.quotient.named(inner), self.paid(copy))

    def pairs_of(self, states: IntArray, action: Hashable | None) -> IntArray:
        """Find the pairs of the process that take an action, or any action, in given states.

        Args:
            states: numbers of states of the model.
            action: an action of one of these states, ``GIVE_UP``, ``STAY``, or None for all.

        Raises:
            ModelError: none of the states has the action.
        """
        quotient, live = self.quotient, states[self.quotient.node_of[states] >= 0]
        inner = np.isin(quotient.pair_node, quotient.node_of[live])
        if action is GIVE_UP or action == STAY:
            inner &= quotient.gives_up
        elif action is not None:
            model = self.model
            named = np.array([name == action for name in model.action_names], dtype=np.bool_)
            taken = np.flatnonzero(np.isin(model.pair_state, states) & named[model.pair_action])
            acts = np.diff(model.pair_offsets)[states] > 0  # copies that are out of time do not act
            if not taken.size and (acts.any() or not isinstance(model, ProductSSP)):
                raise ModelError(model.no_such_action(int(states[np.argmax(acts)]), action))
            inner &= np.isin(quotient.pair_at, taken)
        return np.flatnonzero(self._of_copies(inner))

    def policy(self, choice: IntArray) -> DeterministicPolicy | CostAwarePolicy:
        """Return the policy on the model that a deterministic choice in the process describes.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        return self.inner.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """Return the policy on the model that draws pairs in proportion to their visits.

        Args:
            visits: expected visits, [process pairs].
            choice: the pairs that are taken in states that are never visited, [process states].
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
class LabelledModel(AugmentedProcess):
    """The process of case M: its states are those of the model while a run has not failed."""

    inner: LabelledProcess
    discount: float | None

    @classmethod
    def of(
        cls,
        inner: LabelledProcess,
        start: FloatArray,
        semantics: FailureSemantics,
        discount: float | None,
    ) -> LabelledModel:
        """Build the augmented model from a process of case M, with all its states.

        Args:
            inner: the process with the failure label.
            start: distribution over states, [states].
            semantics: where giving up is allowed.
            discount: a factor in (0, 1), or None for no discount.
        """
        every = np.arange(inner.process.n_states), np.arange(inner.process.n_pairs)
        return cls(inner, start, semantics, ReachablePart(inner.process, *every), discount)

    @property
    def live(self) -> LabelledProcess:
        """The process itself: there is one copy, since no cost is accumulated."""
        return self.inner

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """Yield the expected visits of the model's pairs, for the only copy."""
        quotient = self.quotient
        flow = model_flow(quotient, visits[: self.width] / self.inner.escape)
        yield moving_within(quotient, flow, self.start + flow.entering(quotient))

    def spread(self, spread: Spread) -> LabelledModel:
        """Return the augmented model in which each live state is a node of its own."""
        process, single, width = self.process, spread.quotient, self.width
        rows = single.transitions(1.0, departing=False).matrix  # a discount collapses nothing
        rewards = (process.cost, process.failure, process.goal)
        taken = (spread.per_visit(each[:width]) for each in rewards)
        apart = ExplicitProcess(single.pair_offsets, rows, single.gather(self.start), *taken)
        whole = with_start(apart, single, self.start, float(process.cost[width:].sum()))
        ones = np.ones(len(single.pair_at))
        labelled = LabelledProcess(whole, single, ones)
        return LabelledModel.of(labelled, self.start, self.semantics, self.discount)

    def started(self, start: Hashable | Mapping[Hashable, float]) -> LabelledModel | None:
        """Return the augmented model with another start.

        The result is None with a horizon, or if an episode may end where it begins: then the pairs
        depend on the start.
        """
        if isinstance(self.model, ProductSSP) and self.model.is_hidden:
            return None
        begun, ends = start_distribution(self.model, start), self.quotient.node_of < 0
        if begun[ends].any() or self.start[ends].any():
            return None
        live = replace(self.inner, process=replace(self.process, start=self.quotient.gather(begun)))
        return LabelledModel.of(live, begun, self.semantics, self.discount)

    def counted(self, term: Term) -> FloatArray:
        """Return the coefficient of a term for each pair, [process pairs]."""
        counting = counting_of(self.inner, self.start, self.semantics, self.discount)
        return np.append(*term.at(counting))[: self.process.n_pairs]


@dataclass(frozen=True, eq=False)
class LayeredModel(AugmentedProcess):
    """The process of case S: its states are pairs of a model state and an accumulated cost.

    It contains only accumulated costs that a run can reach. One last layer stands for all costs
    above the cap.
    """

    inner: OpenEnded

    @classmethod
    def of(cls, inner: OpenEnded, start: FloatArray, semantics: FailureSemantics) -> LayeredModel:
        """Build the augmented model from layers of accumulated cost, without unreachable states.

        Args:
            inner: the layers and the last layer above the cap.
            start: distribution over states, [states].
            semantics: where giving up is allowed.
        """
        part = inner.reachable_part()
        return cls(replace(inner), start, semantics, part)  # without the table's caches

    @property
    def live(self) -> AccumulatedCost:
        """One layer, which is copied for each accumulated cost."""
        return self.inner.base

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """Yield the expected visits of the model's pairs in each layer, the lowest cost first."""
        base, quotient, n_pairs = self.inner.base, self.quotient, self.width
        model, merged = quotient.model, bool(quotient.merged.any())
        entering = np.zeros((self.copies + base.width if merged else 0, model.n_states))
        entering[:1] = self.inner.start
        kinds, kind = np.unique(base.step_classes.ahead, return_inverse=True)
        below = self.inner.leads(kinds)[0] if merged else kinds
        visits = self.in_all_copies(visits)
        for layer in range(self.copies):
            taken = visits[layer * n_pairs : (layer + 1) * n_pairs] / base.escape
            flow = model_flow(quotient, taken)
            if merged:
                mass = np.repeat(flow.pairs, np.diff(model.outcome_offsets)) * model.probabilities
                moved = np.flatnonzero(mass)
                reached = below[layer, kind[moved]]
                np.add.at(entering, (reached, model.successors[moved]), mass[moved])
                flow = moving_within(quotient, flow, entering[layer])
            yield flow

    def spread(self, spread: Spread) -> LayeredModel:
        """Return the augmented model in which no component of a layer is merged."""
        base = spread_layer(self.inner.base, spread, self.start)
        return LayeredModel.of(replace(self.inner, base=base), self.start, self.semantics)

    def counted(self, term: Term) -> FloatArray:
        """Return the coefficient of a term for each pair of all layers, [process pairs]."""
        taken = self.inner.everywhere(*term.at(self.inner.counting(self.semantics)))
        return taken[self.part.pairs]

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """Translate a choice in the process to a policy of the model that remembers the cost.

        At an accumulated cost that no run reaches, the policy acts as at the next smaller reached
        cost.

        Args:
            choice: one pair of each state of the process, [process states].
        """
        shape = self.copies, self.inner.base.n_nodes
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
        """Number of layers, including the last one, which stands for all costs above the cap."""
        return self.inner.cap + 1

    def paid(self, copy: int) -> float:
        """Return the accumulated cost of a layer; the last layer stands for all greater costs."""
        return float(self.inner.totals.values[copy])
