"""Searches on a model's graph, compiled; their twins are in ``ssp_lp.model``.

Indices are read through unsigned views: numba guards signed ones against counting from the end.
Sets and least elements only, so every result is the same, bit by bit, as that of the twin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.deadline import check_time, pieces

_TURNS = 30_000  # states taken from a queue between two looks at the time


def reaching(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, goals: IntArray
) -> BoolArray:
    """By a compiled search, states from which a run may reach a goal, goals included, [states].

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


@njit(cache=True)
def _search_backwards(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, mask: BoolArray, queue: IntArray,
    head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Go on with a search against the graph for some turns."""
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
    offsets: IntArray,
    pairs: IntArray,
    pair_state: IntArray,
    open_pairs: BoolArray,
    open_counts: IntArray,
    closed_states: IntArray,
) -> None:
    """By a graph search close, in place, every pair that may lead to a closed state.

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


@njit(cache=True)
def _drain_search(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, open_pairs: BoolArray,
    open_counts: IntArray, queue: IntArray, head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Go on for some turns with the search that closes pairs."""
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
    offsets: IntArray,
    pairs: IntArray,
    pair_state: IntArray,
    useful: IntArray,
    usable: BoolArray,
    choice: IntArray,
    distance: IntArray,
) -> None:
    """By a graph search choose, in place, for each state a usable pair that comes nearer.

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


@njit(cache=True)
def _begin_search(pair_state: IntArray, useful: IntArray, choice: IntArray, queue: IntArray) -> int:
    """Begin a search at the useful pairs; how many states the queue holds."""
    filled = 0
    for pair in useful:
        state = pair_state[pair]
        if choice[state] < 0:
            choice[state] = pair
            queue[filled] = state
            filled += 1
    return filled


@njit(cache=True)
def _approach_search(
    offsets: IntArray, pairs: IntArray, pair_state: IntArray, usable: BoolArray, choice: IntArray,
    distance: IntArray, queue: IntArray, head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Go on for some turns with the search for pairs that come nearer."""
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
    """By a search of the graph, pairs that may lead into one of the states, [pairs]."""
    leads = np.zeros(len(outcome_offsets) - 1, dtype=np.bool_)
    _search_leading_into(outcome_offsets, unsigned(successors), probabilities, states, leads)
    return leads


@njit(cache=True)
def _search_leading_into(
    outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray, states: BoolArray,
    leads: BoolArray,
) -> None:  # fmt: skip
    """Mark, in place, pairs that lead into the states searched for."""
    for pair in range(len(leads)):
        for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if states[successors[outcome]] and probabilities[outcome] > 0:
                leads[pair] = True
                break


def _empty_queue(
    step: Callable[..., tuple[int, int]], arrays: tuple[Any, ...], filled: int
) -> None:
    """Take all states from a search's queue, with looks at the clock in between."""
    head = 0
    while head < filled:
        check_time()
        head, filled = step(*arrays, head, filled)


def _search_queue(first: IntArray, room: int) -> tuple[IntArray, int]:
    """A search's queue of states that begins with these, and how many they are."""
    queue = np.empty(room, dtype=np.uint32)
    queue[: len(first)] = first
    return queue, len(first)


def transpose_graph(
    n_states: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray
) -> tuple[IntArray, IntArray]:
    """Turn the graph round for a search: offsets, [states + 1], and pairs, by a counting sort."""
    columns = unsigned(successors)
    counts = np.zeros(n_states, dtype=np.int64)
    for some in pieces(len(columns), len(columns)):
        _count_edges(columns[some], probabilities[some], counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    pairs = np.empty(offsets[-1], dtype=np.int32)
    places = offsets[:-1].copy()
    for some in pieces(len(outcome_offsets) - 1, len(columns)):
        bounds = outcome_offsets[some.start : some.stop + 1]
        _place_edges(some.start, bounds, columns, probabilities, places, pairs)
    return offsets, pairs


@njit(cache=True)
def _count_edges(successors: IntArray, probabilities: FloatArray, counts: IntArray) -> None:
    """Count the possible outcomes that go to each state."""
    for outcome in range(len(successors)):
        if probabilities[outcome] > 0:
            counts[successors[outcome]] += 1


@njit(cache=True)
def _place_edges(
    first: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray,
    places: IntArray, pairs: IntArray,
) -> None:  # fmt: skip
    """Write each pair to the next place of its successors."""
    for pair in range(len(outcome_offsets) - 1):
        for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if probabilities[outcome] > 0:
                successor = successors[outcome]
                pairs[places[successor]] = first + pair
                places[successor] += 1
