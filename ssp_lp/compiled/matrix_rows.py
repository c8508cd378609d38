"""Compiled selection of rows: a process from a model's outcomes, a policy from a process.

A node of a process is a state at which a run goes on, or several such states that are treated as
one. A row belongs to a pair, and has the probabilities of the nodes to which the pair leads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ssp_lp.compiled.cores import compiled_loop, one_or_all_cores

Array = np.ndarray[Any, Any]


@compiled_loop
def count_rows(
    outcome_offsets: Array, successors: Array, probabilities: Array, node_of: Array, pair_at: Array,
    owner: Array, counts: Array, escape: Array, leaks: Array,
) -> None:  # fmt: skip
    """Count the entries of a process's rows, and sum the probability of ending.

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        node_of: node of each state; negative if runs end there, [states].
        pair_at: the model's pair for each row; negative: giving up, [rows].
        owner: node of each row, if self-loops are removed, [rows]; otherwise empty.
        counts: written: number of entries, [rows].
        escape: written: probability of departing from the node, if a self-loop is removed, else 1,
            [rows].
        leaks: written: probability that the run ends, [rows].
    """
    departing = owner.size > 0
    for row in range(pair_at.size):
        entries, loops, leak, away = 0, 0, 0.0, 0.0
        if pair_at[row] < 0:
            leak = 1.0
        else:
            pair = np.uint32(pair_at[row])
            for k in range(outcome_offsets[pair], outcome_offsets[pair + np.uint32(1)]):
                node = node_of[successors[k]]
                if node < 0:
                    leak += probabilities[k]
                elif probabilities[k] > 0.0:
                    if departing and node == owner[row]:
                        loops += 1
                    else:
                        away += probabilities[k]
                        entries += 1
        mass = leak + away
        if loops > 0 and mass == 0.0:
            entries += loops
        counts[row] = entries
        escape[row] = mass if loops > 0 and mass > 0.0 else 1.0
        leaks[row] = leak


@compiled_loop
def fill_rows(
    outcome_offsets: Array, successors: Array, probabilities: Array, ahead: Array, node_of: Array,
    n_nodes: int, pair_at: Array, owner: Array, escape: Array, survival: float, indptr: Array,
    indices: Array, data: Array,
) -> None:  # fmt: skip
    """Write columns and probabilities of the entries that ``count_rows`` counted.

    The arguments are those of ``count_rows``, and:

    Args:
        ahead: number of layers that each outcome passes, [outcomes]; empty: none.
        n_nodes: number of nodes of a layer.
        survival: discount of the probabilities.
        indptr: offsets of the rows' entries, [rows + 1].
        indices: written: node plus ``n_nodes`` for each layer passed, [entries].
        data: written, [entries].
    """
    departing, layered = owner.size > 0, ahead.size > 0
    for row in range(pair_at.size):
        place, end = indptr[row], indptr[row + 1]
        if place < end:
            pair = np.uint32(pair_at[row])
            begin, stop = outcome_offsets[pair], outcome_offsets[pair + np.uint32(1)]
            only_loops = departing
            if departing:
                for k in range(begin, stop):
                    if probabilities[k] > 0.0 and node_of[successors[k]] != owner[row]:
                        only_loops = False
                        break
            for k in range(begin, stop):
                node = node_of[successors[k]]
                if node < 0 or probabilities[k] <= 0.0:
                    continue
                if departing and node == owner[row] and not only_loops:
                    continue
                column = np.int64(node)
                if layered:
                    column += np.int64(ahead[k]) * n_nodes
                indices[place] = column
                data[place] = probabilities[k] / escape[row] * survival
                place += 1


@compiled_loop
def share_rows(
    indptr: Array, numbers: Array, starts: Array, data: Array, slots: Array, used: int
) -> int:
    """Store the numbers of rows, equal rows once, and the position of each row's numbers.

    Args:
        indptr: offsets of each row's numbers, [rows + 1].
        numbers: positive, [entries].
        starts: written, the position in ``data`` of each row's first number, [rows].
        data: written from position ``used`` on.
        slots: a hash table from rows to positions in ``data``, -1 in empty slots; its size is a
            power of two, and at least twice the size of ``data``.
        used: number of entries of ``data`` in use before the call.

    Returns:
        The number of entries in use after the call; -1 if ``data`` is too small.
    """
    bits, shared = numbers.view(np.uint64), data.view(np.uint64)
    for row in range(starts.size):
        first, length = np.int64(indptr[row]), np.int64(indptr[row + 1]) - np.int64(indptr[row])
        mixed = np.uint64(length)
        for k in range(first, first + length):
            mixed = (mixed ^ bits[k]) * np.uint64(0x9E3779B97F4A7C15)
            mixed ^= mixed >> np.uint64(29)
        slot = mixed & np.uint64(slots.size - 1)
        while slots[slot] >= 0:
            begin, same = slots[slot], 0
            if begin + length <= used:
                while same < length and shared[begin + same] == bits[first + same]:
                    same += 1
            if same == length:
                break
            slot = (slot + np.uint64(1)) & np.uint64(slots.size - 1)
        if slots[slot] < 0:
            if used + length > data.size:
                return -1
            data[used : used + length] = numbers[first : first + length]
            slots[slot] = used
            used += int(length)
        starts[row] = slots[slot]
    return used


@one_or_all_cores
def row_product(
    choice: Array, indptr: Array, starts: Array, indices: Array, data: Array, x: Array,
    result: Array,
) -> None:  # fmt: skip
    """Multiply chosen rows of a matrix by one vector."""
    for s in prange(choice.size):
        row = choice[s]
        total, first, begin = 0.0, indptr[row], starts[row]
        for k in range(indptr[row + 1] - first):
            total += data[begin + k] * x[indices[first + k]]
        result[s] = total


@one_or_all_cores
def row_products(
    choice: Array, indptr: Array, starts: Array, indices: Array, data: Array, x: Array,
    result: Array,
) -> None:  # fmt: skip
    """Multiply chosen rows of a matrix by several vectors, [states, vectors]."""
    for s in prange(choice.size):
        first, begin = indptr[choice[s]], starts[choice[s]]
        result[s] = 0.0
        for k in range(indptr[choice[s] + 1] - first):
            weight, column = data[begin + k], indices[first + k]
            for j in range(x.shape[1]):
                result[s, j] += weight * x[column, j]


@one_or_all_cores
def copy_rows(
    choice: Array, indptr: Array, starts: Array, indices: Array, data: Array, own_indptr: Array,
    own_indices: Array, own_data: Array,
) -> None:  # fmt: skip
    """Copy chosen rows of a matrix to ``own_indices`` and ``own_data``, one after the other."""
    for s in prange(choice.size):
        first, begin, place = indptr[choice[s]], starts[choice[s]], own_indptr[s]
        for k in range(own_indptr[s + 1] - place):
            own_indices[place + k] = indices[first + k]
            own_data[place + k] = data[begin + k]


@compiled_loop
def place_layers(
    choice: Array, first: Array, pair_at: Array, offsets: Array, node_of: Array, found: Array
) -> None:
    """Convert a choice by node, in many layers, to decisions by state of the model.

    Args:
        choice: position of a pair of the process, counted from ``first``, [layers, nodes].
        first: pair from which the choice of each node counts, [nodes].
        pair_at: the model's pair for each pair of the process, or a negative code, [pairs].
        offsets: first pair of each state of the model, [states].
        node_of: node of each state; negative if nothing is decided there, [states].
        found: written: position among the state's pairs, or the code, [layers, states].
    """
    for s in range(node_of.size):
        node = node_of[s]
        if node >= 0:
            for layer in range(choice.shape[0]):
                pair = pair_at[first[node] + np.uint64(choice[layer, node])]
                found[layer, s] = pair if pair < 0 else pair - offsets[s]
