"""Nested dicts and successor functions, flattened into the arrays that :class:`SSP` keeps."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterable, Mapping
from contextlib import suppress
from fractions import Fraction
from typing import Any, cast

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
