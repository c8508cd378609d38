"""Strong components of a sparse matrix's graph, in the order in which they can be solved."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.compiled.accelerator import accelerated


@dataclass(frozen=True, eq=False)
class StrongComponents:
    """Strong components, each after all that it leads to: ends first."""

    label: IntArray  # [states] component of each state
    order: IntArray  # [states] the states, component by component
    offsets: IntArray  # [components + 1] where each component lies in the order

    @property
    def n_components(self) -> int:
        """Number of components."""
        return len(self.offsets) - 1

    @cached_property
    def sizes(self) -> IntArray:
        """Number of states of each component, [components]."""
        return np.diff(self.offsets)

    @cached_property
    def largest(self) -> int:
        """Number of states of the largest component."""
        return int(self.sizes.max(initial=0))

    def members(self, component: int) -> IntArray:
        """The states of a component."""
        return self.order[self.offsets[component] : self.offsets[component + 1]]


def strong_components(
    indptr: IntArray, indices: IntArray, data: FloatArray, *, by_height: bool = False
) -> StrongComponents:
    """Find the components and sort them topologically (Tarjan 1972).

    Args:
        indptr: offsets of each state's entries, [states + 1].
        indices: successors, [entries].
        data: probabilities; entries of 0 are no edges, [entries].
        by_height: sorted, where compiled, by the most steps to an end: for passes along the order.
    """
    n = len(indptr) - 1
    if accelerated(len(indices)):
        return _compiled_components(indptr[:-1], indptr[1:], indices, data, by_height=by_height)
    graph = sp.csr_array((data, indices, indptr), shape=(n, n))
    found = csgraph.connected_components(_possible_edges(graph), connection="strong")[1]
    label = _topological_components(graph, found)
    order = np.argsort(label, kind="stable").astype(np.int32)
    return StrongComponents(label, order, offsets_of(np.bincount(label)))


def chosen_components(rows: sp.csr_array, choice: IntArray) -> StrongComponents:
    """The same for ``rows[choice]``, compiled; the rows are read where they are.

    Args:
        rows: [pairs, states].
        choice: [states].
    """
    begin, end = rows.indptr[choice], rows.indptr[1:][choice]
    return _compiled_components(begin, end, rows.indices, rows.data)


def _compiled_components(
    begin: IntArray, end: IntArray, indices: IntArray, data: FloatArray, *, by_height: bool = False
) -> StrongComponents:
    """The strong components by a compiled search."""
    from ssp_lp.compiled.graph_components import order_components

    label, order, count = order_components(begin, end, indices, data, by_height=by_height)
    sizes = np.bincount(label, minlength=count)
    return StrongComponents(label, order, offsets_of(sizes))


def _possible_edges(graph: sp.csr_array) -> sp.csr_array:
    """A graph for strong components: each edge once and none of weight 0, as scipy needs it."""
    kept = graph.copy()
    kept.sum_duplicates()
    kept.eliminate_zeros()
    return kept


def _topological_components(graph: sp.csr_array, label: IntArray) -> IntArray:
    """Labels renumbered, if need be, so that no edge leads to a component of a greater number.

    Those of scipy's search are so already, which is not documented and hence checked.
    """
    entry = graph.tocoo()
    entry_from, entry_to = label[entry.row], label[entry.col]
    if (entry_from >= entry_to)[entry.data > 0.0].all():
        return label
    between = (entry_from != entry_to) & (entry.data > 0.0)
    source, target = entry_from[between], entry_to[between]
    height = np.zeros(int(label.max()) + 1, dtype=np.int64)
    while True:
        raised = height.copy()
        np.maximum.at(raised, source, height[target] + 1)
        if np.array_equal(raised, height):
            break
        height = raised
    position = np.empty_like(height)
    position[np.argsort(height, kind="stable")] = np.arange(height.size)
    return position[label].astype(label.dtype)
