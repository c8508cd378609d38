"""Compiled searches of a graph: reached states, and strong components in order.

Index arrays are unsigned views, because numba tests signed indices for negative values.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.cores import compiled_loop
from ssp_lp.compiled.deadline import check_time

Array = np.ndarray[Any, Any]

_CLOSED = np.uint32(2**32 - 1)  # above every number of a state that is still open
_TURNS = 100_000  # turns of a search between two checks of the time


def transpose(
    n_states: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return the pairs that may lead to each state: offsets, [states + 1], and pairs, [entries]."""
    check_time()
    places = np.zeros(n_states + 2, dtype=np.int64)
    pairs = np.empty(successors.size, dtype=np.int32)
    count_and_place(outcome_offsets, unsigned(successors), probabilities, places, pairs)
    return places[:-1], pairs[: places[-1]]


@compiled_loop
def count_and_place(
    outcome_offsets: Array, successors: Array, probabilities: Array, places: Array, pairs: Array
) -> None:
    """Sort the pairs by their possible successors (a counting sort).

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        places: zeros; written: offsets of each state's pairs, then one unused entry, [states + 2].
        pairs: written: pairs that may lead to each state, [entries].
    """
    for k in range(successors.size):
        if probabilities[k] > 0.0:
            places[successors[k] + 2] += 1
    for state in range(2, places.size):
        places[state] += places[state - 1]
    for pair in range(outcome_offsets.size - 1):
        for k in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if probabilities[k] > 0.0:
                past = successors[k] + 1
                pairs[places[past]] = pair
                places[past] += 1


def search_backwards(
    graph: tuple[IntArray, IntArray, IntArray], open_pairs: BoolArray, needed: IntArray,
    states: IntArray, choice: IntArray | None = None, distance: IntArray | None = None,
) -> None:  # fmt: skip
    """Search backwards from given states, breadth-first, and close the pairs that lead to them.

    A state is reached as soon as ``needed`` of its pairs are closed. If ``needed`` is 1, the search
    finds the states from which some pair may lead to a reached state. If ``needed`` is the number
    of open pairs, it finds the states from which every open pair may lead to a reached state.

    Args:
        graph: offsets of each state's predecessors, [states + 1]; the predecessors, which are
            pairs, [entries]; and the state of each pair, [pairs].
        open_pairs: pairs that are not closed yet; updated, [pairs].
        needed: number of pairs to close before a state is reached; updated, [states] int64.
        states: the states from which the search begins, which are reached.
        choice: written: a pair by which each state is reached in the fewest steps; if there are
            several, the one with the lowest index, [states] int64.
        distance: zeros; written: steps from each reached state to ``states``, [states] int32.
    """
    n, (offsets, pairs, owner) = needed.size, graph
    choice = np.empty(n, dtype=np.int64) if choice is None else choice
    distance = np.zeros(n, dtype=np.int32) if distance is None else distance
    queue, head, filled = np.empty(n, dtype=np.uint32), 0, states.size
    queue[:filled] = states
    arrays = offsets, unsigned(pairs), unsigned(owner), open_pairs, needed, choice, distance, queue
    while head < filled:
        check_time()
        head, filled = take_from_queue(*arrays, head, filled)


@compiled_loop
def take_from_queue(
    offsets: Array, pairs: Array, owner: Array, open_pairs: Array, needed: Array, choice: Array,
    distance: Array, queue: Array, head: int, filled: int,
) -> tuple[int, int]:  # fmt: skip
    """Process some states of the queue of ``search_backwards``; return its new head and end."""
    past = head + _TURNS
    while head < min(filled, past):
        near = queue[head]
        head, steps = head + 1, distance[near] + 1
        for entry in range(offsets[near], offsets[near + 1]):
            pair = pairs[entry]
            if not open_pairs[pair]:
                continue
            open_pairs[pair] = False
            state = owner[pair]
            needed[state] -= 1
            if needed[state] == 0:
                choice[state], distance[state], queue[filled] = pair, steps, state
                filled += 1
            elif needed[state] < 0 and distance[state] == steps and pair < choice[state]:
                choice[state] = pair
    return head, filled


