"""The moves of a policy's layers, read off the model's outcomes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, concatenated_ranges
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.model import SSP
from ssp_lp.model.chunks import chunks
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.policies.cost_layers import CostLayers

_NO_CLASSES = np.zeros(0, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Staying:
    """Moves of a layer's decisions that stay in it."""

    share: sp.csr_array  # [states, states] probabilities
    paid: sp.csr_array  # [states, states] the same times the cost
    onward: FloatArray  # [states] probability of moving to a later layer


@dataclass(frozen=True, eq=False)
class Moves:
    """A model's outcomes by the class of their cost, and which of its states act."""

    model: SSP
    layers: CostLayers

    @cached_property
    def acting(self) -> BoolArray:
        """States at which episodes go on, [states]."""
        return ~(dead_ends(self.model) | self.model.goal_mask)

    @cached_property
    def classes(self) -> IntArray:
        """Class of each outcome's cost, [outcomes]; empty where there is one class."""
        costs, model = self.layers.costs, self.model
        if len(costs) == 1:
            return _NO_CLASSES
        result = np.empty(model.n_outcomes, dtype=np.min_scalar_type(len(costs)))
        for some in chunks(model.n_outcomes):
            result[some] = np.searchsorted(costs, model.costs[some])
        return result

    def pairs(self, decision: IntArray) -> IntArray:
        """Pairs of acting states in place of positions; codes stay, -3 elsewhere, [states]."""
        pair = np.where(decision < 0, decision, self.model.pair_offsets[:-1] + decision)
        return np.where(self.acting, pair, -3)

    def slots(self, layer: int) -> IntArray:
        """Where in a ring of ``width - 1`` layers each class leads, -1: it stays, [classes]."""
        leads, room = self.layers.leads(layer), max(self.layers.width - 1, 1)
        return np.where(leads > 0, (layer + leads) % room, -1)

    def expect(
        self,
        pairs: IntArray,
        slots: IntArray,
        worth: FloatArray,
        marks: IntArray,
        priced: IntArray,
        costs: FloatArray,
    ) -> tuple[FloatArray, IntArray]:
        """Expected worth of arriving in later layers, [states, columns], and marks met, [states].

        Args:
            pairs: [states].
            slots: [classes].
            worth: [slots, states, columns].
            marks: [slots, states].
            priced: columns (from, to) of which one counts in the other, times a cost, [k, 2].
            costs: of each class, [k, classes].
        """
        check_time()
        model = self.model
        sums, found = np.zeros(worth.shape[1:]), np.zeros(len(pairs), dtype=np.uint8)
        if accelerated(model.n_outcomes):
            from ssp_lp.compiled.streaming import stream_totals

            stream_totals(model.n_outcomes)(
                pairs, model.outcome_offsets, model.successors.view(np.uint32),
                model.probabilities, self.classes, slots, costs,
                worth, marks, priced, sums, found,
            )  # fmt: skip
            return sums, found
        source, outcome = self._taken(pairs)
        kind = self.classes[outcome] if self.classes.size else np.zeros(len(outcome), dtype=int)
        later = slots[kind] >= 0
        source, outcome, kind = source[later], outcome[later], kind[later]
        place = slots[kind] * len(pairs) + model.successors[outcome]
        flat, shape = worth.reshape(-1, worth.shape[2]), (len(pairs), marks.size)
        share = model.probabilities[outcome]
        sums += sp.csr_array((share, (source, place)), shape=shape) @ flat
        for (begin, end), cost in zip(priced.tolist(), costs, strict=True):
            sums[:, end] += (
                sp.csr_array((share * cost[kind], (source, place)), shape=shape) @ flat[:, begin]
            )
        np.bitwise_or.at(found, source, marks.reshape(-1)[place])
        return sums, found

    def send(self, mass: FloatArray, pairs: IntArray, slots: IntArray, waiting: FloatArray) -> None:
        """Send the mass of a layer on to later ones, in place.

        Args:
            mass: [states].
            pairs: [states].
            slots: [classes].
            waiting: [slots, states].
        """
        check_time()
        model = self.model
        if accelerated(model.n_outcomes):
            from ssp_lp.compiled.streaming import stream_mass

            arrays = model.outcome_offsets, model.successors.view(np.uint32), model.probabilities
            stream_mass(mass, pairs, *arrays, self.classes, slots, waiting)
            return
        source, outcome = self._taken(np.where(mass > 0.0, pairs, -1))
        kind = self.classes[outcome] if self.classes.size else np.zeros(len(outcome), dtype=int)
        later = slots[kind] >= 0
        source, outcome, kind = source[later], outcome[later], kind[later]
        place = slots[kind], model.successors[outcome]
        np.add.at(waiting, place, mass[source] * model.probabilities[outcome])

    def staying(self, pairs: IntArray, slots: IntArray) -> Staying | None:
        """Moves within the layer; None: there are none."""
        if (slots >= 0).all():
            return None
        source, outcome = self._taken(pairs)
        kind = self.classes[outcome] if self.classes.size else np.zeros(len(outcome), dtype=int)
        stays, share = slots[kind] < 0, self.model.probabilities[outcome]
        onward = np.zeros(len(pairs))
        np.add.at(onward, source[~stays], share[~stays])
        source, outcome, kind = source[stays], outcome[stays], kind[stays]
        if not source.size:
            return None
        where, shape = (source, self.model.successors[outcome]), (len(pairs), len(pairs))
        share = share[stays]
        paid = sp.csr_array((share * self.layers.costs[kind], where), shape=shape)
        return Staying(sp.csr_array((share, where), shape=shape), paid, onward)

    def _taken(self, pairs: IntArray) -> tuple[IntArray, IntArray]:
        """State and outcome of each possible move, [moves] each."""
        states = np.flatnonzero(pairs >= 0)
        begin = self.model.outcome_offsets[pairs[states]]
        counts = self.model.outcome_offsets[pairs[states] + 1] - begin
        outcome, source = concatenated_ranges(begin, counts), np.repeat(states, counts)
        possible = self.model.probabilities[outcome] > 0.0
        return source[possible], outcome[possible]
