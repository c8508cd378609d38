"""Facts about a model's graph: which states can, may or need not reach the goal.

They are decided by searches on the graph of possible transitions (outcomes of positive
probability), never by comparing floating-point values with zero (paper, section 2.3). Each takes
time linear in the outcomes (end components: in each round), compiled or not, with one result.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.accelerator import accelerated
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model.approach import nearer_pairs
from ssp_lp.model.chunks import pieces
from ssp_lp.model.kept import kept
from ssp_lp.model.predecessors import narrow, possible_steps
from ssp_lp.model.ssp import SSP


def reachable_states(model: SSP, start: IntArray) -> BoolArray:
    """States that some policy visits with positive probability from the start states, [states]."""
    arrays = model.outcome_offsets, model.successors, model.probabilities
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graph import reached

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
        from ssp_lp.compiled.graph import reaching

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
    _drain(model, open_pairs, open_counts, np.flatnonzero(model.goal_mask))
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
        _drain(model, open_pairs, open_counts, np.flatnonzero(lost))
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
        from ssp_lp.compiled.graph import leading_into

        return leading_into(model.outcome_offsets, model.successors, model.probabilities, states)
    leads = np.zeros(model.n_pairs, dtype=np.bool_)
    for piece in pieces(model.outcome_offsets):
        successors, chances = model.successors[piece.entries], model.probabilities[piece.entries]
        entering = states[successors] & (chances > 0)
        leads[piece.segments] = np.logical_or.reduceat(entering, piece.firsts)
    return leads


def staying_pairs(model: SSP, attention: BoolArray) -> BoolArray:
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


def end_components(model: SSP, allowed: BoolArray) -> tuple[IntArray, BoolArray]:
    """Maximal end components of the model restricted to the allowed pairs.

    An end component is a set of states and of pairs whose successors all stay in the set, that is
    strongly connected by these pairs. In rounds: what cannot stay among the allowed pairs is
    dropped, then what leaves its strong component, and components that lost a pair come again.

    Args:
        allowed: pairs that may be part of a component, [pairs].

    Returns:
        The component of each state, numbered from 0 in the order of their first states, and -1
        outside of all, [states]; and the pairs that lie inside a component, [pairs].
    """
    inside = allowed.copy()
    component = np.full(model.n_states, -1, dtype=np.int64)
    if not inside.any():
        return component, inside
    counts = np.bincount(model.pair_state[inside], minlength=model.n_states)
    label = np.full(model.n_states, -1, dtype=np.int32)
    closed: IntArray = np.flatnonzero(counts == 0)
    pending = np.ones(model.n_states, dtype=np.bool_)
    while True:
        _drain(model, inside, counts, closed)
        label[counts == 0] = -1
        pending &= counts > 0
        if not pending.any():
            break
        _label_components(model, inside, pending, label)
        leaving = np.flatnonzero(_crossing(model, inside, pending, label))
        torn = np.zeros_like(pending)
        torn[label[model.pair_state[leaving]]] = True
        closed = _close(model, inside, counts, leaving)
        pending &= torn[label]
    members = counts > 0
    component[members] = np.unique(label[members], return_inverse=True)[1]
    return component, inside


def reached_along(columns: IntArray, offsets: IntArray, start: IntArray) -> BoolArray:
    """States reached along edges by scipy, from a node added and linked to the start, [states].

    Args:
        columns: where the edges lead, [edges].
        offsets: of each state's edges, [states + 1].
        start: states to begin with.
    """
    n_states = len(offsets) - 1
    linked = np.concatenate([columns, np.asarray(start, dtype=columns.dtype)])
    graph = _edges(linked, np.append(offsets, linked.size))
    order = csgraph.breadth_first_order(graph, n_states, return_predecessors=False)
    mask = np.zeros(n_states + 1, dtype=np.bool_)
    mask[order] = True
    return mask[:n_states]


def _edges(columns: IntArray, offsets: IntArray) -> sp.csr_array:
    """A graph as scipy's searches want it; the weights, which they do not read, take no room."""
    weights: FloatArray = np.broadcast_to(np.float64(1.0), columns.shape)
    shape = len(offsets) - 1, len(offsets) - 1
    return sp.csr_array((weights, columns, narrow(offsets)), shape=shape)


def _drain(
    model: SSP, open_pairs: BoolArray, open_counts: IntArray, closed_states: IntArray
) -> None:
    """Close, in place, pairs that may lead to a closed state, and states with no pair left open.

    Args:
        open_pairs: [pairs].
        open_counts: the number of open pairs of each state, [states].
        closed_states: the states to begin with, which have no open pairs.
    """
    if not closed_states.size:
        return
    before = model.predecessors
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graph import drain

        drain(
            before.offsets, before.pairs, model.pair_state, open_pairs, open_counts, closed_states
        )
        return
    while closed_states.size:
        entering = before.entering(closed_states, open_pairs)
        closed_states = _close(model, open_pairs, open_counts, entering)


def _close(model: SSP, open_pairs: BoolArray, open_counts: IntArray, pairs: IntArray) -> IntArray:
    """Close these open pairs, ascending, in place; return the states with none left open."""
    open_pairs[pairs] = False
    state = model.pair_state[pairs]
    first = _run_starts(state)
    touched = state[first]
    open_counts[touched] -= np.diff(first, append=pairs.size)
    return np.asarray(touched[open_counts[touched] == 0])


def _label_components(model: SSP, inside: BoolArray, pending: BoolArray, label: IntArray) -> None:
    """Label each pending state, in place, by the first state of its strong component.

    Args:
        inside: the pairs that link states; those of pending states lead to pending states, [pairs].
        pending: [states].
        label: [states].
    """
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.components import label_components

        arrays = model.pair_offsets, model.outcome_offsets, model.successors, model.probabilities
        label_components(*arrays, inside, np.flatnonzero(pending), label)
        return
    ends, columns = possible_steps(
        model.outcome_offsets,
        model.successors,
        model.probabilities,
        inside & pending[model.pair_state],
    )
    found = _strong_components(columns, ends[model.pair_offsets])
    _, first, back = np.unique(found, return_index=True, return_inverse=True)
    label[pending] = first[back[pending]]


def _strong_components(columns: IntArray, offsets: IntArray) -> IntArray:
    """The strong component of each state by scipy, which never ends if an edge comes twice."""
    shape = len(offsets) - 1, len(offsets) - 1
    present = np.ones(columns.size, dtype=np.bool_)
    once = sp.csr_array((present, columns.copy(), narrow(offsets)), shape=shape)
    once.sum_duplicates()
    graph = _edges(once.indices, once.indptr)
    return np.asarray(csgraph.connected_components(graph, connection="strong")[1])


def _crossing(model: SSP, inside: BoolArray, pending: BoolArray, label: IntArray) -> BoolArray:
    """Inside pairs of pending states that may lead to a state of another label, [pairs]."""
    candidates = inside & pending[model.pair_state]
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.components import crossing

        arrays = model.outcome_offsets, model.successors, model.probabilities, model.pair_state
        return crossing(*arrays, candidates, label)
    for piece in pieces(model.outcome_offsets):
        successors, chances = model.successors[piece.entries], model.probabilities[piece.entries]
        here = np.repeat(label[model.pair_state[piece.segments]], piece.lengths)
        other = (label[successors] != here) & (chances > 0)
        candidates[piece.segments] &= np.logical_or.reduceat(other, piece.firsts)
    return candidates


def _run_starts(ordered: IntArray) -> IntArray:
    """Where each run of equal values begins in ascending non-negative values."""
    return np.flatnonzero(np.diff(ordered, prepend=-1))
