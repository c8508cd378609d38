"""Plain models, their graph facts, and the Markov chain of one deterministic stationary policy."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

State = Hashable
Action = Hashable
Outcome = tuple[float, State, float]
Choices = Mapping[State, Mapping[Action, Sequence[Outcome]]]
Moves = Mapping[State, Sequence[Outcome]]
Policy = Mapping[State, Action]

STOP = "<stop>"
"""The decision to give up; no model of the tests has an action of this name."""


@dataclass(frozen=True)
class PlainModel:
    """A nested-dict model together with its graph facts.

    `choices` holds the non-goal states only; a state without actions has an empty dictionary.
    """

    choices: dict[State, dict[Action, list[Outcome]]]
    goals: frozenset[State]
    dead_ends: frozenset[State]
    attention: frozenset[State]

    def staying(self, state: State) -> list[Action]:
        """The actions of `state` whose successors are all attention states."""
        return [
            action
            for action, outcomes in self.choices[state].items()
            if all(successor in self.attention for _, successor, _ in outcomes)
        ]

    def mean_cost(self, state: State, action: Action) -> float:
        """The expected stage cost of one state-action pair."""
        return sum(p * cost for p, _, cost in self.choices[state][action])

    def least_cost(self, state: State, actions: Iterable[Action]) -> float:
        """The least expected stage cost over `actions`, 0 if there are none."""
        return min((self.mean_cost(state, action) for action in actions), default=0.0)


def plain_model(choices: Choices, goal: Iterable[State]) -> PlainModel:
    """Collect the non-goal states of `choices` and work out dead-ends and attention states.

    Outcomes of probability 0 cannot happen and are left out.
    """
    goals = frozenset(goal)
    table = {
        state: {
            action: [outcome for outcome in outcomes if outcome[0] > 0]
            for action, outcomes in actions.items()
        }
        for state, actions in choices.items()
        if state not in goals
    }
    for actions in list(table.values()):
        for outcomes in actions.values():
            for _, successor, _ in outcomes:
                if successor not in goals:
                    table.setdefault(successor, {})
    return PlainModel(table, goals, _dead_ends(table, goals), _attention(table, goals))


def _dead_ends(table: Choices, goals: frozenset[State]) -> frozenset[State]:
    """States without any path to a goal."""
    moves = {s: [o for outcomes in a.values() for o in outcomes] for s, a in table.items()}
    return frozenset(table) - reaching(moves, goals)


def _attention(table: Choices, goals: frozenset[State]) -> frozenset[State]:
    """Greatest set of non-goal states in which each state has no action, or one that stays."""
    inside = set(table)
    while True:
        leaving = {
            state
            for state in inside
            if table[state]
            and not any(all(o[1] in inside for o in outcomes) for outcomes in table[state].values())
        }
        if not leaving:
            return frozenset(inside)
        inside -= leaving


def reaching(moves: Moves, targets: Iterable[State]) -> frozenset[State]:
    """The states of `moves` from which some path leads into `targets` (targets themselves not)."""
    found = set(targets)
    hits: set[State] = set()
    while True:
        new = {s for s in moves if s not in found and any(o[1] in found for o in moves[s])}
        if not new:
            return frozenset(hits)
        found |= new
        hits |= new


def reachable(moves: Moves, start: Iterable[State]) -> list[State]:
    """The states of `moves` that paths from `start` visit, in order of discovery."""
    order = [state for state in start if state in moves]
    seen = set(order)
    for state in order:
        for _, successor, _ in moves[state]:
            if successor in moves and successor not in seen:
                seen.add(successor)
                order.append(successor)
    return order


def policies(
    model: PlainModel, start: Iterable[State], allowed: Callable[[State], list[Action]]
) -> Iterator[dict[State, Action]]:
    """All deterministic stationary policies, decided only at the states that they visit.

    `allowed(state)` lists the decisions at a state; a state with an empty list is one at which the
    episode is over, and the chain stops there.
    """

    def expand(policy: dict[State, Action]) -> Iterator[dict[State, Action]]:
        for state in reachable(moves_of(model, policy), start):
            options = allowed(state) if state not in policy else []
            if options:
                for action in options:
                    yield from expand({**policy, state: action})
                return
        yield policy

    return expand({})


def moves_of(model: PlainModel, policy: Policy) -> dict[State, list[Outcome]]:
    """The outcomes that a policy plays at each state; none where it stops or does not decide."""
    return {
        state: actions[policy[state]] if policy.get(state, STOP) != STOP else []
        for state, actions in model.choices.items()
    }


def solve_chain(
    moves: Moves, states: Iterable[State], reward: Callable[[Outcome], float], discount: float
) -> dict[State, float]:
    """Solve v(x) = sum_w p(w) {reward(w) + discount * v(successor)} on `states` (0 elsewhere)."""
    order = list(states)
    index = {state: i for i, state in enumerate(order)}
    matrix = np.eye(len(order))
    right = np.zeros(len(order))
    for state, row in index.items():
        for outcome in moves[state]:
            right[row] += outcome[0] * reward(outcome)
            if outcome[1] in index:
                matrix[row, index[outcome[1]]] -= discount * outcome[0]
    return dict(zip(order, np.linalg.solve(matrix, right).tolist(), strict=True))


def goal_weight(model: PlainModel, moves: Moves, discount: float = 1.0) -> dict[State, float]:
    """E[discount^T; goal reached] from each state, T the time of arrival; 1 at goals."""
    states = reaching(moves, model.goals)
    weight = solve_chain(
        moves, states, lambda o: discount if o[1] in model.goals else 0.0, discount
    )
    return weight | dict.fromkeys(model.goals, 1.0)


def recurrent_classes(moves: Moves, states: Iterable[State]) -> list[frozenset[State]]:
    """The closed communicating classes inside `states` (none of whose members stops)."""
    pool = list(states)
    ahead = {state: frozenset(reachable(moves, [state])) for state in pool}
    classes = set()
    for state in pool:
        closed = all(o[1] in ahead[state] for s in ahead[state] for o in moves[s])
        stops = any(not moves[s] for s in ahead[state])
        if closed and not stops and all(state in ahead[s] for s in ahead[state]):
            classes.add(ahead[state])
    return list(classes)


def long_run_average(
    model: PlainModel, begin: Mapping[State, float], policy: Policy, doublings: int = 30
) -> float:
    """(1/T) sum of P(x_t is not a goal) over t < T = 2^doublings, by S_2T = S_T + M^T S_T."""
    order = list(model.choices)
    index = {state: i for i, state in enumerate(order)}
    matrix = np.zeros((len(order), len(order)))
    for state, outcomes in moves_of(model, policy).items():
        for p, successor, _ in outcomes or [(1.0, state, 0.0)]:
            if successor in index:
                matrix[index[state], index[successor]] += p
    average = np.ones(len(order))
    for _ in range(doublings):
        average = (average + matrix @ average) / 2
        matrix = matrix @ matrix
    return mean(begin, dict(zip(order, average.tolist(), strict=True)))


def mean(start: Mapping[State, float], values: Mapping[State, float]) -> float:
    """The start distribution's mean of `values`, which are 0 where absent."""
    return sum(weight * values.get(state, 0.0) for state, weight in start.items())


def start_distribution(start: State | Mapping[State, float]) -> dict[State, float]:
    """A start state or distribution, as a distribution."""
    return dict(start) if isinstance(start, Mapping) else {start: 1.0}
