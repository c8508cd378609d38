"""Compiled passes over one layer of a policy's chain, read off the model's outcomes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


@njit(cache=True)
def stream_mass(
    mass: Array, pairs: Array, offsets: Array, successors: Array, probabilities: Array,
    classes: Array, slots: Array, waiting: Array,
) -> None:  # fmt: skip
    """Send the mass of a layer on to later ones, in place; one core: the sums keep their order.

    Args:
        mass: [states].
        pairs: of each state, negative where none is taken, [states].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        waiting: written, [slots, states].
    """
    for s in range(pairs.size):
        if pairs[s] >= 0 and mass[s] > 0.0:
            for outcome in range(offsets[pairs[s]], offsets[pairs[s] + 1]):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                if slots[kind] >= 0:
                    waiting[slots[kind], successors[outcome]] += mass[s] * probabilities[outcome]


@njit(cache=True)
def stream_arrivals(
    pairs: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    slots: Array, arriving: Array,
) -> None:  # fmt: skip
    """Mark where the moves of a layer to later ones may arrive, in place.

    Args:
        pairs: of each state that is left, negative where none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        arriving: marked, [slots, states].
    """
    for s in range(pairs.size):
        if pairs[s] >= 0:
            for outcome in range(offsets[pairs[s]], offsets[pairs[s] + 1]):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                if slots[kind] >= 0 and probabilities[outcome] > 0.0:
                    arriving[slots[kind], successors[outcome]] = True


@one_or_all_cores
def stream_totals(
    pairs: Array, offsets: Array, successors: Array, probabilities: Array, classes: Array,
    slots: Array, costs: Array, worth: Array, marks: Array, priced: Array,
    sums: Array, found: Array,
) -> None:  # fmt: skip
    """Expected totals after moves to later layers, and the marks that may be met there.

    Args:
        pairs: of each state that is asked for, negative where none is taken, [k].
        offsets: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        classes: of the step costs, [outcomes]; empty: all outcomes are of class 0.
        slots: where the layer lies that a class of steps leads to, -1: this one, [classes].
        costs: [totals that are priced, classes].
        worth: totals from there on, [slots, states, columns].
        marks: bits, [slots, states].
        priced: columns (from, to): the worth in one, times the cost, counts in the other, [.., 2].
        sums: written, [k, columns].
        found: written, [k].
    """
    n_columns = sums.shape[1]
    for s in prange(pairs.size):
        found[s] = 0
        for k in range(n_columns):
            sums[s, k] = 0.0
        if pairs[s] < 0:
            continue
        begin, end = offsets[pairs[s]], offsets[pairs[s] + 1]
        for first in range(0, n_columns, 4):  # four at a time, in registers
            last = n_columns - 1
            second, third, fourth = min(first + 1, last), min(first + 2, last), min(first + 3, last)
            one, two, three, four = 0.0, 0.0, 0.0, 0.0
            for outcome in range(begin, end):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                slot, share = slots[kind], probabilities[outcome]
                if slot < 0 or share <= 0.0:
                    continue
                to = successors[outcome]
                if first == 0:
                    found[s] |= marks[slot, to]
                one += share * worth[slot, to, first]
                two += share * worth[slot, to, second]
                three += share * worth[slot, to, third]
                four += share * worth[slot, to, fourth]
            sums[s, first], sums[s, second] = one, two
            sums[s, third], sums[s, fourth] = three, four
        for j in range(priced.shape[0]):
            paid = 0.0
            for outcome in range(begin, end):
                kind = np.int64(classes[outcome]) if classes.size > 0 else np.int64(0)
                slot, share = slots[kind], probabilities[outcome]
                if slot >= 0 and share > 0.0:
                    paid += share * costs[j, kind] * worth[slot, successors[outcome], priced[j, 0]]
            sums[s, priced[j, 1]] += paid
