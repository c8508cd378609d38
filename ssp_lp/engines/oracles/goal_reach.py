"""Greatest and least probability of reaching the goal, and the cheapest policies that attain it.

MAXPROB and MINPROB of section 2.3 of the paper, exact or discounted (E[gamma^T]), followed by a
second stage that minimises a cost over the policies that attain the first (DESIGN, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import MAXIMISER, BoolArray, FloatArray, IntArray
from ssp_lp.bellman import ChosenRows
from ssp_lp.engines.oracles.policy_iteration import approach, improve
from ssp_lp.engines.oracles.sub_solution import sub_solution
from ssp_lp.linear import accumulate
from ssp_lp.model import SSP
from ssp_lp.model.graph import approach_pairs, attention_states, pairs_into
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED
from ssp_lp.process.charge import TailValues
from ssp_lp.process.expectations import cost_means, costless_pairs, successor_means
from ssp_lp.process.rows import RowChoice, live_rows
from ssp_lp.process.semantics import Aim
from ssp_lp.process.skeleton import Skeleton, build_skeleton

_ONE = np.ones(1)


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

    @property
    def values(self) -> TailValues:
        """What following the policy from each state on attains, [states] each."""
        return TailValues(self.goal, self.early, self.cost, np.zeros_like(self.goal))


def greatest_goal_reach(model: SSP, survival: float = 1.0) -> GoalReach:
    """MAXPROB: the greatest E[survival^T; goal] from every state.

    Args:
        survival: the discount; 1 for probabilities.
    """
    everything = np.ones(model.n_pairs, dtype=np.bool_) if survival == 1.0 else None
    skeleton = build_skeleton(model, free=everything)  # moving about in a component risks nothing
    offsets = skeleton.pair_offsets
    transitions, departs = skeleton.transitions(survival, departing=survival == 1.0)
    hit = survival * _goal_mass(skeleton) / departs
    first = approach(offsets, transitions, hit > 0)
    settled = improve(offsets, transitions, hit[:, None], -_ONE, first)
    chain = ChosenRows(transitions, settled.choice)
    reach = accumulate(chain, hit[settled.choice], settled.totals[:, 0])
    best = hit + transitions @ reach >= reach[skeleton.pair_node] * (1.0 - MAXIMISER)
    best[settled.choice] = True
    bound = -sub_solution(offsets, transitions, -hit, -reach, floor=-1.0 - 1e-9)
    return _on_states(skeleton, reach, bound, best, settled.choice)


def extreme_goal_reach(model: SSP, aim: Aim) -> GoalReach:
    """MAXPROB or MINPROB, exact, as the aim says."""
    return greatest_goal_reach(model) if aim is Aim.GREATEST_GOAL else least_goal_reach(model)


def least_goal_reach(model: SSP, survival: float = 1.0) -> GoalReach:
    """MINPROB: the least E[survival^T; goal] from every state; 0 at attention states.

    Only states that cannot avoid the goal for sure need to be solved for.
    """
    attention = attention_states(model)
    skeleton = build_skeleton(model, ended=attention)
    offsets = skeleton.pair_offsets
    transitions, departs = skeleton.transitions(survival, departing=survival == 1.0)
    hit = survival * _goal_mass(skeleton) / departs
    first = np.asarray(offsets[:-1])
    settled = improve(offsets, transitions, hit[:, None], _ONE, first)
    chain = ChosenRows(transitions, settled.choice)
    reach = np.maximum(accumulate(chain, hit[settled.choice], settled.totals[:, 0]), 0.0)
    best = hit + transitions @ reach <= reach[skeleton.pair_node] * (1.0 + MAXIMISER)
    best[settled.choice] = True
    bound = sub_solution(offsets, transitions, hit, reach)
    found = _on_states(skeleton, reach, bound, best, settled.choice)
    decision = np.where(attention & ~skeleton.dead, GIVE_UP_CODE, found.decision)
    return replace(found, decision=decision)


def cheapest(model: SSP, reach: GoalReach, survival: float = 1.0) -> ReachPolicy:
    """Among the policies that attain the extreme, the least E[survival^(T-1) * cost; goal].

    A transition to x' is priced g * reach(x'), reach taken one step early under discounting, so
    the second stage is an ordinary problem without accumulated cost (paper, S3P; DESIGN,
    section 4). Loops that cost nothing are collapsed: a policy must leave them.
    """
    early = np.where(model.goal_mask, 0.0, reach.goal / survival)
    weight = np.where(model.goal_mask, 1.0, survival * early)
    exits = reach.decision == GIVE_UP_CODE
    free = costless_pairs(model, weight) & ~exits[model.pair_state] if survival == 1.0 else None
    usable = reach.usable & ~exits[model.pair_state]
    skeleton = build_skeleton(model, usable=usable, free=free, exits=exits)
    transitions, departs = skeleton.transitions(survival, departing=survival == 1.0)
    gain = _goal_mass(skeleton) / departs
    pair_cost = skeleton.at_pairs(cost_means(model, weight)) / departs
    first = approach(
        skeleton.pair_offsets, transitions, (skeleton.pair_at == GIVE_UP_CODE) | (gain > 0)
    )
    rewards, only_cost = np.stack([pair_cost, gain], axis=1), np.array([1.0, 0.0])
    settled = improve(skeleton.pair_offsets, transitions, rewards, only_cost, first)
    choice = settled.choice
    solved = accumulate(ChosenRows(transitions, choice), rewards[choice], settled.totals)
    bound = sub_solution(skeleton.pair_offsets, transitions, pair_cost, solved[:, 0])
    early_goal = skeleton.lift(solved[:, 1])
    return ReachPolicy(
        decision=skeleton.pull_back(choice),
        goal=np.where(model.goal_mask, 1.0, survival * early_goal),
        early=early_goal,
        cost=skeleton.lift(solved[:, 0]),
        cost_bound=skeleton.lift(bound),
    )


def goal_directed(model: SSP, survival: float = 1.0) -> ReachPolicy:
    """A policy every step of which may come nearer to the goal, in number of steps.

    It reaches the goal with positive probability from wherever that can be done, and is found and
    evaluated without optimising anything; its cost bound is the trivial one.
    """
    decision = approach_pairs(model, pairs_into(model, model.goal_mask))
    live = np.flatnonzero(decision >= 0)
    node_of = np.full(model.n_states, -1, dtype=np.int32)
    node_of[live] = np.arange(live.size)
    taken, exact = decision[live].astype(np.int32), survival == 1.0
    home = node_of[live] if exact else None
    chain, departs = live_rows(RowChoice(model, node_of, live.size, taken, home), survival)
    hit = successor_means(model, model.goal_mask)[taken] / departs
    early = np.zeros(model.n_states)
    early[live] = accumulate(chain, hit)
    goal = np.where(model.goal_mask, 1.0, survival * early)
    cost = np.zeros(model.n_states)
    cost[live] = accumulate(chain, cost_means(model, goal)[taken] / departs)
    return ReachPolicy(
        decision=np.where(decision >= 0, decision, UNDECIDED),
        goal=goal,
        early=early,
        cost=cost,
        cost_bound=np.zeros(model.n_states),
    )


def _goal_mass(skeleton: Skeleton) -> FloatArray:
    return skeleton.at_pairs(successor_means(skeleton.model, skeleton.model.goal_mask))


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
