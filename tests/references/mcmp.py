"""Case M by enumeration: least expected cost until failure is certain, within a failure budget.

Semantics (the three words of `give_up`): an episode stops paying at tau, the first time at which
the goal is unreachable under the policy ("anywhere", "attention"), or at the first true dead-end
("dead_ends"). Wandering for ever is failure: under the first two it is the same as giving up on
entry, under the third it costs what it costs, nothing or infinity (finite when discounted).
"""

from collections.abc import Callable, Mapping
from math import inf

from references.chain import (
    STOP,
    Action,
    Moves,
    PlainModel,
    Policy,
    State,
    goal_weight,
    mean,
    moves_of,
    policies,
    reachable,
    reaching,
    recurrent_classes,
    solve_chain,
    start_distribution,
)
from references.frontier import Point, least_failure

Start = State | Mapping[State, float]


def points(
    model: PlainModel,
    start: Start,
    *,
    give_up: str = "attention",
    charge_failing_step: bool = True,
    discount: float | None = None,
) -> list[Point]:
    """(failure, cost) of every deterministic stationary policy with the choice to give up.

    With a discount both numbers are the discounted ones.
    """
    begin = start_distribution(start)
    return [
        evaluate(model, begin, policy, give_up, charge_failing_step, discount)
        for policy in policies(model, begin, allowed(model, give_up))
    ]


def allowed(model: PlainModel, give_up: str) -> Callable[[State], list[Action]]:
    """What may be done in a state, giving up included where it is allowed."""

    def actions(state: State) -> list[Action]:
        if state in model.dead_ends:
            return []
        stop = give_up == "anywhere" or (give_up == "attention" and state in model.attention)
        return [*model.choices[state], STOP] if stop else list(model.choices[state])

    return actions


def evaluate(
    model: PlainModel,
    begin: Mapping[State, float],
    policy: Policy,
    give_up: str,
    charge_failing_step: bool,
    discount: float | None = None,
) -> Point:
    """(failure, cost) of one policy; the cost is infinite if it pays for ever with some chance."""
    moves = moves_of(model, policy)
    gamma = 1.0 if discount is None else discount
    failure = 1.0 - mean(begin, goal_weight(model, moves, gamma))
    if give_up == "dead_ends":
        over = {s: charge(model, s, give_up) for s in model.dead_ends}
        free = _endless(model, begin, moves) if discount is None else {}
    else:
        hopeless = set(model.choices) - reaching(moves, model.goals)
        over, free = {s: charge(model, s, give_up) for s in hopeless}, {}
    if not charge_failing_step:
        over = dict.fromkeys(over, 0.0)
    return Point(failure, _cost(model, begin, moves, over | free, gamma))


def charge(model: PlainModel, state: State, give_up: str) -> float:
    """What the failing step costs at the state in which failure has become certain."""
    if state in model.dead_ends or give_up == "anywhere":
        return model.least_cost(state, model.choices[state])
    return model.least_cost(state, model.staying(state))


def _endless(model: PlainModel, begin: Mapping[State, float], moves: Moves) -> dict[State, float]:
    """The future cost, 0 or infinity, at each state of a class in which the chain wanders."""
    live = [s for s in reachable(moves, begin) if s not in model.dead_ends]
    future = {}
    for members in recurrent_classes(moves, live):
        pays = any(p * cost > 0 for s in members for p, _, cost in moves[s])
        future |= dict.fromkeys(members, inf if pays else 0.0)
    return future


def _cost(
    model: PlainModel,
    begin: Mapping[State, float],
    moves: Moves,
    over: Mapping[State, float],
    gamma: float,
) -> float:
    """Expected (discounted) cost up to the states of `over`, plus what is charged there."""
    visited = reachable({s: [] if s in over else moves[s] for s in model.choices}, begin)
    if any(over.get(state) == inf for state in visited):
        return inf
    paying = [state for state in visited if state not in over]
    value = solve_chain(moves, paying, lambda o: o[2] + gamma * over.get(o[1], 0.0), gamma)
    return mean(begin, value | dict(over))


def at_least_failure(model: PlainModel, start: Start, *, charge_failing_step: bool = True) -> Point:
    """The least failure, and the least cost among the policies that attain it, in two stages.

    At least failure only a true dead-end is hopeless, so all three meanings of giving up agree.
    """
    every = points(model, start, give_up="dead_ends", charge_failing_step=charge_failing_step)
    least = least_failure(every)
    return Point(least, min(cost for failure, cost in every if failure <= least + 1e-11))
