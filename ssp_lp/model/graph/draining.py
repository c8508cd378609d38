"""Closing pairs that may lead to closed states, and states that have no pair left open."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.model.ssp import SSP


def drain(
    model: SSP, open_pairs: BoolArray, open_counts: IntArray, closed_states: IntArray
) -> None:
    """Close, in place, pairs that may lead to a closed state, and states with no pair left open.

    Args:
        open_pairs: [pairs].
        open_counts: the number of open pairs of each state, [states].
        closed_states: the states to begin with, which have no open pairs.
    """
    if not closed_states.size:
        return
    before = model.predecessors
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled import graph_searches as searches

        searches.drain(
            before.offsets, before.pairs, model.pair_state, open_pairs, open_counts, closed_states
        )
        return
    while closed_states.size:
        entering = before.entering(closed_states, open_pairs)
        closed_states = close_pairs(model, open_pairs, open_counts, entering)


def close_pairs(
    model: SSP, open_pairs: BoolArray, open_counts: IntArray, pairs: IntArray
) -> IntArray:
    """Close these open pairs, ascending, in place; return the states with none left open."""
    open_pairs[pairs] = False
    state = model.pair_state[pairs]
    first = _run_starts(state)
    touched = state[first]
    open_counts[touched] -= np.diff(first, append=pairs.size)
    return np.asarray(touched[open_counts[touched] == 0])


def _run_starts(ordered: IntArray) -> IntArray:
    """Where each run of equal values begins in ascending non-negative values."""
    return np.flatnonzero(np.diff(ordered, prepend=-1))
