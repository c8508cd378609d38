"""Compiled passes of policy improvement over the strong components of a policy's chain."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ssp_lp.compiled.elimination import _best_pair, _eliminate, _gather

Array = np.ndarray[Any, Any]

_ROUNDS = 50
"""Howard's rounds in one component: more would be spent on what lies around it."""


@njit(cache=True)
def improve_blocks(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    order: Array, blocks: Array, is_forward: bool, most: int, cost: Array, noise: float,
    choice: Array, values: Array,
) -> int:  # fmt: skip
    """Improve a policy block by block, in place, at the latest values of all that lies around.

    A small block is solved exactly and improved by Howard's rounds until none of its states
    changes; the states of a larger one are backed up once each.

    Args:
        offsets: [states + 1].
        indptr: [pairs + 1].
        indices: [entries].
        data: [entries].
        exits: [pairs].
        order: states, block by block, [states].
        blocks: offsets of the blocks in the order, [blocks + 1].
        is_forward: whether blocks and their states are visited in order; else from the last on.
        most: states of a block up to which it is solved.
        cost: [pairs].
        noise: relative gain up to which a pair is kept.
        choice: pair of each state, [states].
        values: [states].

    Returns:
        How often a pair was changed.
    """
    inner, right = np.empty((most, most)), np.empty((most, 1))
    low, leaving = np.empty(most, dtype=np.int64), np.empty(most)
    place = np.full(values.size, -1, dtype=np.int32)
    changed, last = 0, blocks.size - 2
    for c in range(blocks.size - 1):
        block = c if is_forward else last - c
        begin, size = blocks[block], blocks[block + 1] - blocks[block]
        if 1 < size <= most:
            changed += _settle(
                offsets, indptr, indices, data, exits, order, begin, size, place, cost, noise,
                choice, values, inner, low, leaving, right,
            )  # fmt: skip
            continue
        for i in range(size):
            s = order[begin + i if is_forward else begin + size - 1 - i]
            pick, least, kept, terms = _best_pair(
                offsets, indptr, indices, data, exits, cost, values, s, choice[s]
            )
            if least < kept - noise * terms:
                choice[s], values[s] = pick, least
                changed += 1
            elif kept < np.inf:
                values[s] = kept
    return changed


@njit(cache=True)
def _settle(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array,
    order: Array, begin: int, size: int, place: Array, cost: Array, noise: float,
    choice: Array, values: Array, inner: Array, low: Array, leaving: Array, right: Array,
) -> int:  # fmt: skip
    """Howard's rounds within one block; a policy that does not leave it is taken back."""
    column, rewards = values.reshape(values.size, 1), cost.reshape(cost.size, 1)
    before = np.empty(size, dtype=choice.dtype)
    for i in range(size):
        place[order[begin + i]] = i
    changed = 0
    for _ in range(_ROUNDS):
        _gather(
            indptr, indices, data, exits, choice, order, begin, size, place, rewards, column,
            inner, low, leaving, right,
        )  # fmt: skip
        if not _eliminate(inner, low, leaving, right, size):
            if changed:
                for i in range(size):
                    choice[order[begin + i]] = before[i]
            break
        now = 0
        for i in range(size):
            values[order[begin + i]] = right[i, 0]
        for i in range(size):
            s = order[begin + i]
            before[i] = choice[s]
            pick, least, kept, terms = _best_pair(
                offsets, indptr, indices, data, exits, cost, values, s, choice[s]
            )
            if least < kept - noise * terms:
                choice[s] = pick
                now += 1
        changed += now
        if now == 0:
            break
    for i in range(size):
        place[order[begin + i]] = -1
    return changed
