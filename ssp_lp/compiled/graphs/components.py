"""Strong components of the graph that a set of pairs spans, compiled (Tarjan 1972, iterative)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.loops import one_or_all_cores


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


def crossing(
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
