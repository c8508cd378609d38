"""A policy that remembers its cost, layer by layer of the cost paid, on the model's own outcomes.

Backward sweeps total what follows. Only the layers that a step can reach are held at once. Within a
layer, where steps cost nothing, and under the tails, the totals are those of a chain of its own and
verified as such (``evaluate_chain``); from layer to layer they are sums of products, which lose a
rounding each.

Forward, the law of the total cost: below the cap the cost paid is the layer, so that all that a law
needs of a layer is how much mass arrives at the goal with it. What reaches the cap goes on by the
policy's tails, whose chains are written out.

A state from which the goal is not reached under a policy is one in which it can be avoided for
sure, so that the policy may give up there: what it would still pay changes no cost given success.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.accumulated_cost.totals import exact_cost, totals_of
from ssp_lp.arrays import (
    SAME_TOTAL,
    BoolArray,
    FloatArray,
    IntArray,
    chunks,
    concatenated_ranges,
    offsets_of,
    read_only,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.equations import System, strong_components
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import (
    dead_ends,
    goal_pairs,
    nearer_pairs,
    reached_along,
)
from ssp_lp.policies import CostAwarePolicy, MixedPolicy
from ssp_lp.policies.chain import Chain, policy_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, CostLayers, DeterministicPolicy, Policy

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

    def closed(self, among: BoolArray) -> BoolArray:
        """States of classes that no move ever leaves, [k].

        Args:
            among: states outside of which every move leaves, [k].
        """
        closed = np.zeros(len(among), dtype=np.bool_)
        closed[System(self.share, np.where(among, self.onward, 1.0)).closed] = True
        return closed


@dataclass(frozen=True, eq=False)
class LayerMoves:
    """A model's outcomes by the class of their cost, and which of its states act.

    Layers ahead are rows of a ring: there each class of steps leads, -1 where it stays, [classes].
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

    def ring(self, layer: int) -> IntArray:
        """Rows of the ring to which a layer's classes of steps lead, -1: they stay, [classes]."""
        leads, room = self.layers.leads(layer), self.room
        ring = leads + layer % room
        ring[ring >= room] -= room  # no step leads beyond the ring
        ring[leads <= 0] = -1
        return ring

    def expect(
        self,
        pairs: IntArray,
        ring: IntArray,
        worth: FloatArray,
        marks: IntArray,
        priced: IntArray,
        costs: FloatArray,
    ) -> tuple[FloatArray, IntArray]:
        """Expected worth of arriving in later layers, [k, columns], and marks met, [k].

        Args:
            pairs: of the states asked for, [k].
            ring: [classes].
            worth: [rows, states, columns].
            marks: [rows, states].
            priced: columns (from, to) of which one counts in the other, times a cost, [.., 2].
            costs: of each class, [.., classes].
        """
        check_time()
        totals = np.zeros((len(pairs), worth.shape[2]))
        met = np.zeros(len(pairs), dtype=np.uint8)
        if accelerated(self.model.n_outcomes):
            from ssp_lp.compiled.layers import stream_totals

            stream_totals(self.model.n_outcomes)(
                pairs, *self._outcomes, ring, costs, worth, marks, priced, totals, met
            )
            return totals, met
        source, outcome, step = self._taken(pairs, ring >= 0)
        place = ring[step] * marks.shape[1] + self.model.successors[outcome]
        flat, shape = worth.reshape(-1, worth.shape[2]), (len(pairs), marks.size)
        share = self.model.probabilities[outcome]
        totals += sp.csr_array((share, (source, place)), shape=shape) @ flat
        for (begin, end), cost in zip(priced.tolist(), costs, strict=True):
            totals[:, end] += (
                sp.csr_array((share * cost[step], (source, place)), shape=shape) @ flat[:, begin]
            )
        np.bitwise_or.at(met, source, marks.reshape(-1)[place])
        return totals, met

    @cached_property
    def free_order(self) -> IntArray:
        """States, each after those that its free moves lead to, as far as may be, [states]."""
        model = self.model
        staying = (self.layers.leads(0) <= 0)[self.classes if self.classes.size else [0]]
        begins = model.outcome_offsets[model.pair_offsets]
        return strong_components(begins, model.successors, model.probabilities * staying).order

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
            from ssp_lp.compiled.layers import stream_hope

            own = decision[begin:end], self.acting, model.pair_offsets
            rest = leads, self.free_order, hopeful[begin:]
            stream_hope(decision[begin:end].size)(*own, *self._outcomes, *rest)
            return
        everywhere = np.arange(model.n_states)
        for layer in reversed(range(begin, end)):
            pairs = self.pairs(layer, everywhere)
            source, outcome, step = self._taken(pairs, leads >= 0)
            met = hopeful[layer + leads[step], model.successors[outcome]]
            hopeful[layer, source[met]] = True
            if (leads <= 0).any():
                marks = np.where(hopeful[layer], HOPEFUL, 0)
                spread_in_layer(marks, HOPEFUL, self.staying(everywhere, pairs, self.ring(layer)))
                hopeful[layer] = marks > 0

    def send(self, mass: FloatArray, pairs: IntArray, ring: IntArray, waiting: FloatArray) -> None:
        """Send the mass of k states by their pairs on to later layers, in place, [rows, states]."""
        check_time()
        if accelerated(self.model.n_outcomes):
            from ssp_lp.compiled.layers import stream_mass

            stream_mass(mass, pairs, *self._outcomes, ring, waiting)
            return
        source, outcome, step = self._taken(np.where(mass > 0.0, pairs, -1), ring >= 0)
        place = ring[step], self.model.successors[outcome]
        np.add.at(waiting, place, mass[source] * self.model.probabilities[outcome])

    def within(self, pairs: IntArray, ring: IntArray, begins: IntArray) -> IntArray:
        """States to which moves that stay lead from some, these included, increasing.

        Args:
            pairs: of all states, [states].
            ring: [classes].
            begins: increasing.
        """
        source, outcome, _ = self._taken(pairs, ring < 0)
        if not source.size:
            return begins
        offsets = offsets_of(np.bincount(source, minlength=len(pairs)))
        return np.flatnonzero(reached_along(self.model.successors[outcome], offsets, begins))

    def staying(self, states: IntArray, pairs: IntArray, ring: IntArray) -> Staying | None:
        """Moves within the layer; None: there are none.

        Args:
            states: increasing, from which all such moves lead to one of them, [k].
            pairs: [k].
            ring: [classes].
        """
        if (ring >= 0).all():
            return None
        source, outcome, step = self._taken(pairs, ring < 0)
        if not source.size:
            return None
        share, target = self.model.probabilities[outcome], self.model.successors[outcome]
        where, shape = (source, np.searchsorted(states, target)), (len(states), len(states))
        paid = sp.csr_array((share * self.layers.costs[step], where), shape=shape)
        onward = np.zeros(len(pairs))
        source, outcome, _ = self._taken(pairs, ring >= 0)
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


