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

_LOWERINGS = 16
"""Turns in which bounds within a layer follow each other's rounding: more than halving it takes."""


@one_or_all_cores
def back_up(
    offsets: Array, indptr: Array, begins: Array, indices: Array, data: Array, cost: Array,
    slope: Array, factor: float, values: Array, held: Array, tied: float, minima: Array,
    choice: Array, here: Array,
) -> None:  # fmt: skip
    """Least value of each state, the first pair tied with it, and the held pair's value."""
    keeps = held.size > 0
    for s in prange(offsets.size - 1):
        least, pick, kept, below = np.inf, offsets[s], np.inf, np.inf
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
                least = total
                if total < below:
                    below, pick = total - tied * abs(total), pair
            if keeps and pair == own:
                kept = total
        minima[s], choice[s] = least, pick
        if keeps:
            here[s] = kept


@one_or_all_cores
def back_up_safely(
    offsets: Array, indptr: Array, begins: Array, indices: Array, data: Array, cost: Array,
    magnitude: Array, slope: Array, factor: float, alone: Array, epsilon: float, values: Array,
    minima: Array, position: Array,
) -> None:  # fmt: skip
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


@njit(cache=True, inline="always")
def _best_of_layers(
    pick: Any, past: Any, indptr: Array, kinds: Array, nodes: Array, data: Array,
    begin: Array, charge: Array, slot: Array, growth: Array, factor: float, owed: Array,
    values: Array, tied: float,
) -> tuple[float, Any]:  # fmt: skip
    """The least value of some pairs of a layer, and the first of them that is tied with it."""
    least, below = np.inf, np.inf
    for pair in range(pick, past):
        total = 0.0
        for k in range(indptr[pair], indptr[pair + 1]):
            total += data[k] * values[begin[kinds[k]] + nodes[k]]
        stage = charge[slot[pair]] + owed[pair]
        if factor != 0.0:
            stage += factor * growth[pair]
        total = stage + total
        if total < least:
            least = total
            if total < below:
                below, pick = total - tied * abs(total), pair
    return least, pick


@njit(cache=True)
def back_up_layers(
    order: Array, most: int, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, charge: Array, slot: Array, growth: Array, first: int, end: int,
    owed: Array, gain: Array, failure: Array, survival: float, accuracy: float, tied: float,
    values: Array, measured: Array, position: Array, keeps: bool,
) -> None:  # fmt: skip
    """All layers of a process in one pass, the last of them first.

    Where free steps go round, a layer is gone over again, forwards and backwards, until values and
    measures stay as they are (Gauss-Seidel).

    Args:
        order: nodes, each after those that its free steps lead to, as far as may be, [nodes].
        most: turns over a layer; 1: free steps do not go round.
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
        accuracy: relative change at which a layer is left.
        tied: relative distance to the least value at which the first pair is taken.
        values: of all layers, those beyond the cap given, [all layers * nodes].
        measured: charge, failure and goal, likewise, [all layers * nodes, 3].
        position: the choice among each node's pairs, [layers, nodes].
        keeps: whether the choice is given, rather than written; then values do not matter.
    """
    n, rows = offsets.size - 1, measured.shape[0] // (offsets.size - 1)
    begin = np.empty(leads.shape[1], dtype=np.int64)
    for layer in range(end - 1, first - 1, -1):
        begin[:] = (leads[0] + layer if leads.shape[0] == 1 else leads[layer]) * n
        charged = charge[layer if charge.shape[0] > 1 else 0]
        factor = paid[layer] if growth.size > 0 else 0.0
        row, later = layer * n, (layer + 1) % rows * n
        if most > 1:
            values[row : row + n] = values[later : later + n]
            measured[row : row + n] = 0.0  # they grow, and what is never met stays nothing
        is_greedy = True  # then the choice is followed until nothing changes, and made anew
        for turn in range(most):
            change, scale = 0.0, 0.0
            for i in range(n):
                s = order[i] if turn % 2 == 0 else order[n - 1 - i]
                here, begins = row + s, np.uint64(offsets[s])
                pick = begins + np.uint64(position[layer, s])
                if not keeps:
                    least, pick = _best_of_layers(
                        begins if is_greedy else pick,
                        np.uint64(offsets[s + 1]) if is_greedy else pick + np.uint64(1),
                        indptr, kinds, nodes, data,
                        begin, charged, slot, growth, factor, owed, values,
                        tied if most == 1 else 0.0,
                    )  # fmt: skip
                    change, scale = max(change, abs(least - values[here])), max(scale, abs(least))
                    values[here], position[layer, s] = least, pick - begins
                paying, failed, reached = 0.0, 0.0, 0.0
                for k in range(indptr[pick], indptr[pick + 1]):
                    place = begin[kinds[k]] + nodes[k]
                    paying += data[k] * measured[place, 0]
                    failed += data[k] * measured[place, 1]
                    reached += data[k] * measured[place, 2]
                if factor != 0.0:
                    paying += factor * growth[pick]
                paying += charged[slot[pick]]
                failed += failure[pick]
                reached += survival * gain[pick]
                was = measured[here]
                if most > 1 and (
                    abs(paying - was[0]) > accuracy * abs(paying)
                    or abs(failed - was[1]) > accuracy * failed
                    or abs(reached - was[2]) > accuracy * reached
                ):
                    change = np.inf
                measured[here, 0], measured[here, 1], measured[here, 2] = paying, failed, reached
            is_same = change <= accuracy * scale
            if is_same and (is_greedy or keeps):
                break
            is_greedy = is_same


