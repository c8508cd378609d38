"""The accumulated-cost process cut at a cap M, with the tail policies that take over there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.process.accumulated_cost import AccumulatedCost


@dataclass(frozen=True, eq=False)
class Tails:
    """Stationary policies for accumulated costs beyond the cap, as values per node.

    Row 0 goes for the goal, where ``exact`` with the least failure; the last row fails most (the
    paper's pi'_or).
    """

    decisions: IntArray  # [tails, states]
    goal: FloatArray  # [tails, nodes] E[gamma^T; goal]
    early: FloatArray  # [tails, nodes] E[gamma^(T - 1); goal]
    cost: FloatArray  # [tails, nodes] E[gamma^(T - 1) * cost; goal]
    greatest_goal: FloatArray  # [nodes] checked upper bound of E[gamma^T; goal]
    least_goal: FloatArray  # [nodes] checked lower bound of it
    exact: bool = True  # whether row 0 and the upper bound are those of the least failure

    def threshold(self, unit: float, failure_price: float) -> FloatArray:
        """Layer from which the last tail is no worse than the first at this price, [nodes].

        The value of tail k at accumulated cost r is price * (1 - goal_k) + r * early_k + cost_k.
        """
        saved = self.early[0] - self.early[-1]
        owed = failure_price * (self.goal[0] - self.goal[-1]) + self.cost[-1] - self.cost[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            layer = np.ceil(owed / (saved * unit) - 1e-9)
        return np.where(saved > 0, layer, np.where(owed < 0, -np.inf, np.inf))


@dataclass(frozen=True, eq=False)
class LayeredProcess:
    """States (node, layer) for layers below ``cap``; beyond it a policy follows a tail for good."""

    base: AccumulatedCost
    cap: int
    tails: Tails

    def threshold(self, price: float) -> FloatArray:
        """Layer from which the last tail is followed at a price of failure, [nodes].

        -infinity where it is followed from the cap on, so that equal rules compare equal.
        """
        layer = self.tails.threshold(self.base.unit, price)
        return np.where(layer <= self.cap, -np.inf, layer)

    def beyond(self, price: float) -> tuple[FloatArray, FloatArray]:
        """(cost, goal) of the tails chosen by a price at (node, cap + i), 2 x [i, nodes]."""
        layer = self.cap + np.arange(self.base.width - 1)[:, None]
        last = layer >= self.threshold(price)[None, :]
        tails = self.tails
        early = np.where(last, tails.early[-1], tails.early[0])
        cost = np.where(last, tails.cost[-1], tails.cost[0])
        goal = np.where(last, tails.goal[-1], tails.goal[0])
        return cost + layer * self.base.unit * early, goal

    def beyond_bound(self, failure_price: float, failing: float) -> FloatArray:
        """Lower bound of every policy's value at (node, cap + i), [width - 1, nodes].

        Every success pays at least the r that has been paid: r * early + price * (1 - goal) with
        early = goal / gamma (DESIGN, section 5: r + (kappa - r) F). It is exact where it is best
        to fail and possible.

        Args:
            failure_price: kappa.
            failing: what failing counts: kappa, or 0 with -kappa for success.
        """
        layer = self.cap + np.arange(self.base.width - 1)[:, None]
        paid = layer * self.base.unit / self.base.survival
        goal = np.where(paid < failure_price, self.tails.greatest_goal, self.tails.least_goal)
        rest = failing * (1.0 - goal) - (failure_price - failing) * goal
        size = np.where(goal == 0, 0.0, (paid + failure_price) * MACHINE_EPSILON)
        return np.asarray(rest + paid * goal - 8.0 * size)

    def policy(self, choice: IntArray, tail_price: float) -> CostAwarePolicy:
        """Pull a choice back to the model.

        Args:
            choice: position among the pairs of its node, [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        skeleton, model = self.base.skeleton, self.base.skeleton.model
        threshold = np.full(model.n_states, np.inf)
        live = skeleton.node_of >= 0
        threshold[live] = self.threshold(tail_price)[skeleton.node_of[live]]
        most = int(np.diff(model.pair_offsets).max(initial=1))
        decision = np.empty((self.cap, model.n_states), dtype=least_integer_type(most))
        for layer in range(self.cap):
            pair = skeleton.pull_back(self.base.pair_offsets[:-1] + choice[layer])
            decision[layer] = np.where(pair < 0, pair, pair - model.pair_offsets[:-1])
        return CostAwarePolicy(
            model=model,
            unit=self.base.unit,
            decision=decision,
            tails=self.tails.decisions,
            tail_threshold=threshold,
        )
