"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.accumulated_cost.process import AccumulatedCost
from ssp_lp.accumulated_cost.totals import MOST_SUMS, Totals, Window, step_costs, sums_in
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
from ssp_lp.game.best_response import (
    BestResponse,
    Discounted,
    Iterated,
    improved_response,
    iterate_values,
)
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.expectations import cost_means

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
    totals: Totals  # of the layers, and those beyond the cap
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
        steps = step_costs(self.base.quotient.model)[1]
        return float(steps[-1]) if self.base.by_steps else float(self.base.width)

    def totals(self, cap: float) -> Totals:
        """The totals below M, all that can occur, and those at which tails take over.

        Raises:
            ModelError: they are too many.
        """
        base, most = self.base, _MOST_ENTRIES // max(self.base.n_nodes, 1)
        most = min(most, _MOST_LAYERS)
        if not base.by_steps and cap <= most:
            return base.totals(int(cap))
        model = base.quotient.model
        sums = sums_in(model, cap, min(most, MOST_SUMS)) if base.by_steps else None
        if sums is None:
            raise ModelError(
                f"the totals below {cap * base.unit:g} are too many for the game on "
                f"{base.n_nodes:,} states (unit {base.unit:g}): round the costs to a coarser grid"
            )
        return Totals(np.append(sums, cap), step_costs(model)[1], complete=True)

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
        totals: Totals = self.response(1.0, price, accuracy).strategy.totals
        bounds = Window(self.tail.surplus(totals.beyond, weights), totals)
        lowest = np.zeros(base.n_nodes)
        chosen: IntArray = base.pair_offsets[:-1]
        worth = price * base.survival * base.gain
        for paid in totals.values[-2::-1].tolist():
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
        base, totals = self.base, self.totals(cap)
        threshold = self.tail.threshold(weights) - _SAME_LAYER * base.unit
        measured = Window(self.tail.attained(totals.beyond, threshold), totals)
        attained = np.zeros((base.n_nodes, 2))
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((totals.size, base.n_nodes), dtype=least_integer_type(most))
        chosen: IntArray = base.pair_offsets[:-1]
        for layer in reversed(range(totals.size)):
            costs = self._costs(float(totals.values[layer]))
            chosen, attained = self._best(costs, weights, measured.flat, chosen)
            choice[layer] = chosen - base.pair_offsets[:-1]
            measured.push(attained)
        settled = np.array([0.0, -base.start_goal if self.origin else base.start_failure])
        objective, failing = (base.start @ attained + settled).tolist()
        *_, lowest = self.lowest(weights, totals)
        bound = float(base.start @ lowest + settled @ weights)
        strategy = LayeredStrategy(choice, threshold, totals, cap)
        return BestResponse(objective, failing, bound, strategy, 2 * totals.size, self.origin)

    def lowest(self, weights: FloatArray, totals: Totals) -> Iterator[FloatArray]:
        """Lower bounds of every policy's weighted cost, [nodes], from the last layer to the first.

        Args:
            weights: of J_obj and J_cond, [2].
            totals: the totals.
        """
        chosen = self.base.pair_offsets[:-1]
        ahead = Window(self.tail.bound(totals.beyond, weights), totals)
        for paid in totals.values[-2::-1].tolist():
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
    known = np.append(strategy.totals.values[: len(choice)], strategy.cap)
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
