"""Where a policy has lost the goal, and may as well stop.

A state from which the goal is not reached under a policy is one in which it can be avoided for
sure, so that the policy may give up there: what it would still pay changes no cost given success.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.analysis.layers.layer_moves import HOPEFUL, LayerMoves, spread_in_layer
from ssp_lp.arrays import IntArray
from ssp_lp.policies import CostAwarePolicy, MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, CostLayers, Policy


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
    moves = LayerMoves(policy.model, layers)
    tails, marks = _stopping_tails(moves, layers)
    return replace(policy, decision=_stopping_layers(moves, layers, marks), tails=tails)


def _stopping_tails(moves: LayerMoves, layers: CostLayers) -> tuple[IntArray, IntArray]:
    """The tails that stop, and where the goal is not lost under them, [tails, states] both."""
    everywhere, tails = np.arange(moves.model.n_states), layers.tails.copy()
    marks = np.zeros(tails.shape, dtype=np.uint8)
    stay = np.full(len(layers.costs), -1)
    for number, mark in enumerate(marks):
        pairs = moves.tail(number, everywhere)
        mark[moves.model.goal_mask] = HOPEFUL
        spread_in_layer(mark, HOPEFUL, moves.staying(everywhere, pairs, stay))
        tails[number, (pairs >= 0) & (mark == 0)] = GIVE_UP_CODE
    return tails, marks


def _stopping_layers(moves: LayerMoves, layers: CostLayers, tail_marks: IntArray) -> IntArray:
    """The decisions of each layer that stop, [layers, states].

    Args:
        moves: of the policy.
        layers: of the policy.
        tail_marks: where the goal is not lost under a tail, [tails, states].
    """
    room, n, count = moves.room, moves.model.n_states, layers.count
    everywhere, decision = np.arange(n), layers.decision.copy()
    hopeful = np.empty((room, n), dtype=np.bool_)
    for layer in range(count, count + room):
        hopeful[layer % room] = tail_marks[layers.tail_at(layer), everywhere] > 0
    for layer in reversed(range(count)):
        pairs, slots = moves.pairs(layer, everywhere), moves.slots(layer)
        meets = moves.meets(pairs, slots, hopeful) | moves.model.goal_mask
        marks = np.where(meets, HOPEFUL, 0)
        spread_in_layer(marks, HOPEFUL, moves.staying(everywhere, pairs, slots))
        decision[layer, (pairs >= 0) & (marks == 0)] = GIVE_UP_CODE
        hopeful[layer % room] = marks > 0
    return decision
