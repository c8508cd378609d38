"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    backup_rounding,
    best_pairs,
    chosen_product,
    safe_minima,
)
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse, Discounted, improved_response
from ssp_lp.game.tail import Tail, outer_tail
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.totals.ladder import Ladder
from ssp_lp.processes.totals.levels import Levels, Window
from ssp_lp.processes.totals.step_sums import MOST_SUMS, step_lattice, sums_in

_MOST_ENTRIES = 200_000_000
"""Largest table of decisions, nodes x layers."""

_MOST_LAYERS = 500_000
_FIRST_LAYERS = 16
_LAYER_ROUNDING = 16.0 * MACHINE_EPSILON
"""Relative rounding of a bound, per layer of the sweep: more layers cannot undo it."""

_SAME_LAYER = 1e-9  # of a unit: the rounding of a total, far below a step

_RARE = 1e-3
"""Greatest success up to which J_cond is counted from 1; above it few digits are lost without."""

_STALLED = 1e-8
"""Relative distance below which one that more layers leave as it was is rounding."""


@dataclass(frozen=True, eq=False)
class LayeredStrategy:
    """A decision for each (layer, node), followed by a tail from the cap on."""

    choice: IntArray  # [layers, nodes] position among the pairs of the node
    threshold: FloatArray  # [nodes] total from which the tail is pi'_or
    levels: Levels  # the totals of the layers, and those beyond the cap
    cap: float  # M, in units