@njit(cache=True)
def back_up_layers_safely(
    order: Array, most: int, offsets: Array, indptr: Array, kinds: Array, nodes: Array, data: Array,
    leads: Array, paid: Array, charge: Array, slot: Array, growth: Array, first: int, end: int,
    owed: Array, saved: Array, epsilon: float, accuracy: float, within: Array, given: Array,
    values: Array,
) -> None:  # fmt: skip
    """Lower bounds of the least values of all layers; rounding counts against every pair.

    Where free steps go round, values are lowered to their backups, each by its own rounding. What
    they exceed these by after some turns, times the steps that any policy takes within a layer, is
    taken off all of them: then they are a sub-solution.

    Args:
        order: as in ``back_up_layers``, like all that is not listed here.
        saved: what a pair earns, [pairs].
        epsilon: of the machine.
        within: at least one more than after the free steps of any pair, [nodes].
        given: values that are not to be exceeded, [layers, nodes].
        values: of all layers, those beyond the cap given, [all layers * nodes].
    """
    n, rows = offsets.size - 1, values.size // (offsets.size - 1)
    begin = np.empty(leads.shape[1], dtype=np.int64)
    picks, due = np.empty(n, dtype=np.uint64), owed - saved
    for layer in range(end - 1, first - 1, -1):
        begin[:] = (leads[0] + layer if leads.shape[0] == 1 else leads[layer]) * n
        charged = charge[layer if charge.shape[0] > 1 else 0]
        factor = paid[layer] if growth.size > 0 else 0.0
        row, later = layer * n, (layer + 1) % rows * n
        if most > 1:
            values[row : row + n] = values[later : later + n]
            is_greedy = True
            for turn in range(most):
                change, scale = 0.0, 0.0
                for i in range(n):
                    s = order[i] if turn % 2 == 0 else order[n - 1 - i]
                    least, picks[s] = _best_of_layers(
                        np.uint64(offsets[s]) if is_greedy else picks[s],
                        np.uint64(offsets[s + 1]) if is_greedy else picks[s] + np.uint64(1),
                        indptr, kinds, nodes, data,
                        begin, charged, slot, growth, factor, due, values, 0.0,
                    )  # fmt: skip
                    change = max(change, abs(least - values[row + s]))
                    scale = max(scale, abs(least))
                    values[row + s] = least
                is_same = change <= accuracy * scale
                if is_same and is_greedy:
                    break
                is_greedy = is_same
            for s in range(n):
                values[row + s] = min(values[row + s], given[layer, s])
        excess, size_of_all = 0.0, 0.0
        for turn in range(_LOWERINGS + 1 if most > 1 else 1):
            excess = 0.0
            for i in range(n):
                s = order[i]
                least = np.inf
                for pair in range(offsets[s], offsets[s + 1]):
                    total, size = 0.0, 0.0
                    for k in range(indptr[pair], indptr[pair + 1]):
                        term = data[k] * values[begin[kinds[k]] + nodes[k]]
                        total += term
                        size += abs(term)
                    stage = charged[slot[pair]] + owed[pair] - saved[pair]
                    whole = abs(charged[slot[pair]]) + owed[pair] + saved[pair]
                    if factor != 0.0:
                        stage += factor * growth[pair]
                        whole += factor * growth[pair]
                    total, size = stage + total, whole + size
                    if size != owed[pair]:
                        terms = float(indptr[pair + 1] - indptr[pair]) + 4.0
                        total -= (terms * epsilon) * size
                    least = min(least, total)
                if most > 1:
                    excess = max(excess, values[row + s] - least)
                    if turn < _LOWERINGS:
                        values[row + s] = min(values[row + s], least)
                    size_of_all = max(size_of_all, abs(values[row + s]))
                else:
                    values[row + s] = min(least, given[layer, s])
            if excess == 0.0:
                break
        if excess > 0.0:
            excess += 8.0 * epsilon * (size_of_all + excess)
            for s in range(n):
                values[row + s] -= excess * within[s] * (1.0 + 4.0 * epsilon)
