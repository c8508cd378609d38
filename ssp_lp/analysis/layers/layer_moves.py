"""The moves of a policy's layers, read off the model's outcomes, and what they may come to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, concatenated_ranges, offsets_of
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.equations import strong_components
from ssp_lp.model import SSP
from ssp_lp.model.chunks import chunks
from ssp_lp.model.graph.reachability import dead_ends, reached_along
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, CostLayers

HOPEFUL, OPEN, WRONG, ENDLESS, FAILS = 1, 2, 4, 8, 16
"""Bits: the goal can be reached; some end can; a decision that is missing or not allowed can;
a loop that costs something and is never left can; failing can, where that is forbidden."""

ENDED = -3
"""In place of a pair where an episode is over."""

_NO_CLASSES = np.zeros(0, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Staying:
    """Moves of a layer's decisions that stay in it, among k states from which they stay there."""

    share: sp.csr_array  # [k, k] probabilities
    paid: sp.csr_array  # [k, k] the same times the cost
    onward: FloatArray  # [k] probability of moving to a later layer


@dataclass(frozen=True, eq=False)
class LayerMoves:
    """A model's outcomes by the class of their cost, and which of its states act.

    ``slots`` are where in a ring of layers each class of steps leads, -1 where it stays, [classes].
    """

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

    @property
    def room(self) -> int:
        """Layers in a ring that holds all to which a step may lead."""
        return max(self.layers.width - 1, 1)

    def pairs(self, layer: int, states: IntArray) -> IntArray:
        """Pairs of acting states in a layer; codes stay, -3 elsewhere, like ``states``."""
        decision = self.layers.decision[layer][states]
        pair = np.where(decision < 0, decision, self.model.pair_offsets[states] + decision)
        return np.where(self.acting[states], pair, ENDED)

    def tail(self, number: int, states: IntArray) -> IntArray:
        """The same moves under a tail."""
        return np.where(self.acting[states], self.layers.tails[number][states], ENDED)

    def slots(self, layer: int) -> IntArray:
        """Slots of a layer's moves."""
        leads, room = self.layers.leads(layer), self.room
        slots = leads + layer % room
        slots[slots >= room] -= room  # no step leads beyond the ring
        slots[leads <= 0] = -1
        return slots

    def expect(
        self,
        pairs: IntArray,
        slots: IntArray,
        worth: FloatArray,
        marks: IntArray,
        priced: IntArray,
        costs: FloatArray,
    ) -> tuple[FloatArray, IntArray]:
        """Expected worth of arriving in later layers, [k, columns], and marks met, [k].

        Args:
            pairs: of the states asked for, [k].
            slots: [classes].
            worth: [slots, states, columns].
            marks: [slots, states].
            priced: columns (from, to) of which one counts in the other, times a cost, [.., 2].
            costs: of each class, [.., classes].
        """
        check_time()
        sums, found = np.zeros((len(pairs), worth.shape[2])), np.zeros(len(pairs), dtype=np.uint8)
        if accelerated(self.model.n_outcomes):
            from ssp_lp.compiled.streaming import stream_totals

            stream_totals(self.model.n_outcomes)(
                pairs, *self._outcomes, slots, costs, worth, marks, priced, sums, found
            )
            return sums, found
        source, outcome, kind = self._taken(pairs, slots >= 0)
        place = slots[kind] * marks.shape[1] + self.model.successors[outcome]
        flat, shape = worth.reshape(-1, worth.shape[2]), (len(pairs), marks.size)
        share = self.model.probabilities[outcome]
        sums += sp.csr_array((share, (source, place)), shape=shape) @ flat
        for (begin, end), cost in zip(priced.tolist(), costs, strict=True):
            sums[:, end] += (
                sp.csr_array((share * cost[kind], (source, place)), shape=shape) @ flat[:, begin]
            )
        np.bitwise_or.at(found, source, marks.reshape(-1)[place])
        return sums, found

    @cached_property
    def free_order(self) -> IntArray:
        """States, each after those that its free moves lead to, as far as may be, [states]."""
        model = self.model
        staying = (self.layers.leads(0) <= 0)[self.classes if self.classes.size else [0]]
        begins = model.outcome_offsets[model.pair_offsets]
        found = strong_components(begins, model.successors, model.probabilities * staying)
        return found.order

    def meet(self, begin: int, end: int, hopeful: BoolArray) -> None:
        """Mark where decisions of layers may lead to what is marked in them or later, in place.

        Args:
            begin: the first of the layers, which pass equally many with each class of steps.
            end: behind the last of them; they are taken from the last one on.
            hopeful: what is marked, and becomes so, [layers and those behind them, states].
        """
        check_time()
        model, leads, decision = self.model, self.layers.leads(begin), self.layers.decision
        if not model.n_outcomes:
            return
        if accelerated(model.n_outcomes * (end - begin)):
            from ssp_lp.compiled.streaming import stream_hope

            own = decision[begin:end], self.acting, model.pair_offsets
            rest = leads, self.free_order, hopeful[begin:]
            stream_hope(decision[begin:end].size)(*own, *self._outcomes, *rest)
            return
        everywhere = np.arange(model.n_states)
        for layer in reversed(range(begin, end)):
            pairs = self.pairs(layer, everywhere)
            source, outcome, kind = self._taken(pairs, leads >= 0)
            met = hopeful[layer + leads[kind], model.successors[outcome]]
            hopeful[layer, source[met]] = True
            if (leads <= 0).any():
                marks = np.where(hopeful[layer], HOPEFUL, 0)
                spread_in_layer(marks, HOPEFUL, self.staying(everywhere, pairs, self.slots(layer)))
                hopeful[layer] = marks > 0

    def reach(self, pairs: IntArray, slots: IntArray, arriving: BoolArray) -> None:
        """Mark where pairs, [k], may lead in later layers, in place, [slots, states]."""
        check_time()
        if accelerated(self.model.n_outcomes):
            from ssp_lp.compiled.streaming import stream_arrivals

            stream_arrivals(pairs, *self._outcomes, slots, arriving)
            return
        _, outcome, kind = self._taken(pairs, slots >= 0)
        arriving[slots[kind], self.model.successors[outcome]] = True

    def send(self, mass: FloatArray, pairs: IntArray, slots: IntArray, waiting: FloatArray) -> None:
        """Send the mass of a layer, [states], on to later ones, in place, [slots, states]."""
        check_time()
        if accelerated(self.model.n_outcomes):
            from ssp_lp.compiled.streaming import stream_mass

            stream_mass(mass, pairs, *self._outcomes, slots, waiting)
            return
        source, outcome, kind = self._taken(np.where(mass > 0.0, pairs, -1), slots >= 0)
        place = slots[kind], self.model.successors[outcome]
        np.add.at(waiting, place, mass[source] * self.model.probabilities[outcome])

    def within(self, pairs: IntArray, slots: IntArray, begins: IntArray) -> IntArray:
        """States to which moves that stay lead from some, these included, increasing.

        Args:
            pairs: of all states, [states].
            slots: [classes].
            begins: increasing.
        """
        source, outcome, _ = self._taken(pairs, slots < 0)
        if not source.size:
            return begins
        offsets = offsets_of(np.bincount(source, minlength=len(pairs)))
        return np.flatnonzero(reached_along(self.model.successors[outcome], offsets, begins))

    def staying(self, states: IntArray, pairs: IntArray, slots: IntArray) -> Staying | None:
        """Moves within the layer; None: there are none.

        Args:
            states: increasing, from which all such moves lead to one of them, [k].
            pairs: [k].
            slots: [classes].
        """
        if (slots >= 0).all():
            return None
        source, outcome, kind = self._taken(pairs, slots < 0)
        if not source.size:
            return None
        share, target = self.model.probabilities[outcome], self.model.successors[outcome]
        where, shape = (source, np.searchsorted(states, target)), (len(states), len(states))
        paid = sp.csr_array((share * self.layers.costs[kind], where), shape=shape)
        onward = np.zeros(len(pairs))
        source, outcome, _ = self._taken(pairs, slots >= 0)
        np.add.at(onward, source, self.model.probabilities[outcome])
        return Staying(sp.csr_array((share, where), shape=shape), paid, onward)

    @property
    def _outcomes(self) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
        """What a compiled pass reads of a layer's moves."""
        model = self.model
        successors = model.successors.view(np.uint32)
        return model.outcome_offsets, successors, model.probabilities, self.classes

    def _taken(self, pairs: IntArray, wanted: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
        """Position among the pairs, outcome and class of each possible move of wanted classes."""
        where = np.flatnonzero(pairs >= 0)
        begin = self.model.outcome_offsets[pairs[where]]
        counts = self.model.outcome_offsets[pairs[where] + 1] - begin
        outcome, source = concatenated_ranges(begin, counts), np.repeat(where, counts)
        kept = self.model.probabilities[outcome] > 0.0
        if self.classes.size:
            kept &= wanted[self.classes[outcome]]
        elif not wanted.all():
            kept[:] = False
        source, outcome = source[kept], outcome[kept]
        return source, outcome, self.classes[outcome] if self.classes.size else 0 * outcome


def marks_of(
    pairs: IntArray,
    staying: Staying | None,
    met: IntArray,
    ended: IntArray,
    forbidden: BoolArray,
    *,
    forbids_failing: bool,
    paying: BoolArray | None,
) -> IntArray:
    """The marks of k states of a layer, of what its moves may meet.

    Args:
        pairs: [k].
        staying: moves within the layer; None: there are none.
        met: marks that may be met in later layers, [k].
        ended: marks of goals and dead-ends, 0 elsewhere, [k].
        forbidden: where the policy may not give up, [k].
        forbids_failing: whether failing is forbidden.
        paying: states whose decision may cost something, where loops that are never left cost
            without end, [k]; None: nothing is paid in them.
    """
    quits, missing = pairs == GIVE_UP_CODE, pairs == UNDECIDED
    marks = met | ended
    marks[quits] |= OPEN | (FAILS if forbids_failing else 0)
    marks[missing | (quits & forbidden)] |= WRONG
    acting = ended == 0
    for bit in (HOPEFUL, OPEN):
        spread_in_layer(marks, bit, staying)
    if forbids_failing:
        marks[acting & ((marks & HOPEFUL) == 0)] |= FAILS
    if paying is not None and staying is not None:
        never = acting & ((marks & OPEN) == 0)
        marks[closed_states(staying.share, staying.onward, never) & paying] |= ENDLESS
    for bit in (WRONG, ENDLESS, FAILS):
        spread_in_layer(marks, bit, staying)
    return marks


def spread_in_layer(marks: IntArray, bit: int, staying: Staying | None) -> None:
    """Mark, in place, all states from which a marked one can be reached within the layer."""
    begins = np.flatnonzero(marks & bit)
    if staying is None or not begins.size or begins.size == marks.size:
        return
    backward = staying.share.tocsc()
    marks[reached_along(backward.indices, backward.indptr, begins)] |= bit


def closed_states(share: sp.csr_array, onward: FloatArray, among: BoolArray) -> BoolArray:
    """States of classes that no move of the layer ever leaves, [k].

    Args:
        share: moves, [k, k].
        onward: probability of leaving otherwise, [k].
        among: states outside of which every move leaves, [k].
    """
    _, label = csgraph.connected_components(share, connection="strong")
    entry = share.tocoo()
    leaves = ~among | (onward > 0.0)
    leaves[entry.row[label[entry.row] != label[entry.col]]] = True
    return np.asarray(~np.isin(label, np.unique(label[leaves])))
