"""Checks of a model's arrays; every error names the state and the action at fault."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
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
from ssp_lp.model.chunks import chunks, pieces

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
    for piece in pieces(offsets):
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
    for piece in pieces(offsets):
        by = np.repeat(sums[piece.segments], piece.lengths)
        np.divide(probabilities[piece.entries], by, out=shared[piece.entries])
    return shared


def successor_array(successors: npt.ArrayLike) -> IntArray:
    """Successors as integers, [outcomes]; raises :class:`ModelError` if they are none."""
    array = np.asarray(successors)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ModelError("successors must be integers (indices of states)")
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
