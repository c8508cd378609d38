"""Expected visits of a process's pairs, taken back to the pairs of the model.

A collapsed component is one place of the process: what enters it at one member may leave it at
another. How to get there is free, but must be said. Let P be the chain that moves uniformly at
random within a component, e what enters at each member and l what leaves there. The visits z of
members on the way satisfy ``z (I - P) = e - l`` and are unique up to multiples of the stationary
distribution of P, which is positive: the least such z >= 0 is taken. Drawing each member's move
in proportion to these visits realises the visits of the process exactly (paper, section 2.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges, segment_sums
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
    """The flow with the moves within components, and with giving up shared among members.

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
    passed = _least_passing(quotient, members, entering[members] - leaving)
    inside = np.flatnonzero(quotient.inside)
    state = quotient.model.pair_state[inside]
    ways = np.bincount(state, minlength=quotient.model.n_states)
    place = np.full(quotient.model.n_states, -1)
    place[members] = np.arange(members.size)
    pairs[inside] = passed[place[state]] / ways[state]
    return ModelFlow(pairs, give_up)


def _least_passing(quotient: Quotient, members: IntArray, supply: FloatArray) -> FloatArray:
    """The least visits >= 0 of members that carry a supply to where it is missing, [members]."""
    stay = _uniform_moves(quotient, members)
    node = quotient.node_of[members]
    _, first = np.unique(node, return_index=True)  # one member of each component is grounded
    free = np.ones(members.size, dtype=np.bool_)
    free[first] = False
    rest = np.flatnonzero(free)
    system = sp.csc_array((sp.eye_array(members.size) - stay.T)[rest][:, rest])
    entered = np.asarray(stay.T[rest][:, first].sum(axis=1)).ravel()
    found, stationary = np.zeros(members.size), np.ones(members.size)
    if rest.size:
        factors = linalg.splu(system)
        found[rest], stationary[rest] = factors.solve(supply[rest]), factors.solve(entered)
    owed = np.zeros(quotient.n_nodes)
    np.maximum.at(owed, node, -found / stationary)
    return np.asarray(np.maximum(found + owed[node] * stationary, 0.0))


def _uniform_moves(quotient: Quotient, members: IntArray) -> sp.csr_array:
    """The chain that takes each inside pair of a member equally often, [members, members]."""
    model = quotient.model
    inside = np.flatnonzero(quotient.inside)
    state = model.pair_state[inside]
    ways = np.bincount(state, minlength=model.n_states)
    lengths = np.diff(model.outcome_offsets)[inside]
    outcomes = concatenated_ranges(model.outcome_offsets[inside], lengths)
    place = np.full(model.n_states, -1)
    place[members] = np.arange(members.size)
    weight = model.probabilities[outcomes] / np.repeat(ways[state], lengths)
    ends = place[np.repeat(state, lengths)], place[model.successors[outcomes]]
    possible = weight > 0.0
    return sp.csr_array(
        (weight[possible], (ends[0][possible], ends[1][possible])),
        shape=(members.size, members.size),
    )


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
