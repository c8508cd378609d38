"""Compiled selection of a process's rows from a model's outcomes: ``processes.live_rows``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True)
def count(
    outcome_offsets: Array,
    successors: Array,
    probabilities: Array,
    node_of: Array,
    pair_at: Array,
    home: Array,
    counts: Array,
    departs: Array,
    leaks: Array,
) -> None:
    """Entries of each row, the mass that departs where waiting is left out, what ends there."""
    departing = home.size > 0
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
                    if departing and node == home[row]:
                        loops += 1
                    else:
                        away += probabilities[k]
                        entries += 1
        mass = leak + away
        if loops > 0 and mass == 0.0:
            entries += loops
        counts[row] = entries
        departs[row] = mass if loops > 0 and mass > 0.0 else 1.0
        leaks[row] = leak


@njit(cache=True)
def fill(
    outcome_offsets: Array,
    successors: Array,
    probabilities: Array,
    ahead: Array,
    node_of: Array,
    n_nodes: int,
    pair_at: Array,
    home: Array,
    departs: Array,
    survival: float,
    indptr: Array,
    indices: Array,
    data: Array,
) -> None:
    """Columns and probabilities of the entries that ``count`` counted."""
    departing, layered = home.size > 0, ahead.size > 0
    for row in range(pair_at.size):
        place, end = indptr[row], indptr[row + 1]
        if place < end:
            pair = np.uint32(pair_at[row])
            begin, stop = outcome_offsets[pair], outcome_offsets[pair + np.uint32(1)]
            only_loops = departing
            if departing:
                for k in range(begin, stop):
                    if probabilities[k] > 0.0 and node_of[successors[k]] != home[row]:
                        only_loops = False
                        break
            for k in range(begin, stop):
                node = node_of[successors[k]]
                if node < 0 or probabilities[k] <= 0.0:
                    continue
                if departing and node == home[row] and not only_loops:
                    continue
                column = np.int64(node)
                if layered:
                    column += np.int64(ahead[k]) * n_nodes
                indices[place] = column
                data[place] = probabilities[k] / departs[row] * survival
                place += 1
