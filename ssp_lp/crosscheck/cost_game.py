"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from ssp_lp.policies.policy import UNDECIDED
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
        far as that is near; then it grows until the bound that holds for every policy comes
        within the accuracy. What the cap costs falls geometrically, so two caps foretell a third.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        cap, sweeps, gaps = self._first_cap(weights), 0, dict[int, float]()
        while True:
            reply = self._reply(weights, cap)
            sweeps += reply.sweeps
            pays = reply.payoff(objective_weight, condition_weight)
            gaps[cap] = pays - reply.bound
            if gaps[cap] <= accuracy * pays:
                return replace(reply, sweeps=sweeps)
            cap = _larger_cap(gaps, accuracy * pays) + self.base.width
            if cap * self.base.n_nodes > _MOST_ENTRIES:
                raise ModelError(
                    f"{cap:,} layers of accumulated cost on {self.base.n_nodes:,} states are too "
                    "many for the game; round the costs to a coarser grid"
                )

    def policies(self, replies: Sequence[Reply]) -> tuple[CostAwarePolicy, ...]:
        """The replies' policies on the model's states; they remember the cost paid."""
        strategies: list[LayeredStrategy] = [r.strategy for r in replies]
        cap = max(len(s.choice) for s in strategies)
        return tuple(cost_aware(self.base, self.tail, s.choice, cap) for s in strategies)

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
        base, chosen = self.base, None
        measured, totals = (
            Window(self.tail.attained(self._beyond(cap))),
            np.zeros((base.n_nodes, 2)),
        )
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((cap, base.n_nodes), dtype=least_integer_type(most))
        for layer in reversed(range(cap)):
            costs = self._costs(layer)
            chosen = self._best(costs @ weights, measured.flat @ weights, chosen)
            totals = self._measured(costs, chosen, measured.flat)
            choice[layer] = chosen - base.pair_offsets[:-1]
            measured.push(totals)
        failed = np.array([0.0, base.start_failure])
        objective, condition = (base.start @ totals + failed).tolist()
        bound = float(base.start @ self.lowest(weights, cap)[0] + failed @ weights)
        return Reply(objective, condition, bound, LayeredStrategy(choice), 2 * cap)

    def lowest(self, weights: FloatArray, cap: int) -> FloatArray:
        """Lower bounds of every policy's weighted cost below the cap, [cap, nodes].

        Args:
            weights: of J_obj and J_cond, [2].
            cap: layers.
        """
        values, best = np.empty((cap, self.base.n_nodes)), None
        ahead = Window(self.tail.bound(self._beyond(cap), weights))
        for layer in reversed(range(cap)):
            values[layer], best = self._lowest(self._costs(layer) @ weights, ahead.flat, best)
            ahead.push(values[layer])
        return values

    def _beyond(self, cap: int) -> FloatArray:
        """Accumulated cost in the layers beyond the cap that a step can reach, [width - 1]."""
        return np.arange(cap, cap + self.base.width - 1, dtype=np.float64) * self.base.unit

    def _costs(self, layer: int) -> FloatArray:
        """E[G_o] and E[G_{d,gamma}] of each pair at an accumulated cost, [pairs, 2]."""
        base = self.base
        objective = base.gain * (layer * base.unit) + base.gain_cost
        return np.stack([objective, base.failure], axis=1)

    def _best(self, pair_cost: FloatArray, ahead: FloatArray, guess: IntArray | None) -> IntArray:
        """The pairs of least value in a layer, given the values of later layers, [nodes]."""
        base = self.base
        if base.instant.nnz == 0:
            return best_pairs(base.pair_offsets, base.later, pair_cost, ahead).choice
        return self._within(pair_cost + base.later @ ahead, guess).choice

    def _within(self, onward: FloatArray, guess: IntArray | None) -> Iterated:
        """Value iteration within a layer, whose free steps may form cycles.

        Args:
            onward: cost of each pair with all that follows it in later layers, [pairs].
            guess: the best pairs of the layer after this one, [nodes].
        """
        base = self.base
        process = Discounted(base.pair_offsets, base.instant, onward[:, None], base.survival)
        watched = np.full(base.n_nodes, 1.0 / base.n_nodes)
        return iterate_values(process, np.ones(1), watched, guess, accuracy=_INNER_ACCURACY)

    def _measured(self, costs: FloatArray, chosen: IntArray, ahead: FloatArray) -> FloatArray:
        """(J_obj, J_cond) from each node of a layer under its chosen pairs, [nodes, 2]."""
        totals = costs[chosen] + chosen_product(self.base.later, chosen, ahead)
        if self.base.instant.nnz == 0:
            return totals
        return accumulate(ChosenRows(self.base.instant, chosen), totals)

    def _lowest(
        self, pair_cost: FloatArray, ahead: FloatArray, guess: IntArray | None
    ) -> tuple[FloatArray, IntArray | None]:
        """Lower bounds of every policy's value in a layer, rounding counted, and their pairs."""
        base = self.base
        if base.instant.nnz == 0:
            cost = PairCost(pair_cost)
            safe = safe_minima(base.pair_offsets, base.later, cost, pair_cost, pair_cost, ahead)
            return safe, None
        onward = (pair_cost + base.later @ ahead) * (1.0 - backup_rounding(base.later))
        found = self._within(onward, guess)
        return found.values, found.choice


def _larger_cap(gaps: Mapping[int, float], wanted: float) -> int:
    """A cap at which the gap should be as small as wanted, from 1.25 to 4 times the last one."""
    cap = max(gaps)
    needed = 2.0 * cap
    smaller = max((c for c in gaps if c < cap), default=cap)
    if gaps[cap] < gaps[smaller] and wanted > 0.0:
        rate = np.log(gaps[smaller] / gaps[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(gaps[cap] / wanted) / rate
    return int(np.ceil(min(max(needed, 1.25 * cap), 4.0 * cap)))


def cost_aware(base: AccumulatedCost, tail: Tail, choice: IntArray, cap: int) -> CostAwarePolicy:
    """Pull a choice for each (layer, node) back to the model, followed by pi'_or.

    Args:
        base: the process.
        tail: pi'_or.
        choice: position among the pairs of the node, [layers, nodes].
        cap: layers of the policy's table; those beyond the choice follow pi'_or.
    """
    skeleton, model = base.skeleton, base.skeleton.model
    live = np.flatnonzero(skeleton.node_of >= 0)  # in the order of the nodes: none are merged
    chosen = np.broadcast_to(tail.choice, (cap, base.n_nodes)).copy()
    chosen[: len(choice)] = base.pair_offsets[:-1] + choice
    pair = skeleton.pair_at[chosen]
    decision = np.full((cap, model.n_states), UNDECIDED, dtype=choice.dtype)
    decision[:, live] = np.where(pair < 0, pair, pair - model.pair_offsets[live])
    return CostAwarePolicy(
        model=model,
        unit=base.unit,
        decision=decision,
        tails=skeleton.pull_back(tail.choice)[None, :],
        tail_threshold=np.full(model.n_states, -np.inf),
    )
