"""Accumulated cost written out in layers, with its way back to the model (paper, section 3.1.1).

Up to a cap with tail policies beyond it, or open-ended, one place standing for all costs beyond.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.flow import ModelFlow, decisions, model_flow, moving_within
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess, materialise
from ssp_lp.processes.layered.open_ended import OpenEnded
from ssp_lp.processes.quotient import Quotient
from ssp_lp.programs.augmented import FAIL, GO_FOR_GOAL, Augmented, ColumnLabel

_MIXED = 1e-9  # share of a tail's visits from which it counts


@dataclass(frozen=True, eq=False)
class LayeredModel(Augmented):
    """States and the cost paid so far, up to a cap; from there on a tail policy for good."""

    layered: LayeredProcess
    start: FloatArray  # [states]

    @cached_property
    def process(self) -> ExplicitProcess:
        """All layers, written out."""
        return materialise(self.layered)

    @property
    def quotient(self) -> Quotient:
        """The live part of a layer."""
        return self.layered.base.quotient

    @property
    def copies(self) -> int:
        """The layers below the cap."""
        return self.layered.cap

    def paid(self, copy: int) -> float:
        """The layer's multiple of the unit."""
        return float(copy * self.layered.base.exact_unit)

    def label_beyond(self, pair: int) -> ColumnLabel:
        """The tail that is followed from a place beyond the cap, or the start."""
        if pair == self.process.n_pairs - 1:
            return super().label_beyond(pair)
        first = self.copies * len(self.quotient.pair_at)
        place, tail = divmod(pair - first, len(self._tails))
        beyond, node = divmod(place, self.quotient.n_nodes)
        words = (GO_FOR_GOAL, FAIL)[tail]
        return ColumnLabel(self.quotient.first_member(node), words, self.paid(self.copies + beyond))

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
        flows = layer_flows(self.layered.base, visits, self.start, self.copies)
        found = _decisions_in_layers(self.quotient, carrier, flows)
        for number, tail in enumerate(carrier.tails):
            known = np.flatnonzero(tail >= GIVE_UP_CODE)
            keys = (self.copies + number) * self.model.n_states + known
            found.append((keys, tail[known].astype(np.int64), np.ones(known.size)))
        keys, pairs, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, carrier)

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


def _decisions_in_layers(
    quotient: Quotient, carrier: CostAwarePolicy, flows: Iterable[ModelFlow]
) -> list[tuple[IntArray, IntArray, FloatArray]]:
    """Situations, pairs and shares of each layer; the carrier's where a layer is never visited."""
    n_states, found = quotient.model.n_states, []
    for layer, flow in enumerate(flows):
        otherwise = carrier.branches(np.arange(n_states), np.full(n_states, layer)).pair
        state, pair, share = decisions(quotient, flow, otherwise)
        found.append((layer * n_states + state, pair, share))
    return found


@dataclass(frozen=True, eq=False)
class OpenEndedModel(Augmented):
    """States and the cost paid so far; from the cap on one policy for all costs."""

    layered: OpenEnded

    @property
    def process(self) -> ExplicitProcess:
        """All layers, written out."""
        return self.layered.process

    @property
    def quotient(self) -> Quotient:
        """The live part of a layer."""
        return self.layered.base.quotient

    @property
    def copies(self) -> int:
        """The layers up to the cap, which stands for all costs beyond it."""
        return self.layered.cap + 1

    def paid(self, copy: int) -> float:
        """The layer's total; the last stands for more."""
        return float(self.layered.totals[copy])

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """One decision for each state and accumulated cost."""
        return self.layered.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A policy on states and accumulated cost."""
        layered, carrier = self.layered, self.policy(choice)
        flows = layer_flows(layered.base, visits, layered.start, self.copies, layered.leads[0])
        found = _decisions_in_layers(self.quotient, carrier, flows)
        keys, pairs, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, carrier)
