"""Pairs by which each state comes nearer, in number of steps, to pairs that leave."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.model.graph.predecessors import Predecessors


def nearer_pairs(
    before: Predecessors,
    pair_offsets: IntArray,
    pair_state: IntArray,
    leaving: BoolArray,
    usable: BoolArray | None = None,
) -> IntArray:
    """For each state a pair by which it may come nearer to a leaving pair.

    A state with a leaving pair of its own takes that. Among pairs that come equally near, the
    first is taken.

    Args:
        before: the graph turned round.
        pair_offsets: [states + 1].
        pair_state: [pairs].
        leaving: [pairs].
        usable: pairs that may be taken, leaving ones included, [pairs]; all if left out.

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    free = np.ones(len(pair_state), dtype=np.bool_) if usable is None else usable.copy()
    choice = np.full(len(pair_offsets) - 1, -1, dtype=np.int64)
    useful: IntArray = np.flatnonzero(leaving & free)
    if accelerated(len(before.pairs)):
        from ssp_lp.compiled.graph_searches import approach

        approach(before.offsets, before.pairs, pair_state, useful, free, choice)
        return choice
    return _by_distance(before, pair_offsets, pair_state, useful, free)


def _by_distance(
    before: Predecessors,
    pair_offsets: IntArray,
    pair_state: IntArray,
    useful: IntArray,
    usable: BoolArray,
) -> IntArray:
    """The same from the distance of each state, found by scipy from a node added behind all ends.

    Args:
        before: the graph turned round.
        pair_offsets: [states + 1].
        pair_state: [pairs].
        useful: usable pairs that leave.
        usable: [pairs].
    """
    n = len(pair_offsets) - 1
    reached = np.repeat(np.arange(n), np.diff(before.offsets))
    kept = usable[before.pairs]
    pairs, reached = before.pairs[kept], reached[kept]
    source = np.concatenate([reached, np.full(useful.size, n)])
    target = np.concatenate([pair_state[pairs], pair_state[useful]])
    graph = sp.csr_array((np.ones(source.size), (source, target)), shape=(n + 1, n + 1))
    distance: FloatArray = csgraph.dijkstra(  # type: ignore[call-overload]
        graph, indices=n, unweighted=True
    )[:n]
    near = np.full(len(pair_state), np.inf)
    np.minimum.at(near, pairs, distance[reached] + 1.0)
    near[useful] = 1.0
    choice = np.full(n, -1, dtype=np.int64)
    best = np.flatnonzero((near == distance[pair_state]) & np.isfinite(near))
    first = np.flatnonzero(np.diff(pair_state[best], prepend=-1))
    choice[pair_state[best[first]]] = best[first]
    return choice
