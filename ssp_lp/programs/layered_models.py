"""Accumulated cost written out in layers, with its way back to the model (paper, section 3.1.1).

Up to a cap with tail policies beyond it, or open-ended, one place standing for all costs beyond.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.flow import ModelFlow, decisions, model_flow, moving_within
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess, materialise
from ssp_lp.processes.layered.open_ended import OpenEnded
from ssp_lp.programs.augmented import FAIL, GO_FOR_GOAL, START, ColumnLabel

_MIXED = 1e-9  # share of a tail's visits from which it counts


@dataclass(frozen=True, eq=False)
class LayeredModel:
    """States and the cost paid so far, up to a cap; from there on a tail policy for good."""

    layered: LayeredProcess
    start: FloatArray  # [states]

    @cached_property
    def process(self) -> ExplicitProcess:
        """All layers, whose pairs are the columns."""
        return materialise(self.layered)

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        return self.layered.base.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        mask = np.zeros(self.process.n_pairs, dtype=np.bool_)
        own = np.tile(self.layered.base.quotient.gives_up, self.layered.cap)
        mask[: own.size] = own
        return mask

    def label(self, pair: int) -> ColumnLabel:
        """The state, the action and the accumulated cost of a pair."""
        base, quotient = self.layered.base, self.layered.base.quotient
        if pair == self.process.n_pairs - 1:
            return ColumnLabel(None, START, 0.0)
        layer, inner = divmod(pair, len(base.gain))
        if layer < self.layered.cap:
            return ColumnLabel(*quotient.named(inner), float(layer * base.exact_unit))
        place, tail = divmod(pair - self.layered.cap * len(base.gain), len(self._tails))
        beyond, node = divmod(place, base.n_nodes)
        paid = float((self.layered.cap + beyond) * base.exact_unit)
        return ColumnLabel(quotient.first_member(node), (GO_FOR_GOAL, FAIL)[tail], paid)

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """One pair of the process for each accumulated cost below the cap."""
        base = self.layered.base
        layers = np.arange(self.layered.cap)[:, None] * len(base.gain)
        return np.asarray((layers + base.quotient.places_of(pair, state)).ravel())

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """One decision for each state and accumulated cost below the cap, then a tail."""
        base, cap, n = self.layered.base, self.layered.cap, self.layered.base.n_nodes
        rows = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1]
        within = self.layered.policy(choice[: cap * n].reshape(cap, n) - rows, 0.0)
        first = self.process.pair_offsets[cap * n : cap * n + (base.width - 1) * n]
        tail = choice[cap * n : cap * n + (base.width - 1) * n] - first
        return self._with_tails(within, tail.reshape(base.width - 1, n))

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A policy on states and accumulated cost, which follows the tails beyond the cap.

        Raises:
            ModelError: the visits follow both tails from one place, which no policy that only
                remembers the cost can do.
        """
        carrier = self._with_tails(self.policy(choice), self._tails_taken(visits, choice))
        n_states, cap = self.model.n_states, self.layered.cap
        found = []
        of_layers = layer_flows(self.layered.base, visits, self.start, cap)
        for layer, flow in enumerate(of_layers):
            everywhere = np.arange(n_states)
            memory = np.full(n_states, layer)
            otherwise = carrier.branches(everywhere, memory).pair
            state, pair, share = decisions(self.layered.base.quotient, flow, otherwise)
            found.append((layer * n_states + state, pair, share))
        for number, tail in enumerate(carrier.tails):
            known = np.flatnonzero(tail >= GIVE_UP_CODE)
            keys = (cap + number) * n_states + known
            found.append((keys, tail[known].astype(np.int64), np.ones(known.size)))
        keys, pairs, flows = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, flows, carrier)

    def _tails_taken(self, visits: FloatArray, choice: IntArray) -> IntArray:
        """The tail that is followed from each place beyond the cap, [layers, nodes].

        Raises:
            ModelError: both are.
        """
        base, cap, n = self.layered.base, self.layered.cap, self.layered.base.n_nodes
        begin, n_tails = cap * len(base.gain), len(self._tails)
        size = (base.width - 1) * n
        flow = visits[begin : begin + size * n_tails].reshape(size, n_tails)
        total = flow.sum(axis=1)
        both = (flow > _MIXED * total[:, None]).sum(axis=1) > 1
        if (both & np.tile(self._tails_differ, base.width - 1)).any():
            raise ModelError(
                "the measure goes on in two ways from one accumulated cost beyond the cap, and a "
                "policy that remembers the cost alone cannot: take mixed_policy(), or a larger "
                "cost_cap"
            )
        first = self.process.pair_offsets[cap * n : cap * n + size]
        chosen = choice[cap * n : cap * n + size] - first
        return np.where(total > 0.0, flow.argmax(axis=1), chosen).reshape(base.width - 1, n)

    def _with_tails(self, policy: CostAwarePolicy, tails: IntArray) -> CostAwarePolicy:
        """The policy with the tail that is followed from each place, [layers, nodes]."""
        quotient = self.layered.base.quotient
        live = quotient.node_of >= 0
        table = np.zeros((max(len(tails), 1), self.model.n_states), dtype=np.int8)
        if len(tails):
            table[:, live] = tails[:, quotient.node_of[live]]
        return CostAwarePolicy(
            self.model, policy.unit, policy.decision, policy.tails, policy.tail_threshold, table
        )

    @property
    def _tails_differ(self) -> BoolArray:
        """Where it matters which tail is followed, [nodes]."""
        values = self.layered.tails.values
        figures = values.goal, values.cost, values.moment
        differ = [np.ptp(v, axis=0) > _MIXED * np.abs(v).max(axis=0) for v in figures]
        return np.asarray(np.any(differ, axis=0))

    @property
    def _tails(self) -> IntArray:
        """The decisions of the tail policies, [tails, states]."""
        return self.layered.tails.decisions


