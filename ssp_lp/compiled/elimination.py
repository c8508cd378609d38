"""Compiled state reduction: equations of substochastic chains, solved without subtractions.

Grassmann, Taksar and Heyman (1985): a state is taken out by sending what would enter it to where it
goes next. The probability of departing is summed from where it goes, the exits among them, never
formed as 1 - p; all numbers stay non-negative and keep their relative accuracy, however seldom the
chain leaves (Alfa, Xue and Ye 2002).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True)
def solve_by_elimination(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, offsets: Array, first: int, last: int, most: int, rewards: Array, x: Array,
) -> int:  # fmt: skip
    """Solve ``x = rewards + chain @ x`` on components ``first .. last - 1``, ends first.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: probability of leaving the chain, [rows].
        rows: the row of each state, [states].
        order: states, component by component, [states].
        offsets: of the components in the order, [components + 1].
        first: component to begin with; all before it are solved.
        last: where to end.
        most: states of the largest component.
        rewards: [states, rewards].
        x: written, [states, rewards].

    Returns:
        The first component that is never left; -1 if there is none.
    """
    inner, right = np.empty((most, most)), np.empty((most, rewards.shape[1]))
    low, leaving = np.empty(most, dtype=np.int64), np.empty(most)
    place = np.full(rows.size if most > 1 else 0, -1, dtype=np.int32)
    for c in range(first, last):
        begin, size = offsets[c], offsets[c + 1] - offsets[c]
        if size == 1:
            s = order[begin]
            if not _eliminate_one_state(indptr, indices, data, exits, rows[s], s, rewards, x):
                return c
            continue
        for i in range(size):
            place[order[begin + i]] = i
        gather_component(
            indptr, indices, data, exits, rows, order, begin, size, place, rewards, False, x,
            inner, low, leaving, right,
        )  # fmt: skip
        if not eliminate_component(inner, low, leaving, right, size):
            return c
        for i in range(size):
            x[order[begin + i], :] = right[i, :]
            place[order[begin + i]] = -1
    return -1


@njit(cache=True, inline="always")
def _eliminate_one_state(
    indptr: Array, indices: Array, data: Array, exits: Array, row: int, s: int,
    rewards: Array, x: Array,
) -> bool:  # fmt: skip
    """Solve a component of one state; false if it is never left."""
    departs = exits[row]
    for j in range(x.shape[1]):
        x[s, j] = rewards[s, j]
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        successor, p = indices[k], data[k]
        if successor != s and p > 0.0:
            departs += p
            for j in range(x.shape[1]):
                x[s, j] += p * x[successor, j]
    if departs <= 0.0:
        return False
    for j in range(x.shape[1]):
        x[s, j] /= departs
    return True


@njit(cache=True)
def gather_component(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, begin: int, size: int, place: Array, rewards: Array, by_row: bool, x: Array,
    inner: Array, low: Array, leaving: Array, right: Array,
) -> None:  # fmt: skip
    """For elimination, one component as a matrix, what leaves it, and its rewards.

    ``low[i]`` is the first column of the lower triangle, and the first row of the upper one, that
    is not zero beside the diagonal's entry i, when all later states have been taken out. ``rows``
    says which row belongs to each state; rewards are those of rows or of states.
    """
    for i in range(size):
        low[i] = i
    for i in range(size):
        s = rows[order[begin + i]]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            other = np.int64(place[indices[k]])
            if other >= i:
                low[other] = min(low[other], i)
            elif other >= 0:
                low[i] = min(low[i], other)
    for i in range(size - 1, 1, -1):
        if low[i] < i - 1:
            low[i - 1] = min(low[i - 1], low[i])
    for i in range(size):
        for j in range(low[i], i + 1):
            inner[i, j] = inner[j, i] = 0.0
    for i in range(size):
        s = rows[order[begin + i]]
        leaving[i] = exits[s]
        owner = s if by_row else order[begin + i]
        for j in range(right.shape[1]):
            right[i, j] = rewards[owner, j]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            successor, p = indices[k], data[k]
            if place[successor] >= 0:
                inner[i, place[successor]] += p
            elif p > 0.0:
                leaving[i] += p
                for j in range(right.shape[1]):
                    right[i, j] += p * x[successor, j]


@njit(cache=True)
def eliminate_component(inner: Array, low: Array, leaving: Array, right: Array, size: int) -> bool:
    """Solve one component, in place; false if it is never left."""
    n_rewards = right.shape[1]
    for i in range(size - 1, -1, -1):
        departs = leaving[i]
        for j in range(low[i], i):
            departs += inner[i, j]
        if departs <= 0.0:
            return False
        for j in range(low[i], i):
            inner[i, j] /= departs
        leaving[i] /= departs
        for j in range(n_rewards):
            right[i, j] /= departs
        for r in range(low[i], i):
            weight = inner[r, i]
            if weight > 0.0:
                for j in range(low[i], i):
                    inner[r, j] += weight * inner[i, j]
                leaving[r] += weight * leaving[i]
                for j in range(n_rewards):
                    right[r, j] += weight * right[i, j]
    for i in range(1, size):
        for j in range(low[i], i):
            weight = inner[i, j]
            for k in range(n_rewards):
                right[i, k] += weight * right[j, k]
    return True


@njit(cache=True)
def eliminate_band(band: Array, leaving: Array, weights: Array) -> bool:
    """Take the states of a banded chain out, last first, in place.

    Args:
        band: ``band[i, width + j - i]`` is the probability of going from i to j,
            [states, 2 * width + 1]; then, for j < i, what remains of it, divided by the
            probability of departing, and for j > i the weights with which j is replaced.
        leaving: probability of leaving from each state, [states].
        weights: probability of departing from each state, written, [states].

    Returns:
        False if the chain is never left.
    """
    n, width = band.shape[0], band.shape[1] // 2
    for i in range(n - 1, -1, -1):
        low = max(0, i - width)
        departs = leaving[i]
        for j in range(low, i):
            departs += band[i, width + j - i]
        if departs <= 0.0:
            return False
        weights[i] = departs
        for j in range(low, i):
            band[i, width + j - i] /= departs
        leaving[i] /= departs
        for r in range(low, i):
            weight = band[r, width + i - r]
            if weight > 0.0:
                for j in range(low, i):
                    band[r, width + j - r] += weight * band[i, width + j - i]
                leaving[r] += weight * leaving[i]
    return True


@njit(cache=True)
def solve_band(band: Array, departs: Array, right: Array) -> None:
    """Solve with an eliminated band, in place, [states, rewards]."""
    n, width = band.shape[0], band.shape[1] // 2
    n_rewards = right.shape[1]
    for i in range(n - 1, -1, -1):
        for k in range(n_rewards):
            right[i, k] /= departs[i]
        for r in range(max(0, i - width), i):
            weight = band[r, width + i - r]
            if weight > 0.0:
                for k in range(n_rewards):
                    right[r, k] += weight * right[i, k]
    for i in range(1, n):
        for j in range(max(0, i - width), i):
            weight = band[i, width + j - i]
            if weight > 0.0:
                for k in range(n_rewards):
                    right[i, k] += weight * right[j, k]
