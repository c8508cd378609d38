"""Predecessors of a model's states, compiled; the twin is ``model.graph.predecessors``."""

from __future__ import annotations

import numpy as np
from numba import njit

from ssp_lp.arrays import FloatArray, IntArray, unsigned
from ssp_lp.compiled.deadline import pieces


def transposed(
    n_states: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray
) -> tuple[IntArray, IntArray]:
    """Offsets, [states + 1], and pairs, [entries], by a counting sort."""
    columns = unsigned(successors)
    counts = np.zeros(n_states, dtype=np.int64)
    for some in pieces(len(columns), len(columns)):
        _count(columns[some], probabilities[some], counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    pairs = np.empty(offsets[-1], dtype=np.int32)
    places = offsets[:-1].copy()
    for some in pieces(len(outcome_offsets) - 1, len(columns)):
        bounds = outcome_offsets[some.start : some.stop + 1]
        _place(some.start, bounds, columns, probabilities, places, pairs)
    return offsets, pairs


@njit(cache=True)
def _count(successors: IntArray, probabilities: FloatArray, counts: IntArray) -> None:
    """Count the possible outcomes that go to each state."""
    for outcome in range(len(successors)):
        if probabilities[outcome] > 0:
            counts[successors[outcome]] += 1


@njit(cache=True)
def _place(
    first: int,
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    places: IntArray,
    pairs: IntArray,
) -> None:
    """Write each pair to the next place of its successors."""
    for pair in range(len(outcome_offsets) - 1):
        for outcome in range(outcome_offsets[pair], outcome_offsets[pair + 1]):
            if probabilities[outcome] > 0:
                successor = successors[outcome]
                pairs[places[successor]] = first + pair
                places[successor] += 1
