"""Nested dicts and successor functions, flattened into the arrays that :class:`SSP` keeps."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, cast

from ssp_lp.errors import ModelError

Outcomes = Iterable[tuple[float, Hashable, float]]

_PROGRESS_EVERY = 10_000


class FlatModel(NamedTuple):
    """A model as flat lists: labels, offsets and outcomes."""

    states: Sequence[Hashable]  # [states]
    actions: Sequence[Hashable]  # [pairs]
    goal_states: Sequence[int]
    pair_offsets: Sequence[int]  # [states + 1]
    outcome_offsets: Sequence[int]  # [pairs + 1]
    successors: Sequence[int]  # [outcomes]
    probabilities: Sequence[float]  # [outcomes]
    costs: Sequence[float]  # [outcomes]
    exact_costs: Mapping[float, Fraction]  # costs that were given as fractions


def flatten_transitions(
    transitions: Mapping[Hashable, Mapping[Hashable, Outcomes]], goal: Iterable[Hashable]
) -> FlatModel:
    """Flatten ``{state: {action: [(probability, successor, cost), ...]}}``.

    Raises:
        ModelError: an outcome is no triple, or its successor is neither a key nor a goal.
    """
    goals = list(dict.fromkeys(no_lone_string(goal, "goal")))
    states = list(transitions) + [g for g in goals if g not in transitions]
    goal_set = set(goals)
    table = {s: {} if s in goal_set else transitions[s] for s in states}
    return _flatten(states, table, goal_set)


def flatten_successors(
    start: Hashable | Iterable[Hashable],
    successors: Callable[[Any], Mapping[Hashable, Outcomes]],
    goal: Callable[[Any], bool] | Iterable[Hashable],
    state_limit: int,
    progress: Callable[[int], None] | None,
) -> FlatModel:
    """Explore breadth-first from ``start`` and flatten what is found.

    Raises:
        ModelError: more than ``state_limit`` states, or an outcome that is no triple.
    """
    is_goal = goal if callable(goal) else set(no_lone_string(goal, "goal")).__contains__
    several = isinstance(start, (list, set, frozenset))
    starts: list[Any] = list(cast(Iterable[Any], start)) if several else [start]
    found: dict[Hashable, None] = dict.fromkeys(starts)
    queue = list(found)
    table: dict[Hashable, Mapping[Hashable, Outcomes]] = {}
    for state in queue:  # the list grows while it is walked: breadth-first order
        table[state] = {} if is_goal(state) else _listed(_actions(successors(state), state), state)
        for outcomes in table[state].values():
            for _, successor, _ in outcomes:
                if successor not in found:
                    found[successor] = None
                    queue.append(successor)
        if len(found) > state_limit:
            raise ModelError(
                f"more than state_limit={state_limit:,} states are reachable; raise the limit or "
                f"bound the model (the last state expanded was {state!r})"
            )
        if progress is not None and len(table) % _PROGRESS_EVERY == 0:
            progress(len(found))
    if progress is not None:
        progress(len(found))
    return _flatten(queue, table, {s for s in queue if is_goal(s)})


def no_lone_string(states: Iterable[Hashable], name: str) -> Iterable[Hashable]:
    """The states themselves; a lone string, whose letters they would be, is an error."""
    if isinstance(states, str):
        raise ModelError(f"{name} must be a set of states, such as {{{states!r}}}, not a string")
    return states


def _listed(
    actions: Mapping[Hashable, Outcomes], state: Hashable
) -> Mapping[Hashable, list[tuple[float, Hashable, float]]]:
    """The actions of a state with their outcomes as lists of checked triples."""
    return {
        action: [_triple(o, state, action) for o in outcomes]
        for action, outcomes in actions.items()
    }


def _actions(actions: Any, state: Hashable) -> Mapping[Hashable, Outcomes]:
    if not isinstance(actions, Mapping):
        raise ModelError(
            f"state {state!r} needs a dict {{action: [(probability, successor, cost), ...]}}, "
            f"not {actions!r}"
        )
    return actions


def _triple(outcome: Any, state: Hashable, action: Hashable) -> tuple[float, Hashable, float]:
    if not isinstance(outcome, (tuple, list)) or len(outcome) != 3:
        raise ModelError(
            f"action {action!r} of state {state!r}: an outcome must be a triple (probability, "
            f"successor, cost), not {outcome!r}"
        )
    return outcome[0], outcome[1], outcome[2]


def _number(value: Any, what: str, state: Hashable, action: Hashable) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ModelError(
            f"action {action!r} of state {state!r} has a {what} that is no number: {value!r}"
        ) from error


def _flatten(
    states: Sequence[Hashable],
    table: Mapping[Hashable, Mapping[Hashable, Outcomes]],
    goals: set[Hashable],
) -> FlatModel:
    index = {s: i for i, s in enumerate(states)}
    flat = FlatModel(states, [], [index[g] for g in states if g in goals], [0], [0], [], [], [], {})
    actions, pair_offsets, outcome_offsets = [], [0], [0]
    successors, probabilities, costs = [], [], []
    exact: dict[float, Fraction] = {}
    for state in states:
        for action, outcomes in _actions(table[state], state).items():
            for outcome in outcomes:
                probability, successor, cost = _triple(outcome, state, action)
                if successor not in index:
                    raise ModelError(
                        f"action {action!r} of state {state!r} leads to {successor!r}, which is "
                        "neither a state of the model nor a goal"
                    )
                successors.append(index[successor])
                probabilities.append(_number(probability, "probability", state, action))
                costs.append(_number(cost, "cost", state, action))
                if isinstance(cost, Fraction):
                    exact[costs[-1]] = cost
            actions.append(action)
            outcome_offsets.append(len(successors))
        pair_offsets.append(len(actions))
    return flat._replace(
        actions=actions,
        pair_offsets=pair_offsets,
        outcome_offsets=outcome_offsets,
        successors=successors,
        probabilities=probabilities,
        costs=costs,
        exact_costs=exact,
    )
