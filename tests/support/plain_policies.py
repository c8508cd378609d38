"""Members of a solution, and a user's own policies, as chains that the references can solve."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from hypothesis import strategies as st

from references import mcmp, s3p
from references.chain import STOP, PlainModel, Policy, State, mean, plain_model
from references.frontier import Point
from ssp_lp import GIVE_UP, SSP
from ssp_lp.policies import DeterministicPolicy


def member_actions(member: Any) -> dict[State, Any]:
    """A stationary member's decisions, with the references' word for giving up."""
    return {s: STOP if a is GIVE_UP else a for s, a in member.actions().items()}


def mcmp_point(
    model: PlainModel,
    start: Mapping[State, float],
    solution: Any,
    discount: float | None,
    **meaning,
) -> Point:
    """(failure, cost) of the solution's lottery, each member's chain solved by the reference."""
    parts = [
        mcmp.evaluate(model, start, member_actions(member), discount=discount, **meaning)
        for member in solution.policy.policies
    ]
    return lottery(parts, solution.policy.weights)


def s3p_point(
    model: PlainModel, start: Mapping[State, float], solution: Any, discount: float | None
) -> Point:
    """(failure, cost on success) of the solution's lottery, over states and memories."""
    parts = []
    for member in solution.policy.policies:
        begin, chain, moves = memory_chain(model, start, member)
        weight, cost = s3p.values(chain, moves, discount)
        parts.append(Point(1.0 - mean(begin, weight), mean(begin, cost)))
    return lottery(parts, solution.policy.weights)


def lottery(parts: list[Point], weights: Any) -> Point:
    """The weighted mean of both numbers."""
    failure, cost = np.asarray(weights) @ np.array(parts)
    return Point(float(failure), float(cost))


def memory_chain(
    model: PlainModel, start: Mapping[State, float], member: Any
) -> tuple[dict[State, float], PlainModel, Policy]:
    """Play one member through every (state, memory) that it can meet.

    Returns:
        The start, the chain as a model with one action, and the policy that plays it.
    """
    library: SSP = member.model
    begin = {
        (s, int(member.start_memory(np.array([library.index_of(s)]))[0])): mass
        for s, mass in start.items()
    }
    queue, choices, goals = list(begin), {}, set()
    for node in queue:
        if node in choices or node in goals:
            continue
        if node[0] in model.goals:
            goals.add(node)
            continue
        choices[node] = {"play": _outcomes(model, member, node)} if model.choices[node[0]] else {}
        queue += [o[1] for outcomes in choices[node].values() for o in outcomes]
    chain = plain_model(choices, goals)
    moving = [node for node, actions in chain.choices.items() if actions.get("play")]
    return begin, chain, dict.fromkeys(moving, "play")


def _outcomes(model: PlainModel, member: Any, node: tuple[State, int]) -> list:
    """The outcomes of what a member does at a node; none where it stops or need not act."""
    library: SSP = member.model
    state, memory = node
    decision = member.branches(np.array([library.index_of(state)]), np.array([memory]))
    pair = int(decision.pair[0])
    if pair < 0:
        return []
    return [
        (p, (successor, _next(member, memory, pair, successor, cost)), cost)
        for p, successor, cost in model.choices[state][library.action_of(pair)]
    ]


def _next(member: Any, memory: int, pair: int, successor: State, cost: float) -> int:
    """The memory after a step."""
    there = np.array([member.model.index_of(successor)])
    taken = np.array([pair])
    return int(member.remember(np.array([memory]), taken, there, np.array([float(cost)]))[0])


@st.composite
def stationary_policies(draw, drawn, model: PlainModel, give_up: str):
    """A user's own decisions: at each live state an action, or giving up where it is allowed."""
    decisions = {}
    for state in drawn.choices:
        if state in model.dead_ends:
            continue
        stop = give_up == "anywhere" or (give_up == "attention" and state in model.attention)
        decisions[state] = draw(
            st.sampled_from([*model.choices[state], STOP] if stop else [*model.choices[state]])
        )
    return decisions


def library_policy(model: SSP, decisions: Mapping[State, Any]) -> DeterministicPolicy:
    """The decisions as a policy of the library."""
    actions = {s: GIVE_UP if a == STOP else a for s, a in decisions.items()}
    return DeterministicPolicy.from_actions(model, actions)