@dataclass(frozen=True, eq=False)
class CostPlayer:
    """Best responses below M, by the operator T_alpha; M grows until nothing is lost beyond it."""

    base: AccumulatedCost
    origin: float = 0.0  # from where J_cond is counted, see ``BestResponse``

    @classmethod
    def of(cls, base: AccumulatedCost) -> CostPlayer:
        """The player that counts J_cond so that neither success nor failure loses digits."""
        player = cls(base)
        greatest = float(base.start @ player.tail.greatest_goal) + base.start_goal
        return player if greatest > _RARE else cls(base, origin=1.0)

    @cached_property
    def tail(self) -> Tail:
        """What follows beyond M."""
        return outer_tail(self.base, self.origin)

    @property
    def dearest(self) -> float:
        """Units that M is moved by at least: what the dearest step costs, and a little more."""
        steps = step_lattice(self.base.quotient.model)[1]
        return float(steps[-1]) if self.base.by_steps else float(self.base.width)

    def levels(self, cap: float) -> Levels:
        """The totals below M, all that can occur, and those at which tails take over.

        Raises:
            ModelError: they are too many.
        """
        base, most = self.base, _MOST_ENTRIES // max(self.base.n_nodes, 1)
        most = min(most, _MOST_LAYERS)
        if not base.by_steps and cap <= most:
            return Levels.of_lattice(base.exact_unit, int(cap), base.width)
        model = base.quotient.model
        sums = sums_in(model, cap, min(most, MOST_SUMS)) if base.by_steps else None
        if sums is None:
            raise ModelError(
                f"the totals below {cap * base.unit:g} are too many for the game on "
                f"{base.n_nodes:,} states (unit {base.unit:g}): round the costs to a coarser grid"
            )
        return Levels.of_sums(Ladder(np.append(sums, cap), step_lattice(model)[1], complete=True))

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """A policy of (state, accumulated cost) of least weighted cost.

        M is first put where failing at attention states has become optimal, ``w_o r = w_d``, as
        far as that is near; then it grows until the bound that holds for every policy comes
        within the accuracy, or only rounding is left. What the cap costs falls geometrically, so
        two caps foretell a third.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        cap, sweeps, lost = self._first_cap(weights), 0, dict[float, float]()
        while True:
            response = self._response(weights, cap)
            layers = len(response.strategy.choice)
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            stalled = pays - response.bound > 0.9 * min(lost.values(), default=np.inf)
            lost[cap] = pays - response.bound
            size = response.size(objective_weight, condition_weight)
            wanted = max(accuracy, _LAYER_ROUNDING * layers) * size
            if lost[cap] <= wanted or (stalled and lost[cap] <= _STALLED * size):
                return replace(response, sweeps=sweeps)
            cap = self._whole(_larger_cost_cap(lost, wanted)) + self.dearest

    def _whole(self, cap: float) -> float:
        """A cap as a whole number of layers, where these are multiples of a unit."""
        return cap if self.base.by_steps else float(np.ceil(cap))

    def surplus(self, price: float, accuracy: float) -> float:
        """What every policy has at least of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Sure failure counts 0 here, so that a policy that is a little worse than it is not lost in
        the rounding of ``price``. The sign says whether ``J_obj / (1 - J_cond) >= price`` for all.
        """
        base, weights = self.base, np.array([1.0, price])
        levels: Levels = self.response(1.0, price, accuracy).strategy.levels
        bounds = Window(self.tail.surplus(levels.totals[levels.cap :], weights), levels)
        lowest = np.zeros(base.n_nodes)
        chosen: IntArray = base.pair_offsets[:-1]
        worth = price * base.survival * base.gain
        for paid in levels.totals[levels.cap - 1 :: -1].tolist():
            spent = self._costs(paid)[:, 0]
            lowest, chosen = self._lowest(spent - worth, spent + worth, bounds.flat, chosen)
            bounds.push(lowest)
        terms = np.append(base.start * lowest, -price * base.start_goal)
        return float(terms.sum() - len(terms) * MACHINE_EPSILON * np.abs(terms).sum())

    def policy(self, response: BestResponse) -> CostAwarePolicy:
        """The response's policy on the model's states, with the cost paid as its memory."""
        return cost_aware(self.base, self.tail, response.strategy)

    def _first_cap(self, weights: FloatArray) -> float:
        """Units after which it is best to fail where that can be done for sure, if they are few.

        Otherwise as many as the least failing policies may need, to be doubled soon.
        """
        base, cap = self.base, _FIRST_LAYERS * self.dearest
        if weights[0] == 0.0:
            return cap
        lossless = base.survival * weights[1] / (weights[0] * base.unit)
        once_more = self.dearest if base.by_steps else 1.0
        return self._whole(lossless) + once_more if lossless <= 8 * cap else cap

    def _response(self, weights: FloatArray, cap: float) -> BestResponse:
        """The best response that follows the tail from M = cap units on, and a bound for all."""
        base, levels = self.base, self.levels(cap)
        threshold = self.tail.threshold(weights) - _SAME_LAYER * base.unit
        measured = Window(self.tail.attained(levels.totals[levels.cap :], threshold), levels)
        totals = np.zeros((base.n_nodes, 2))
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((levels.cap, base.n_nodes), dtype=least_integer_type(most))
        chosen: IntArray = base.pair_offsets[:-1]
        for layer in reversed(range(levels.cap)):
            costs = self._costs(float(levels.totals[layer]))
            chosen, totals = self._best(costs, weights, measured.flat, chosen)
            choice[layer] = chosen - base.pair_offsets[:-1]
            measured.push(totals)
        settled = np.array([0.0, -base.start_goal if self.origin else base.start_failure])
        objective, failing = (base.start @ totals + settled).tolist()
        *_, lowest = self.lowest(weights, levels)
        bound = float(base.start @ lowest + settled @ weights)
        strategy = LayeredStrategy(choice, threshold, levels, cap)
        return BestResponse(objective, failing, bound, strategy, 2 * levels.cap, self.origin)

    def lowest(self, weights: FloatArray, levels: Levels) -> Iterator[FloatArray]:
        """Lower bounds of every policy's weighted cost, [nodes], from the last layer to the first.

        Args:
            weights: of J_obj and J_cond, [2].
            levels: the totals.
        """
        chosen = self.base.pair_offsets[:-1]
        ahead = Window(self.tail.bound(levels.totals[levels.cap :], weights), levels)
        for paid in levels.totals[levels.cap - 1 :: -1].tolist():
            costs = self._costs(paid)
            size = np.abs(costs) @ weights
            values, chosen = self._lowest(costs @ weights, size, ahead.flat, chosen)
            ahead.push(values)
            yield values

    def _costs(self, paid: float) -> FloatArray:
        """E[G_o] and E[G_{d,gamma}] of each pair at an accumulated cost, [pairs, 2].

        Counted from origin 1, J_cond is paid where the goal is reached.
        """
        base = self.base
        objective = base.gain * paid + base.gain_cost
        failing = -base.survival * base.gain if self.origin else base.failure
        return np.stack([objective, failing], axis=1)

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
        chosen, totals, _ = improved_response(
            self._layer(costs + base.later @ ahead), weights, later
        )
        return chosen, totals

    def _layer(self, onward: FloatArray) -> Discounted:
        """The free steps of a layer, with all that follows them among the costs."""
        base = self.base
        return Discounted(base.instant_dynamics, onward, base.survival)

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
        chosen, totals, _ = improved_response(self._layer(onward[:, None]), np.ones(1), guess)
        floor = min(float((onward / (1.0 - base.survival)).min(initial=0.0)), 0.0)
        values = sub_solution(base.instant_dynamics, onward, totals[:, 0], floor)
        return values, chosen


def _larger_cost_cap(lost: Mapping[float, float], wanted: float) -> float:
    """A cap at which as little is lost as is wanted, from 1.25 to 4 times the last one."""
    cap = max(lost)
    needed = 2.0 * cap
    smaller = max((c for c in lost if c < cap), default=cap)
    if lost[cap] < lost[smaller] and wanted > 0.0:
        rate = np.log(lost[smaller] / lost[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(lost[cap] / wanted) / rate
    return min(max(needed, 1.25 * cap), 4.0 * cap)


def cost_aware(base: AccumulatedCost, tail: Tail, strategy: LayeredStrategy) -> CostAwarePolicy:
    """Pull the cost player's choice for each (layer, node) back to the model, then a tail.

    Args:
        base: the process.
        tail: the two policies of which one is followed beyond the choice.
        strategy: the choice, and the total from which the tail is pi'_or.
    """
    quotient, model, choice = base.quotient, base.quotient.model, strategy.choice
    threshold = strategy.threshold / base.unit
    threshold = threshold if base.by_steps else np.ceil(threshold)
    known = np.append(strategy.levels.totals[: len(choice)], strategy.cap)
    live = np.flatnonzero(quotient.node_of >= 0)  # in the order of the nodes: none are merged
    pair = quotient.pair_at[base.pair_offsets[:-1] + choice]
    decision = np.full((len(choice), model.n_states), UNDECIDED, dtype=choice.dtype)
    decision[:, live] = np.where(pair < 0, pair, pair - model.pair_offsets[live])
    return CostAwarePolicy(
        model=model,
        unit=base.unit,
        decision=decision,
        tails=np.stack([quotient.pull_back(c) for c in tail.choice]),
        tail_threshold=quotient.lift(np.where(threshold <= strategy.cap, -np.inf, threshold)),
        levels=known if base.by_steps else None,
    )
