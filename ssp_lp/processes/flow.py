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
from ssp_lp.dynamic_programming.linear_systems.system import System
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import approach_pairs, pairs_into
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.processes.quotient import Quotient


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
        choice = approach_pairs(model, last, usable)
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
