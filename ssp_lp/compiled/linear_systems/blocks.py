"""Compiled passes of policy improvement over the strong components of a policy's chain."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ssp_lp.compiled.linear_systems.elimination import best_pair, improve_component

Array = np.ndarray[Any, Any]

_ROUNDS = 50
"""Howard's rounds in one component: more would be spent on what lies around it."""


@njit(cache=True)
def improve_blocks(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    order: Array, blocks: Array, is_forward: bool, most: int, cost: Array, noise: float,
    entering: Array, entering_offsets: Array, owner: Array,
    choice: Array, values: Array, stale: Array,
) -> int:  # fmt: skip
    """Improve a policy block by block, in place, at the latest values of all that lies around.

    A block is solved exactly and improved by Howard's rounds until none of its states changes.
    Blocks without a stale state, one that leads to values that are newer than its own, are passed
    over.

    Args:
        offsets: [states + 1].
        indptr: [pairs + 1].
        indices: [entries].
        data: [entries].
        exits: [pairs].
        order: states, block by block, [states].
        blocks: offsets of the blocks in the order, [blocks + 1].
        is_forward: whether blocks are visited in order; else from the last on.
        most: states of the largest block.
        cost: [pairs].
        noise: relative gain up to which a pair is kept.
        entering: the pairs that lead to each state, [entries].
        entering_offsets: [states + 1].
        owner: the state of each pair, [pairs].
        choice: pair of each state, [states].
        values: [states].
        stale: [states].

    Returns:
        How often a pair was changed.
    """
    inner, right = np.empty((most, most)), np.empty((most, 1))
    low, leaving = np.empty(most, dtype=np.int64), np.empty(most)
    before, place = np.empty(most), np.full(values.size, -1, dtype=np.int32)
    changed, last = 0, blocks.size - 2
    for c in range(blocks.size - 1):
        block = c if is_forward else last - c
        begin, end = blocks[block], blocks[block + 1]
        if end - begin > 1:
            states = order[begin:end]
            if _any_stale(stale, states):
                before[: states.size] = values[states]
                moved, _ = improve_component(
                    offsets, indptr, indices, data, exits, states, place, cost, noise, _ROUNDS,
                    choice, values, inner, low, leaving, right,
                )  # fmt: skip
                changed += moved
                _mark(entering, entering_offsets, owner, states, before, values, stale)
            continue
        s = order[begin]
        if not stale[s]:
            continue
        pick, least, kept, terms = best_pair(
            offsets, indptr, indices, data, exits, cost, values, s, choice[s]
        )
        old = values[s]
        if least < kept - noise * terms:
            choice[s], values[s] = pick, least
            changed += 1
        elif kept < np.inf:
            values[s] = kept
        if values[s] != old:
            _mark_entering(entering, entering_offsets, owner, s, stale)
        stale[s] = False
    return changed


@njit(cache=True)
def _any_stale(stale: Array, states: Array) -> bool:
    for s in states:  # noqa: SIM110 (compiled)
        if stale[s]:
            return True
    return False


@njit(cache=True)
def _mark(
    entering: Array, entering_offsets: Array, owner: Array,
    states: Array, before: Array, values: Array, stale: Array,
) -> None:  # fmt: skip
    """Mark what leads to the states of a block that changed; the block itself is up to date."""
    for i in range(states.size):
        s = states[i]
        if values[s] != before[i]:
            _mark_entering(entering, entering_offsets, owner, s, stale)
    for s in states:
        stale[s] = False


@njit(cache=True)
def _mark_entering(
    entering: Array, entering_offsets: Array, owner: Array, s: int, stale: Array
) -> None:
    for k in range(entering_offsets[s], entering_offsets[s + np.uint32(1)]):
        stale[owner[entering[k]]] = True
