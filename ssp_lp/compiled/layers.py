"""Compiled backup of one layer of accumulated cost, with the measures of what it chose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def back_up_layer(
    offsets: Array, indptr: Array, indices: Array, data: Array,
    cost: Array, slope: Array, layer: float,
    charge: Array, growth: Array, gain: Array, failure: Array, survival: float,
    values: Array, measured: Array, minima: Array, position: Array, totals: Array,
) -> None:  # fmt: skip
    """Least values of a layer, who attains them, and the (charge, failure, goal) of that choice.

    The chosen row is read again while it is still near.
    """
    for s in prange(offsets.size - 1):
        least, pick = np.inf, offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total = 0.0
            for k in range(indptr[pair], indptr[pair + 1]):
                total += data[k] * values[indices[k]]
            stage = cost[pair]
            if layer != 0.0:
                stage += layer * slope[pair]
            total = stage + total
            if total < least:
                least, pick = total, pair
        minima[s], position[s] = least, pick - offsets[s]
        paid, failed, reached = 0.0, 0.0, 0.0
        for k in range(indptr[pick], indptr[pick + 1]):
            weight, column = data[k], indices[k]
            paid += weight * measured[column, 0]
            failed += weight * measured[column, 1]
            reached += weight * measured[column, 2]
        if layer != 0.0:
            paid += layer * growth[pick]
        totals[s, 0] = charge[pick] + paid
        totals[s, 1] = failure[pick] + failed
        totals[s, 2] = survival * gain[pick] + reached


@njit(cache=True)
def back_up_layers(
    order: Array, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, cost: Array, slope: Array,
    charge: Array, growth: Array, gain: Array, failure: Array, survival: float,
    values: Array, measured: Array, position: Array,
) -> None:  # fmt: skip
    """Several layers of small ones in one pass, the last of them first.

    Values and measures stand layer after layer, those of these layers, which are written, before
    those of all that they lead to.

    Args:
        order: nodes, each after those that its free steps lead to, [nodes].
        offsets: pairs of each node, [nodes + 1].
        indptr: [pairs + 1].
        kinds: which kind of step an entry is; 0: a free one, within the layer, [entries].
        nodes: to where it leads, [entries].
        data: [entries].
        leads: layer that each kind of step leads to, counted from the first here, [layers, kinds].
        paid: total of each layer, [layers].
        cost: of pairs, [layers or 1, pairs].
        slope: what a unit of the total adds to it, [pairs] or empty.
        charge: of arriving, [layers or 1, pairs].
        growth: what a unit of the total adds to it, [pairs] or empty.
        gain: [pairs].
        failure: [pairs].
        survival: the discount.
        values: [layers * nodes and more].
        measured: charge, failure and goal, [layers * nodes and more, 3].
        position: written: the choice among each node's pairs, [layers, nodes].
    """
    n = offsets.size - 1
    begin = np.empty(leads.shape[1], dtype=np.int64)
    for layer in range(leads.shape[0] - 1, -1, -1):
        begin[:] = leads[layer] * n
        row = layer if cost.shape[0] > 1 else 0
        factor = paid[layer] if slope.size > 0 else 0.0
        for s in order:
            least, pick = np.inf, offsets[s]
            for pair in range(offsets[s], offsets[s + 1]):
                total = 0.0
                for k in range(indptr[pair], indptr[pair + 1]):
                    total += data[k] * values[begin[kinds[k]] + nodes[k]]
                stage = cost[row, pair]
                if factor != 0.0:
                    stage += factor * slope[pair]
                total = stage + total
                if total < least:
                    least, pick = total, pair
            paying, failed, reached = 0.0, 0.0, 0.0
            for k in range(indptr[pick], indptr[pick + 1]):
                place = begin[kinds[k]] + nodes[k]
                paying += data[k] * measured[place, 0]
                failed += data[k] * measured[place, 1]
                reached += data[k] * measured[place, 2]
            if factor != 0.0:
                paying += factor * growth[pick]
            here = layer * n + s
            values[here], position[layer, s] = least, pick - offsets[s]
            measured[here, 0] = charge[row, pick] + paying
            measured[here, 1] = failure[pick] + failed
            measured[here, 2] = survival * gain[pick] + reached


@njit(cache=True)
def back_up_layers_safely(
    order: Array, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, cost: Array, slope: Array, magnitude: Array, alone: Array,
    epsilon: float, given: Array, values: Array,
) -> None:  # fmt: skip
    """Lower bounds of the least values of several layers; rounding counts against every pair.

    Args:
        order: as in ``back_up_layers``, like all that is not listed here.
        magnitude: sum of the sizes of the parts of the cost, [layers or 1, pairs].
        alone: size of a sum that is a single number, of which nothing was rounded, [pairs].
        epsilon: of the machine.
        given: values that are not to be exceeded, [layers, nodes].
        values: [layers * nodes and more].
    """
    n = offsets.size - 1
    begin = np.empty(leads.shape[1], dtype=np.int64)
    for layer in range(leads.shape[0] - 1, -1, -1):
        begin[:] = leads[layer] * n
        row = layer if cost.shape[0] > 1 else 0
        factor = paid[layer] if slope.size > 0 else 0.0
        for s in order:
            least = np.inf
            for pair in range(offsets[s], offsets[s + 1]):
                total, size = 0.0, 0.0
                for k in range(indptr[pair], indptr[pair + 1]):
                    term = data[k] * values[begin[kinds[k]] + nodes[k]]
                    total += term
                    size += abs(term)
                stage, whole = cost[row, pair], magnitude[row, pair]
                if factor != 0.0:
                    stage += factor * slope[pair]
                    whole += factor * slope[pair]
                total, size = stage + total, whole + size
                if size != alone[pair]:
                    terms = float(indptr[pair + 1] - indptr[pair]) + 4.0
                    total -= (terms * epsilon) * size
                least = min(least, total)
            values[layer * n + s] = min(least, given[layer, s])
