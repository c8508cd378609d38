"""Strong components of a sparse matrix's graph in the order in which they can be solved."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True)
def order_components(
    begin: Array, end: Array, indices: Array, data: Array, label: Array, order: Array
) -> int:
    """Number the components, in place, so that each comes after all that it leads to.

    Tarjan's search (1972) without recursion. Within a component the states stand in the order in
    which the search was done with them, so that most come after those that they lead to.

    Args:
        begin: first entry of each state, [states].
        end: past its last one, [states].
        indices: [entries].
        data: entries of 0 are no edges, [entries].
        label: component of each state, written, [states].
        order: states, one component after the other, written, [states].

    Returns:
        The number of components.
    """
    n = label.size
    number, low = np.zeros(n, dtype=np.uint32), np.zeros(n, dtype=np.uint32)
    place = begin.copy()
    opened, calls = np.empty(n, dtype=np.uint32), np.empty(n, dtype=np.uint32)
    finished = np.empty(n, dtype=np.uint32)
    n_open, n_finished, visited, found = 0, 0, np.uint32(0), 0
    label[:] = -1
    for root in range(n):
        if number[root] != 0:
            continue
        depth, entered = 0, np.int64(root)
        while entered >= 0 or depth > 0:
            if entered >= 0:
                visited += np.uint32(1)
                number[entered] = low[entered] = visited
                opened[n_open] = calls[depth] = entered
                n_open, depth = n_open + 1, depth + 1
            state = calls[depth - 1]
            entered = _not_entered(state, place, end, indices, data, label, number, low)
            if entered >= 0:
                continue
            depth -= 1
            finished[n_finished] = state
            n_finished += 1
            if depth > 0:
                caller = calls[depth - 1]
                low[caller] = min(low[caller], low[state])
            if low[state] == number[state]:
                n_open = _close(state, opened, n_open, found, label)
                found += 1
    _sort_by_label(label, finished, found, order)
    return found


@njit(cache=True)
def _not_entered(
    state: int, place: Array, end: Array, indices: Array, data: Array,
    label: Array, number: Array, low: Array,
) -> np.int64:  # fmt: skip
    """The next successor that the search has not met, or -1; ``place`` and ``low`` follow."""
    k, past = place[state], end[state]
    while k < past:
        successor, possible = indices[k], data[k] > 0.0
        k += 1
        if not possible:
            continue
        if number[successor] == 0:
            place[state] = k
            return np.int64(successor)
        if label[successor] < 0:
            low[state] = min(low[state], number[successor])
    place[state] = k
    return np.int64(-1)


@njit(cache=True)
def _close(state: int, opened: Array, n_open: int, found: int, label: Array) -> int:
    """Give all that was opened since a state its label; how many states are left open."""
    while True:
        n_open -= 1
        label[opened[n_open]] = found
        if opened[n_open] == state:
            return n_open


@njit(cache=True)
def mark_left(
    indptr: Array, indices: Array, data: Array, exits: Array, label: Array, left: Array
) -> None:
    """Mark, in place, the components from which a step leads elsewhere or out, [components]."""
    for s in range(label.size):
        if left[label[s]]:
            continue
        if exits[s] > 0.0:
            left[label[s]] = True
            continue
        for k in range(indptr[s], indptr[np.uint32(s + 1)]):
            if data[k] > 0.0 and label[indices[k]] != label[s]:
                left[label[s]] = True
                break


@njit(cache=True)
def _sort_by_label(label: Array, finished: Array, found: int, order: Array) -> None:
    """Counting sort that keeps the order of finishing within each component."""
    begin = np.zeros(found + 1, dtype=np.int64)
    for state in finished:
        begin[label[state] + 1] += 1
    for c in range(found):
        begin[c + 1] += begin[c]
    for state in finished:
        order[begin[label[state]]] = state
        begin[label[state]] += 1
