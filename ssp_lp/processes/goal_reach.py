"""Greatest and least goal probability, and the cheapest policies that attain them.

The first stage is MAXPROB or MINPROB of section 2.3 of the paper, exact or discounted (E[gamma^T]).
The second stage minimises a cost over the policies that attain the optimum of the first
(mathematics, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray, IntArray, expected, read_only
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.dynamic_programming.dual_bound import dual_bound
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.dynamic_programming.evaluation import EVALUATED
from ssp_lp.dynamic_programming.extreme_reach import ExtremeReach, attaining_pairs, extreme_reach
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.model import SSP, graph
from ssp_lp.model.graph import nearer_pairs
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.processes.live_rows import (
    RowChoice,
    cost_means,
    costless_pairs,
    live_rows,
    successor_means,
)
from ssp_lp.processes.quotient import Quotient, build_quotient

_RARE = 1e-4  # failure below which the bounds of sweeps on success leave it few digits


@dataclass(frozen=True, eq=False)
class GoalReach:
    """The greatest or the least goal probability of each state, and the pairs that attain it."""

    goal: FloatArray  # [states] E[gamma^T; goal]; 1 at goals, 0 at dead-ends
    bound: FloatArray  # [states] certified: upper bound of the greatest, lower bound of the least
    decision: IntArray  # [states] one policy that attains it
    sure_pairs: BoolArray  # [model pairs] pairs that attain the extreme by the graph alone
    solved: tuple[Quotient, ExtremeReach] | None = None  # for states that the graph does not decide

    def least_failure(self, start: FloatArray) -> float:
        """Return a certified lower bound of every policy's failure probability.

        The object must have the greatest goal probabilities. The bound includes the rounding errors
        of its computation.

        Args:
            start: distribution over states, [states].
        """
        return max(1.0 - float(expected(start, self.bound)) - 4.0 * MACHINE_EPSILON, 0.0)

    @cached_property
    def usable(self) -> BoolArray:
        """Mask of the pairs that attain the optimal goal probability, [model pairs]."""
        if self.solved is None:
            return self.sure_pairs
        quotient, reach = self.solved
        usable, pairs = self.sure_pairs | quotient.inside, quotient.pair_at[attaining_pairs(reach)]
        usable[pairs[pairs >= 0]] = True
        return usable


@dataclass(frozen=True, eq=False)
class ReachPolicy:
    """A stationary policy, with its cost and its goal probability from each state.

    The goal probability, or E[survival^T; goal], is usually the greatest or the least one; a policy
    of ``goal_directed`` is an exception.
    """

    decision: IntArray  # [states]
    values: TailValues  # [states] each, of following it from each state
    bound: FloatArray  # [states] certified, of all such policies: least cost, or greatest moment


def greatest_goal_reach(
    model: SSP, survival: float = 1.0, start: FloatArray | None = None, *, precise: bool = True
) -> GoalReach:
    """Solve MAXPROB: the greatest E[survival^T; goal] from every state.

    The graph shows from which states the goal can be reached surely, and from which never. If each
    start state is of one of these kinds, nothing else is computed: the result then has goal
    probability 0 in all states without sure success.

    Args:
        model: the model.
        survival: the discount; 1 for probabilities.
        start: only the results from states with positive entries are needed, [states]; None: from
            all states.
        precise: whether all pairs that attain the greatest value are needed, rather than one
            policy and a bound.
    """
    exact, setting = survival == 1.0, (survival, start, precise)
    one_pass = _reach_in_order(model, start) if exact and not precise else None
    if one_pass is not None:
        return one_pass
    if exact:
        sure, keeping, nearer = graph.surely_reaching(model)
        decision = np.where(nearer < 0, UNDECIDED, nearer)
        inside = sure & ~model.goal_mask
        surely, reached = keeping & inside[model.pair_state], sure.astype(np.float64)
        if start is not None and model.failure_label is None and sure[start > 0.0].all():
            return GoalReach(reached, np.ones(model.n_states), decision, surely)
    hopeless = graph.hopeless_states(model)
    # all pairs are equally good once the goal is out of reach
    lost = (hopeless & ~graph.dead_ends(model))[model.pair_state]
    if not exact:
        quotient = build_quotient(model, ended=model.goal_mask | hopeless)
        return _extreme_reach(quotient, model.goal_mask, lost, *setting, greatest=True)
    surely, starts = lost | surely, ~hopeless & (start is None or start > 0.0)
    if not (starts & ~sure).any():  # the graph decides it all
        return GoalReach(reached, (~hopeless).astype(np.float64), decision, surely)
    everything = np.ones(model.n_pairs, dtype=np.bool_)
    # moves in an end component have no risk
    quotient = build_quotient(model, free=everything, ended=sure | hopeless)
    reach = _extreme_reach(quotient, sure, surely, *setting, greatest=True)
    return replace(reach, decision=np.where(inside, nearer, reach.decision))


@with_twin
def _reach_in_order(model: SSP, start: FloatArray | None) -> GoalReach | None:
    """Compute the greatest goal probabilities in one pass, if each step leads to a later state.

    This holds in products with a count of steps. The result is None in other models, if the loop is
    not worth compiling, and if rounding may exceed ``EVALUATED`` at a start state. Its pairs are
    those of one policy, not all that attain the optimum.
    """
    if model.failure_label is not None or start is None:
        return None
    if not accelerated(model.n_outcomes, "policy_improvement.reach_in_order"):
        return None
    from ssp_lp.compiled.policy_improvement import reach_in_order

    n, graph = model.n_states, (model.pair_offsets, model.outcome_offsets, model.successors)
    decision, values = np.full(n, UNDECIDED, dtype=np.int32), np.empty((n, 4))
    arrays = *graph, model.probabilities, model.goal_mask, MACHINE_EPSILON
    for some in pieces(n, model.n_outcomes):
        if not reach_in_order(*arrays, some.start, some.stop, decision, values):
            return None
    hit, miss, most, least = values.T
    goal = np.where(miss < hit, 1.0 - miss, hit)
    bound = np.clip(np.minimum(most, 1.0 + 2.0 * MACHINE_EPSILON - least), goal, 1.0)
    if (((bound - goal) > EVALUATED * goal) & (start > 0.0)).any():
        return None
    surely = np.zeros(model.n_pairs, dtype=np.bool_)
    surely[decision[decision >= 0]] = True
    return GoalReach(goal, bound, decision, surely)


def greatest_goal_from(model: SSP, start: FloatArray) -> float:
    """Return the greatest goal probability from a start distribution, [states].

    The result keeps its digits if failure is rare.

    Raises:
        Stop: the time limit was reached before it was computed.
    """
    reached = float(expected(start, greatest_goal_reach(model, start=start, precise=False).goal))
    check_time()  # at a time limit it may not be the greatest
    if 1.0 - _RARE < reached < 1.0:
        return float(expected(start, greatest_goal_reach(model, start=start).goal))
    return reached


def extreme_goal_reach(model: SSP, aim: Aim, start: FloatArray) -> GoalReach:
    """Return the greatest or the least goal probability from a start distribution, [states].

    Args:
        model: the model.
        aim: ``GREATEST_GOAL``; any other aim stands for the least.
        start: only the results from states with positive entries are needed, [states].
    """
    if aim is Aim.GREATEST_GOAL:
        return greatest_goal_reach(model, start=start, precise=False)
    return least_goal_reach(model, start=start)


def least_goal_reach(
    model: SSP, survival: float = 1.0, start: FloatArray | None = None
) -> GoalReach:
    """Solve MINPROB: the least E[survival^T; goal] from every state; 0 at attention states.

    Equations are solved only for states that are no attention states but can reach one. The graph
    decides all others: a state that can reach no attention state has probability 1.
    """
    attention = graph.attention_states(model)
    bound_to = model.goal_mask
    if survival == 1.0:
        bound_to = ~graph.reaching_states(model, attention)
    quotient = build_quotient(model, ended=attention | bound_to)
    inside = bound_to & ~model.goal_mask
    surely = inside[model.pair_state]
    reach = _extreme_reach(quotient, bound_to, surely, survival, start, True, greatest=False)
    decision = np.where(attention & ~quotient.dead, GIVE_UP_CODE, reach.decision)
    return replace(reach, decision=np.where(inside, model.pair_offsets[:-1], decision))


def _extreme_reach(
    quotient: Quotient,
    hit_states: BoolArray,
    sure_pairs: BoolArray,
    survival: float,
    start: FloatArray | None,
    precise: bool,
    *,
    greatest: bool,
) -> GoalReach:
    """Compute the greatest or the least E[survival^T; hit] from every live state.

    T is the number of steps of a run, and ``hit`` the event that it ends in one of ``hit_states``.

    Args:
        quotient: the live states.
        hit_states: the end states that count, [states].
        sure_pairs: pairs that attain the optimum by the graph alone, [model pairs].
        survival: the discount, or 1.
        start: only the results from states with positive entries are needed, [states]; None: from
            all states.
        precise: whether all pairs that attain the optimum are needed.
        greatest: whether to maximise, rather than minimise.
    """
    model = quotient.model
    dynamics, escape = quotient.dynamics(survival, departing=survival == 1.0)
    hit = survival * quotient.at_pairs(successor_means(model, hit_states)) / escape
    missing = (quotient.node_of < 0) & ~hit_states
    miss = survival * quotient.at_pairs(successor_means(model, missing)) / escape
    if survival < 1.0:
        miss = miss + (1.0 - survival)
    begun = None if start is None else quotient.gather(start)
    reach = extreme_reach(dynamics, hit, miss, greatest=greatest, start=begun, precise=precise)
    return GoalReach(
        goal=np.where(hit_states, 1.0, quotient.lift(reach.reach)),
        bound=np.where(hit_states, 1.0, quotient.lift(reach.bound)),
        decision=quotient.pull_back(reach.choice),
        sure_pairs=sure_pairs,
        solved=(quotient, reach),
    )


def cheapest_reach(model: SSP, reach: GoalReach, survival: float = 1.0) -> ReachPolicy:
    """Return the policy of least E[cost; goal] among those with a given goal probability.

    A transition of cost g to x' is charged g * reach(x'), where reach(x') is the goal probability
    from x'. This counts the cost of successful runs only, and the minimisation is an ordinary
    problem without accumulated cost (paper, S3P; mathematics, section 4). Free end components are
    merged, since a policy must leave them.

    Args:
        model: the model.
        reach: the greatest or the least goal probability, with the pairs that attain it.
        survival: the discount, or 1; discounted steps after x' are part of reach(x').
    """
    early = np.where(model.goal_mask, 0.0, reach.goal / survival)
    weight = np.where(model.goal_mask, 1.0, survival * early)
    exits = reach.decision == GIVE_UP_CODE
    free = costless_pairs(model, weight) & ~exits[model.pair_state] if survival == 1.0 else None
    usable = reach.usable & ~exits[model.pair_state]
    hopeless = graph.hopeless_states(model)
    if model.failure_label is not None:  # ways to the goal may have been excluded after failing
        hopeless = hopeless | (reach.goal == 0.0) & ~exits
    quotient = build_quotient(model, usable=usable, free=free, exits=exits, ended=hopeless)
    dynamics, escape = quotient.dynamics(survival, departing=survival == 1.0)
    gain = quotient.at_pairs(successor_means(model, model.goal_mask)) / escape
    pair_cost = quotient.at_pairs(cost_means(model, weight)) / escape
    leaving = nearer_pairs(dynamics.graph, (quotient.pair_at == GIVE_UP_CODE) | (gain > 0))
    missing = successor_means(model, (quotient.node_of < 0) & ~model.goal_mask)
    miss = (1.0 - survival) + survival * quotient.at_pairs(missing, 1.0) / escape
    rewards, only_cost = np.stack([pair_cost, gain, miss], axis=1), np.array([1.0, 0.0, 0.0])
    settled = iterate_policy(dynamics, rewards, only_cost, leaving)
    bound = dual_bound(dynamics, pair_cost, settled.totals[:, 0], choice=settled.choice).rounded
    early_goal = np.clip(quotient.lift(settled.totals[:, 1]), 0.0, 1.0)
    surely = reach.goal == 1.0  # decided by the graph
    values = TailValues(
        goal=np.where(surely, 1.0, survival * early_goal),
        failure=_failing_to_reach(model, surely, quotient.node_of, settled.totals[:, 2]),
        early=np.where(surely & ~model.goal_mask, 1.0, early_goal),
        cost=quotient.lift(settled.totals[:, 0]),
        moment=np.zeros(model.n_states),
    )
    return ReachPolicy(quotient.pull_back(settled.choice), values, quotient.lift(bound))


def _failing_to_reach(
    model: SSP, sure_states: BoolArray, node_of: IntArray, miss_probability: FloatArray
) -> FloatArray:
    """Return the probability of not reaching the goal, [states]; 1 for states without a node.

    Args:
        model: the model.
        sure_pairs: states from which the goal is reached surely, [states].
        node_of: the node of each live state, negative elsewhere, [states].
        miss_probability: probability of not reaching the goal, [nodes].
    """
    failure = np.where(model.goal_mask | sure_states, 0.0, 1.0)
    solved = ((node_of >= 0) & ~model.goal_mask).nonzero()[0]
    failure[solved] = np.clip(miss_probability[node_of[solved]], 0.0, 1.0)
    return failure


def goal_directed(model: SSP, survival: float = 1.0) -> ReachPolicy:
    """Return a policy each of whose steps comes nearer to the goal with positive probability.

    Distance is the least number of steps. The policy reaches the goal with positive probability
    wherever this is possible. Nothing is optimised, so the bound of its cost is 0.
    """
    decision, _ = graph.goal_approach(model)
    live = (decision >= 0).nonzero()[0]
    node_of = np.full(model.n_states, -1, dtype=np.int32)
    node_of[live] = np.arange(live.size)
    taken, exact = decision[live].astype(np.int32), survival == 1.0
    home = node_of[live] if exact else None
    rows = live_rows(RowChoice(model, node_of, live.size, taken, home), survival)
    chain, escape = System(rows.matrix, rows.exits), rows.escape
    hit = successor_means(model, model.goal_mask)[taken] / escape
    missing = successor_means(model, (node_of < 0) & ~model.goal_mask)[taken]
    miss = (1.0 - survival) + survival * missing / escape
    solved = chain.solve(np.stack([hit, miss], axis=1))
    early = np.zeros(model.n_states)
    early[live] = solved[:, 0]
    goal = np.where(model.goal_mask, 1.0, survival * early)
    cost = np.zeros(model.n_states)
    cost[live] = chain.solve(cost_means(model, goal)[taken] / escape)
    nothing = np.zeros(model.n_states)
    failure = _failing_to_reach(model, model.goal_mask, node_of, solved[:, 1])
    values = TailValues(goal, failure, early, cost, moment=nothing)
    return ReachPolicy(np.where(decision >= 0, decision, UNDECIDED), values, nothing)


def max_goal_probability(model: SSP) -> FloatArray:
    """Return the greatest probability of reaching the goal from each state, [states].

    This is MAXPROB (Kolobov et al. 2011; paper, section 2.3), solved by policy iteration from a
    policy that reaches the goal wherever possible.
    """
    return read_only(greatest_goal_reach(model).goal)


def min_goal_probability(model: SSP) -> FloatArray:
    """Return the least probability of reaching the goal from each state, [states].

    This is MINPROB (paper, section 2.3); it is exactly 0 at the attention states, by the graph.
    """
    return read_only(least_goal_reach(model).goal)
