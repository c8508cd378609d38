"""Compiled Bellman backups and policy products; twin of ``dynamic_programming.bellman``.

No fast-math: sums run in the order of scipy's products, so that both agree to the last bit.
Index arrays come as unsigned views: signed ones cost a test for negative positions at each access.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def back_up(
    offsets: Array,
    indptr: Array,
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
            total = 0.0
            for k in range(indptr[pair], indptr[pair + 1]):
                total += data[k] * values[indices[k]]
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
) -> None:
    """Least value of each state with the rounding of every pair's sum counted against it."""
    for s in prange(offsets.size - 1):
        least = np.inf
        for pair in range(offsets[s], offsets[s + 1]):
            total, size = 0.0, 0.0
            for k in range(indptr[pair], indptr[pair + 1]):
                term = data[k] * values[indices[k]]
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
            least = min(least, total)
        minima[s] = least


@one_or_all_cores
def product(
    choice: Array, indptr: Array, indices: Array, data: Array, x: Array, result: Array
) -> None:
    """Chosen rows times one vector."""
    for s in prange(choice.size):
        row = choice[s]
        total = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            total += data[k] * x[indices[k]]
        result[s] = total


@one_or_all_cores
def products(
    choice: Array, indptr: Array, indices: Array, data: Array, x: Array, result: Array
) -> None:
    """Chosen rows times several vectors, [states, vectors]."""
    if x.shape[1] == 3:  # each entry is read once
        for s in prange(choice.size):
            row = choice[s]
            first, second, third = 0.0, 0.0, 0.0
            for k in range(indptr[row], indptr[row + 1]):
                weight, column = data[k], indices[k]
                first += weight * x[column, 0]
                second += weight * x[column, 1]
                third += weight * x[column, 2]
            result[s, 0], result[s, 1], result[s, 2] = first, second, third
        return
    for s in prange(choice.size):
        row = choice[s]
        for j in range(x.shape[1]):
            total = 0.0
            for k in range(indptr[row], indptr[row + 1]):
                total += data[k] * x[indices[k], j]
            result[s, j] = total


@one_or_all_cores
def extract(
    choice: Array,
    indptr: Array,
    indices: Array,
    data: Array,
    own_indptr: Array,
    own_indices: Array,
    own_data: Array,
) -> None:
    """Copy the chosen rows one after the other, so that products read memory in order."""
    for s in prange(choice.size):
        begin, place = indptr[choice[s]], own_indptr[s]
        for k in range(own_indptr[s + 1] - place):
            own_indices[place + k] = indices[begin + k]
            own_data[place + k] = data[begin + k]
