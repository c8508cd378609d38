"""Checks of a model's arrays; every error names the state and the action at fault."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import PROBABILITY_SUM, BoolArray, FloatArray, IntArray, read_only, segment_sums
from ssp_lp.errors import ModelError

Describe = Callable[[int], str]


def check_offsets(name: str, offsets: IntArray, end: int) -> None:
    """Raise :class:`ModelError` unless ``offsets`` rise from 0 to ``end``."""
    if offsets.ndim != 1 or offsets.size == 0 or offsets[0] != 0 or offsets[-1] != end:
        raise ModelError(f"{name} must be one-dimensional and run from 0 to {end}")
    if np.any(np.diff(offsets) < 0):
        raise ModelError(f"{name} decreases at position {int(np.argmax(np.diff(offsets) < 0))}")


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
    rules: list[tuple[BoolArray, str]] = [
        ((successors < 0) | (successors >= n_states), "has a successor that is no state"),
        (np.isnan(probabilities), "has a probability that is NaN"),
        (probabilities < 0, "has a negative probability"),
        (np.isinf(probabilities), "has an infinite probability"),
        (np.isnan(costs), "has a cost that is NaN"),
        (costs < 0, "has a negative cost"),
        (np.isinf(costs), "has an infinite cost"),
    ]
    for broken, complaint in rules:
        if broken.any():
            raise ModelError(f"{describe(int(np.argmax(broken)))} {complaint}")


def unit_sums(probabilities: FloatArray, offsets: IntArray, describe: Describe) -> FloatArray:
    """Return the probabilities with rounding of their sums (up to 1e-9) divided out, [outcomes].

    Args:
        probabilities: [outcomes].
        offsets: the outcomes of pair k are ``offsets[k] : offsets[k + 1]``, [pairs + 1].
        describe: turns a pair's index into "action a of state s".

    Raises:
        ModelError: a pair without outcomes, or whose probabilities do not sum to one.
    """
    empty = np.diff(offsets) == 0
    if empty.any():
        raise ModelError(f"{describe(int(np.argmax(empty)))} has no outcomes")
    sums = segment_sums(probabilities, offsets)
    wrong = np.abs(sums - 1.0) > PROBABILITY_SUM
    if wrong.any():
        pair = int(np.argmax(wrong))
        raise ModelError(f"{describe(pair)}: probabilities sum to {sums[pair]:.12g}, not to 1")
    if np.all(sums == 1.0):
        return probabilities
    return probabilities / np.repeat(sums, np.diff(offsets))


def successor_array(successors: npt.ArrayLike) -> IntArray:
    """Successors as integers, [outcomes]; raises :class:`ModelError` if they are none."""
    array = np.asarray(successors)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ModelError("successors must be integers (indices of states)")
    return read_only(array, np.int64 if array.dtype.itemsize > 4 else np.int32)


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
