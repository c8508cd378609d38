"""Where a policy has lost the goal, and may as well stop.

A state from which the goal is not reached under a policy is one in which it can be avoided for
sure, so that the policy may give up there: what it would still pay changes no cost given success.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.analysis.layers.layer_moves import LayerMoves
from ssp_lp.model.graph.reachability import goal_pairs, nearer_pairs
from ssp_lp.policies import CostAwarePolicy, MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, Policy

_AT_ONCE = 1_000_000  # decisions between two looks at the time


def stopping_where_lost(policy: MixedPolicy) -> MixedPolicy:
    """The same policy, but that members that remember their cost give up once the goal is lost.

    Raises:
        Stop: the time ended.
    """
    return replace(policy, policies=tuple(_stopping(member) for member in policy.policies))


def _stopping(policy: Policy) -> Policy:
    """A member that gives up where it has lost the goal; others are left as they are."""
    layers = policy.layers()
    if not isinstance(policy, CostAwarePolicy) or layers is None:
        return policy
    model, moves, count = policy.model, LayerMoves(policy.model, layers), layers.count
    tails, decision, everywhere = (
        layers.tails.copy(),
        layers.decision.copy(),
        np.arange(model.n_states),
    )
    beyond = np.empty(tails.shape, dtype=np.bool_)  # where a tail has not lost the goal
    for number, tail in enumerate(layers.tails):
        followed = np.zeros(model.n_pairs, dtype=np.bool_)
        followed[tail[tail >= 0]] = True
        nearer = nearer_pairs(model, goal_pairs(model), followed)
        beyond[number] = model.goal_mask | (nearer >= 0)
    hopeful = np.empty((count + moves.room, model.n_states), dtype=np.bool_)
    hopeful[:count] = model.goal_mask
    for layer in range(count, len(hopeful)):
        hopeful[layer] = beyond[layers.tail_at(layer), everywhere]
    several = 1 if layers.unit is None else max(_AT_ONCE // max(model.n_states, 1), 1)
    for end in range(count, 0, -several):
        moves.meet(max(end - several, 0), end, hopeful)
    decision[moves.acting & (decision >= 0) & ~hopeful[:count]] = GIVE_UP_CODE
    tails[moves.acting & (tails >= 0) & ~beyond] = GIVE_UP_CODE
    return replace(policy, decision=decision, tails=tails)
