"""Exponential utility of the total cost: the optimal tail, and the cost horizon.

The worth of a stationary policy after paying r is ``exp(rate * r) * E[exp(rate * C); goal] + bonus
* Pr(goal)``: the utility factors. As r grows the first term vanishes, so that from a finite cost on
the optimal policy maximises the goal probability first and the exponential moment second (Freire,
Delgado and Reis, ICAPS 2019: the cost horizon C_max of eGUBS).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.arrays import FAILURE_FLOOR, BoolArray, FloatArray, segment_sums
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.model import SSP
from ssp_lp.model.graph import nearer_pairs
from ssp_lp.processes.goal_reach import GoalReach, ReachPolicy
from ssp_lp.processes.live_rows import costless_pairs, successor_means
from ssp_lp.processes.quotient import Quotient, build_quotient

_ONE = np.ones(1)


def greatest_moment(model: SSP, rate: float, usable: BoolArray | None) -> ReachPolicy:
    """Maximise the moment E[exp(rate * C); goal] over the policies that use only some pairs.

    A step multiplies the moment that follows it by exp(rate * cost). The moment is therefore the
    probability of reaching the goal in a process whose transition probabilities are scaled by this
    factor. End components of cost 0 are collapsed to single nodes, and policies must leave them.

    Args:
        model: the model.
        rate: negative.
        usable: pairs that may be used, such as those of greatest goal probability, [model pairs];
            None: all.
    """
    quotient = build_quotient(model, usable=usable, free=costless_pairs(model))
    shrinking = _tilted_process(quotient, rate)
    gain = quotient.at_pairs(_tilted_arrivals(model, rate))
    hit = quotient.at_pairs(successor_means(model, model.goal_mask))
    plain, _ = quotient.dynamics(1.0, departing=False)
    first = nearer_pairs(plain.graph, hit > 0)
    settled = iterate_policy(shrinking, gain[:, None], -_ONE, first)
    moment = settled.totals[:, 0]
    bound = -sub_solution(shrinking, -gain, -moment, floor=-1.0 - 1e-9)
    reached = plain.chain(settled.choice).solve(hit[settled.choice])
    goal, moment, bound = (
        np.where(model.goal_mask, 1.0, quotient.lift(each)) for each in (reached, moment, bound)
    )
    values = TailValues(goal, 1.0 - goal, goal, cost=np.zeros_like(goal), moment=moment)
    return ReachPolicy(quotient.pull_back(settled.choice), values, bound)


def pairs_keeping_goal(model: SSP, greatest: GoalReach) -> BoolArray:
    """Return a mask of the pairs that preserve the greatest goal probability, [pairs].

    Pairs with a relative loss of at most ``FAILURE_FLOOR`` are included, since such a pair may be
    optimal at any accumulated cost that is computed. A tail that uses such pairs loses a little;
    this loss is part of the gap between its value and the bound.
    """
    floor = FAILURE_FLOOR * greatest.goal[model.pair_state]
    return greatest.usable | (_lost_goal(model, greatest) <= floor)


def _lost_goal(model: SSP, greatest: GoalReach) -> FloatArray:
    """Return the goal probability that is lost by taking each pair once, [pairs].

    All decisions after the pair attain the greatest goal probability.
    """
    here = greatest.goal[model.pair_state]
    return np.asarray(here - successor_means(model, greatest.goal))


def cost_horizon(
    model: SSP, greatest: GoalReach, tail: ReachPolicy, rate: float, bonus: float
) -> float:
    """Return C_max of eGUBS: the accumulated cost from which a tail is optimal.

    In state s after cost r the tail is optimal if every pair (s, a) satisfies bonus * (P(s) -
    Q_P(s, a)) >= exp(rate * r) * (Q_V(s, a) - V(s)). Here P is the greatest goal probability, V the
    moment of the tail, and Q_P and Q_V are their values if a is taken once. Pairs that (nearly)
    preserve P satisfy this at every r, since V is optimal. All other pairs satisfy it from some r
    on.

    Args:
        model: the model.
        greatest: greatest goal probabilities and the pairs that attain them.
        tail: the policy of greatest moment among policies of such pairs.
        rate: negative.
        bonus: positive.

    Returns:
        The cost; 0 if the tail is optimal from the start.
    """
    losing = ~pairs_keeping_goal(model, greatest) & ~model.goal_mask[model.pair_state]
    lost = _lost_goal(model, greatest)
    ahead = _tilted_arrivals(model, rate, np.where(model.goal_mask, 1.0, tail.values.moment))
    gained = ahead - tail.values.moment[model.pair_state]
    tempting = losing & (gained > 0.0)
    if not tempting.any():
        return 0.0
    lost = lost[tempting] / 2.0  # a larger horizon, so that rounding does not matter
    share = bonus * lost / gained[tempting]
    with np.errstate(divide="ignore"):
        return float(max(np.log(share).min() / rate, 0.0))


def _tilted_arrivals(model: SSP, rate: float, values: FloatArray | None = None) -> FloatArray:
    """Return E[exp(rate * cost) * value of the successor] of each pair, [pairs]."""
    worth = model.goal_mask.astype(np.float64) if values is None else values
    terms = model.probabilities * np.exp(rate * model.costs) * worth[model.successors]
    return segment_sums(terms, model.outcome_offsets)


def _tilted_process(quotient: Quotient, rate: float) -> Dynamics:
    """Return the dynamics with transitions weighted by exp(rate * stage cost)."""
    model = quotient.model
    node = quotient.node_of[model.successors]
    live = node >= 0
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    weight = model.probabilities * np.exp(rate * model.costs)
    every = sp.csr_array(
        (weight[live], (pair[live], node[live])), shape=(model.n_pairs, quotient.n_nodes)
    )
    lost = np.where(live, -np.expm1(rate * model.costs), 1.0) * model.probabilities
    exits = quotient.at_pairs(segment_sums(lost, model.outcome_offsets))
    return Dynamics(quotient.pair_offsets, sp.csr_array(every[quotient.pair_at]), exits)
