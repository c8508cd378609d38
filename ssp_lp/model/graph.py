"""Facts about a model's graph: which states can, may or need not reach the goal.

They are decided by searches on the graph of possible transitions (outcomes of positive
probability), never by comparing floating-point values with zero (paper, section 2.3).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, IntArray, concatenated_ranges
from ssp_lp.model.ssp import SSP


def reachable_states(model: SSP, start: IntArray) -> BoolArray:
    """States that some policy visits with positive probability from the start states, [states]."""
    return _reached(_state_graph(model), start)


def dead_ends(model: SSP) -> BoolArray:
    """States from which no policy reaches the goal, X_{d,all} of section 2.3, [states]."""
    return ~_reached(_state_graph(model).T.tocsr(), np.flatnonzero(model.goal_mask))


def attention_states(model: SSP) -> BoolArray:
    """States from which some policy surely avoids the goal, X_{d,or} of section 2.3, [states].

    The greatest set of non-goal states each of which has no action or an action whose successors
    all lie in the set; dead-ends are among them. Computed through its complement, the least set
    that holds the goal and every state all of whose actions may lead into it.
    """
    incidence = _pair_graph(model).tocsc()  # column s: the pairs that may lead to state s
    doomed = model.goal_mask.copy()  # states that cannot avoid the goal for sure
    pair_hits = np.zeros(model.n_pairs, dtype=np.bool_)
    open_pairs = np.diff(model.pair_offsets).astype(np.int64)
    frontier = np.flatnonzero(doomed)
    while frontier.size:
        first = incidence.indptr[frontier]
        entering = incidence.indices[
            concatenated_ranges(first, incidence.indptr[frontier + 1] - first)
        ]
        newly = np.unique(entering[~pair_hits[entering]])
        pair_hits[newly] = True
        touched, closed = np.unique(model.pair_state[newly], return_counts=True)
        open_pairs[touched] -= closed
        frontier = touched[(open_pairs[touched] == 0) & ~doomed[touched]]
        doomed[frontier] = True
    return ~doomed


def staying_pairs(model: SSP, attention: BoolArray) -> BoolArray:
    """Pairs of attention states whose successors are all attention states, [pairs].

    Args:
        attention: the result of :func:`attention_states`, [states].
    """
    leaving = ~attention[model.successors] & (model.probabilities > 0)
    leaves = np.zeros(0, dtype=np.bool_)
    if model.n_pairs:
        leaves = np.logical_or.reduceat(leaving, model.outcome_offsets[:-1])
    return np.asarray(attention[model.pair_state] & ~leaves)


def end_components(model: SSP, allowed: BoolArray) -> tuple[IntArray, BoolArray]:
    """Maximal end components of the model restricted to the allowed pairs.

    An end component is a set of states and of pairs whose successors all stay in the set, that is
    strongly connected by these pairs.

    Args:
        allowed: pairs that may be part of a component, [pairs].

    Returns:
        The component of each state, numbered from 0, and -1 outside of all, [states]; and the
        pairs that lie inside a component, [pairs].
    """
    inside = allowed.copy()
    component = np.full(model.n_states, -1, dtype=np.int64)
    graph = _pair_graph(model)
    while inside.any():
        pairs = np.flatnonzero(inside)
        steps = graph[pairs].tocoo()
        source = model.pair_state[pairs][steps.row]
        _, label = csgraph.connected_components(
            sp.csr_array((steps.data, (source, steps.col)), shape=(model.n_states,) * 2),
            connection="strong",
        )
        acting = np.zeros(model.n_states, dtype=np.bool_)
        acting[model.pair_state[pairs]] = True
        leaving = (label[source] != label[steps.col]) | ~acting[steps.col]
        kept = np.ones(pairs.size, dtype=np.bool_)
        kept[steps.row[leaving]] = False
        if kept.all():
            members = np.flatnonzero(acting)
            component[members] = np.unique(label[members], return_inverse=True)[1]
            break
        inside[pairs[~kept]] = False
    return component, inside


def _pair_graph(model: SSP) -> sp.csr_array:
    """Boolean matrix [pairs, states]: the pair may lead to the state."""
    possible = model.probabilities > 0
    if possible.all():
        successors, offsets = model.successors, model.outcome_offsets
    else:
        before = np.concatenate([[0], np.cumsum(possible)])
        successors, offsets = model.successors[possible], before[model.outcome_offsets]
    return sp.csr_array(
        (np.ones(len(successors), dtype=np.bool_), successors, offsets),
        shape=(model.n_pairs, model.n_states),
    )


def _state_graph(model: SSP) -> sp.csr_array:
    """Boolean matrix [states, states]: some action may lead from one state to the other."""
    matrix = _pair_graph(model)
    return sp.csr_array(
        (matrix.data, matrix.indices, matrix.indptr[model.pair_offsets]),
        shape=(model.n_states, model.n_states),
    )


def _reached(graph: sp.csr_array, sources: IntArray) -> BoolArray:
    """States reached from any of the sources, which a virtual node is linked to, [states]."""
    n = graph.shape[0]
    indices = np.concatenate([graph.indices, np.asarray(sources, dtype=graph.indices.dtype)])
    indptr = np.concatenate([graph.indptr, [indices.size]])
    linked = sp.csr_array((np.ones(indices.size), indices, indptr), shape=(n + 1, n + 1))
    order = csgraph.breadth_first_order(linked, n, return_predecessors=False)
    mask = np.zeros(n + 1, dtype=np.bool_)
    mask[order] = True
    return mask[:n]
