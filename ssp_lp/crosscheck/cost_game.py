"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, least_integer_type
from ssp_lp.bellman import (
    ChosenRows,
    PairCost,
    backup_rounding,
    best_pairs,
    chosen_product,
    safe_minima,
)
from ssp_lp.crosscheck.iteration import Discounted, Iterated, iterate_values
from ssp_lp.crosscheck.reply import Reply
from ssp_lp.crosscheck.tail import Tail, worst_tail
from ssp_lp.engines.oracles.window import Window
from ssp_lp.errors import ModelError
from ssp_lp.linear import accumulate
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.process.accumulated_cost import AccumulatedCost

_MOST_ENTRIES = 200_000_000
"""Largest table of decisions, nodes x layers."""

_FIRST_LAYERS = 16
_INNER_ACCURACY = 1e-14


@dataclass(frozen=True, eq=False)
class LayeredStrategy:
    """A decision for each (layer, node), followed by pi'_or from the cap on."""

    choice: IntArray  # [cap, nodes] position among the pairs of the node


@dataclass(frozen=True, eq=False)
class CostPlayer:
    """Best replies in Pi_{M, pi'_or}, by the operator T_alpha; M grows until nothing is lost."""

    base: AccumulatedCost

    @cached_property
    def tail(self) -> Tail:
        """What follows beyond M."""
        return worst_tail(self.base)

    def reply(self, objective_weight: float, condition_weight: float, accuracy: float) -> Reply:
        """A policy of (state, accumulated cost) of least weighted cost.

        M is first put where failing at attention states has become optimal, ``w_o r = w_d``, as
        far as that is near; then it grows by half until the bound that holds for every policy
        comes within the accuracy.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        cap, sweeps = self._first_cap(weights), 0
        while True:
            reply = self._reply(weights, cap)
            sweeps += reply.sweeps
            pays = reply.payoff(objective_weight, condition_weight)
            if pays - reply.bound <= accuracy * pays:
                return Reply(reply.objective, reply.condition, reply.bound, reply.strategy, sweeps)
            cap += max(cap // 2, self.base.width)
            if cap * self.base.n_nodes > _MOST_ENTRIES:
                raise ModelError(
                    f"{cap:,} layers of accumulated cost on {self.base.n_nodes:,} states are too "
                    "many for the game; round the costs to a coarser grid"
                )

    def policy(self, reply: Reply) -> CostAwarePolicy:
        """The reply's policy on the model's states, with the cost paid as its memory."""
        strategy: LayeredStrategy = reply.strategy
        base, skeleton = self.base, self.base.skeleton
        model, first = skeleton.model, skeleton.model.pair_offsets[:-1]
        pairs = [skeleton.pull_back(base.pair_offsets[:-1] + row) for row in strategy.choice]
        return CostAwarePolicy(
            model=model,
            unit=base.unit,
            decision=np.stack([np.where(p < 0, p, p - first) for p in pairs]),
            tails=self.tail.decision[None, :],
            tail_threshold=np.full(model.n_states, -np.inf),
        )

    def _first_cap(self, weights: FloatArray) -> int:
        """Layers after which it is best to fail where that can be done for sure, if they are few.

        Otherwise as many as the least failing policies may need, to be doubled soon.
        """
        base, cap = self.base, _FIRST_LAYERS * self.base.width
        if weights[0] == 0.0:
            return cap
        lossless = base.survival * weights[1] / (weights[0] * base.unit)
        return int(np.ceil(lossless)) + 1 if lossless <= 8 * cap else cap

    def _reply(self, weights: FloatArray, cap: int) -> Reply:
        """The best reply in Pi_{M, pi'_or} at M = cap layers, and a bound for every policy."""
        base = self.base
        paid = np.arange(cap, cap + base.width - 1, dtype=np.float64) * base.unit
        measured, bounds = Window(self.tail.attained(paid)), Window(self.tail.bound(paid, weights))
        totals, lowest = np.zeros((base.n_nodes, 2)), np.zeros(base.n_nodes)
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((cap, base.n_nodes), dtype=least_integer_type(most))
        for layer in reversed(range(cap)):
            costs = self._costs(layer)
            chosen = self._best(costs @ weights, measured.flat @ weights)
            totals = self._measured(costs, chosen, measured.flat)
            lowest = self._lowest(costs @ weights, bounds.flat)
            choice[layer] = chosen - base.pair_offsets[:-1]
            measured.push(totals)
            bounds.push(lowest)
        failed = np.array([0.0, base.start_failure])
        objective, condition = (base.start @ totals + failed).tolist()
        bound = float(base.start @ lowest + failed @ weights)
        return Reply(objective, condition, bound, LayeredStrategy(choice), 2 * cap)

    def _costs(self, layer: int) -> FloatArray:
        """E[G_o] and E[G_{d,gamma}] of each pair at an accumulated cost, [pairs, 2]."""
        base = self.base
        objective = base.gain * (layer * base.unit) + base.gain_cost
        return np.stack([objective, base.failure], axis=1)

    def _best(self, pair_cost: FloatArray, ahead: FloatArray) -> IntArray:
        """The pairs of least value in a layer, given the values of later layers, [nodes]."""
        base = self.base
        if base.instant.nnz == 0:
            return best_pairs(base.pair_offsets, base.later, pair_cost, ahead).choice
        return self._within(pair_cost + base.later @ ahead).choice

    def _within(self, onward: FloatArray) -> Iterated:
        """Value iteration within a layer, whose free steps may form cycles."""
        base = self.base
        process = Discounted(base.pair_offsets, base.instant, onward[:, None], base.survival)
        watched = np.full(base.n_nodes, 1.0 / base.n_nodes)
        return iterate_values(process, np.ones(1), watched, accuracy=_INNER_ACCURACY)

    def _measured(self, costs: FloatArray, chosen: IntArray, ahead: FloatArray) -> FloatArray:
        """(J_obj, J_cond) from each node of a layer under its chosen pairs, [nodes, 2]."""
        totals = costs[chosen] + chosen_product(self.base.later, chosen, ahead)
        if self.base.instant.nnz == 0:
            return totals
        return accumulate(ChosenRows(self.base.instant, chosen), totals)

    def _lowest(self, pair_cost: FloatArray, ahead: FloatArray) -> FloatArray:
        """Lower bounds of every policy's value in a layer, rounding counted, [nodes]."""
        base = self.base
        if base.instant.nnz == 0:
            cost = PairCost(pair_cost)
            return safe_minima(base.pair_offsets, base.later, cost, pair_cost, pair_cost, ahead)
        onward = (pair_cost + base.later @ ahead) * (1.0 - backup_rounding(base.later))
        return self._within(onward).values
