"""Compiled Bellman backups of a whole process; the numpy version is in ``bellman``.

Without fast-math sums run in the order of scipy's products, so that both agree to the last bit.
Index arrays are unsigned views, because numba tests signed indices for negative values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def back_up(
    offsets: Array, indptr: Array, starts: Array, indices: Array, data: Array, cost: Array,
    slope: Array, factor: float, values: Array, current: Array, minima: Array,
    choice: Array, current_values: Array,
) -> None:  # fmt: skip
    """Compute each state's least value and the first pair that attains it: a Bellman backup.

    Args:
        offsets: offsets of each state's pairs, [states + 1].
        indptr: position of each pair's first column, [pairs + 1].
        starts: position of each pair's first number, [pairs].
        indices: columns, [entries].
        data: nonzero numbers; rows with equal numbers may share them.
        cost: fixed cost, [pairs].
        slope: cost per unit of ``factor``, [pairs].
        factor: 0: ``slope`` is not used.
        values: [columns].
        current: a pair of each state, also to be evaluated, [states]; or empty.
        minima: written: least values, [states].
        choice: written: pairs, [states].
        current_values: written unless ``current`` is empty: values of the held pairs, [states].
    """
    keeps = current.size > 0
    for s in prange(offsets.size - 1):
        least, pick, kept = np.inf, offsets[s], np.inf
        own = current[s] if keeps else offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total, first, begin = 0.0, indptr[pair], starts[pair]
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
            current_values[s] = kept


@one_or_all_cores
def back_up_safely(
    offsets: Array, indptr: Array, starts: Array, indices: Array, data: Array, cost: Array,
    magnitude: Array, slope: Array, factor: float, largest_term: Array, epsilon: float,
    values: Array, minima: Array, position: Array,
) -> None:  # fmt: skip
    """Compute a lower bound of each state's least value: a Bellman backup rounded down.

    A bound of the rounding errors is subtracted from each pair's sum. The arguments are those of
    ``back_up``, and:

    Args:
        magnitude: sum of the absolute values of the fixed cost's terms, [pairs].
        largest_term: greatest absolute value of one of these terms, [pairs].
        epsilon: the machine epsilon.
        position: written unless empty: position of the first best pair among the pairs of its
            state, [states].
    """
    keeps = position.size > 0
    for s in prange(offsets.size - 1):
        least, pick = np.inf, offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total, size, first, begin = 0.0, 0.0, indptr[pair], starts[pair]
            for k in range(indptr[pair + 1] - first):
                term = data[begin + k] * values[indices[first + k]]
                total += term
                size += abs(term)
            stage, whole = cost[pair], magnitude[pair]
            if factor != 0.0:
                stage += factor * slope[pair]
                whole += factor * slope[pair]
            total, size = stage + total, whole + size
            if size != largest_term[pair]:
                terms = float(indptr[pair + 1] - indptr[pair]) + 4.0
                total -= (terms * epsilon) * size
            if total < least:
                least, pick = total, pair
        minima[s] = least
        if keeps:
            position[s] = pick - offsets[s]
