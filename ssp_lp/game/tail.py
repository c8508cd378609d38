"""What follows beyond the cap M of case S (paper, section 3.5.1), and bounds of what may."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.game.best_response import Discounted, Iterated, iterate_values
from ssp_lp.processes.expectations import cost_means
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost

_ACCURACY = 1e-13


@dataclass(frozen=True, eq=False)
class Tail:
    """Two stationary policies for what lies beyond M, and how much any policy may succeed.

    The paper follows pi'_or there, which fails most. Where failing is dear, M would have to be very
    large for that: there the policy that fails least is followed until as much has been paid that
    pi'_or is no worse.
    """

    choice: IntArray  # [2, nodes] pairs of the policy that fails least, and of pi'_or
    early: FloatArray  # [2, nodes] E[gamma^(T-1); goal]
    cost: FloatArray  # [2, nodes] E[gamma^(T-1) * cost; goal]
    failing: FloatArray  # [2, nodes] J_cond - origin, with J_cond = 1 - E[gamma^T; goal]
    least_goal: FloatArray  # [nodes] checked lower bound of E[gamma^T; goal]
    greatest_goal: FloatArray  # [nodes] checked upper bound of it
    survival: float  # gamma; 1 where J_obj is not discounted
    origin: float = 0.0  # 0 or 1, see ``BestResponse``

    def threshold(self, weights: FloatArray) -> FloatArray:
        """Accumulated cost from which pi'_or is no worse than the other, [nodes]."""
        saved = weights[0] * (self.early[0] - self.early[1])
        owed = weights[1] * (self.failing[1] - self.failing[0])
        owed += weights[0] * (self.cost[1] - self.cost[0])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            total = owed / saved
        return np.where(saved > 0.0, total, np.where(owed <= 0.0, -np.inf, np.inf))

    def attained(self, paid: FloatArray, threshold: FloatArray) -> FloatArray:
        """(J_obj, J_cond - origin) of going on where so much was paid, [totals, nodes, 2].

        Section 3.5.1 leaves the tail's J_obj undiscounted; under discounting it is discounted here
        like what comes before M, so that c-hat does not depend on M once M is large.
        """
        last = paid[:, None] >= threshold
        early, cost, failing = (
            np.where(last, v[1], v[0]) for v in (self.early, self.cost, self.failing)
        )
        return np.stack([paid[:, None] * early + cost, failing], axis=-1)

    def bound(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """Lower bound of every policy's weighted cost at these totals, [totals, nodes]."""
        return np.asarray(weights[1] * (1.0 - self.origin) + self.surplus(paid, weights))

    def surplus(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """The same, less the weighted cost of sure failure, [totals, nodes].

        Whoever succeeds pays at least what has been paid: ``w_o r E[gamma^(T-1); goal] - w_d
        E[gamma^T; goal]`` is linear in the success, which lies between two bounds.
        """
        per_success = weights[0] * paid[:, None] / self.survival - weights[1]
        goal = np.where(per_success < 0.0, self.greatest_goal, self.least_goal)
        return np.asarray(per_success * goal)


def outer_tail(base: AccumulatedCost, origin: float = 0.0) -> Tail:
    """Find the policies that fail least and most, by MAXPROB and MINPROB (paper, section 2.3).

    Both are value iterations on the discounted process without accumulated cost.

    Args:
        base: the process.
        origin: from which J_cond is counted, 0 or 1.
    """
    quotient, gamma = base.quotient, base.survival
    dynamics, _ = quotient.dynamics(gamma, departing=False)
    watched = np.full(base.n_nodes, 1.0 / max(base.n_nodes, 1))
    success = np.where(quotient.pair_at >= 0, gamma * base.gain, 0.0)

    def least(costs: FloatArray) -> Iterated:
        """The policy of least expected total of some costs, [pairs]."""
        process = Discounted(dynamics, costs[:, None], gamma)
        return iterate_values(process, np.ones(1), watched, accuracy=_ACCURACY)

    safest, riskiest = least(base.failure), least(success)
    both = np.stack([safest.choice, riskiest.choice])
    early, cost = _followed_tails(base, both, gamma)
    return Tail(
        choice=both,
        early=early,
        cost=cost,
        failing=(1.0 - origin) - gamma * early,
        least_goal=riskiest.values,
        greatest_goal=1.0 - safest.values,
        survival=gamma,
        origin=origin,
    )


def undiscounted_tail(base: AccumulatedCost, tail: Tail) -> Tail:
    """The same policies with their undiscounted J_obj; J_cond stays discounted (section 3.3).

    Whoever succeeds with weight E[gamma^T; goal] succeeds with at least that probability and pays
    for it undiscounted, so that the bounds of the weight serve here too.
    """
    goal, cost = _followed_tails(base, tail.choice, 1.0)
    return replace(tail, early=goal, cost=cost, survival=1.0)


def _followed_tails(
    base: AccumulatedCost, choices: IntArray, survival: float
) -> tuple[FloatArray, FloatArray]:
    """E[survival^(T-1); goal] and E[survival^(T-1) * cost; goal] of policies, [policies, nodes]."""
    quotient, (early, cost) = base.quotient, np.zeros((2, *choices.shape))
    dynamics, _ = quotient.dynamics(survival, departing=False)
    for k, choice in enumerate(choices):
        chain = dynamics.chain(choice)
        early[k] = chain.solve(base.gain[choice])
        weight = np.where(quotient.model.goal_mask, 1.0, survival * quotient.lift(early[k]))
        priced = quotient.at_pairs(cost_means(quotient.model, weight))
        cost[k] = chain.solve(priced[choice])
    return early, cost
