"""Contraction of a process at a vector of prices: components that are free there become one state.

At prices some of which are 0 a process may hold end components that cost nothing though they cost
something in an unpriced row. They are free in the pricing problem (DESIGN, section 4): every state
of such a component is worth the same, so that a value function on the contracted process proves as
much as one on the process, and rounding has no cycle to go round in. Nobody may stay in one for
ever by that: of the process only pairs that stay are taken away, and none is added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.process.explicit import ExplicitProcess


@dataclass(frozen=True, eq=False)
class Contracted:
    """The pairs of a process that leave its free components, sorted by node."""

    pair_offsets: IntArray  # [nodes + 1]
    transitions: sp.csr_array  # [kept pairs, nodes]
    pairs: IntArray  # [kept pairs] pair of the process
    node_of: IntArray  # [states]

    def least(self, values: FloatArray) -> FloatArray:
        """Least value over the states of each node, [nodes]."""
        result = np.full(len(self.pair_offsets) - 1, np.inf)
        np.minimum.at(result, self.node_of, values)
        return result


def contract(process: ExplicitProcess, priced: FloatArray) -> Contracted | None:
    """Contract the end components of pairs that cost nothing.

    Args:
        process: the process.
        priced: the cost of each pair at the prices, [pairs].

    Returns:
        None where there are no such components.
    """
    free = (priced == 0.0) & (process.goal == 0.0) & (process.failure == 0.0)
    if not free.any():
        return None
    inside, component = _end_components(process, free)
    if not inside.any():
        return None
    _, node_of = np.unique(component, return_inverse=True)
    kept = np.flatnonzero(~inside)
    kept = kept[np.argsort(node_of[process.pair_state[kept]], kind="stable")]
    n_states, n_nodes = process.n_states, int(node_of.max()) + 1
    members = sp.csr_array(
        (np.ones(n_states), (np.arange(n_states), node_of)), shape=(n_states, n_nodes)
    )
    counts = np.bincount(node_of[process.pair_state[kept]], minlength=n_nodes)
    return Contracted(
        pair_offsets=np.append(0, np.cumsum(counts)).astype(process.pair_offsets.dtype),
        transitions=sp.csr_array(process.transitions[kept] @ members),
        pairs=kept,
        node_of=node_of,
    )


def _end_components(process: ExplicitProcess, free: BoolArray) -> tuple[BoolArray, IntArray]:
    """Free pairs that stay in an end component of such pairs, and a label of each state's.

    Strongly connected components of the free pairs' graph, without the pairs that may leave
    theirs, until none does.
    """
    entry = process.transitions.tocoo()
    possible = entry.data > 0
    pair, successor = entry.row[possible], entry.col[possible]
    source, n = process.pair_state[pair], process.n_states
    inside = free
    while True:
        step = inside[pair]
        graph = sp.csr_array(
            (np.ones(int(step.sum())), (source[step], successor[step])), shape=(n, n)
        )
        _, label = csgraph.connected_components(graph, directed=True, connection="strong")
        escapes = np.zeros(process.n_pairs, dtype=np.bool_)
        escapes[pair[step & (label[source] != label[successor])]] = True
        if not escapes.any():
            return inside, label
        inside = inside & ~escapes
