"""What follows beyond the cap M of case S: the policy pi'_or (paper, section 3.5.1), and bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.bellman import ChosenRows
from ssp_lp.crosscheck.iteration import Discounted, Iterated, iterate_values
from ssp_lp.linear import accumulate
from ssp_lp.process.accumulated_cost import AccumulatedCost
from ssp_lp.process.expectations import cost_means

_ACCURACY = 1e-13


@dataclass(frozen=True, eq=False)
class Tail:
    """pi'_or in Pi_{d,or}, which fails most, and how much any policy may succeed, per node."""

    choice: IntArray  # [nodes] pairs of pi'_or
    early: FloatArray  # [nodes] E[gamma^(T-1); goal] under pi'_or
    cost: FloatArray  # [nodes] E[gamma^(T-1) * cost; goal] under pi'_or
    condition: FloatArray  # [nodes] J_cond of it, 1 - E[gamma^T; goal]
    least_goal: FloatArray  # [nodes] checked lower bound of E[gamma^T; goal]
    greatest_goal: FloatArray  # [nodes] checked upper bound of it
    survival: float  # gamma, or 1 where J_obj is not discounted

    def attained(self, paid: FloatArray) -> FloatArray:
        """(J_obj, J_cond) of following pi'_or where so much has been paid, [..., nodes, 2].

        Section 3.5.1 leaves the tail's J_obj undiscounted; under discounting it is discounted here
        like what comes before M, so that c-hat does not depend on M once M is large.

        Args:
            paid: accumulated cost, [...].
        """
        objective = paid[..., None] * self.early + self.cost
        condition = np.broadcast_to(self.condition, objective.shape)
        return np.stack([objective, condition], axis=-1)

    def bound(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """Lower bound of every policy's weighted cost where so much has been paid, [..., nodes].

        Whoever succeeds pays at least what has been paid: ``w_o r E[gamma^(T-1); goal] + w_d (1 -
        E[gamma^T; goal])`` is linear in the success, which lies between two bounds.
        """
        per_success = weights[0] * paid[..., None] / self.survival - weights[1]
        goal = np.where(per_success < 0.0, self.greatest_goal, self.least_goal)
        return np.asarray(weights[1] + per_success * goal)


def worst_tail(base: AccumulatedCost) -> Tail:
    """Find pi'_or by MINPROB, and the greatest success by MAXPROB (paper, section 2.3).

    Both are value iterations on the discounted process without accumulated cost.
    """
    skeleton, gamma = base.skeleton, base.survival
    transitions = skeleton.transitions(gamma, departing=False)[0]
    watched = np.full(base.n_nodes, 1.0 / max(base.n_nodes, 1))
    success = np.where(skeleton.pair_at >= 0, gamma * base.gain, 0.0)

    def least(costs: FloatArray) -> Iterated:
        process = Discounted(skeleton.pair_offsets, transitions, costs[:, None], gamma)
        return iterate_values(process, np.ones(1), watched, accuracy=_ACCURACY)

    riskiest, safest = least(success), least(base.failure)
    early, cost = _success(base, transitions, riskiest.choice, gamma)
    return Tail(
        choice=riskiest.choice,
        early=early,
        cost=cost,
        condition=1.0 - gamma * early,
        least_goal=riskiest.values,
        greatest_goal=1.0 - safest.values,
        survival=gamma,
    )


def undiscounted(base: AccumulatedCost, tail: Tail) -> Tail:
    """The same policy with its undiscounted J_obj; J_cond stays discounted (section 3.3).

    Whoever succeeds with weight E[gamma^T; goal] succeeds with at least that probability and pays
    for it undiscounted, so that the bounds of the weight serve here too.
    """
    transitions = base.skeleton.transitions(1.0, departing=False)[0]
    goal, cost = _success(base, transitions, tail.choice, 1.0)
    return replace(tail, early=goal, cost=cost, survival=1.0)


def _success(
    base: AccumulatedCost, transitions: sp.csr_array, choice: IntArray, survival: float
) -> tuple[FloatArray, FloatArray]:
    """E[survival^(T-1); goal] and E[survival^(T-1) * cost; goal] of a policy, [nodes] each."""
    skeleton, chain = base.skeleton, ChosenRows(transitions, choice)
    early = accumulate(chain, base.gain[choice])
    weight = np.where(skeleton.model.goal_mask, 1.0, survival * skeleton.lift(early))
    cost = skeleton.at_pairs(cost_means(skeleton.model, weight))
    return early, accumulate(chain, cost[choice])
