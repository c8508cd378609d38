"""Goal states and action labels as arrays."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, IntArray, read_only
from ssp_lp.errors import ModelError


def goal_mask_of(goal_states: npt.ArrayLike, n_states: int) -> BoolArray:
    """Turn indices of goal states into a mask, [states].

    Raises:
        ModelError: there are none, or one is no index of a state.
    """
    goals = np.asarray(goal_states, dtype=np.int64).reshape(-1)
    if goals.size == 0:
        raise ModelError("the model has no goal state; name at least one")
    if goals.min() < 0 or goals.max() >= n_states:
        raise ModelError(f"goal states must be indices of states, 0 .. {n_states - 1}")
    mask = np.zeros(n_states, dtype=np.bool_)
    mask[goals] = True
    return read_only(mask)


def action_table(
    actions: Sequence[Hashable] | None, pair_offsets: IntArray
) -> tuple[Sequence[Hashable], IntArray]:
    """Distinct action labels and, per pair, the position of its label among them."""
    n_pairs = int(pair_offsets[-1])
    if actions is None:
        position = np.arange(n_pairs) - np.repeat(pair_offsets[:-1], np.diff(pair_offsets))
        return range(int(position.max(initial=-1)) + 1), position.astype(np.int32)
    if len(actions) != n_pairs:
        raise ModelError(f"{len(actions)} action labels given for {n_pairs} pairs")
    table: dict[Hashable, int] = {}
    code = [table.setdefault(a, len(table)) for a in actions]
    return tuple(table), np.array(code, dtype=np.int32)
