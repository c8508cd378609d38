"""Searches and strong components of a model's graph, compiled; their twins are in ``ssp_lp.model``.

Indices are read through unsigned views: numba guards signed ones against counting from the end.
Sets and least elements only, so every result is the same, bit by bit, as that of the twin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import prange

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.cores import compiled_loop, one_or_all_cores
from ssp_lp.compiled.deadline import check_time, pieces

_TURNS = 30_000  # states taken from a queue between two looks at the time


def reaching(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, goals: IntArray
) -> BoolArray:
    """Compiled graph search: states from which a run may reach a goal, goals included, [states].

    Args:
        offsets: of the predecessors, [states + 1].
        pairs: the predecessors, [entries].
        pair_state: [pairs].
        goals: distinct states.
    """
    mask = np.zeros(len(offsets) - 1, dtype=np.bool_)
    mask[goals] = True
    queue, filled = _search_queue(goals, mask.size)
    arrays = offsets, unsigned(pairs), unsigned(pair_state), mask, queue
    _empty_queue(_search_backwards, arrays, filled)
    return mask


@compiled_loop
def _search_backwards(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, mask: BoolArray, queue: IntArray,
    head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Compiled graph search against the edges, for some turns."""
    past = head + _TURNS
    while head < min(filled, past):
        near = queue[head]
        head += 1
        for entry in range(offsets[near], offsets[near + 1]):
            state = pair_state[pairs[entry]]
            if not mask[state]:
                mask[state] = True
                queue[filled] = state
                filled += 1
    return head, filled


def drain(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, open_pairs: BoolArray,
    open_counts: IntArray, closed_states: IntArray,
) -> None:  # fmt: skip
    """Compiled graph search: close, in place, every pair that may lead to a closed state.

    Args:
        offsets: of the predecessors, [states + 1].
        pairs: the predecessors, [entries].
        pair_state: [pairs].
        open_pairs: [pairs].
        open_counts: the number of open pairs of each state, [states].
        closed_states: states to begin with.
    """
    queue, filled = _search_queue(closed_states, open_counts.size)
    arrays = offsets, unsigned(pairs), unsigned(pair_state), open_pairs, open_counts, queue
    _empty_queue(_drain_search, arrays, filled)