def layer_flows(
    base: AccumulatedCost,
    visits: FloatArray,
    start: FloatArray,
    n_layers: int,
    below: IntArray | None = None,
) -> Iterator[ModelFlow]:
    """The model's flow in each layer, moves within collapsed components included.

    Args:
        base: one layer of the process.
        visits: of the process's pairs, layer by layer, [process pairs].
        start: [states].
        n_layers: how many layers there are.
        below: the layer that each step leads to, [layers, steps]; None: as many ahead as it has.
    """
    quotient, model, n_pairs = base.quotient, base.quotient.model, len(base.gain)
    merged = bool(quotient.merged.any())
    entering = np.zeros((n_layers + base.width, model.n_states) if merged else (0, 0))
    lengths = np.diff(model.outcome_offsets)
    if merged:
        entering[0] = start
    for layer in range(n_layers):
        taken = visits[layer * n_pairs : (layer + 1) * n_pairs] / base.departs
        flow = model_flow(quotient, taken)
        if merged:
            mass = np.repeat(flow.pairs, lengths) * model.probabilities
            moved = np.flatnonzero(mass)
            ahead = base.lattice.ahead[moved]
            reached = layer + ahead if below is None else below[layer, ahead]
            np.add.at(entering, (reached, model.successors[moved]), mass[moved])
            flow = moving_within(quotient, flow, entering[layer])
        yield flow


@dataclass(frozen=True, eq=False)
class OpenEndedModel:
    """States and the cost paid so far; from the cap on one policy for all costs."""

    layered: OpenEnded

    @property
    def process(self) -> ExplicitProcess:
        """All layers, whose pairs are the columns."""
        return self.layered.process

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        return self.layered.base.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        own = self.layered.base.quotient.gives_up
        return np.append(np.tile(own, self.layered.cap + 1), False)

    def label(self, pair: int) -> ColumnLabel:
        """The state, the action and the accumulated cost of a pair; the last stands for more."""
        base = self.layered.base
        if pair == self.process.n_pairs - 1:
            return ColumnLabel(None, START, 0.0)
        layer, inner = divmod(pair, len(base.gain))
        return ColumnLabel(*base.quotient.named(inner), float(self.layered.totals[layer]))

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """One pair of the process for each accumulated cost."""
        base = self.layered.base
        layers = np.arange(self.layered.cap + 1)[:, None] * len(base.gain)
        return np.asarray((layers + base.quotient.places_of(pair, state)).ravel())

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """One decision for each state and accumulated cost."""
        return self.layered.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A policy on states and accumulated cost."""
        layered, n_states = self.layered, self.model.n_states
        carrier, everywhere = self.policy(choice), np.arange(n_states)
        flows = layer_flows(layered.base, visits, layered.start, layered.cap + 1, layered.leads[0])
        found = []
        for layer, flow in enumerate(flows):
            otherwise = carrier.branches(everywhere, np.full(n_states, layer)).pair
            state, pair, share = decisions(layered.base.quotient, flow, otherwise)
            found.append((layer * n_states + state, pair, share))
        keys, pairs, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, carrier)
