"""Bayes-adaptive value iteration of case S (paper, section 3.3): the unapproximated game.

States are (node, accumulated cost) as in section 3.1.1 and the belief makes time a third
coordinate, as in case M. J_obj is the undiscounted E[total cost; goal].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess, LayeredTails
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.accumulated_cost.totals import Totals
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse
from ssp_lp.game.cost_player import CostPlayer, followed_tails, lower_bounds
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.remembering import TimedPolicy

_FIRST_HORIZON = 32
_SLOW = 0.9  # of the gap: a longer horizon that leaves more of it is not what was missing
_MOST_ENTRIES = 100_000_000
"""Largest table of decisions, nodes x layers x time."""

_SMALLEST_ERROR = 1e-13  # relative, of a sum of many products


@dataclass(frozen=True, eq=False)
class _TimedLayers:
    """A decision for each (time, layer, node), followed by pi'_or beyond cap and horizon."""

    choice: IntArray  # [horizon, layers, nodes] position among the pairs of the node
    totals: Totals  # of the layers


@dataclass(frozen=True, eq=False)
class BayesCostPlayer:
    """Best responses among all policies, by backward induction over time and accumulated cost."""

    base: AccumulatedCost

    @cached_property
    def tails(self) -> LayeredTails:
        """pi'_or, which is followed for good beyond cap and horizon, and bounds of all policies.

        J_obj is undiscounted, while J_cond stays discounted (section 3.3).
        """
        tails, worst = self.stationary.tails, self.stationary.tail_pairs[1:]
        goal, cost = followed_tails(self.base, worst, 1.0)
        values = TailValues(*(each[1:] for each in tails.values))._replace(early=goal, cost=cost)
        return replace(tails, decisions=tails.decisions[1:], values=values)

    def _surplus(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """Lower bound of every policy's weighted cost less that of sure failure, [totals, nodes].

        Whoever succeeds with weight E[gamma^T; goal] succeeds with at least that probability, and
        pays for it what has been paid, undiscounted: linear in the success, which lies between two
        bounds.
        """
        per_success = weights[0] * paid[:, None] - weights[1]
        tails = self.tails
        goal = np.where(per_success < 0.0, tails.greatest_goal, tails.least_goal)
        return np.asarray(per_success * goal)

    @cached_property
    def stationary(self) -> CostPlayer:
        """The player of section 3.5.1, whose game is a lower bound of this one."""
        return CostPlayer(self.base)

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """A policy of (time, state, accumulated cost) of least weighted cost.

        The cap is the stationary player's. The horizon is doubled until the bound meets what the
        policy pays; where that no longer helps, so is the cap.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        first = self.stationary.response(objective_weight, condition_weight, accuracy)
        cap, horizon, sweeps, gap = first.strategy.process.end, _FIRST_HORIZON, first.sweeps, np.inf
        while True:
            response = self._response(weights, cap, horizon)
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            before, gap = gap, pays - response.bound
            if gap <= max(accuracy, _SMALLEST_ERROR) * pays:
                return replace(response, sweeps=sweeps)
            horizon *= 2
            cap *= 2 if gap > _SLOW * before else 1

    def surplus(self, price: float, accuracy: float) -> float:
        """What every policy has at least of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Sure failure counts exactly 0 here: rounding is counted where something is summed.
        """
        base, gamma = self.base, self.base.survival
        strategy: _TimedLayers = self.response(1.0, price, accuracy).strategy
        horizon, totals = len(strategy.choice), strategy.totals
        stage, worth = self._stage(totals), price * gamma * base.gain[:, None]
        weights, beyond_cap = np.array([1.0, price]), totals.beyond
        lowest = self._surplus(totals.with_beyond, weights * [1.0, gamma**horizon]).T
        for time in reversed(range(horizon)):
            saved = gamma**time * worth
            size = stage + saved + self._ahead(np.abs(lowest), totals)
            below = self._least(stage - saved + self._ahead(lowest, totals) - self._lost * size)[1]
            beyond = self._surplus(beyond_cap, weights * [1.0, gamma**time])
            lowest = np.hstack([below, beyond.T])
        terms = np.append(base.start * lowest[:, 0], -price * base.start_goal)
        return float(terms.sum() - len(terms) * MACHINE_EPSILON * np.abs(terms).sum())

    def policy(self, response: BestResponse) -> TimedPolicy:
        """The response's policy on the model's states; it remembers the time and the cost paid.

        Successive stages that decide alike are one object.
        """
        strategy: _TimedLayers = response.strategy
        worst = self.stationary.tail_pairs[1] - self.base.pair_offsets[:-1]
        after = np.broadcast_to(worst, strategy.choice.shape[1:])
        rows = [*strategy.choice, after.astype(strategy.choice.dtype)]
        stages: list[CostAwarePolicy] = []
        for time, choice in enumerate(rows):
            if time == 0 or not np.array_equal(choice, rows[time - 1]):
                stage = LayeredProcess(self.base, strategy.totals, self.tails).policy(choice, 0.0)
            stages.append(stage)
        return TimedPolicy(tuple(stages))

    @property
    def _lost(self) -> float:
        """Relative rounding of one backup."""
        longest = int(np.diff(self.base.steps.indptr).max(initial=0)) + self.base.width
        return (longest + 4) * MACHINE_EPSILON

    def _stage(self, totals: Totals) -> FloatArray:
        """E[G_o] of each pair in each layer, [pairs, layers]."""
        paid = totals.values[:-1]
        return np.asarray(self.base.gain[:, None] * paid + self.base.gain_cost[:, None])

    @cached_property
    def _blocks(self) -> list[sp.csr_array]:
        """Real probabilities of the steps that lead 0, 1, ... layers ahead, each [pairs, nodes]."""
        base, n = self.base, self.base.n_nodes
        steps = sp.csc_array(base.steps / base.survival)
        return [sp.csr_array(steps[:, k * n : (k + 1) * n]) for k in range(base.width)]

    def _ahead(self, values: FloatArray, totals: Totals) -> FloatArray:
        """E[value after the step] of each pair in each layer below the cap, [pairs, layers].

        Args:
            values: [nodes, totals].
            totals: the totals, and which step leads where.
        """
        leads = totals.reached
        parts = (b @ values[:, leads[:, k]] for k, b in enumerate(self._blocks) if b.nnz)
        return np.asarray(sum(parts, np.zeros((len(self.base.gain), totals.size))))

    def _response(self, weights: FloatArray, m: float, horizon: int) -> BestResponse:
        """Backward induction from the horizon, where pi'_or takes over for good.

        Args:
            weights: of J_obj and J_cond, [2].
            m: the cap M, in units.
            horizon: steps.
        """
        base, gamma, totals = self.base, self.base.survival, self.stationary.totals(m)
        cap, every = totals.size, totals.with_beyond
        if cap * horizon * base.n_nodes > _MOST_ENTRIES:
            raise ModelError(
                f"{horizon:,} steps x {cap:,} layers of accumulated cost on {base.n_nodes:,} "
                "states are too many for the Bayes-adaptive iteration"
            )
        last = self.tails.first
        objective = np.asarray((every[:, None] * last.early + last.cost).T)
        condition = np.repeat(last.failure[:, None], len(every), axis=1)
        beyond = objective[:, cap:], condition[:, cap:]
        lowest = self._beyond(totals, weights * [1.0, gamma**horizon])
        stage = self._stage(totals)
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((horizon, cap, base.n_nodes), dtype=least_integer_type(most))
        for time in reversed(range(horizon)):
            now = weights * [1.0, gamma**time]
            priced = now[0] * stage + now[1] * base.failure[:, None]
            best, below = self._least(priced + self._ahead(lowest, totals))
            choice[time] = (best - base.pair_offsets[:-1, None]).T
            on_objective = np.take_along_axis(stage + self._ahead(objective, totals), best, 0)
            on_condition = np.take_along_axis(
                base.failure[:, None] + gamma * self._ahead(condition, totals), best, 0
            )
            objective = np.hstack([on_objective, beyond[0]])
            condition = np.hstack([on_condition, beyond[1]])
            lowest = np.hstack([below, now[1] + self._surplus(every[cap:], now).T])
        start, failed = base.start, base.start_failure  # rounding of sums counts against the bound
        bound = float(start @ lowest[:, 0] + weights[1] * failed)
        return BestResponse(
            objective=float(start @ objective[:, 0]),
            failing=float(start @ condition[:, 0] + failed),
            bound=bound * (1.0 - (horizon + 1) * self._lost),
            strategy=_TimedLayers(choice, totals),
            sweeps=horizon * cap,
        )

    def _beyond(self, totals: Totals, weights: FloatArray) -> FloatArray:
        """Lower bound of every policy's weighted cost from the horizon on, [nodes, totals].

        Discounting the objective too can only lower it, so the stationary game bounds this one.

        Args:
            totals: the totals.
            weights: with that of J_cond as it has faded by then.
        """
        bound, cap = weights[1] + self._surplus(totals.with_beyond, weights), totals.size
        if weights[0] > 0.0:
            process = LayeredProcess(self.base, totals, self.stationary.tails)
            price = float(weights[1] / weights[0])
            below = weights[0] * lower_bounds(Sweep(process), price, price)[1]
            bound[:cap] = np.maximum(bound[:cap], below)
        return np.asarray(bound.T)

    def _least(self, priced: FloatArray) -> tuple[IntArray, FloatArray]:
        """The first best pair of each (node, layer) and its value, [nodes, cap] each."""
        first = self.base.pair_offsets[:-1]
        least = np.minimum.reduceat(priced, first, axis=0)
        attains = priced == np.repeat(least, np.diff(self.base.pair_offsets), axis=0)
        number = np.where(attains, np.arange(len(priced))[:, None], len(priced))
        return np.minimum.reduceat(number, first, axis=0), least