@compiled_loop
def _drain_search(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, open_pairs: BoolArray,
    open_counts: IntArray, queue: IntArray, head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Compiled graph search that closes pairs, for some turns."""
    past = head + _TURNS
    while head < min(filled, past):
        closed = queue[head]
        head += 1
        for entry in range(offsets[closed], offsets[closed + 1]):
            pair = pairs[entry]
            if open_pairs[pair]:
                open_pairs[pair] = False
                state = pair_state[pair]
                open_counts[state] -= 1
                if open_counts[state] == 0:
                    queue[filled] = state
                    filled += 1
    return head, filled


def approach(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, useful: IntArray, usable: BoolArray,
    choice: IntArray, distance: IntArray,
) -> None:  # fmt: skip
    """Compiled graph search: choose for each state a usable pair that comes nearer, in place.

    Args:
        offsets: of the predecessors, [states + 1].
        pairs: the predecessors, [entries].
        pair_state: [pairs].
        useful: usable pairs to begin with, ascending.
        usable: [pairs].
        choice: [states], -1 throughout, and where no useful pair can be reached.
        distance: zeros, written: steps before a useful pair is taken, [states].
    """
    queue = np.empty(choice.size, dtype=np.uint32)
    home = unsigned(pair_state)
    arrays = offsets, unsigned(pairs), home, usable, choice, distance, queue
    _empty_queue(_approach_search, arrays, _begin_search(home, useful, choice, queue))


@compiled_loop
def _begin_search(pair_state: IntArray, useful: IntArray, choice: IntArray, queue: IntArray) -> int:
    """Compiled graph search begun at the useful pairs; how many states the queue holds."""
    filled = 0
    for pair in useful:
        state = pair_state[pair]
        if choice[state] < 0:
            choice[state] = pair
            queue[filled] = state
            filled += 1
    return filled


@compiled_loop
def _approach_search(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, usable: BoolArray, choice: IntArray,
    distance: IntArray, queue: IntArray, head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Compiled graph search for pairs that come nearer, for some turns."""
    past = head + _TURNS
    while head < min(filled, past):
        near = queue[head]
        head += 1
        for entry in range(offsets[near], offsets[near + 1]):
            pair = pairs[entry]
            state = pair_state[pair]
            if not usable[pair]:
                continue
            if choice[state] < 0:
                choice[state] = pair
                distance[state] = distance[near] + 1
                queue[filled] = state
                filled += 1
            elif distance[state] == distance[near] + 1 and pair < choice[state]:
                choice[state] = pair
    return head, filled


def leading_into(
    outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray, states: BoolArray
) -> BoolArray:
    """Compiled graph search: pairs that may lead into one of the states, [pairs]."""
    leads = np.zeros(len(outcome_offsets) - 1, dtype=np.bool_)
    _search_leading_into(outcome_offsets, unsigned(successors), probabilities, states, leads)
    return leads


@compiled_loop
def _search_leading_into(
    outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray, states: BoolArray,
    leads: BoolArray,
) -> None:  # fmt: skip
    """Compiled: mark, in place, pairs whose graph edges lead into the states searched for."""
    for pair in range(len(leads)):
        for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if states[successors[outcome]] and probabilities[outcome] > 0:
                leads[pair] = True
                break


def _empty_queue(
    step: Callable[..., tuple[int, int]], arrays: tuple[Any, ...], filled: int
) -> None:
    """Run a compiled graph search until its queue is empty, with looks at the clock in between."""
    head = 0
    while head < filled:
        check_time()
        head, filled = step(*arrays, head, filled)


def _search_queue(first: IntArray, room: int) -> tuple[IntArray, int]:
    """A compiled graph search's queue that begins with these states, and how many they are."""
    queue = np.empty(room, dtype=np.uint32)
    queue[: len(first)] = first
    return queue, len(first)


def transpose_graph(
    n_states: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray
) -> tuple[IntArray, IntArray]:
    """Compiled: transpose a graph, offsets, [states + 1], and pairs, by a counting sort."""
    columns = unsigned(successors)
    counts = np.zeros(n_states, dtype=np.int64)
    for some in pieces(len(columns), len(columns)):
        _count_edges(columns[some], probabilities[some], counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    pairs = np.empty(offsets[-1], dtype=np.int32)
    places = offsets[:-1].copy()
    for some in pieces(len(outcome_offsets) - 1, len(columns)):
        bounds = outcome_offsets[some.start : some.stop + 1]
        _write_edges(some.start, bounds, columns, probabilities, places, pairs)
    return offsets, pairs


@compiled_loop
def _count_edges(successors: IntArray, probabilities: FloatArray, counts: IntArray) -> None:
    """Compiled: count the graph's edges into each state."""
    for outcome in range(len(successors)):
        if probabilities[outcome] > 0:
            counts[successors[outcome]] += 1


@compiled_loop
def _write_edges(
    first: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray,
    places: IntArray, pairs: IntArray,
) -> None:  # fmt: skip
    """Compiled: write each pair to the next place among its successors' edges of the graph."""
    for pair in range(len(outcome_offsets) - 1):
        for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if probabilities[outcome] > 0:
                successor = successors[outcome]
                pairs[places[successor]] = first + pair
                places[successor] += 1


Array = np.ndarray[Any, Any]

_CLOSED = np.uint32(2**32 - 1)  # above every number of a state that is still open
_TURNS = 100_000  # of a search between two looks at the time


def order_components(
    begin: IntArray, end: IntArray, indices: IntArray, data: FloatArray, *, by_height: bool = False
) -> tuple[IntArray, IntArray, int]:
    """Compiled: number a graph's strong components, each after all that it leads to.

    Within a component the states stand in the order in which the search was done with them, so
    that most come after those that they lead to.

    Args:
        begin: first entry of each state, [states].
        end: past its last one, [states].
        indices: [entries].
        data: entries of 0 are no edges, [entries].
        by_height: components that are as far from the ends stand in the order of their states, so
            that passes along the order, where there are many, read rows that lie side by side.

    Returns:
        The component of each state, [states]; the states, one component after the other, [states];
        and the number of components.
    """
    n = len(begin)
    label, order = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.uint32)
    roots = np.arange(n, dtype=np.uint32)
    finished, n_components = _found_components(begin, end, unsigned(indices), data, roots, label)
    if by_height:
        _number_by_height(begin, end, unsigned(indices), data, finished, n_components, label)
    _sort_by_component(label, finished, n_components, order)
    return label, order.view(np.int32), n_components


def label_components(
    pair_offsets: IntArray, outcome_offsets: IntArray, successors: IntArray,
    probabilities: FloatArray, inside: BoolArray, roots: IntArray, label: IntArray,
) -> None:  # fmt: skip
    """Compiled: label each root in the graph by the first state of its strong component.

    Args:
        pair_offsets: [states + 1].
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        inside: the pairs that link states; those of roots lead to roots, [pairs].
        roots: the states to label, ascending.
        label: [states].
    """
    bounds = outcome_offsets[pair_offsets]
    possible = np.repeat(inside, np.diff(outcome_offsets))
    possible &= probabilities > 0.0
    edges = bounds[:-1], bounds[1:], unsigned(successors), possible
    _, n_components = _found_components(*edges, roots, label)
    first, backwards = np.empty(n_components, dtype=label.dtype), roots[::-1]
    first[label[backwards]] = backwards  # the last one that is written stays
    label[roots] = first[label[roots]]


def _found_components(
    begin: IntArray, end: IntArray, indices: IntArray, data: Array, roots: IntArray, label: IntArray
) -> tuple[IntArray, int]:
    """Compiled: number the roots of a graph's strong components in place, ends first.

    Returns:
        The roots in the order in which the search was done with them, and how many components.
    """
    n, label[roots] = label.size, -1
    number, low = np.zeros((2, n), dtype=np.uint32)
    opened, calls = np.empty((2, n), dtype=np.uint32)
    finished, counts = np.empty(len(roots), dtype=np.uint32), np.zeros(6, dtype=np.int64)
    arrays = number, low, begin.copy(), opened, calls, finished, counts
    check_time()
    while _search_components(begin, end, indices, data, roots, label, *arrays):
        check_time()
    return finished, int(counts[5])


@compiled_loop
def _search_components(
    begin: Array, end: Array, indices: Array, data: Array, roots: Array, label: Array,
    number: Array, low: Array, place: Array, opened: Array, calls: Array, finished: Array,
    counts: Array,
) -> bool:  # fmt: skip
    """Compiled depth-first search of a graph for strong components; whether it has not ended.

    Args:
        begin: as in ``order_components``, like what follows.
        end: [states].
        indices: [entries].
        data: [entries].
        roots: where searches begin.
        label: written, [states].
        number: when each state was met, 0: not yet, ``_CLOSED``: it has a component, [states].
        low: the least number that is reached from each and still open, [states].
        place: entry with which each state goes on, [states].
        opened: states without a component yet, [states].
        calls: the states from which the search came, [states].
        finished: states that it is done with, [roots].
        counts: roots, calls, open states, finished ones, states met, components.
    """
    root, depth, n_open = counts[0], counts[1], counts[2]
    n_finished, visited, n_components = counts[3], counts[4], counts[5]
    goes_on = True
    for _ in range(_TURNS):
        entered = np.int64(-1)
        if depth > 0:
            state = calls[depth - 1]
            entered = _not_entered(state, place, end, indices, data, number, low)
        elif root == roots.size:
            goes_on = False
            break
        else:
            state, root = roots[root], root + 1
            if number[state] != 0:
                continue
            entered = np.int64(state)
        if entered >= 0:
            visited += 1
            number[entered] = low[entered] = visited
            opened[n_open] = calls[depth] = entered
            n_open, depth = n_open + 1, depth + 1
            continue
        depth -= 1
        finished[n_finished] = state
        n_finished += 1
        if depth > 0:
            caller = calls[depth - 1]
            low[caller] = min(low[caller], low[state])
        if low[state] == number[state]:
            n_open = _close_component(state, opened, n_open, n_components, label, number)
            n_components += 1
    counts[0], counts[1], counts[2] = root, depth, n_open
    counts[3], counts[4], counts[5] = n_finished, visited, n_components
    return goes_on


@compiled_loop
def _not_entered(
    state: int, place: Array, end: Array, indices: Array, data: Array,
    number: Array, low: Array,
) -> np.int64:  # fmt: skip
    """Compiled: the next successor that the graph's component search has not met, or -1."""
    k, past, least = place[state], end[state], low[state]
    while k < past:
        successor, met = indices[k], number[indices[k]]
        if data[k] > 0.0:
            if met == 0:
                place[state], low[state] = k + 1, least
                return np.int64(successor)
            least = min(least, met)
        k += 1
    place[state], low[state] = k, least
    return np.int64(-1)


@compiled_loop
def _close_component(
    state: int, opened: Array, n_open: int, found: int, label: Array, number: Array
) -> int:
    """Compiled: label a finished strong component of the graph; how many states stay open."""
    while True:
        n_open -= 1
        label[opened[n_open]], number[opened[n_open]] = found, _CLOSED
        if opened[n_open] == state:
            return n_open


@compiled_loop
def mark_leading(
    indptr: Array, indices: Array, data: Array, states: Array, marked: BoolArray
) -> None:
    """Compiled: mark each of some states of a graph that leads to a marked one, one by one."""
    for s in states:
        for k in range(indptr[s], indptr[np.uint32(s + 1)]):
            if data[k] > 0.0 and marked[indices[k]]:
                marked[s] = True
                break


@compiled_loop
def mark_left(
    indptr: Array, indices: Array, data: Array, exits: Array, label: Array, left: Array
) -> None:
    """Compiled: mark strong components of a graph from which a step leads out, [components]."""
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


@compiled_loop
def _number_by_height(
    begin: Array, end: Array, indices: Array, data: Array, finished: Array, found: int, label: Array
) -> None:
    """Compiled: renumber a graph's components by the most steps to an end, then first states."""
    height, number = np.zeros(found, dtype=np.int64), np.full(found, -1, dtype=np.int64)
    for s in finished:
        own = label[s]
        for k in range(begin[s], end[s]):
            to = label[indices[k]]
            if to != own and data[k] > 0.0:
                height[own] = max(height[own], height[to] + 1)
    place = np.zeros(found + 1, dtype=np.int64)
    for c in range(found):
        place[height[c] + 1] += 1
    for c in range(found):
        place[c + 1] += place[c]
    for s in range(label.size):
        own = label[s]
        if number[own] < 0:
            number[own] = place[height[own]]
            place[height[own]] += 1
    for s in range(label.size):
        label[s] = number[label[s]]


@compiled_loop
def _sort_by_component(label: Array, finished: Array, found: int, order: Array) -> None:
    """Compiled counting sort of a graph's states by component, in order of finishing."""
    begin = np.zeros(found + 1, dtype=np.int64)
    for state in finished:
        begin[label[state] + 1] += 1
    for c in range(found):
        begin[c + 1] += begin[c]
    for state in finished:
        order[begin[label[state]]] = state
        begin[label[state]] += 1


def crossing_pairs(
    outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray,
    pair_state: IntArray, candidates: BoolArray, label: IntArray,
) -> BoolArray:  # fmt: skip
    """Compiled: candidate pairs that lead from one component of a graph to another, [pairs].

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        pair_state: [pairs].
        candidates: [pairs].
        label: [states].
    """
    graph = outcome_offsets, unsigned(successors), probabilities, unsigned(pair_state)
    crossing = np.zeros(len(candidates), dtype=np.bool_)
    _crossing_components(len(successors))(*graph, candidates, label, crossing)
    return crossing


@one_or_all_cores
def _crossing_components(
    outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray,
    pair_state: IntArray, candidates: BoolArray, label: IntArray, found: BoolArray,
) -> None:  # fmt: skip
    """Compiled: mark candidate pairs that cross between a graph's components, in place."""
    for pair in prange(len(candidates)):
        if candidates[pair]:
            here = label[pair_state[pair]]
            for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
                if label[successors[outcome]] != here and probabilities[outcome] > 0:
                    found[pair] = True
                    break
