"""Facts about a model's graph: which states can, may or need not reach the goal.

They are decided by searches on the graph of possible transitions (outcomes of positive
probability), never by comparing floating-point values with zero (paper, section 2.3). Each takes
time linear in the outcomes (end components: in each round), compiled or not, with one result.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.model.chunks import pieces
from ssp_lp.model.graph.approach import nearer_pairs
from ssp_lp.model.graph.draining import drain
from ssp_lp.model.graph.kept import kept
from ssp_lp.model.graph.predecessors import narrow, possible_steps
from ssp_lp.model.ssp import SSP


def reachable_states(model: SSP, start: IntArray) -> BoolArray:
    """States that some policy visits with positive probability from the start states, [states]."""
    arrays = model.outcome_offsets, model.successors, model.probabilities
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graphs.searches import reached

        return reached(model.pair_offsets, *arrays, start)
    ends, columns = possible_steps(*arrays)
    return reached_along(columns, ends[model.pair_offsets], start)


@kept
def dead_ends(model: SSP) -> BoolArray:
    """States from which no policy reaches the goal, X_{d,all} of section 2.3, [states]."""
    return ~reaching_states(model, model.goal_mask)


def reaching_states(model: SSP, ends: BoolArray) -> BoolArray:
    """States from which some policy may come to one of the given states, these included, [states].

    Args:
        ends: [states].
    """
    before, first = model.predecessors, np.flatnonzero(ends)
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graphs.searches import reaching

        return reaching(before.offsets, before.pairs, model.pair_state, first)
    return reached_along(model.pair_state[before.pairs], before.offsets, first)


@kept
def attention_states(model: SSP) -> BoolArray:
    """States from which some policy surely avoids the goal, X_{d,or} of section 2.3, [states].

    The greatest set of non-goal states each of which has no action or an action whose successors
    all lie in the set; dead-ends are among them. Computed through its complement, the least set
    that holds the goal and every state all of whose actions may lead into it.
    """
    open_pairs = np.ones(model.n_pairs, dtype=np.bool_)
    open_counts = np.diff(model.pair_offsets)
    idle = open_counts == 0
    drain(model, open_pairs, open_counts, np.flatnonzero(model.goal_mask))
    return np.asarray(~model.goal_mask & (idle | (open_counts > 0)))


@kept
def surely_reaching(model: SSP) -> tuple[BoolArray, BoolArray]:
    """States from which some policy reaches the goal with probability one, and how.

    The greatest set of states each of which can reach the goal by pairs that never leave the set.
    In rounds: what cannot reach the goal is dropped, with all pairs that may lead there.

    Returns:
        The states, goals included, [states]; and the pairs that stay among them, [pairs].
    """
    open_pairs = np.ones(model.n_pairs, dtype=np.bool_)
    open_counts = np.diff(model.pair_offsets)
    into_goal = goal_pairs(model)
    kept = np.ones(model.n_states, dtype=np.bool_)
    while True:
        nearer = approach_pairs(model, into_goal & open_pairs, open_pairs)
        lost = kept & ~model.goal_mask & (nearer < 0)
        if not lost.any():
            return kept, open_pairs
        open_pairs &= ~lost[model.pair_state]
        open_counts[lost] = 0
        drain(model, open_pairs, open_counts, np.flatnonzero(lost))
        kept = model.goal_mask | (open_counts > 0)


@kept
def goal_pairs(model: SSP) -> BoolArray:
    """Pairs that may lead to a goal, [pairs]."""
    return pairs_into(model, model.goal_mask)


def pairs_into(model: SSP, states: BoolArray) -> BoolArray:
    """Pairs that may lead to one of the states, [pairs].

    Args:
        states: [states].
    """
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graphs.searches import leading_into

        return leading_into(model.outcome_offsets, model.successors, model.probabilities, states)
    leads = np.zeros(model.n_pairs, dtype=np.bool_)
    for piece in pieces(model.outcome_offsets):
        successors, chances = model.successors[piece.entries], model.probabilities[piece.entries]
        entering = states[successors] & (chances > 0)
        leads[piece.segments] = np.logical_or.reduceat(entering, piece.firsts)
    return leads


def attention_pairs(model: SSP, attention: BoolArray) -> BoolArray:
    """Pairs of attention states whose successors are all attention states, [pairs].

    Args:
        attention: the result of :func:`attention_states`, [states].
    """
    return np.asarray(attention[model.pair_state] & ~pairs_into(model, ~attention))


def approach_pairs(model: SSP, leaving: BoolArray, usable: BoolArray | None = None) -> IntArray:
    """For each state a pair by which it may come nearer, in number of steps, to a leaving pair.

    A state with a leaving pair of its own takes that. Among pairs that come equally near, the
    first is taken.

    Args:
        leaving: [pairs].
        usable: pairs that may be taken, leaving ones included, [pairs]; all if left out.

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached, and at goals.
    """
    before = model.predecessors
    return nearer_pairs(before, model.pair_offsets, model.pair_state, leaving, usable)


def reached_along(columns: IntArray, offsets: IntArray, start: IntArray) -> BoolArray:
    """States reached along edges by scipy, from a node added and linked to the start, [states].

    Args:
        columns: where the edges lead, [edges].
        offsets: of each state's edges, [states + 1].
        start: states to begin with.
    """
    n_states = len(offsets) - 1
    linked = np.concatenate([columns, np.asarray(start, dtype=columns.dtype)])
    graph = edges(linked, np.append(offsets, linked.size))
    order = csgraph.breadth_first_order(graph, n_states, return_predecessors=False)
    mask = np.zeros(n_states + 1, dtype=np.bool_)
    mask[order] = True
    return mask[:n_states]


def edges(columns: IntArray, offsets: IntArray) -> sp.csr_array:
    """A graph as scipy's searches want it; the weights, which they do not read, take no room."""
    weights: FloatArray = np.broadcast_to(np.float64(1.0), columns.shape)
    shape = len(offsets) - 1, len(offsets) - 1
    return sp.csr_array((weights, columns, narrow(offsets)), shape=shape)