def unroll(
    graph: tuple[IntArray, IntArray, IntArray, FloatArray], begin: IntArray, steps: int
) -> tuple[IntArray, IntArray, tuple[IntArray, ...]]:
    """Return the states that are reached after each number of steps, with their outcomes.

    Args:
        graph: offsets of each state's pairs, [states + 1], and of each pair's outcomes,
            [pairs + 1]; the outcomes' successors and probabilities, [outcomes] each.
        begin: states in which episodes may begin, ascending.
        steps: number of steps after which an episode is over.

    Returns:
        The states, one layer after the other, ascending except that states without pairs come
        first in the last layer; offsets of the layers, [steps + 2]; and the last five arguments of
        ``fill_layers``.
    """
    offsets, bounds, successors, probabilities = graph
    n, arrays = offsets.size - 1, (offsets, bounds, unsigned(successors), probabilities)
    found, layers = np.empty((steps + 1) * n, dtype=np.uint32), np.zeros(steps + 2, dtype=np.int64)
    counts, place, layer = np.zeros(2, dtype=np.int64), np.full(n, -1, dtype=np.int32), 0
    found[: begin.size], layers[1] = begin, begin.size
    while layer < steps:
        check_time()
        layer = find_layers(*arrays, found, layers, counts, place, layer, steps)
    states, layer = found[: layers[-1]], 0
    taken, outcomes = (np.empty(count, dtype=np.int64) for count in counts)
    own, ends = (np.zeros(part.size + 1, dtype=np.int64) for part in (states, taken))
    written = own, ends, np.empty(outcomes.size, dtype=np.int32), taken, outcomes
    while layer <= steps:
        check_time()
        layer = fill_layers(*arrays, states, layers, place, layer, *written)
    return states.astype(np.int64), layers, written


@compiled_loop
def find_layers(
    offsets: Array, bounds: Array, successors: Array, probabilities: Array, found: Array,
    layers: Array, counts: Array, place: Array, layer: int, steps: int,
) -> int:  # fmt: skip
    """Find the states of some further layers of ``unroll``; return the number of layers found.

    Args:
        offsets: pairs of each state, [states + 1].
        bounds: outcomes of each pair, [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        found: states of the layers, one after the other; written.
        layers: offsets of the layers; written, [steps + 2].
        counts: numbers of pairs and of possible outcomes in the layers found; updated, [2].
        place: the last layer in which a state was found, -1: none; updated, [states].
        layer: number of layers found before, without the first one.
        steps: number of steps after which an episode is over.
    """
    n, most = offsets.size - 1, counts[1] + _TURNS
    while layer < steps and counts[1] < most:
        filled, layer = layers[layer + 1], layer + 1
        for k in range(layers[layer - 1], layers[layer]):
            s = found[k]
            counts[0] += offsets[s + 1] - offsets[s]
            for entry in range(bounds[offsets[s]], bounds[offsets[s + 1]]):
                t = successors[entry]
                if probabilities[entry] > 0.0:
                    counts[1] += 1
                    if place[t] != layer:
                        acts = layer == steps and offsets[t] < offsets[t + 1]
                        place[t], found[filled] = layer, t + n * acts  # sorted behind the others
                        filled += 1
        layers[layer + 1] = filled
        found[layers[layer] : filled].sort()
        for k in range(layers[layer], filled):
            found[k] %= n
    return layer


@compiled_loop
def fill_layers(
    offsets: Array, bounds: Array, successors: Array, probabilities: Array, states: Array,
    layers: Array, place: Array, layer: int,
    own: Array, ends: Array, targets: Array, taken: Array, outcomes: Array,
) -> int:  # fmt: skip
    """Write the outcomes of some further layers of ``unroll``; return the number of layers done.

    Args:
        offsets: pairs of each state, like the next four as in ``find_layers``.
        bounds: outcomes of each pair.
        successors: [outcomes].
        probabilities: [outcomes].
        states: states of all layers.
        layers: offsets of the layers, [steps + 2].
        place: overwritten by the places of the next layer's states, [states].
        layer: number of layers done before.
        own: written: offsets of the pairs of the layers' states, [states of all layers + 1].
        ends: written: offsets of the outcomes of the layers' pairs, [pairs of all layers + 1].
        targets: written: places of the outcomes' successors, [outcomes of all layers].
        taken: written: pairs of the graph, [pairs of all layers].
        outcomes: written: outcomes of the graph, [outcomes of all layers].
    """
    begin, end = layers[layer], layers[layer + 1]
    pair = own[begin]
    k = ends[pair]
    most = k + _TURNS
    while layer < layers.size - 1 and k <= most:
        begin, end = layers[layer], layers[layer + 1]
        layer += 1
        if layer == layers.size - 1:
            own[begin + 1 :] = pair
            break
        for there in range(end, layers[layer + 1]):
            place[states[there]] = there
        for here in range(begin, end):
            for held in range(offsets[states[here]], offsets[states[here] + 1]):
                taken[pair] = held
                for entry in range(bounds[held], bounds[held + 1]):
                    if probabilities[entry] > 0.0:
                        outcomes[k], targets[k] = entry, place[successors[entry]]
                        k += 1
                pair += 1
                ends[pair] = k
            own[here + 1] = pair
    return layer


