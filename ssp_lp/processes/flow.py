"""Expected visits of a process's pairs, taken back to the pairs of the model.

A collapsed component is one place of the process: what enters it at one member may leave it at
another. How to get there is free, but must be said: whatever enters goes to each member by which
the component is left with that member's share of all that leaves, the shortest way in number of
steps. Drawing each member's move in proportion to the visits that this makes realises the visits of
the process exactly (paper, section 2.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges, segment_sums
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import nearer_pairs, pairs_into
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.processes.quotient import Quotient


@dataclass(frozen=True, eq=False)
class Spread:
    """A quotient's states and pairs, each by itself, beside the pairs of the quotient.

    Methods count departures from a node; what is stated counts how often each pair is taken. Pairs
    within a component cost nothing and are taken by nobody there, and staying in it for ever is
    giving up, possible in each of its states.
    """

    quotient: Quotient  # of the same live states, none merged
    place: IntArray  # [its pairs] where each stands in the merged quotient, -1: inside a component
    departs: FloatArray  # [its pairs] chance that taking it is departing from the merged node

    def per_taking(self, per_departure: FloatArray) -> FloatArray:
        """What each pair takes whenever it is taken, of what its departures take, [pairs]."""
        return np.where(self.place >= 0, per_departure[self.place] * self.departs, 0.0)

    def departures(self, visits: FloatArray) -> FloatArray:
        """How often nodes are departed from, [merged quotient's pairs], by visits [pairs]."""
        own, size = self.place >= 0, int(self.place.max(initial=-1)) + 1
        gone = visits[own] * self.departs[own]
        return np.bincount(self.place[own], weights=gone, minlength=size).astype(np.float64)

    def visits(self, flow: ModelFlow) -> FloatArray:
        """The model's flow at these pairs, [pairs]."""
        given_up = flow.give_up[self.quotient.first_states[self.quotient.pair_node]]
        return self.quotient.at_pairs(flow.pairs, 0.0) + np.where(
            self.quotient.gives_up, given_up, 0.0
        )


def spread_out(quotient: Quotient, departs: FloatArray) -> Spread | None:
    """Undo what is collapsed and left out; None: nothing is.

    Args:
        quotient: the live part of a model.
        departs: [pairs] what rows were divided by, see ``live_rows``.
    """
    if not quotient.merged.any() and (departs == 1.0).all():
        return None
    single = quotient.split()
    place = quotient.places[single.pair_at]
    giving = np.full(quotient.n_nodes, -1)
    giving[quotient.pair_node[quotient.gives_up]] = np.flatnonzero(quotient.gives_up)
    nodes = quotient.node_of[single.first_states[single.pair_node]]
    place = np.where(single.gives_up, giving[nodes], place)
    return Spread(single, place, np.where(place >= 0, departs[place], 1.0))


@dataclass(frozen=True, eq=False)
class ModelFlow:
    """How often each pair of the model is taken, and each state gives up, in expectation."""

    pairs: FloatArray  # [model pairs]
    give_up: FloatArray  # [states]

    def entering(self, quotient: Quotient) -> FloatArray:
        """How often each state is entered, [states]."""
        model = quotient.model
        taken = np.repeat(self.pairs, np.diff(model.outcome_offsets))
        return np.bincount(
            model.successors, weights=taken * model.probabilities, minlength=model.n_states
        ).astype(np.float64)


def model_flow(quotient: Quotient, visits: FloatArray) -> ModelFlow:
    """The visits that a process itself speaks of; moves within its components are missing.

    Args:
        quotient: the live part of the model.
        visits: how often each pair is taken, repetitions counted, [pairs].
    """
    acting = quotient.pair_at >= 0
    pairs = np.zeros(quotient.model.n_pairs)
    pairs[quotient.pair_at[acting]] = visits[acting]
    giving = np.bincount(
        quotient.pair_node[~acting], weights=visits[~acting], minlength=quotient.n_nodes
    )
    return ModelFlow(pairs, quotient.lift(giving.astype(np.float64)))


def moving_within(quotient: Quotient, flow: ModelFlow, entering: FloatArray) -> ModelFlow:
    """The model's flow with the moves within components, and giving up shared among members.

    Args:
        quotient: the live part of the model.
        flow: as ``model_flow`` has it: every member of a component gives up as often as all do.
        entering: how often each state is entered or started in, [states].
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
    quotient: Quotient, members: IntArray, entering: FloatArray, leaving: FloatArray
) -> FloatArray:
    """How often each pair inside a component is taken, [model pairs].

    Each component's first exit is served first, then the second one of each that has one, and so
    on: moves of different components never meet.

    Args:
        quotient: the live part of the model.
        members: states of components.
        entering: [members].
        leaving: [members].
    """
    model, node = quotient.model, quotient.node_of[members]
    exits = np.flatnonzero(leaving > 0.0)
    exits = exits[np.argsort(node[exits], kind="stable")]
    begins = np.diff(node[exits], prepend=-1) != 0
    turn = np.arange(exits.size) - np.flatnonzero(begins)[np.cumsum(begins) - 1]
    total = np.bincount(node, weights=leaving, minlength=quotient.n_nodes)
    pairs = np.zeros(model.n_pairs)
    for number in range(int(turn.max(initial=-1)) + 1):
        served = exits[turn == number]
        share = np.zeros(quotient.n_nodes)
        share[node[served]] = leaving[served] / total[node[served]]
        is_target = np.zeros(model.n_states, dtype=np.bool_)
        is_target[members[served]] = True
        last = quotient.inside & pairs_into(model, is_target) & ~is_target[model.pair_state]
        usable = quotient.inside & ~is_target[model.pair_state]
        choice = nearer_pairs(model, last, usable)
        moving = np.flatnonzero((choice[members] >= 0) & (share[node] > 0.0))
        taken = choice[members[moving]]
        pairs[taken] += _visits_of_flow(
            model, members[moving], taken, (entering * share[node])[moving]
        )
    return pairs


def _visits_of_flow(
    model: SSP, states: IntArray, pairs: IntArray, entering: FloatArray
) -> FloatArray:
    """Expected visits of some states that each take one pair until they are left, [some states]."""
    lengths = np.diff(model.outcome_offsets)[pairs]
    outcomes = concatenated_ranges(model.outcome_offsets[pairs], lengths)
    place = np.full(model.n_states, -1)
    place[states] = np.arange(states.size)
    source, target = np.repeat(np.arange(states.size), lengths), place[model.successors[outcomes]]
    stays = (target >= 0) & (model.probabilities[outcomes] > 0.0)
    shape = states.size, states.size
    chance = model.probabilities[outcomes]
    inner = sp.csr_array((chance[stays], (source[stays], target[stays])), shape=shape)
    exits = np.bincount(source[~stays], weights=chance[~stays], minlength=states.size)
    return System(inner, exits.astype(np.float64)).solve_transposed(entering)


def decisions(
    quotient: Quotient, flow: ModelFlow, otherwise: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Each decision that is taken, with its flow; where there is none, another with flow 1.

    Args:
        quotient: the live part of the model.
        flow: with the moves within components.
        otherwise: pair, code of giving up or of no decision, for states not visited, [states].

    Returns:
        State, pair or code of giving up, and flow, [decisions] each.
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
