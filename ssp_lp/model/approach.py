"""Pairs by which each state comes nearer, in number of steps, to pairs that leave."""

from __future__ import annotations

import numpy as np

from ssp_lp.accelerator import accelerated
from ssp_lp.arrays import BoolArray, IntArray, concatenated_ranges
from ssp_lp.model.predecessors import Predecessors


def nearer_pairs(
    before: Predecessors,
    pair_offsets: IntArray,
    pair_state: IntArray,
    leaving: BoolArray,
    usable: BoolArray | None = None,
) -> IntArray:
    """For each state a pair by which it may come nearer to a leaving pair.

    A state with a leaving pair of its own takes that. Among pairs that come equally near, the
    first is taken.

    Args:
        before: the graph turned round.
        pair_offsets: [states + 1].
        pair_state: [pairs].
        leaving: [pairs].
        usable: pairs that may be taken, leaving ones included, [pairs]; all if left out.

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    free = np.ones(len(pair_state), dtype=np.bool_) if usable is None else usable.copy()
    choice = np.full(len(pair_offsets) - 1, -1, dtype=np.int64)
    useful: IntArray = np.flatnonzero(leaving & free)
    if accelerated(len(before.pairs)):
        from ssp_lp.compiled.graph import approach

        approach(before.offsets, before.pairs, pair_state, useful, free, choice)
        return choice
    while useful.size:  # pairs, ascending, of states that have taken none
        owner = pair_state[useful]
        first = np.flatnonzero(np.diff(owner, prepend=-1))
        states = owner[first]
        choice[states] = useful[first]
        begin = pair_offsets[states]
        free[concatenated_ranges(begin, pair_offsets[states + 1] - begin)] = False
        useful = before.entering(states, free)
    return choice