def spread_in_layer(marks: IntArray, bit: int, staying: Staying | None) -> None:
    """Mark, in place, all states from which a marked one can be reached within the layer."""
    begins = np.flatnonzero(marks & bit)
    if staying is None or not begins.size or begins.size == marks.size:
        return
    backward = staying.share.tocsc()
    marks[reached_along(backward.indices, backward.indptr, begins)] |= bit


_LOG = logging.getLogger("ssp_lp.evaluation")


@dataclass(frozen=True, eq=False)
class TotalledReward:
    """One total: ``v(x) = reward + survival * E[v(next)]`` where something is still open."""

    ends: FloatArray  # [states] value at goals and dead-ends
    survival: float = 1.0  # factor of what is to come
    until_lost: bool = True  # open while the goal can be reached; else while some end can be
    each: float = 0.0  # reward of every decision
    reward: FloatArray | None = None  # [pairs] beside it
    gives_up: FloatArray | float = 0.0  # [states] reward of giving up
    lost: FloatArray | float = 0.0  # [states] value where nothing is open
    goes_on: bool = False  # costs go on where the goal is lost, until a dead-end is entered
    prices: int | None = None  # the column whose next value, times the cost, counts besides


@dataclass(frozen=True, eq=False)
class LayerSweep:
    """The layers of one policy, and what is totalled over them.

    First it is found where the policy may be in each layer: only these states are totalled.
    """

    moves: LayerMoves
    columns: tuple[TotalledReward, ...]
    forbidden: BoolArray  # [states] where the policy may not give up
    forbids_failing: bool

    def at_start(self, begins: IntArray) -> tuple[FloatArray, IntArray]:
        """The totals from some states on, [begins, columns], with nothing paid, and their marks.

        Args:
            begins: states, increasing.
        """
        moves, room = self.moves, self.moves.room
        met, worth, marks = self._met(begins)
        for layer in reversed(range(moves.layers.count)):
            over = 1.0 - layer / moves.layers.count
            _LOG.debug("layer %d of %d", layer, moves.layers.count, extra={"share": over})
            here = np.flatnonzero(np.unpackbits(met[layer]))
            pairs, ring = moves.pairs(layer, here), moves.ring(layer)
            totals, own_marks = moves.expect(pairs, ring, worth, marks, *self._priced)
            self._settle(here, pairs, moves.staying(here, pairs, ring), totals, own_marks)
            worth[layer % room, here], marks[layer % room, here] = totals, own_marks
        at = np.searchsorted(here, begins)
        return totals[at], own_marks[at]

    def _met(self, begins: IntArray) -> tuple[list[npt.NDArray[np.uint8]], FloatArray, IntArray]:
        """Where the policy may be in each layer, as bits, and what follows beyond the last one.

        Returns:
            The bits of the states, [layers]; then, of the states that may be met in the layers from
            there on, the totals, [rows, states, columns], and the marks, [rows, states].
        """
        moves, room, n = self.moves, self.moves.room, self.moves.model.n_states
        arriving, met, everywhere = np.zeros((room, n)), [], np.arange(n)  # > 0: it may arrive
        arriving[0, begins] = 1.0
        for layer in range(moves.layers.count):
            here: IntArray = np.flatnonzero(arriving[layer % room])
            ring = moves.ring(layer)
            arriving[layer % room] = 0.0
            if (ring < 0).any():
                here = moves.within(moves.pairs(layer, everywhere), ring, here)
            moves.send(np.ones(len(here)), moves.pairs(layer, here), ring, arriving)
            is_met = np.zeros(n, dtype=np.bool_)
            is_met[here] = True
            met.append(np.packbits(is_met))
        worth, marks = np.empty((room, n, len(self.columns))), np.empty((room, n), dtype=np.uint8)
        count, stays = moves.layers.count, np.full(len(moves.layers.costs), -1)
        chosen = {row % room: moves.layers.tail_at(row) for row in range(count, count + room)}
        for number in range(len(moves.layers.tails)):  # a layer, all of whose moves stay
            lands = [(arriving[row] > 0.0) & (tail == number) for row, tail in chosen.items()]
            landed = np.flatnonzero(np.logical_or.reduce(lands))
            if not landed.size:
                continue
            here = moves.within(moves.tail(number, everywhere), stays, landed)
            pairs, totals = moves.tail(number, here), np.zeros((len(here), len(self.columns)))
            tail_marks = np.zeros(len(here), dtype=np.uint8)
            self._settle(here, pairs, moves.staying(here, pairs, stays), totals, tail_marks)
            for row, tail in chosen.items():
                own = tail[here] == number
                worth[row, here[own]], marks[row, here[own]] = totals[own], tail_marks[own]
        return met, worth, marks

    @cached_property
    def _priced(self) -> tuple[IntArray, FloatArray]:
        """Columns (from, to) of which one, times a cost, counts in the other, and the costs.

        What is to come is discounted later, and these are not.

        Returns:
            [k, 2], and the costs of each class of steps, [k, classes].
        """
        priced = [(c.prices, k) for k, c in enumerate(self.columns) if c.prices is not None]
        factors = [1.0 / self.columns[k].survival for _, k in priced]
        return np.array(priced, dtype=np.int64), np.outer(factors, self.moves.layers.costs)

    @cached_property
    def _groups(self) -> list[list[int]]:
        """Columns that are totalled over the same states at once, those that need others last."""
        groups: dict[tuple[bool, bool, float, bool], list[int]] = {}
        for k, column in enumerate(self.columns):
            key = column.prices is not None, column.until_lost, column.survival, column.goes_on
            groups.setdefault(key, []).append(k)
        return [columns for _, columns in sorted(groups.items())]

    @cached_property
    def _closed(self) -> list[FloatArray]:
        """What each column is worth where nothing is open, [states] each."""
        lost = [0.0 if column.goes_on else column.lost for column in self.columns]
        return [
            np.where(self.moves.acting, worth, column.ends)
            for worth, column in zip(lost, self.columns, strict=True)
        ]

    @cached_property
    def _ended(self) -> IntArray:
        """Marks of goals and dead-ends, [states]."""
        failed = OPEN | (FAILS if self.forbids_failing else 0)
        ended = np.where(self.moves.model.goal_mask, HOPEFUL | OPEN, failed)
        return np.where(self.moves.acting, 0, ended).astype(np.uint8)

    def _settle(
        self,
        here: IntArray,
        pairs: IntArray,
        staying: Staying | None,
        totals: FloatArray,
        marks: IntArray,
    ) -> None:
        """Turn what is met after moves to later layers into a layer's own, in place.

        Args:
            here: states, increasing, [k].
            pairs: [k].
            staying: moves within the layer; None: there are none.
            totals: expected ones, [k, columns].
            marks: those that may be met, [k].
        """
        self._mark(here, pairs, staying, marks)
        acting, moving = self.moves.acting[here], np.maximum(pairs, 0)
        quits = np.flatnonzero(pairs == GIVE_UP_CODE)
        hopeful, is_open = (marks & HOPEFUL) > 0, (marks & OPEN) > 0
        goes_on = (marks & ENDLESS) == 0
        if staying is not None and any(column.goes_on for column in self.columns):
            goes_on &= ~staying.closed(acting & ~is_open)
        systems: dict[tuple[float, bytes], tuple[sp.csr_array, System]] = {}
        for group in self._groups:
            kind = self.columns[group[0]]
            inside = hopeful if kind.until_lost else is_open
            if kind.goes_on:
                inside = inside | goes_on | (kind.survival < 1.0)
            inside = acting & inside
            out = np.flatnonzero(~inside)
            for k in group:
                column, total = self.columns[k], totals[:, k]
                if column.survival < 1.0:
                    total *= column.survival
                    total += column.each
                if column.reward is not None:
                    total += np.where(pairs >= 0, column.reward[moving], 0.0)
                if quits.size:
                    gain = np.broadcast_to(column.gives_up, column.ends.shape)
                    total[quits] += gain[here[quits]]
                total[out] = self._closed[k][here[out]]
            nodes = np.flatnonzero(inside)
            if staying is None or not nodes.size:
                continue
            key = kind.survival, inside.tobytes()
            if key not in systems:
                rows = staying.share[nodes]
                left = rows @ (~inside).astype(np.float64) + staying.onward[nodes]
                left += (pairs[nodes] == GIVE_UP_CODE).astype(np.float64)
                leak = (1.0 - kind.survival) + kind.survival * left
                own = sp.csr_array(rows[:, nodes] * kind.survival)
                systems[key] = rows, System(own, leak)
            rows, system = systems[key]
            rewards, beyond = totals[nodes][:, group], totals[:, group]
            beyond[nodes] = 0.0
            rewards += kind.survival * (rows @ beyond)
            if kind.prices is not None:
                for j, k in enumerate(group):
                    rewards[:, j] += staying.paid[nodes] @ totals[:, self.columns[k].prices]
            totals[nodes[:, None], group] = evaluate_chain(system, rewards).values

    def _mark(
        self, here: IntArray, pairs: IntArray, staying: Staying | None, marks: IntArray
    ) -> None:
        """Add to the marks of what a layer's moves may meet those of the layer itself, in place."""
        quits, missing = pairs == GIVE_UP_CODE, pairs == UNDECIDED
        acting = self.moves.acting[here]
        marks |= self._ended[here]
        marks[quits] |= OPEN | (FAILS if self.forbids_failing else 0)
        marks[missing | (quits & self.forbidden[here])] |= WRONG
        for bit in (HOPEFUL, OPEN):
            spread_in_layer(marks, bit, staying)
        if self.forbids_failing:
            marks[acting & ((marks & HOPEFUL) == 0)] |= FAILS
        if staying is not None and any(column.goes_on for column in self.columns):
            paying = np.asarray(staying.paid.sum(axis=1)).ravel() > 0.0
            never = acting & ((marks & OPEN) == 0)  # such loops cost without end
            marks[staying.closed(never) & paying] |= ENDLESS
        for bit in (WRONG, ENDLESS, FAILS):
            spread_in_layer(marks, bit, staying)


