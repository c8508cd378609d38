"""A user's arrays and labels, checked, and as a model keeps them; errors name state and action."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import (
    PROBABILITY_SUM,
    SINGLE_PRECISION_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    read_only,
)
from ssp_lp.errors import ModelError
from ssp_lp.model.builders import no_lone_string
from ssp_lp.model.chunks import chunks, pieces_of_chunks

AnyArray = npt.NDArray[Any]
Describe = Callable[[int], str]

_NEGATIVE_COST = (
    "has a negative cost: costs must be >= 0 (rewards? pass costs=-rewards; a constant added to "
    "every step would ask another question)"
)


def check_offsets(name: str, offsets: IntArray, end: int) -> None:
    """Raise :class:`ModelError` unless ``offsets`` rise from 0 to ``end``."""
    if offsets.ndim != 1 or offsets.size == 0 or offsets[0] != 0 or offsets[-1] != end:
        raise ModelError(f"{name} must be one-dimensional and run from 0 to {end}")
    falls = offsets[1:] < offsets[:-1]
    if falls.any():
        raise ModelError(f"{name} decreases at position {int(np.argmax(falls))}")


def check_outcomes(
    successors: IntArray,
    probabilities: FloatArray,
    costs: FloatArray,
    n_states: int,
    describe: Describe,
) -> None:
    """Check each outcome: known successor, probability in [0, 1], finite non-negative cost.

    Args:
        successors: state indices, [outcomes].
        probabilities: [outcomes].
        costs: [outcomes].
        n_states: number of states.
        describe: turns an outcome's index into "action a of state s".

    Raises:
        ModelError: naming the first outcome at fault.
    """
    paid = costs[:1] if costs.strides == (0,) else costs  # one number for all
    rules: list[tuple[AnyArray, Callable[[AnyArray], AnyArray], str]] = [
        (successors, lambda s: (s < 0) | (s >= n_states), "has a successor that is no state"),
        (probabilities, np.isnan, "has a probability that is NaN"),
        (probabilities, lambda p: p < 0, "has a negative probability"),
        (probabilities, np.isinf, "has an infinite probability"),
        (paid, np.isnan, "has a cost that is NaN"),
        (paid, lambda c: c < 0, _NEGATIVE_COST),
        (paid, np.isinf, "has an infinite cost"),
    ]
    for values, is_broken, complaint in rules:
        for some in chunks(values.size):
            broken = is_broken(values[some])
            if broken.any():
                raise ModelError(f"{describe(some.start + int(np.argmax(broken)))} {complaint}")


def unit_sums(
    probabilities: FloatArray, offsets: IntArray, describe: Describe, *, normalise: bool = False
) -> FloatArray:
    """Return the probabilities with rounding of their sums (up to 1e-9) divided out, [outcomes].

    Args:
        probabilities: [outcomes].
        offsets: the outcomes of pair k are ``offsets[k] : offsets[k + 1]``, [pairs + 1].
        describe: turns a pair's index into "action a of state s".
        normalise: divide out the rounding of single precision as well (up to 1e-5).

    Raises:
        ModelError: a pair without outcomes, or whose probabilities do not sum to one.
    """
    empty = offsets[1:] == offsets[:-1]
    if empty.any():
        raise ModelError(f"{describe(int(np.argmax(empty)))} has no outcomes")
    sums = np.empty(empty.size)
    for piece in pieces_of_chunks(offsets):
        sums[piece.segments] = np.add.reduceat(probabilities[piece.entries], piece.firsts)
    off = np.abs(sums - 1.0)
    wrong = off > (SINGLE_PRECISION_SUM if normalise else PROBABILITY_SUM)
    if wrong.any():
        pair = int(np.argmax(wrong))
        told = f"{describe(pair)}: probabilities sum to {sums[pair]:.12g}, not to 1"
        if off[wrong].max() <= SINGLE_PRECISION_SUM:
            told += "; normalise=True divides out the rounding of single precision"
        raise ModelError(told)
    if np.all(sums == 1.0):
        return probabilities
    shared = np.empty_like(probabilities)
    for piece in pieces_of_chunks(offsets):
        by = np.repeat(sums[piece.segments], piece.lengths)
        np.divide(probabilities[piece.entries], by, out=shared[piece.entries])
    return shared


def index_array(name: str, indices: npt.ArrayLike) -> IntArray:
    """Indices as integers, of the width they have; raises :class:`ModelError` if they are none."""
    array = np.asarray(indices)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ModelError(f"{name} must be integers (indices)")
    return read_only(array, np.int64 if array.dtype.itemsize > 4 else np.int32)


def cost_array(costs: npt.ArrayLike, outcome_offsets: IntArray) -> FloatArray:
    """Spread costs over outcomes, [outcomes]; a number for all of them takes no room.

    Args:
        costs: one number, or one per pair, or one per outcome.
        outcome_offsets: [pairs + 1].

    Raises:
        ModelError: they are of another length.
    """
    given = np.asarray(costs, dtype=np.float64)
    n_pairs, n_outcomes = len(outcome_offsets) - 1, int(outcome_offsets[-1])
    if given.ndim == 0 or given.shape == (n_outcomes,):
        return read_only(np.broadcast_to(given, (n_outcomes,)))
    if given.shape == (n_pairs,):
        return read_only(np.repeat(given, np.diff(outcome_offsets)))
    raise ModelError(f"costs must be a number, {n_pairs} or {n_outcomes} numbers")


def check_idle_states(
    pair_offsets: IntArray, goals: BoolArray, states: Sequence[Hashable], accept: bool
) -> None:
    """Check that goals have no pairs and, unless accepted, that all other states have some.

    Raises:
        ModelError: naming the state and the remedy.
    """
    counts = np.diff(pair_offsets)
    acting_goal = goals & (counts > 0)
    if acting_goal.any():
        state = states[int(np.argmax(acting_goal))]
        raise ModelError(f"goal state {state!r} has actions: an episode ends there; drop them")
    idle = (counts == 0) & ~goals
    if idle.any() and not accept:
        raise ModelError(
            f"state {states[int(np.argmax(idle))]!r} has no actions and is no goal; "
            "pass treat_actionless_as_dead_ends=True to accept such states as dead-ends"
        )


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
        for piece in pieces_of_chunks(pair_offsets):
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
