"""Goal states and action labels as arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model.builders import no_lone_string
from ssp_lp.model.chunks import pieces


def goal_mask_of(goal_states: npt.ArrayLike, n_states: int) -> BoolArray:
    """Turn indices of goal states into a mask, [states].

    Raises:
        ModelError: there are none, or one is no index of a state.
    """
    goals = np.asarray(goal_states).reshape(-1)
    if goals.size and not np.issubdtype(goals.dtype, np.integer):
        raise ModelError("goal_states must be indices of states (integers), no mask")
    goals = goals.astype(np.int64)
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
        most = int(np.diff(pair_offsets).max(initial=0))
        position = np.empty(n_pairs, dtype=np.min_scalar_type(most))
        for piece in pieces(pair_offsets):
            first = np.repeat(piece.firsts, piece.lengths)
            position[piece.entries] = np.arange(first.size) - first
        return range(most), position
    if len(actions) != n_pairs:
        raise ModelError(f"{len(actions)} action labels given for {n_pairs} pairs")
    table: dict[Hashable, int] = {}
    code = np.array([table.setdefault(a, len(table)) for a in actions], dtype=np.int32)
    state = np.repeat(np.arange(len(pair_offsets) - 1), np.diff(pair_offsets))
    order = np.lexsort((code, state))
    again = (np.diff(state[order]) == 0) & (np.diff(code[order]) == 0)
    if again.any():
        pair = int(order[int(np.argmax(again))])
        raise ModelError(f"state number {state[pair]} has the action {actions[pair]!r} twice")
    return tuple(table), code


ENDS = ("goal", "dead_end", "gave_up", "wandering", "unfinished")
"""Names that reports give to the ways in which an episode ends."""


def indexed_labels(
    labels: Mapping[str, Iterable[Hashable]], index_of: Callable[[Hashable], int]
) -> Mapping[str, IntArray]:
    """State labels with their members as sorted indices.

    Raises:
        ModelError: an unknown member, or a name that reports use for something else.
    """
    for name in labels:
        if name in ENDS:
            raise ModelError(f"state label {name!r} is taken: reports use {', '.join(ENDS)}")
    return {
        name: read_only(
            np.array(sorted({index_of(s) for s in no_lone_string(members, name)}), dtype=np.int64)
        )
        for name, members in labels.items()
    }


def check_state_names(states: Sequence[Hashable]) -> None:
    """Raise :class:`ModelError` if two states bear one label."""
    if isinstance(states, range) or len(set(states)) == len(states):
        return
    twice = next(s for s, n in Counter(states).items() if n > 1)
    raise ModelError(f"{twice!r} is the label of several states")
