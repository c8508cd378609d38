"""Policy iteration on a handful of states, in floating point or in exact fractions.

A process is a pair of tables: `reward[state][action]`, and `moves[state][action]` with the
probabilities `{successor: p}` of going on; what is missing from 1 has ended. Every policy that is
tried is proper (it ends with probability 1): the first one is, and only strict improvements are
made. For were R a recurrent class of the improved policy, the improvements over R would average to
0; so none was made in R, and R was recurrent before. The end value v is that of a proper policy
and satisfies v = max(reward + moves v). So it is the greatest over proper policies, and, where no
reward is negative, over all policies: wandering for ever earns 0.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import TypeVar

from references.chain import Action, PlainModel, State

Number = TypeVar("Number", float, Fraction)
Rewards = Mapping[State, Mapping[Action, Number]]
Moves = Mapping[State, Mapping[Action, Mapping[State, Number]]]
Kept = Mapping[State, list[Action]]

ROUNDING = 1e-13
"""Relative improvements below this are rounding; exact fractions need no such thing."""


def greatest(first: Mapping[State, Action], reward: Rewards, moves: Moves) -> dict[State, Number]:
    """The greatest total reward of a proper policy from each state, from a proper first policy."""
    policy = dict(first)
    while True:
        value = total(policy, reward, moves)
        better = {s: a for s in policy if (a := _improvement(s, value, reward, moves)) is not None}
        if not better:
            return value
        policy |= better


def _improvement(
    state: State, value: Mapping[State, Number], reward: Rewards, moves: Moves
) -> Action | None:
    """The best action of a state if it is strictly better than the policy's own."""
    worth = {
        action: paid + sum(p * value[s] for s, p in moves[state][action].items())
        for action, paid in reward[state].items()
    }
    best = max(worth, key=worth.get)
    slack = 0 if isinstance(worth[best], Fraction) else ROUNDING * max(1e-300, abs(worth[best]))
    return best if worth[best] > value[state] + slack else None


def total(policy: Mapping[State, Action], reward: Rewards, moves: Moves) -> dict[State, Number]:
    """The total reward of a proper policy: Gauss elimination with the largest pivot."""
    order = list(policy)
    rows = []
    for state in order:
        onward, paid = moves[state][policy[state]], reward[state][policy[state]]
        one, none = type(paid)(1), type(paid)(0)
        rows.append([(one if s == state else none) - onward.get(s, none) for s in order] + [paid])
    for k in range(len(order)):
        pivot = max(range(k, len(order)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i, row in enumerate(rows):
            if i != k and row[k] != 0:
                rows[i] = [
                    entry - row[k] * other for entry, other in zip(row, rows[k], strict=True)
                ]
    return {state: row[-1] for state, row in zip(order, rows, strict=True)}


def homeward(model: PlainModel, kept: Kept) -> dict[State, Action]:
    """A proper policy that keeps the given actions: one step nearer to the goal is possible."""
    policy: dict[State, Action] = {}
    near = set(model.goals)
    while True:
        new = {
            state: action
            for state, actions in kept.items()
            if state not in policy
            for action in actions[::-1]
            if any(o[1] in near for o in model.choices[state][action])
        }
        if not new:
            return policy
        policy |= new
        near |= set(new)


def hopeful(model: PlainModel) -> dict[State, list[Action]]:
    """All actions of the states that can reach the goal."""
    return {s: list(a) for s, a in model.choices.items() if s not in model.dead_ends}


def exact(model: PlainModel, state: State, action: Action) -> list[tuple[Fraction, State]]:
    """Shortest decimals as fractions, scaled to sum to 1."""
    listed = [(Fraction(repr(float(p))), s) for p, s, _ in model.choices[state][action]]
    whole = sum(p for p, _ in listed)
    return [(p / whole, s) for p, s in listed]


def success(model: PlainModel) -> dict[State, Fraction]:
    """The greatest probability of reaching the goal from each state, exactly."""
    every = hopeful(model)
    reward, moves = {}, {}
    for state, actions in every.items():
        reward[state] = dict.fromkeys(actions, Fraction(0))
        moves[state] = {action: {} for action in actions}
        for action in actions:
            for p, s in exact(model, state, action):
                if s in model.goals:
                    reward[state][action] += p
                elif s in every:
                    moves[state][action][s] = moves[state][action].get(s, 0) + p
    known = dict.fromkeys(model.choices, Fraction(0)) | dict.fromkeys(model.goals, Fraction(1))
    return known | greatest(homeward(model, every), reward, moves)


def kept_actions(model: PlainModel) -> dict[State, list[Action]]:
    """The actions that policies of least failure can take, at states that can reach the goal."""
    best = success(model)
    return {
        state: [
            action
            for action in actions
            if sum(p * best[s] for p, s in exact(model, state, action)) == best[state]
        ]
        for state, actions in hopeful(model).items()
    }
