"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type
from ssp_lp.bellman import (
    PairCost,
    backup_rounding,
    best_pairs,
    chosen_product,
    safe_minima,
)
from ssp_lp.crosscheck.iteration import Discounted, improved
from ssp_lp.crosscheck.reply import Reply
from ssp_lp.crosscheck.tail import Tail, outer_tail
from ssp_lp.engines.oracles.sub_solution import sub_solution
from ssp_lp.engines.oracles.window import Window
from ssp_lp.errors import ModelError
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.process.accumulated_cost import AccumulatedCost

_MOST_ENTRIES = 200_000_000
"""Largest table of decisions, nodes x layers."""

_FIRST_LAYERS = 16

_LAYER_ROUNDING = 16.0 * MACHINE_EPSILON
"""Relative rounding of a bound, per layer of the sweep: more layers cannot undo it."""

_STALLED = 1e-8
"""Relative distance below which one that more layers leave as it was is rounding."""


@dataclass(frozen=True, eq=False)
class LayeredStrategy:
    """A decision for each (layer, node), followed by a tail from the cap on."""

    choice: IntArray  # [cap, nodes] position among the pairs of the node
    threshold: FloatArray  # [nodes] layer from which the tail is pi'_or


@dataclass(frozen=True, eq=False)
class CostPlayer:
    """Best replies below M, by the operator T_alpha; M grows until nothing is lost beyond it."""

    base: AccumulatedCost

    @cached_property
    def tail(self) -> Tail:
        """What follows beyond M."""
        return outer_tail(self.base)

    def reply(self, objective_weight: float, condition_weight: float, accuracy: float) -> Reply:
        """A policy of (state, accumulated cost) of least weighted cost.

        M is first put where failing at attention states has become optimal, ``w_o r = w_d``, as
        far as that is near; then it grows by half until the bound that holds for every policy
        comes within the accuracy.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        cap, sweeps, last = self._first_cap(weights), 0, np.inf
        while True:
            reply = self._reply(weights, cap)
            sweeps += reply.sweeps
            pays = reply.payoff(objective_weight, condition_weight)
            lost = pays - reply.bound
            rounded = max(accuracy, _LAYER_ROUNDING * cap) * pays
            stalled = lost > 0.9 * last and lost <= _STALLED * pays
            last = lost
            if lost <= rounded or stalled:
                return Reply(reply.objective, reply.condition, reply.bound, reply.strategy, sweeps)
            cap += max(cap // 2, self.base.width)
            if cap * self.base.n_nodes > _MOST_ENTRIES:
                raise ModelError(
                    f"{cap:,} layers of accumulated cost on {self.base.n_nodes:,} states are too "
                    "many for the game; round the costs to a coarser grid"
                )

    def surplus(self, price: float, accuracy: float) -> float:
        """What every policy has at least of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Sure failure counts 0 here, so that a policy that is a little worse than it is not lost in
        the rounding of ``price``. The sign says whether ``J_obj / (1 - J_cond) >= price`` for all.
        """
        base, weights = self.base, np.array([1.0, price])
        cap = len(self.reply(1.0, price, accuracy).strategy.choice)
        paid = np.arange(cap, cap + base.width - 1, dtype=np.float64) * base.unit
        bounds, lowest = Window(self.tail.surplus(paid, weights)), np.zeros(base.n_nodes)
        chosen: IntArray = base.pair_offsets[:-1]
        worth = price * base.survival * base.gain
        for layer in reversed(range(cap)):
            spent = self._costs(layer)[:, 0]
            lowest, chosen = self._lowest(spent - worth, spent + worth, bounds.flat, chosen)
            bounds.push(lowest)
        terms = np.append(base.start * lowest, -price * base.start_goal)
        return float(terms.sum() - len(terms) * MACHINE_EPSILON * np.abs(terms).sum())

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
            tails=self.tail.decisions,
            tail_threshold=skeleton.lift(strategy.threshold),
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
        """The best reply that follows the tail from M = cap layers on, and a bound for all."""
        base = self.base
        layers = np.arange(cap, cap + base.width - 1)
        threshold = self.tail.threshold(weights, base.unit)
        measured = Window(self.tail.attained(layers, threshold, base.unit))
        paid = layers.astype(np.float64) * base.unit
        bounds = Window(self.tail.bound(paid, weights))
        totals, lowest = np.zeros((base.n_nodes, 2)), np.zeros(base.n_nodes)
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((cap, base.n_nodes), dtype=least_integer_type(most))
        chosen: IntArray = base.pair_offsets[:-1]
        for layer in reversed(range(cap)):
            costs = self._costs(layer)
            chosen, totals = self._best(costs, weights, measured.flat, chosen)
            priced = costs @ weights
            lowest, _ = self._lowest(priced, priced, bounds.flat, chosen)
            choice[layer] = chosen - base.pair_offsets[:-1]
            measured.push(totals)
            bounds.push(lowest)
        failed = np.array([0.0, base.start_failure])
        threshold = np.where(threshold <= cap, -np.inf, threshold)
        objective, condition = (base.start @ totals + failed).tolist()
        bound = float(base.start @ lowest + failed @ weights)
        return Reply(objective, condition, bound, LayeredStrategy(choice, threshold), 2 * cap)

    def _costs(self, layer: int) -> FloatArray:
        """E[G_o] and E[G_{d,gamma}] of each pair at an accumulated cost, [pairs, 2]."""
        base = self.base
        objective = base.gain * (layer * base.unit) + base.gain_cost
        return np.stack([objective, base.failure], axis=1)

    def _best(
        self, costs: FloatArray, weights: FloatArray, ahead: FloatArray, later: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """The pairs of least value in a layer and (J_obj, J_cond) under them, [nodes, 2].

        Free steps may form cycles within the layer: there the choice of the layer after it is
        improved until it is the best.
        """
        base = self.base
        if base.instant.nnz == 0:
            onward = costs @ weights
            chosen = best_pairs(base.pair_offsets, base.later, onward, ahead @ weights).choice
            return chosen, costs[chosen] + chosen_product(base.later, chosen, ahead)
        chosen, totals, _ = improved(self._layer(costs + base.later @ ahead), weights, later)
        return chosen, totals

    def _layer(self, onward: FloatArray) -> Discounted:
        """The free steps of a layer, with all that follows them among the costs."""
        base = self.base
        return Discounted(base.pair_offsets, base.instant, onward, base.survival)

    def _lowest(
        self, pair_cost: FloatArray, size: FloatArray, ahead: FloatArray, guess: IntArray
    ) -> tuple[FloatArray, IntArray]:
        """Lower bounds of every policy's value in a layer, rounding counted, and pairs, [nodes].

        Args:
            pair_cost: [pairs].
            size: of its parts, none of them negative, [pairs].
            ahead: bounds in later layers.
            guess: near-optimal pairs, [nodes].
        """
        base = self.base
        if base.instant.nnz == 0:
            cost, exact = PairCost(pair_cost), np.zeros_like(size)
            return safe_minima(base.pair_offsets, base.later, cost, size, exact, ahead), guess
        size = size + base.later @ np.abs(ahead)
        onward = pair_cost + base.later @ ahead - backup_rounding(base.later) * size
        chosen, totals, _ = improved(self._layer(onward[:, None]), np.ones(1), guess)
        floor = min(float((onward / (1.0 - base.survival)).min(initial=0.0)), 0.0)
        values = sub_solution(base.pair_offsets, base.instant, onward, totals[:, 0], floor)
        return values, chosen
