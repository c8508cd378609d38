"""Maximal end components of a model."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.model.chunks import pieces_of_chunks
from ssp_lp.model.graph.predecessors import Graph, narrow, possible_steps
from ssp_lp.model.graph.reachability import close_pairs, drain, edges


def end_components(model: Graph, allowed: BoolArray) -> tuple[IntArray, BoolArray]:
    """Maximal end components of the model restricted to the allowed pairs.

    An end component is a set of states and of pairs whose successors all stay in the set, that is
    strongly connected by these pairs. In rounds: what cannot stay among the allowed pairs is
    dropped, then what leaves its strong component, and components that lost a pair come again.

    Args:
        model: the model, or a process.
        allowed: pairs that may be part of a component, from which nothing ends, [pairs].

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
    closed: IntArray = (counts == 0).nonzero()[0]
    pending = np.ones(model.n_states, dtype=np.bool_)
    while True:
        drain(model, inside, counts, closed)
        label[counts == 0] = -1
        pending &= counts > 0
        if not pending.any():
            break
        _label_end_components(model, inside, pending, label)
        leaving = _crossing_end_components(model, inside, pending, label).nonzero()[0]
        torn = np.zeros_like(pending)
        torn[label[model.pair_state[leaving]]] = True
        closed = close_pairs(model, inside, counts, leaving)
        pending &= torn[label]
    members = counts > 0
    component[members] = np.unique(label[members], return_inverse=True)[1]
    return component, inside


def _label_end_components(
    model: Graph, inside: BoolArray, pending: BoolArray, label: IntArray
) -> None:
    """Label each pending state, in place, by the first state of its strong component.

    Args:
        inside: the pairs that link states; those of pending states lead to pending states, [pairs].
        pending: [states].
        label: [states].
    """
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graphs import label_components

        arrays = model.pair_offsets, model.outcome_offsets, model.successors, model.probabilities
        label_components(*arrays, inside, pending.nonzero()[0], label)
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
    """For end components, the strong component of each state by scipy."""
    shape = len(offsets) - 1, len(offsets) - 1
    present = np.ones(columns.size, dtype=np.bool_)
    once = sp.csr_array((present, columns.copy(), narrow(offsets)), shape=shape)
    once.sum_duplicates()
    graph = edges(once.indices, once.indptr)
    return np.asarray(csgraph.connected_components(graph, connection="strong")[1])


def _crossing_end_components(
    model: Graph, inside: BoolArray, pending: BoolArray, label: IntArray
) -> BoolArray:
    """Inside pairs of pending states that may lead to a state of another label, [pairs]."""
    candidates = inside & pending[model.pair_state]
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled.graphs import crossing_pairs

        arrays = model.outcome_offsets, model.successors, model.probabilities, model.pair_state
        return crossing_pairs(*arrays, candidates, label)
    for piece in pieces_of_chunks(model.outcome_offsets):
        successors, chances = model.successors[piece.entries], model.probabilities[piece.entries]
        here = np.repeat(label[model.pair_state[piece.segments]], piece.lengths)
        other = (label[successors] != here) & (chances > 0)
        filled = piece.lengths > 0  # a pair of a process may have no outcome but an end
        crosses = np.zeros(len(piece.lengths), dtype=np.bool_)
        crosses[filled] = np.logical_or.reduceat(other, piece.firsts[filled])
        candidates[piece.segments] &= crosses
    return candidates
