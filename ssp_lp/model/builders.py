"""What users state of a model, checked, as the flat arrays and labels that :class:`SSP` keeps.

Nested dicts and successor functions are flattened; errors name the state and the action.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import (
    PROBABILITY_SUM,
    SINGLE_PRECISION_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    chunks,
    pieces_of_chunks,
    read_only,
)
from ssp_lp.errors import ModelError, check_whole, did_you_mean, in_short

Outcomes = Iterable[tuple[float, Hashable, float]]

_PROGRESS_EVERY = 10_000
_EXPLORING = logging.getLogger("ssp_lp.exploring")


def flatten_transitions(
    transitions: Mapping[Hashable, Mapping[Hashable, Outcomes]], goal: Iterable[Hashable]
) -> dict[str, Any]:
    """Flatten ``{state: {action: [(probability, successor, cost), ...]}}``.

    Returns:
        What :meth:`SSP.from_arrays` takes, by name.

    Raises:
        ModelError: an outcome is no triple, or its successor is neither a key nor a goal.
    """
    if not isinstance(transitions, Mapping):
        raise ModelError(
            "a model is told as {state: {action: [(probability, successor, cost), ...]}}, not as "
            f"{in_short(transitions)}"
        )
    goals = list(dict.fromkeys(no_lone_string(goal, "goal")))
    states = list(transitions) + [g for g in goals if g not in transitions]
    found, goal_set = _BuilderFound(list(states)), set(goals)
    for state in states:
        found.add(state, {} if state in goal_set else transitions[state], goal=state in goal_set)
    if len(found.states) > len(states):
        found.refuse_stranger(len(states))
    return found.flat()


def flatten_successors(
    start: Hashable | Iterable[Hashable],
    successors: Callable[[Any], Mapping[Hashable, Outcomes]],
    goal: Callable[[Any], bool] | Iterable[Hashable],
    state_limit: int,
    progress: Callable[[int], None] | None,
) -> dict[str, Any]:
    """Explore breadth-first from ``start`` and flatten what is found.

    Raises:
        ModelError: more than ``state_limit`` states, or an outcome that is no triple.
    """
    check_whole("state_limit", state_limit)
    is_goal = goal if callable(goal) else set(no_lone_string(goal, "goal")).__contains__
    several = isinstance(start, (list, set, frozenset))
    starts: list[Any] = list(cast(Iterable[Any], start)) if several else [start]
    found = _BuilderFound(list(dict.fromkeys(starts)))
    for done, state in enumerate(found.states, start=1):  # it grows while it is walked
        reached = is_goal(state)
        found.add(state, {} if reached else successors(state), goal=reached)
        if len(found.states) > state_limit:
            raise ModelError(
                f"more than state_limit={state_limit:,} states are reachable; raise the limit or "
                f"bound the model (the last state expanded was {state!r})"
            )
        if done % _PROGRESS_EVERY == 0:
            _EXPLORING.debug("%d states found, %d expanded", len(found.states), done)
            if progress is not None:
                progress(len(found.states))
    _EXPLORING.info("%d states found", len(found.states))
    if progress is not None:
        progress(len(found.states))
    return found.flat()


class _BuilderFound:
    """States in the order in which they were found, and the flat lists of those expanded. Grows."""

    def __init__(self, states: list[Any]) -> None:
        """Begin with some distinct states."""
        self.states = states
        self._index = {state: i for i, state in enumerate(states)}
        self._goals: list[int] = []
        self._actions: list[Hashable] = []
        self._pair_offsets, self._outcome_offsets = [0], [0]
        self._successors: list[int] = []
        self._probabilities: list[float] = []
        self._costs: list[float] = []
        self._exact: dict[float, Fraction] = {}

    def add(self, state: Hashable, actions: Any, *, goal: bool) -> None:
        """Append the next state's actions and note what is new among their successors.

        Raises:
            ModelError: no actions, an outcome that is no triple, or what is no number.
        """
        index, states = self._index, self.states
        successors, probabilities, costs = self._successors, self._probabilities, self._costs
        for action, outcomes in _built_actions(actions, state).items():
            for outcome in outcomes:
                if type(outcome) is not tuple or len(outcome) != 3:
                    outcome = _built_outcome(outcome, state, action)
                probability, successor, cost = outcome
                try:
                    place = index.get(successor)
                except TypeError as error:
                    raise ModelError(
                        f"action {action!r} of state {state!r} leads to {in_short(successor)}: a "
                        "state holds no list, dict or set"
                    ) from error
                if place is None:
                    place = index[successor] = len(states)
                    states.append(successor)
                successors.append(place)
                if type(probability) is not float:
                    probability = _built_number(probability, "probability", state, action)
                probabilities.append(probability)
                if type(cost) is not float:
                    cost = self._exactly(cost, state, action)
                costs.append(cost)
            self._actions.append(action)
            self._outcome_offsets.append(len(successors))
        self._pair_offsets.append(len(self._actions))
        if goal:
            self._goals.append(len(self._pair_offsets) - 2)

    def _exactly(self, cost: Any, state: Hashable, action: Hashable) -> float:
        """A cost as a float; a fraction is remembered as it is."""
        value = _built_number(cost, "cost", state, action)
        if isinstance(cost, Fraction):
            self._exact[value] = cost
        return value

    def refuse_stranger(self, known: int) -> None:
        """Raise :class:`ModelError` for the first outcome that leads to no known state."""
        outcome = next(k for k, place in enumerate(self._successors) if place >= known)
        pair = bisect_right(self._outcome_offsets, outcome) - 1
        state = self.states[bisect_right(self._pair_offsets, pair) - 1]
        raise ModelError(
            f"action {self._actions[pair]!r} of state {state!r} leads to {self.states[known]!r}, "
            "which is neither a state of the model nor a goal"
            f"{did_you_mean(self.states[known], self.states[:known])}"
        )

    def flat(self) -> dict[str, Any]:
        """The model as flat lists."""
        return {
            "states": self.states,
            "actions": self._actions,
            "goal_states": self._goals,
            "pair_offsets": self._pair_offsets,
            "outcome_offsets": self._outcome_offsets,
            "successors": self._successors,
            "probabilities": self._probabilities,
            "costs": self._costs,
            "exact_costs": self._exact,
        }


def no_lone_string(states: Iterable[Hashable], name: str) -> Iterable[Hashable]:
    """The states themselves; a lone string, whose letters they would be, is an error."""
    if isinstance(states, str):
        raise ModelError(f"{name} must be a set of states, such as {{{states!r}}}, not a string")
    if not isinstance(states, Iterable):
        raise ModelError(f"{name} must be a set of states, not {in_short(states)}")
    return states


def _built_actions(actions: Any, state: Hashable) -> Mapping[Hashable, Outcomes]:
    """The actions of a state from which a model is built, a dict."""
    if not isinstance(actions, Mapping):
        raise ModelError(
            f"state {state!r} needs a dict {{action: [(probability, successor, cost), ...]}}, "
            f"not {actions!r}"
        )
    return actions


def _built_outcome(
    outcome: Any, state: Hashable, action: Hashable
) -> tuple[float, Hashable, float]:
    """An outcome from which a model is built, a triple."""
    if not isinstance(outcome, (tuple, list)) or len(outcome) != 3:
        raise ModelError(
            f"action {action!r} of state {state!r}: an outcome must be a triple (probability, "
            f"successor, cost), not {outcome!r}"
        )
    return outcome[0], outcome[1], outcome[2]


def _built_number(value: Any, what: str, state: Hashable, action: Hashable) -> float:
    """A number of an outcome from which a model is built."""
    if not isinstance(value, (str, bytes)):
        with suppress(TypeError, ValueError, OverflowError):
            return float(value)
    given = in_short(value)
    raise ModelError(
        f"action {action!r} of state {state!r} has a {what} that is no number: {given}"
    )


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
