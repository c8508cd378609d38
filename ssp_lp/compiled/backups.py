"""Compiled Bellman backups, of a whole process and of layers; their twin is ``bellman``.

No fast-math: sums run in the order of scipy's products, so that both agree to the last bit.
Index arrays come as unsigned views: signed ones cost a test for negative positions at each access.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def back_up(
    offsets: Array,
    indptr: Array,
    begins: Array,
    indices: Array,
    data: Array,
    cost: Array,
    slope: Array,
    factor: float,
    values: Array,
    held: Array,
    minima: Array,
    choice: Array,
    here: Array,
) -> None:
    """Least value of each state, the first pair that attains it, and the held pair's value."""
    keeps = held.size > 0
    for s in prange(offsets.size - 1):
        least, pick, kept = np.inf, offsets[s], np.inf
        own = held[s] if keeps else offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total, first, begin = 0.0, indptr[pair], begins[pair]
            for k in range(indptr[pair + 1] - first):
                total += data[begin + k] * values[indices[first + k]]
            stage = cost[pair]
            if factor != 0.0:
                stage += factor * slope[pair]
            total = stage + total
            if total < least:
                least, pick = total, pair
            if keeps and pair == own:
                kept = total
        minima[s], choice[s] = least, pick
        if keeps:
            here[s] = kept


@one_or_all_cores
def back_up_safely(
    offsets: Array,
    indptr: Array,
    begins: Array,
    indices: Array,
    data: Array,
    cost: Array,
    magnitude: Array,
    slope: Array,
    factor: float,
    alone: Array,
    epsilon: float,
    values: Array,
    minima: Array,
    position: Array,
) -> None:
    """Least value of each state with the rounding of every pair's sum counted against it.

    ``position``, unless it is empty, is written: the first pair that attains it among the state's.
    """
    keeps = position.size > 0
    for s in prange(offsets.size - 1):
        least, pick = np.inf, offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total, size, first, begin = 0.0, 0.0, indptr[pair], begins[pair]
            for k in range(indptr[pair + 1] - first):
                term = data[begin + k] * values[indices[first + k]]
                total += term
                size += abs(term)
            stage, whole = cost[pair], magnitude[pair]
            if factor != 0.0:
                stage += factor * slope[pair]
                whole += factor * slope[pair]
            total, size = stage + total, whole + size
            if size != alone[pair]:
                terms = float(indptr[pair + 1] - indptr[pair]) + 4.0
                total -= (terms * epsilon) * size
            if total < least:
                least, pick = total, pair
        minima[s] = least
        if keeps:
            position[s] = pick - offsets[s]


@njit(cache=True)
def back_up_layers(
    order: Array, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, charge: Array, slot: Array, growth: Array,
    first: int, end: int, owed: Array,
    gain: Array, failure: Array, survival: float,
    values: Array, measured: Array, position: Array,
) -> None:  # fmt: skip
    """All layers of a small process in one pass, the last of them first.

    Args:
        order: nodes, each after those that its free steps lead to, [nodes].
        offsets: pairs of each node, [nodes + 1].
        indptr: [pairs + 1].
        kinds: which kind of step an entry is; 0: a free one, within the layer, [entries].
        nodes: to where it leads, [entries].
        data: [entries].
        leads: layer that each kind of step leads to, [layers, kinds]; or how many ahead of any,
            [1, kinds].
        paid: total of each layer, [layers].
        charge: of arriving, [layers or 1, slots].
        slot: of each pair among them, [pairs].
        growth: what a unit of the total adds to it, [pairs] or empty.
        first: layer with which to end.
        end: the layer after the one to begin with; all from there on are known.
        owed: what a pair costs besides, [pairs].
        gain: [pairs].
        failure: [pairs].
        survival: the discount.
        values: of all layers, those beyond the cap given, [all layers * nodes].
        measured: charge, failure and goal, likewise, [all layers * nodes, 3].
        position: written: the choice among each node's pairs, [layers, nodes].
    """
    n = offsets.size - 1
    begin = np.empty(leads.shape[1], dtype=np.int64)
    for layer in range(end - 1, first - 1, -1):
        begin[:] = (leads[0] + layer if leads.shape[0] == 1 else leads[layer]) * n
        row = layer if charge.shape[0] > 1 else 0
        factor = paid[layer] if growth.size > 0 else 0.0
        for s in order:
            least, pick = np.inf, offsets[s]
            for pair in range(offsets[s], offsets[s + 1]):
                total = 0.0
                for k in range(indptr[pair], indptr[pair + 1]):
                    total += data[k] * values[begin[kinds[k]] + nodes[k]]
                stage = charge[row, slot[pair]] + owed[pair]
                if factor != 0.0:
                    stage += factor * growth[pair]
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
            measured[here, 0] = charge[row, slot[pick]] + paying
            measured[here, 1] = failure[pick] + failed
            measured[here, 2] = survival * gain[pick] + reached


