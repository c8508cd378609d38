"""Strong components of graphs, compiled (Tarjan 1972, without recursion)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


def label_components(
    pair_offsets: IntArray,
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    inside: BoolArray,
    roots: IntArray,
    label: IntArray,
) -> None:
    """Label each root, in place, by the first state of its strong component.

    Args:
        pair_offsets: [states + 1].
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        inside: the pairs that link states; those of roots lead to roots, [pairs].
        roots: the states to label.
        label: [states].
    """
    label[roots] = -1
    graph = pair_offsets, outcome_offsets, unsigned(successors), probabilities, inside
    _search(*graph, roots, label, *_scratch(pair_offsets, outcome_offsets))


def _scratch(pair_offsets: IntArray, outcome_offsets: IntArray) -> tuple[IntArray, ...]:
    """Per state: its number, its low link, where it goes on; the open states, the calls."""
    n_states = len(pair_offsets) - 1
    number = np.zeros(n_states, dtype=np.int32)  # 0: not visited yet
    low = np.zeros(n_states, dtype=np.int32)
    next_pair = pair_offsets[:-1].copy()
    next_outcome = outcome_offsets[next_pair]
    opened, calls = np.empty((2, n_states), dtype=np.uint32)
    return number, low, next_pair, next_outcome, opened, calls


@njit(cache=True)
def _search(
    pair_offsets: IntArray,
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    inside: BoolArray,
    roots: IntArray,
    label: IntArray,
    number: IntArray,
    low: IntArray,
    next_pair: IntArray,
    next_outcome: IntArray,
    opened: IntArray,
    calls: IntArray,
) -> None:
    visited, n_open = 0, 0
    for root in roots:
        depth, entered = 0, -1 if number[root] else root
        while entered >= 0 or depth:
            if entered >= 0:
                visited += 1
                number[entered] = low[entered] = visited
                opened[n_open], calls[depth] = entered, entered
                n_open, depth = n_open + 1, depth + 1
            state = calls[depth - 1]
            entered = _advance(
                pair_offsets, outcome_offsets, successors, probabilities, inside, state,
                label, number, low, next_pair, next_outcome,
            )  # fmt: skip
            if entered < 0:
                depth -= 1
                if depth:
                    caller = calls[depth - 1]
                    low[caller] = min(low[caller], low[state])
                if low[state] == number[state]:
                    n_open = _pop(opened, n_open, state, label)


@njit(cache=True)
def _advance(
    pair_offsets: IntArray,
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    inside: BoolArray,
    state: int,
    label: IntArray,
    number: IntArray,
    low: IntArray,
    next_pair: IntArray,
    next_outcome: IntArray,
) -> int:
    """Go on through the steps of a state to the next one that was not visited, or return -1."""
    pair, outcome = next_pair[state], next_outcome[state]
    while pair < pair_offsets[state + 1]:
        end = outcome_offsets[pair + 1]
        if inside[pair]:
            while outcome < end:
                successor = successors[outcome]
                possible = probabilities[outcome] > 0
                outcome += 1
                if possible and number[successor] == 0:
                    next_pair[state], next_outcome[state] = pair, outcome
                    return int(successor)
                if possible and label[successor] < 0:
                    low[state] = min(low[state], number[successor])
        pair, outcome = pair + 1, end
    next_pair[state] = pair
    return -1


@njit(cache=True)
def _pop(opened: IntArray, n_open: int, root: int, label: IntArray) -> int:
    """Label the component that ends at its root; return the number of states still open."""
    begin, least = n_open - 1, root
    while opened[begin] != root:
        least = min(least, opened[begin])
        begin -= 1
    for place in range(begin, n_open):
        label[opened[place]] = least
    return begin


def crossing_pairs(
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    pair_state: IntArray,
    candidates: BoolArray,
    label: IntArray,
) -> BoolArray:
    """Candidate pairs that may lead to a state of another label, [pairs].

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        pair_state: [pairs].
        candidates: [pairs].
        label: [states].
    """
    graph = outcome_offsets, unsigned(successors), probabilities, unsigned(pair_state)
    found = np.zeros(len(candidates), dtype=np.bool_)
    _crossing(len(successors))(*graph, candidates, label, found)
    return found


@one_or_all_cores
def _crossing(
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    pair_state: IntArray,
    candidates: BoolArray,
    label: IntArray,
    found: BoolArray,
) -> None:
    for pair in prange(len(candidates)):
        if candidates[pair]:
            here = label[pair_state[pair]]
            for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
                if label[successors[outcome]] != here and probabilities[outcome] > 0:
                    found[pair] = True
                    break


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
