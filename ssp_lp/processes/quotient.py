"""The MEC quotient of a model: live states (neither goals nor dead-ends), grouped into nodes.

A node is one live state, or a maximal end component of pairs that cost nothing. Moves inside such a
component are free, so a process without a discount treats it as one state (mathematics, section 4).

Visits of the quotient are mapped back to visits of the model's pairs. Flow may enter a component at
one member and leave it at another, so visits of moves between members are added. The flow that
enters at a member is divided among all members in proportion to the flow that leaves there, and
goes by ways of fewest steps. A policy that draws each pair in proportion to the resulting visits
has exactly the visits of the process (paper, section 2.2).
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    CHUNK,
    BoolArray,
    FloatArray,
    IntArray,
    entries_of,
    least_integer_type,
    offsets_of,
    run_starts,
    segment_ids,
    segment_sums,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, end_components, hopeless_states, nearer_pairs, pairs_into
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED
from ssp_lp.processes.live_rows import LiveRows, RowChoice, live_rows


@dataclass(frozen=True, eq=False)
class Quotient:
    """The nodes of a model and the pairs that leave them, sorted by node.

    *Pairs* are pairs of the quotient; pairs of the model are called model pairs.
    """

    model: SSP
    dead: BoolArray  # [states] dead-ends
    node_of: IntArray  # [states] node, -1 at goals and dead-ends
    n_nodes: int
    inside: BoolArray  # [model pairs] pairs that stay in a collapsed component
    merged: BoolArray  # [states] members of collapsed components
    pair_at: IntArray  # [pairs] pair of the model, or GIVE_UP_CODE
    pair_node: IntArray  # [pairs] increasing
    pair_offsets: IntArray  # [nodes + 1]

    def transitions(self, survival: float, *, departing: bool) -> LiveRows:
        """Return the transition matrix, [pairs, nodes], and the mass that ends.

        Args:
            survival: factor of every probability, the discount or 1.
            departing: whether to condition each pair on departing from its node (``live_rows``).
        """
        home = self.pair_node if departing else None
        return live_rows(
            RowChoice(self.model, self.node_of, self.n_nodes, self.pair_at, home), survival
        )

    def dynamics(self, survival: float, *, departing: bool) -> tuple[Dynamics, FloatArray]:
        """Return the dynamics of the quotient, and the probability that each pair departs, [pairs].

        The arguments are those of :meth:`transitions`.
        """
        rows = self.transitions(survival, departing=departing)
        return Dynamics(self.pair_offsets, rows.matrix, rows.exits), rows.escape

    def at_pairs(self, per_pair: FloatArray, give_up: float | FloatArray = 0.0) -> FloatArray:
        """Return a value for each pair, [pairs], from values of the model's pairs.

        Args:
            per_pair: value of each pair of the model, [model pairs].
            give_up: value of the pairs that give up: a number, or one per node, [nodes].
        """
        given_up = give_up if isinstance(give_up, float) else give_up[self.pair_node]
        return np.where(self.pair_at >= 0, per_pair[self.pair_at], given_up)

    @property
    def gives_up(self) -> BoolArray:
        """Mask of the pairs that give up, [pairs]."""
        return np.asarray(self.pair_at == GIVE_UP_CODE)

    def named(self, pair: int) -> tuple[Hashable, Hashable]:
        """Return the state and the action of a pair; for giving up, the first state of the node."""
        acting = int(self.pair_at[pair])
        if acting == GIVE_UP_CODE:
            return self.model.states[int(self.first_states[self.pair_node[pair]])], GIVE_UP
        return self.model.states[int(self.model.pair_state[acting])], self.model.action_of(acting)

    @cached_property
    def first_states(self) -> IntArray:
        """First state of each node, [nodes]."""
        live = (self.node_of >= 0).nonzero()[0]
        return live[np.unique(self.node_of[live], return_index=True)[1]]

    def split(self) -> Quotient:
        """Return the quotient with a node for each state (no goal or dead-end), and all pairs."""
        live, none = self.node_of >= 0, np.zeros_like(self.merged)
        kept, gives_up = self.inside.copy(), np.zeros(self.n_nodes, dtype=np.bool_)
        kept[self.pair_at[self.pair_at >= 0]] = True
        gives_up[self.pair_node[self.gives_up]] = True
        node_of = _numbered_nodes(live, np.full(live.size, -1))
        leaving, inside = live & gives_up[self.node_of], np.zeros_like(self.inside)
        return _quotient_with_pairs(self.model, self.dead, node_of, inside, none, kept, leaving)

    def nearer_goal(self, usable: BoolArray | None = None) -> IntArray | None:
        """Return a pair of each node on a shortest way to the goal, [nodes]; -1: no way.

        The result is None if components are merged, since their members differ in distance.

        Args:
            usable: pairs that may be taken, [model pairs]; None: all.
        """
        if self.merged.any():
            return None
        kept = self.places >= 0 if usable is None else (self.places >= 0) & usable
        return self.placed(nearer_pairs(self.model, None, kept, ends=self.model.goal_mask))

    def placed(self, decision: IntArray) -> IntArray:
        """Translate decisions on states to pairs of the quotient, [nodes]; -1: no pair.

        Each node of the quotient must stand for a single state (no component is merged).

        Args:
            decision: pair of the model for each state, negative for none, [states].
        """
        taken = decision[self.node_of >= 0]
        return np.where(taken >= 0, self.places[taken], -1)

    @cached_property
    def places(self) -> IntArray:
        """Index in the quotient of each pair of the model, [model pairs]; -1: no such pair."""
        place = np.full(self.model.n_pairs, -1, dtype=np.int32)
        acting = (self.pair_at >= 0).nonzero()[0]
        place[self.pair_at[acting]] = acting
        return place

    def least_over_members(self, values: FloatArray) -> FloatArray:
        """Return the minimum of state values over the members of each node, [nodes]."""
        result = np.full(self.n_nodes, np.inf)
        live = self.node_of >= 0
        np.minimum.at(result, self.node_of[live], values[live])
        return result

    def lift(self, values: FloatArray) -> FloatArray:
        """Return node values as state values, [states]; 0 at goals and dead-ends."""
        result = np.zeros(self.model.n_states)
        live = self.node_of >= 0
        result[live] = values[self.node_of[live]]
        return result

    def gather(self, distribution: FloatArray) -> FloatArray:
        """Sum a distribution over states by node, [nodes]."""
        live = self.node_of >= 0
        return np.bincount(
            self.node_of[live], weights=distribution[live], minlength=self.n_nodes
        ).astype(np.float64)

    @with_twin
    def positions(self, first: IntArray, choice: IntArray) -> IntArray:
        """Translate choices of pairs, by node, to decisions on states, in many layers.

        Args:
            first: the pair of each node that has position 0, [nodes].
            choice: position of the chosen pair, counted from ``first``, [layers, nodes].

        Returns:
            Position among the model's pairs of the state, GIVE_UP_CODE or UNDECIDED, in the
            smallest integer type that holds them, [layers, states].
        """
        model, offsets = self.model, self.model.pair_offsets[:-1]
        most = int(np.diff(model.pair_offsets).max(initial=1))
        places = np.full((len(choice), model.n_states), UNDECIDED, dtype=least_integer_type(most))
        if not self.merged.any() and accelerated(choice.size, "matrix_rows.place_layers"):
            from ssp_lp.compiled.matrix_rows import place_layers

            place_layers(choice, unsigned(first), self.pair_at, offsets, self.node_of, places)
            return places
        live, several = (self.node_of >= 0).nonzero()[0], max(CHUNK // max(len(offsets), 1), 1)
        nodes, own, last = self.node_of[live], self.pair_offsets[:-1], self.pair_offsets[1:] - 1
        shift, most = first - own, int(np.diff(self.pair_offsets).max(initial=1))
        begins = range(0, len(choice), several)
        seen, table = np.zeros(most, np.bool_), np.empty((most, len(live)), places.dtype)
        for begin in begins:
            seen[choice[begin : begin + several] + shift] = True
        for k in seen.nonzero()[0].tolist():
            if k not in self._moves:  # they depend on the nodes' pairs alone
                pairs = self.pull_back(np.minimum(own + k, last))[live]
                own_pairs = np.where(pairs < 0, pairs, pairs - offsets[live])
                self._moves[k] = own_pairs.astype(places.dtype)
            table[k] = self._moves[k]
        for begin in begins:
            taken = choice[begin : begin + several, nodes] + shift[nodes]
            places[begin : begin + several, live] = table[taken, np.arange(len(live))]
        return places

    @cached_property
    def _moves(self) -> dict[int, IntArray]:
        """Cache: by k, the positions of the live states if each node takes its pair k, [live]."""
        return {}

    def pull_back(self, choice: IntArray) -> IntArray:
        """Translate one chosen pair per node to decisions on states.

        In a merged component one member takes the chosen pair; the other members move to its state
        at no cost.

        Args:
            choice: chosen pair of each node, [nodes].

        Returns:
            Pair of the model, GIVE_UP_CODE or UNDECIDED, [states].
        """
        decision = np.full(self.model.n_states, UNDECIDED, dtype=np.int32)
        chosen = self.pair_at[choice]
        live = (self.node_of >= 0).nonzero()[0]
        decision[live[chosen[self.node_of[live]] == GIVE_UP_CODE]] = GIVE_UP_CODE
        acting = chosen[chosen >= 0]
        decision[self.model.pair_state[acting]] = acting
        # moves for the other members of components
        lost = self.merged & (decision == UNDECIDED)
        if not lost.any():
            return decision
        leading = self.inside & pairs_into(self.model, ~lost)
        nearer = nearer_pairs(self.model, leading & lost[self.model.pair_state], self.inside)
        return np.where(lost, nearer, decision).astype(np.int32)


def build_quotient(
    model: SSP,
    *,
    usable: BoolArray | None = None,
    free: BoolArray | None = None,
    exits: BoolArray | None = None,
    free_exits: bool = False,
    ended: BoolArray | None = None,
) -> Quotient:
    """Build the quotient: group live states into nodes, and list the pairs that leave them.

    Args:
        usable: pairs of the model that may be used, [model pairs]; None: all.
        free: usable pairs that cost nothing, [model pairs]; their end components are collapsed.
            None: nothing is collapsed, as with a discount, which removes mass at every step.
        exits: states in which giving up is allowed, [states]; None: none of them.
        free_exits: whether giving up (staying for ever) is allowed in every collapsed component,
            rather than only in those from which the goal cannot be reached.
        ended: further states at which the process ends, [states].
    """
    dead = dead_ends(model)
    live = ~dead & ~model.goal_mask
    live = live if ended is None else live & ~ended
    if model.failure_label is not None:  # exclude pairs with infinite totals after failing
        finite, keeping = model.failure_label.finite
        live, usable = live & finite, keeping if usable is None else keeping & usable
    if usable is not None:  # states without a usable pair end the episode
        acting = np.bincount(model.pair_state[usable], minlength=model.n_states) > 0
        live &= acting if exits is None else acting | exits
    usable = live[model.pair_state] if usable is None else usable & live[model.pair_state]
    component = np.full(model.n_states, -1)
    inside = np.zeros(model.n_pairs, dtype=np.bool_)
    if free is not None and (free & usable).any():
        component, inside = end_components(model, free & usable)
    merged = component >= 0
    leaving = np.zeros(model.n_states, dtype=np.bool_) if exits is None else exits & live
    if merged.any():
        leaving = leaving | (merged if free_exits else merged & hopeless_states(model))
    check_time()
    node_of = _numbered_nodes(live, component)
    return _quotient_with_pairs(model, dead, node_of, inside, merged, usable & ~inside, leaving)


def _numbered_nodes(live: BoolArray, component: IntArray) -> IntArray:
    """Return the node of each state, [states]; -1: the state is not live.

    Nodes are numbered in the order of their first states.

    Args:
        live: live states, [states].
        component: component of each state, negative for none, [states].
    """
    first, members = np.arange(live.size), (component >= 0).nonzero()[0]
    if members.size:
        _, begin, back = np.unique(component[members], return_index=True, return_inverse=True)
        first[members] = members[begin[back]]
    heads = live & (first == np.arange(live.size))
    number = heads.cumsum(dtype=np.int32) - 1
    return np.where(live, number[first], -1).astype(np.int32)


def _quotient_with_pairs(
    model: SSP,
    dead: BoolArray,
    node_of: IntArray,
    inside: BoolArray,
    merged: BoolArray,
    has_pair: BoolArray,
    may_give_up: BoolArray,
) -> Quotient:
    """Return the quotient with given nodes and pairs.

    Args:
        model: the model.
        dead: dead-ends, [states].
        node_of: node of each state, -1 if it is not live, [states].
        inside: pairs that stay in a collapsed component, [model pairs].
        merged: members of collapsed components, [states].
        has_pair: pairs of the model that the quotient has, [model pairs].
        may_give_up: states in which giving up is allowed, [states].
    """
    n_nodes = int(node_of.max(initial=-1)) + 1
    pairs = has_pair.nonzero()[0].astype(np.int32)
    pair_node = node_of[model.pair_state[pairs]]
    if merged.any():
        order = np.argsort(pair_node, kind="stable")
        pairs, pair_node = pairs[order], pair_node[order]
    counts = np.bincount(pair_node, minlength=n_nodes)
    if may_give_up.any():  # giving up is first in its node, so that it wins ties
        nodes = (np.bincount(node_of[may_give_up], minlength=n_nodes) > 0).nonzero()[0]
        pairs = np.insert(pairs, offsets_of(counts)[nodes], GIVE_UP_CODE)
        counts[nodes] += 1
    offsets = offsets_of(counts).astype(np.int32)
    return Quotient(
        model=model,
        dead=dead,
        node_of=node_of,
        n_nodes=n_nodes,
        inside=inside,
        merged=merged,
        pair_at=pairs,
        pair_node=segment_ids(offsets),
        pair_offsets=offsets,
    )


@dataclass(frozen=True, eq=False)
class Spread:
    """The quotient in which no component is merged, with a map of its pairs to the merged quotient.

    Methods use the merged quotient and count departures from its nodes. Programs that a user sees
    use the unmerged quotient and count visits of its pairs, also of pairs within a component. A
    policy that stays in a component for ever gives up; in the unmerged quotient each state of the
    component has a pair for giving up.
    """

    quotient: Quotient  # of the same live states, none merged
    place: IntArray  # [its pairs] pair of the merged quotient, -1: inside a component
    escape: FloatArray  # [its pairs] probability of departing from the merged node

    def per_visit(self, per_departure: FloatArray) -> FloatArray:
        """Convert amounts per departure to amounts per visit of each unmerged pair, [pairs].

        Args:
            per_departure: [merged pairs].
        """
        return np.where(self.place >= 0, per_departure[self.place] * self.escape, 0.0)

    def departures(self, visits: FloatArray) -> FloatArray:
        """Convert visits of unmerged pairs to departures by each merged pair, [merged pairs].

        Args:
            visits: [pairs].
        """
        own, size = self.place >= 0, int(self.place.max(initial=-1)) + 1
        gone = visits[own] * self.escape[own]
        return np.bincount(self.place[own], weights=gone, minlength=size).astype(np.float64)

    def visits(self, flow: ModelFlow) -> FloatArray:
        """Return the expected visits of the unmerged pairs, [pairs], from a flow of the model."""
        return self.quotient.at_pairs(flow.pairs, flow.give_up[self.quotient.first_states])


def unmerged(quotient: Quotient, escape: FloatArray) -> Spread | None:
    """Return the unmerged quotient, with self-loops, and the map of its pairs to the merged one.

    The result is None if no component is merged and no self-loop was removed.

    Args:
        quotient: the merged quotient.
        escape: probability that each pair departs from its node, [pairs] (see ``live_rows``).
    """
    if not quotient.merged.any() and (escape == 1.0).all():
        return None
    single = quotient.split()
    place = quotient.places[single.pair_at]
    giving = np.full(quotient.n_nodes, -1)
    giving[quotient.pair_node[quotient.gives_up]] = np.flatnonzero(quotient.gives_up)
    nodes = quotient.node_of[single.first_states[single.pair_node]]
    place = np.where(single.gives_up, giving[nodes], place)
    return Spread(single, place, np.where(place >= 0, escape[place], 1.0))


@dataclass(frozen=True, eq=False)
class ModelFlow:
    """Expected visits of each pair of the model, and of giving up in each state."""

    pairs: FloatArray  # [model pairs]
    give_up: FloatArray  # [states]

    def entering(self, quotient: Quotient) -> FloatArray:
        """Return the expected arrivals in each state of the model, without starts, [states]."""
        model = quotient.model
        taken = np.repeat(self.pairs, np.diff(model.outcome_offsets))
        return np.bincount(
            model.successors, weights=taken * model.probabilities, minlength=model.n_states
        ).astype(np.float64)


def model_flow(quotient: Quotient, visits: FloatArray) -> ModelFlow:
    """Return the visits of the model's pairs, given visits of a quotient's pairs.

    Moves within components are not included (:func:`moving_within` adds them).

    Args:
        quotient: the quotient.
        visits: expected visits of each pair, [pairs]; each repetition by a self-loop counts.
    """
    acting = quotient.pair_at >= 0
    pairs = np.zeros(quotient.model.n_pairs)
    pairs[quotient.pair_at[acting]] = visits[acting]
    giving = np.bincount(
        quotient.pair_node[~acting], weights=visits[~acting], minlength=quotient.n_nodes
    )
    return ModelFlow(pairs, quotient.lift(giving.astype(np.float64)))


def moving_within(quotient: Quotient, flow: ModelFlow, entering: FloatArray) -> ModelFlow:
    """Return a flow of the model, completed by the moves within merged components.

    A component's amount of giving up is shared among its members, in proportion to the flow that
    enters each of them.

    Args:
        quotient: the quotient.
        flow: flow from ``model_flow``, where each member has the component's whole giving up.
        entering: expected arrivals in each state, starts included, [states].
    """
    members = np.flatnonzero(quotient.merged)
    if members.size == 0:
        return flow
    node = quotient.node_of[members]
    arriving = np.bincount(node, weights=entering[members], minlength=quotient.n_nodes)
    share = entering[members] / np.where(arriving[node] > 0.0, arriving[node], 1.0)
    give_up, pairs = flow.give_up.copy(), flow.pairs.copy()
    give_up[members] *= share
    leaving = segment_sums(pairs, quotient.model.pair_offsets)[members] + give_up[members]
    return ModelFlow(pairs + _flow_of_moves(quotient, members, entering[members], leaving), give_up)


def _flow_of_moves(
    quotient: Quotient, members: IntArray, inflow: FloatArray, outflow: FloatArray
) -> FloatArray:
    """Return the expected visits of the pairs inside merged components, [model pairs].

    They lead the flow from the members where it enters to the members where it leaves. Components
    do not overlap, so one pass handles one exit member of every component.

    Args:
        quotient: the quotient.
        members: states of merged components.
        inflow: flow that enters each member from outside, [members].
        outflow: flow that leaves each member to the outside, [members].
    """
    model, node = quotient.model, quotient.node_of[members]
    exits = np.flatnonzero(outflow > 0.0)
    exits = exits[np.argsort(node[exits], kind="stable")]
    begins = run_starts(node[exits])
    turn = np.arange(exits.size) - np.flatnonzero(begins)[np.cumsum(begins) - 1]
    total = np.bincount(node, weights=outflow, minlength=quotient.n_nodes)
    pairs = np.zeros(model.n_pairs)
    for number in range(int(turn.max(initial=-1)) + 1):
        served = exits[turn == number]
        share = np.zeros(quotient.n_nodes)
        share[node[served]] = outflow[served] / total[node[served]]
        is_target = np.zeros(model.n_states, dtype=np.bool_)
        is_target[members[served]] = True
        last = quotient.inside & pairs_into(model, is_target) & ~is_target[model.pair_state]
        usable = quotient.inside & ~is_target[model.pair_state]
        choice = nearer_pairs(model, last, usable)
        moving = np.flatnonzero((choice[members] >= 0) & (share[node] > 0.0))
        taken, entered = choice[members[moving]], (inflow * share[node])[moving]
        # visits of the chain in which each state takes its one pair
        outcomes, lengths = entries_of(model.outcome_offsets, taken)
        place = np.full(model.n_states, -1)
        place[members[moving]] = np.arange(moving.size)
        source, target = segment_ids(offsets_of(lengths)), place[model.successors[outcomes]]
        chance, shape = model.probabilities[outcomes], (moving.size, moving.size)
        stays = (target >= 0) & (chance > 0.0)
        inner = sp.csr_array((chance[stays], (source[stays], target[stays])), shape=shape)
        ends = np.bincount(source[~stays], weights=chance[~stays], minlength=moving.size)
        pairs[taken] += System(inner, ends.astype(np.float64)).solve_transposed(entered)
    return pairs


def decisions(
    quotient: Quotient, flow: ModelFlow, otherwise: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the decisions of the randomised policy that a flow of the model describes.

    Args:
        quotient: the quotient.
        flow: flow with the moves within components.
        otherwise: decision in states without flow: a pair of the model or a code, [states].

    Returns:
        Three arrays, [decisions] each: the state; the pair or GIVE_UP_CODE; and the weight, which
        is the flow, or 1 in states without flow.
    """
    model = quotient.model
    taken, giving = np.flatnonzero(flow.pairs > 0.0), np.flatnonzero(flow.give_up > 0.0)
    visited = np.zeros(model.n_states, dtype=np.bool_)
    visited[model.pair_state[taken]] = True
    visited[giving] = True
    rest = np.flatnonzero(~visited & (otherwise >= GIVE_UP_CODE))
    return (
        np.concatenate([model.pair_state[taken], giving, rest]),
        np.concatenate([taken, np.full(giving.size, GIVE_UP_CODE), otherwise[rest]]),
        np.concatenate([flow.pairs[taken], flow.give_up[giving], np.ones(rest.size)]),
    )