def order_components(
    indptr: IntArray, indices: IntArray, data: FloatArray, *, by_height: bool
) -> tuple[IntArray, IntArray, int]:
    """Number a graph's strong components, each after the components that it leads to.

    Within a component the states have the order in which the search finished them, so that most
    come after the states that they lead to.

    Args:
        indptr: offsets of each state's entries, [states + 1].
        indices: [entries].
        data: entries of 0 are no edges, [entries].
        by_height: whether components at equal distance from the ends have the order of their
            states, so that passes along the order read adjacent rows.

    Returns:
        The component of each state, [states]; the states, one component after the other, [states];
        and the number of components.
    """
    n = len(indptr) - 1
    graph = indptr[:-1], indptr[1:], unsigned(indices), data
    label, order = np.full(n, -1, dtype=np.int32), np.empty(n, dtype=np.uint32)
    number, low = np.zeros((2, n), dtype=np.uint32)
    opened, calls = np.empty((2, n), dtype=np.uint32)
    finished, counts = np.empty(n, dtype=np.uint32), np.zeros(6, dtype=np.int64)
    arrays = label, number, low, graph[0].copy(), opened, calls, finished, counts
    check_time()
    while _search_components(*graph, *arrays):
        check_time()
    n_components = int(counts[5])
    if by_height:
        _number_by_height(*graph, finished, n_components, label)
    _sort_by_component(label, finished, n_components, order)
    return label, order.view(np.int32), n_components


@compiled_loop
def _search_components(
    begin: Array, end: Array, indices: Array, data: Array, label: Array,
    number: Array, lowlink: Array, place: Array, opened: Array, calls: Array, finished: Array,
    counts: Array,
) -> bool:  # fmt: skip
    """Continue a depth-first search for strong components; return whether it has not ended.

    Args:
        begin: position of each state's first entry, [states].
        end: position after each state's last entry, [states].
        indices: successors, [entries].
        data: entries of 0 are no edges, [entries].
        label: written: component of each state, [states].
        number: order in which states were found, counted from 1; 0: not yet found; ``_CLOSED``: the
            state has a component, [states].
        lowlink: for each state the least ``number`` of an open state that it reaches, [states].
        place: next entry to follow of each state, [states].
        opened: open states: found, but without a component, [states].
        calls: stack of the states on the search's path, [states].
        finished: states that the search has finished, [states].
        counts: numbers of roots tried, of states on the path, of open, finished and found states,
            and of components, [6].
    """
    root, depth, n_open = counts[0], counts[1], counts[2]
    n_finished, visited, n_components = counts[3], counts[4], counts[5]
    goes_on = True
    for _ in range(_TURNS):
        entered = np.int64(-1)
        if depth > 0:
            state = calls[depth - 1]
            entered = _not_entered(state, place, end, indices, data, number, lowlink)
        elif root == label.size:
            goes_on = False
            break
        else:
            state, root = root, root + 1
            if number[state] != 0:
                continue
            entered = np.int64(state)
        if entered >= 0:
            visited += 1
            number[entered] = lowlink[entered] = visited
            opened[n_open] = calls[depth] = entered
            n_open, depth = n_open + 1, depth + 1
            continue
        depth -= 1
        finished[n_finished] = state
        n_finished += 1
        if depth > 0:
            caller = calls[depth - 1]
            lowlink[caller] = min(lowlink[caller], lowlink[state])
        if lowlink[state] == number[state]:
            n_open = _close_component(state, opened, n_open, n_components, label, number)
            n_components += 1
    counts[0], counts[1], counts[2] = root, depth, n_open
    counts[3], counts[4], counts[5] = n_finished, visited, n_components
    return goes_on


@compiled_loop
def _not_entered(
    state: int, place: Array, end: Array, indices: Array, data: Array,
    number: Array, lowlink: Array,
) -> np.int64:  # fmt: skip
    """Follow a state's entries to a successor that the search has not found yet; -1: no more."""
    k, past, least = place[state], end[state], lowlink[state]
    while k < past:
        successor, met = indices[k], number[indices[k]]
        if data[k] > 0.0:
            if met == 0:
                place[state], lowlink[state] = k + 1, least
                return np.int64(successor)
            least = min(least, met)
        k += 1
    place[state], lowlink[state] = k, least
    return np.int64(-1)


@compiled_loop
def _close_component(
    state: int, opened: Array, n_open: int, found: int, label: Array, number: Array
) -> int:
    """Label a finished strong component, and return the number of states still open."""
    while True:
        n_open -= 1
        label[opened[n_open]], number[opened[n_open]] = found, _CLOSED
        if opened[n_open] == state:
            return n_open


@compiled_loop
def _number_by_height(
    begin: Array, end: Array, indices: Array, data: Array, finished: Array, found: int, label: Array
) -> None:
    """Renumber components by their greatest number of steps to an end, then by first state.

    The steps are counted between components. ``label``, [states], is updated.
    """
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
    """Sort states by component, then in the order of finishing (a counting sort)."""
    begin = np.zeros(found + 1, dtype=np.int64)
    for state in finished:
        begin[label[state] + 1] += 1
    for c in range(found):
        begin[c + 1] += begin[c]
    for state in finished:
        order[begin[label[state]]] = state
        begin[label[state]] += 1