@njit(cache=True)
def measure_layers(
    order: Array, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, charge: Array, slot: Array, growth: Array,
    first: int, end: int, gain: Array, failure: Array, survival: float,
    measured: Array, position: Array,
) -> None:  # fmt: skip
    """The charge, failure and goal of a given choice in all layers, as in ``back_up_layers``."""
    n = offsets.size - 1
    for layer in range(end - 1, first - 1, -1):
        row = layer if charge.shape[0] > 1 else 0
        for s in order:
            pick = offsets[s] + position[layer, s]
            paying, failed, reached = 0.0, 0.0, 0.0
            for k in range(indptr[pick], indptr[pick + 1]):
                ahead = leads[0, kinds[k]] + layer
                if leads.shape[0] > 1:
                    ahead = leads[layer, kinds[k]]
                place = ahead * n + nodes[k]
                paying += data[k] * measured[place, 0]
                failed += data[k] * measured[place, 1]
                reached += data[k] * measured[place, 2]
            if growth.size > 0 and paid[layer] != 0.0:
                paying += paid[layer] * growth[pick]
            here = layer * n + s
            measured[here, 0] = charge[row, slot[pick]] + paying
            measured[here, 1] = failure[pick] + failed
            measured[here, 2] = survival * gain[pick] + reached


@njit(cache=True)
def back_up_layers_safely(
    order: Array, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, charge: Array, slot: Array, growth: Array,
    first: int, end: int, owed: Array,
    saved: Array, epsilon: float, given: Array, values: Array,
) -> None:  # fmt: skip
    """Lower bounds of the least values of all layers; rounding counts against every pair.

    Args:
        order: as in ``back_up_layers``, like all that is not listed here.
        saved: what a pair earns, [pairs].
        epsilon: of the machine.
        given: values that are not to be exceeded, [layers, nodes].
        values: of all layers, those beyond the cap given, [all layers * nodes].
    """
    n = offsets.size - 1
    begin = np.empty(leads.shape[1], dtype=np.int64)
    for layer in range(end - 1, first - 1, -1):
        begin[:] = (leads[0] + layer if leads.shape[0] == 1 else leads[layer]) * n
        row = layer if charge.shape[0] > 1 else 0
        factor = paid[layer] if growth.size > 0 else 0.0
        for s in order:
            least = np.inf
            for pair in range(offsets[s], offsets[s + 1]):
                total, size = 0.0, 0.0
                for k in range(indptr[pair], indptr[pair + 1]):
                    term = data[k] * values[begin[kinds[k]] + nodes[k]]
                    total += term
                    size += abs(term)
                stage = charge[row, slot[pair]] + owed[pair] - saved[pair]
                whole = abs(charge[row, slot[pair]]) + owed[pair] + saved[pair]
                if factor != 0.0:
                    stage += factor * growth[pair]
                    whole += factor * growth[pair]
                total, size = stage + total, whole + size
                if size != owed[pair]:
                    terms = float(indptr[pair + 1] - indptr[pair]) + 4.0
                    total -= (terms * epsilon) * size
                least = min(least, total)
            values[layer * n + s] = min(least, given[layer, s])
