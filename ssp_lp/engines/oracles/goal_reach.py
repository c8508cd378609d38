"""Greatest and least probability of reaching the goal, and the cheapest policies that attain it.

MAXPROB and MINPROB of section 2.3 of the paper, exact or discounted (E[gamma^T]), followed by a
second stage that minimises a cost over the policies that attain the first (DESIGN, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MAXIMISER, BoolArray, FloatArray, IntArray
from ssp_lp.engines.oracles.policy_iteration import approach, improve
from ssp_lp.engines.oracles.sub_solution import sub_solution
from ssp_lp.linear import accumulate
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.process.skeleton import Skeleton, build_skeleton


@dataclass(frozen=True, eq=False)
class GoalReach:
    """An extreme probability of reaching the goal, with the pairs that attain it."""

    goal: FloatArray  # [states] E[gamma^T; goal]; 1 at goals, 0 at dead-ends
    bound: FloatArray  # [states] checked: an upper bound of the greatest, a lower of the least
    usable: BoolArray  # [model pairs] pairs that attain the extreme
    decision: IntArray  # [states] one policy that attains it


@dataclass(frozen=True, eq=False)
class ReachPolicy:
    """A stationary policy of extreme goal probability, the cheapest in E[cost; goal]."""

    decision: IntArray  # [states]
    goal: FloatArray  # [states] E[gamma^T; goal]
    early: FloatArray  # [states] E[gamma^(T - 1); goal], 0 at goals
    cost: FloatArray  # [states] E[gamma^(T - 1) * cost; goal]
    cost_bound: FloatArray  # [states] checked lower bound of it


def greatest_goal_reach(model: SSP, survival: float = 1.0) -> GoalReach:
    """MAXPROB: the greatest E[survival^T; goal] from every state.

    Args:
        survival: the discount; 1 for probabilities.
    """
    everything = np.ones(model.n_pairs, dtype=np.bool_) if survival == 1.0 else None
    skeleton = build_skeleton(model, free=everything)  # moving about in a component risks nothing
    transitions, departs = _transitions(skeleton, survival)
    hit = survival * _goal_mass(skeleton) / departs
    first = approach(skeleton.pair_offsets, transitions, hit > 0)
    choice, loss = improve(skeleton.pair_offsets, transitions, -hit, first)
    reach = -loss
    reach = accumulate(transitions[choice], hit[choice], reach)
    ahead = hit + transitions @ reach
    best = ahead >= reach[skeleton.pair_node] * (1.0 - MAXIMISER)
    best[choice] = True
    bound = -sub_solution(skeleton.pair_offsets, transitions, -hit, -reach, floor=-1.0 - 1e-9)
    return _on_states(skeleton, reach, bound, best, choice)


def least_goal_reach(model: SSP, survival: float = 1.0) -> GoalReach:
    """MINPROB: the least E[survival^T; goal] from every state; 0 at attention states."""
    attention = attention_states(model)
    skeleton = build_skeleton(model, exits=attention)
    transitions, departs = _transitions(skeleton, survival)
    hit = survival * _goal_mass(skeleton) / departs
    exits = np.flatnonzero(skeleton.pair_at == GIVE_UP_CODE)
    first = approach(skeleton.pair_offsets, transitions, hit > 0)
    first[skeleton.pair_node[exits]] = exits
    choice, reach = improve(skeleton.pair_offsets, transitions, hit, first)
    reach = np.maximum(accumulate(transitions[choice], hit[choice], reach), 0.0)
    ahead = hit + transitions @ reach
    best = ahead <= reach[skeleton.pair_node] * (1.0 + MAXIMISER)
    best[attention[model.pair_state[np.maximum(skeleton.pair_at, 0)]]] = False
    best[choice] = True
    bound = sub_solution(skeleton.pair_offsets, transitions, hit, reach)
    return _on_states(skeleton, reach, bound, best, choice)


def cheapest(model: SSP, reach: GoalReach, survival: float = 1.0) -> ReachPolicy:
    """Among the policies that attain the extreme, the least E[survival^(T-1) * cost; goal].

    A transition to x' is priced g * reach(x'), reach taken one step early under discounting, so
    the second stage is an ordinary problem without accumulated cost (paper, S3P; DESIGN,
    section 4). Loops that cost nothing are collapsed: a policy must leave them.
    """
    early = np.where(model.goal_mask, 0.0, reach.goal / survival)
    weight = np.where(model.goal_mask, 1.0, survival * early)[model.successors] * model.costs
    free = None
    if survival == 1.0:
        paid = (weight > 0) & (model.probabilities > 0)
        free = ~np.logical_or.reduceat(paid, model.outcome_offsets[:-1]) if model.n_pairs else None
    exits = reach.decision == GIVE_UP_CODE
    free = None if free is None else free & ~exits[model.pair_state]
    usable = reach.usable & ~exits[model.pair_state]
    skeleton = build_skeleton(model, usable=usable, free=free, exits=exits)
    transitions, departs = _transitions(skeleton, survival)
    leaving = (skeleton.pair_at == GIVE_UP_CODE) | (_goal_mass(skeleton) > 0)
    first = approach(skeleton.pair_offsets, transitions, leaving)
    pair_cost = skeleton.expectation(weight) / departs
    choice, _ = improve(skeleton.pair_offsets, transitions, pair_cost, first)
    chain = transitions[choice]
    gain = (_goal_mass(skeleton) / departs)[choice]
    solved = accumulate(chain, np.stack([pair_cost[choice], gain], axis=1))
    bound = sub_solution(skeleton.pair_offsets, transitions, pair_cost, solved[:, 0])
    early_goal = skeleton.lift(solved[:, 1])
    return ReachPolicy(
        decision=skeleton.pull_back(choice),
        goal=np.where(model.goal_mask, 1.0, survival * early_goal),
        early=early_goal,
        cost=skeleton.lift(solved[:, 0]),
        cost_bound=skeleton.lift(bound),
    )


def _goal_mass(skeleton: Skeleton) -> FloatArray:
    model = skeleton.model
    return skeleton.expectation(model.goal_mask[model.successors].astype(np.float64))


def _transitions(skeleton: Skeleton, survival: float) -> tuple[sp.csr_array, FloatArray]:
    """Discounted transitions; exact ones are seen on departing only, with the mass departing."""
    if survival == 1.0:
        return skeleton.departures
    return sp.csr_array(skeleton.outcomes * survival), np.ones(len(skeleton.pair_at))


def _on_states(
    skeleton: Skeleton, reach: FloatArray, bound: FloatArray, best: BoolArray, choice: IntArray
) -> GoalReach:
    model = skeleton.model
    usable = skeleton.inside.copy()
    usable[skeleton.pair_at[best & (skeleton.pair_at >= 0)]] = True
    return GoalReach(
        goal=np.where(model.goal_mask, 1.0, skeleton.lift(np.clip(reach, 0.0, 1.0))),
        bound=np.where(model.goal_mask, 1.0, skeleton.lift(np.clip(bound, 0.0, 1.0))),
        usable=usable,
        decision=skeleton.pull_back(choice),
    )