_AT_ONCE = 1_000_000  # decisions between two looks at the time


def stopping_where_lost(policy: MixedPolicy) -> MixedPolicy:
    """The same policy, but that members that remember their cost give up once the goal is lost.

    Raises:
        Stop: the time ended.
    """
    return replace(policy, policies=tuple(_stopping(member) for member in policy.policies))


def _stopping(policy: Policy) -> Policy:
    """A member that gives up where it has lost the goal; others are left as they are."""
    layers = policy.layers()
    if not isinstance(policy, CostAwarePolicy) or layers is None:
        return policy
    model, moves, count = policy.model, LayerMoves(policy.model, layers), layers.count
    tails, decision = layers.tails.copy(), layers.decision.copy()
    beyond = np.empty(tails.shape, dtype=np.bool_)  # where a tail has not lost the goal
    for number, tail in enumerate(layers.tails):
        followed = np.zeros(model.n_pairs, dtype=np.bool_)
        followed[tail[tail >= 0]] = True
        nearer = nearer_pairs(model, goal_pairs(model), followed)
        beyond[number] = model.goal_mask | (nearer >= 0)
    hopeful = np.empty((count + moves.room, model.n_states), dtype=np.bool_)
    hopeful[:count] = model.goal_mask
    for layer in range(count, len(hopeful)):
        hopeful[layer] = beyond[layers.tail_at(layer), np.arange(model.n_states)]
    several = 1 if layers.unit is None else max(_AT_ONCE // max(model.n_states, 1), 1)
    for end in range(count, 0, -several):
        moves.meet(max(end - several, 0), end, hopeful)
    decision[moves.acting & (decision >= 0) & ~hopeful[:count]] = GIVE_UP_CODE
    tails[moves.acting & (tails >= 0) & ~beyond] = GIVE_UP_CODE
    return replace(policy, decision=decision, tails=tails)


LARGE = 300_000
"""Nodes, states times layers, above which a chain is not written out."""

_NOTHING = np.zeros(0, dtype=np.int64)

_FEW_NODES = 1_000
"""Nodes of a chain that is written out however much its policy may remember: laws soon followed."""


def chain_of_law(
    model: SSP, policy: Policy, start: FloatArray, *, least_nodes: int = LARGE
) -> Chain:
    """A chain with the law of a policy's total cost: its own, or a smaller one where that is large.

    The smaller one of a policy that rounds costs up has the law of the rounded costs.

    Args:
        model: the model.
        policy: on the model.
        start: distribution over states, [states].
        least_nodes: states times layers from which a policy is not written out.

    Raises:
        ModelError: the policy has no decision in a state that it reaches.
    """
    layers = policy.layers()
    if layers is not None and layers.count * model.n_states >= least_nodes:
        law = _law_forwards(LayerMoves(model, layers), start)
        if law is not None:
            return _spine_of_law(model, layers, *law)
    return policy_chain(model, policy, start)


def chains_of_law(
    model: SSP, policy: Policy, start: FloatArray, chain: Chain | None = None, *, soon: bool = False
) -> tuple[Chain, Chain]:
    """Chains with the law of a policy's total cost as it is paid, and as the policy counts it.

    Both are one where it rounds nothing up, and where it may remember much and comes to many nodes.

    Args:
        model: the model.
        policy: on the model.
        start: distribution over states, [states].
        chain: of the policy, where it is at hand.
        soon: whether a chain of many nodes is not looked at, even if it may remember little.

    Raises:
        ModelError: the policy has no decision in a state that it reaches.
    """
    layers = policy.layers()
    if layers is None or not layers.rounds_up:
        own = chain or chain_of_law(model, policy, start)
        return own, own
    counted = chain_of_law(model, policy, start, least_nodes=0)
    many = soon or layers.count * model.n_states >= LARGE
    try:
        paid = chain or policy_chain(model, policy, start, _FEW_NODES if many else np.inf)
    except ModelError:
        return counted, counted
    return counted if many and len(paid.start) > _FEW_NODES else paid, counted


def _law_forwards(moves: LayerMoves, start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Follow the law's mass layer by layer.

    None where a decision is missing, or a cost is no whole number of layers but as a float, and is
    not rounded up to one.

    Returns:
        What arrives at the goal, [layers], those beyond the cap included; and what goes on there,
        [layers beyond the cap, states].
    """
    layers, room, everywhere = moves.layers, moves.layers.width, np.arange(len(start))
    exact = moves.model.exact_costs
    if layers.unit is None:
        return None
    if not layers.rounds_up:
        unit, *costs = (exact_cost(cost, exact) for cost in (layers.unit, *layers.costs.tolist()))
        if any(c != k * unit for c, k in zip(costs, layers.leads(0).tolist(), strict=True)):
            return None
    waiting, goal = np.zeros((room, len(start))), np.zeros(layers.count + room)
    waiting[0] = start
    for layer in range(layers.count + room):
        mass = waiting[layer % room]
        if layer >= layers.count:
            goal[layer] = mass[moves.model.goal_mask].sum()
            mass[~moves.acting] = 0.0
            continue
        pairs, leads = moves.pairs(layer, everywhere), layers.leads(layer)
        if (mass[pairs == UNDECIDED] > 0.0).any():
            return None
        staying = moves.staying(everywhere, pairs, np.where(leads > 0, 0, -1))
        if staying is not None:
            mass = _visits_within_law(staying, pairs, mass)
        moves.send(mass, pairs, np.where(leads > 0, (layer + leads) % room, -1), waiting)
        goal[layer] = mass[moves.model.goal_mask].sum()
        waiting[layer % room] = 0.0
    return goal, waiting[(layers.count + np.arange(room)) % room]


def _spine_of_law(model: SSP, layers: CostLayers, reached: FloatArray, landed: FloatArray) -> Chain:
    """One node of the law's chain per block of layers below the cap, then the goal and the tails.

    A node goes on to the next block, or to the goal at the cost of each layer of its own; the last
    one to where the mass lands beyond the cap. Mass that fails below the cap never starts.
    """
    block = len(landed)  # as many layers as a step may pass: no move is much longer
    count, last, unit = -(-layers.count // block), (layers.count - 1) // block, layers.unit or 0.0
    tail_at = np.stack([layers.tail_at(layers.count + k) for k in range(block)])
    first, tails = count + 1, list[Chain]()
    ends = list[tuple[IntArray, IntArray]]()  # of the moves of each tail: source, target
    moves = list[tuple[IntArray, IntArray, FloatArray, IntArray]]()  # from, to, mass, layer
    for number, tail in enumerate(layers.tails):
        entering = np.where(tail_at == number, landed, 0.0)
        total = entering.sum(axis=0)
        if not (total > 0.0).any():
            continue
        chain = policy_chain(model, DeterministicPolicy(model, tail), total)
        if layers.rounds_up:
            passed = np.ceil(chain.cost / unit * (1.0 - SAME_TOTAL)).astype(np.int64)
            chain = replace(chain, cost=totals_of(passed, exact_cost(unit)))
        place = np.full(model.n_states, -1, dtype=np.int64)
        place[chain.state] = np.arange(first, first + chain.n_nodes)
        ahead, state = np.nonzero(entering)
        source = np.full(len(ahead), last)
        moves.append((source, place[state], entering[ahead, state], layers.count + ahead))
        ends.append((chain.source + first, chain.target + first))
        tails.append(chain)
        first += chain.n_nodes
    arriving = np.flatnonzero(reached[1:] > 0.0) + 1
    source = np.minimum(arriving // block, last)
    moves.append((source, np.full(len(arriving), count), reached[arriving], arriving))
    taken = np.zeros(count)
    for source, _, mass, _ in moves:
        np.add.at(taken, source, mass)
    left = np.cumsum(taken[::-1])[::-1]  # from each block on
    every = np.arange(count - 1)
    moves.append((every, every + 1, left[1:], (every + 1) * block))
    source, target, mass, layer = (np.concatenate(part) for part in zip(*moves, strict=True))
    kept = np.flatnonzero(mass > 0.0)
    source, target, ahead = source[kept], target[kept], (layer - source * block)[kept]
    paid = totals_of(ahead, exact_cost(unit)) if layers.rounds_up else ahead * unit
    state = np.concatenate([np.full(count, np.argmin(model.goal_mask)),
                            [np.argmax(model.goal_mask)], *(c.state for c in tails)])  # fmt: skip
    start, own = np.zeros(len(state)), np.zeros(count + 1)
    start[0], start[count] = left[0], reached[0]
    return Chain(
        model=model,
        state=read_only(state),
        memory=read_only(np.zeros(len(state), dtype=np.int64)),
        start=read_only(start),
        give_up=read_only(np.concatenate([own, *(c.give_up for c in tails)])),
        dead=read_only(np.concatenate([own, *(c.dead for c in tails)])),
        source=np.concatenate([source, *(begin for begin, _ in ends)]),
        target=np.concatenate([target, *(end for _, end in ends)]),
        probability=np.concatenate([mass[kept] / left[source], *(c.probability for c in tails)]),
        cost=np.concatenate([paid, *(c.cost for c in tails)]),
        outcome=_NOTHING,
        branch_node=_NOTHING,
        branch_pair=_NOTHING,
        branch_probability=np.zeros(0),
    )


def _visits_within_law(staying: Staying, pairs: IntArray, mass: FloatArray) -> FloatArray:
    """Expected visits within a layer, given what enters it, [states]."""
    inside = (pairs >= 0) & ~staying.closed(pairs >= 0)
    nodes, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    rows = staying.share[nodes]
    exits = staying.onward[nodes] + rows @ (~inside).astype(np.float64)
    visits = mass.copy()
    visits[nodes] = System(sp.csr_array(rows[:, nodes]), exits).solve_transposed(mass[nodes])
    visits[others] += sp.csr_array(rows[:, others]).T @ visits[nodes]
    return visits
