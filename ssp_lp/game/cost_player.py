"""The player of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess, LayeredTails
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.accumulated_cost.totals import MOST_SUMS, Totals, step_costs, sums_in
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse, Discounted, iterate_values
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.processes.expectations import cost_means

_MOST_ENTRIES = 200_000_000
"""Largest table of decisions, nodes x layers."""

_MOST_LAYERS = 500_000
_FIRST_LAYERS = 16

_LAYER_ROUNDING = 16.0 * MACHINE_EPSILON
"""Relative rounding of a bound, per layer of the sweep: more layers cannot undo it."""

_RARE = 1e-3
"""Greatest success up to which J_cond is counted from 1; above it few digits are lost without."""

_STALLED = 1e-8
"""Relative distance below which one that more layers leave as it was is rounding."""

_ACCURACY = 1e-13  # relative, of the tails' values
_DEAREST = 1e100  # a price of J_cond at which nothing else counts


@dataclass(frozen=True, eq=False)
class LayeredStrategy:
    """A decision for each (layer, node), followed from the cap on by the tails of a price."""

    process: LayeredProcess
    choice: IntArray  # [layers, nodes] position among the pairs of the node
    price: float  # J_cond's weight in units of J_obj's


@dataclass(frozen=True, eq=False)
class CostPlayer:
    """Best responses below M, by the operator T_alpha; M grows until nothing is lost beyond it."""

    base: AccumulatedCost
    origin: float = 0.0  # from where J_cond is counted, see ``BestResponse``

    @classmethod
    def of(cls, base: AccumulatedCost) -> CostPlayer:
        """The player that counts J_cond so that neither success nor failure loses digits."""
        player = cls(base)
        greatest = float(base.start @ player.tails.greatest_goal) + base.start_goal
        return player if greatest > _RARE else cls(base, origin=1.0)

    @property
    def tails(self) -> LayeredTails:
        """What follows beyond M: the policies that fail least and most (see ``outer_tails``)."""
        return self._outer_tails[1]

    @property
    def tail_pairs(self) -> IntArray:
        """The pairs that they take, [2, nodes]."""
        return self._outer_tails[0]

    @cached_property
    def _outer_tails(self) -> tuple[IntArray, LayeredTails]:
        """Both, worked out once."""
        return outer_tails(self.base)

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
        best: LayeredStrategy = self.response(1.0, price, accuracy).strategy
        return float(lower_bounds(Sweep(best.process), price, 0.0)[0][0])

    def policy(self, response: BestResponse) -> CostAwarePolicy:
        """The response's policy on the model's states, with the cost paid as its memory."""
        strategy: LayeredStrategy = response.strategy
        return strategy.process.policy(strategy.choice, strategy.price)

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
        """The best response that follows the tail from M = cap units on, and a bound for all.

        Where J_obj does not count, the policy that fails least is best whatever has been paid.
        """
        base, process = self.base, LayeredProcess(self.base, self.totals(cap), self.tails)
        settled = -base.start_goal if self.origin else base.start_failure
        sweep, price = Sweep(process), _DEAREST
        choice = sweep.room_for_choice()
        if weights[0] == 0.0:
            choice[:] = self.tail_pairs[0] - base.pair_offsets[:-1]
            first = self.tails.first
            measures = np.stack([first.cost, first.failure, first.goal])
            objective, failure, goal = (measures @ base.start).tolist()
            least = lower_bounds(sweep, price, 0.0 if self.origin else price)[0][0] / price
            bound = weights[1] * least  # the sweep leads to digits that the tails' bounds lack
        else:
            price = float(weights[1] / weights[0])
            failing = 0.0 if self.origin else price
            objective, failure, goal = sweep.minimise(price, failing, choice).tolist()
            bound = weights[0] * lower_bounds(sweep, price, failing)[0][0]
            bound = max(bound, -weights[1] * self.origin)  # J_obj is never negative
        failed = settled - goal if self.origin else settled + failure
        strategy = LayeredStrategy(process, choice, price)
        return BestResponse(objective, failed, float(bound), strategy, 2 * process.cap, self.origin)


def lower_bounds(sweep: Sweep, price: float, failing: float) -> tuple[FloatArray, FloatArray]:
    """Lower bounds of what every policy has of J_obj and, at a price, of J_cond.

    Args:
        sweep: over the process cut at M.
        price: of J_cond.
        failing: the price, or 0 where J_cond is counted from 1.

    Returns:
        If a run began in each layer, [layers]; and of each state, [layers, nodes].
    """
    process = sweep.process
    anything = np.broadcast_to(np.inf, (process.cap, process.base.n_nodes))
    return sweep.bound(price, failing, anything, process.beyond_bound(price, failing))


def _larger_cost_cap(lost: Mapping[float, float], wanted: float) -> float:
    """A cap at which as little is lost as is wanted, from 1.25 to 4 times the last one."""
    cap = max(lost)
    needed = 2.0 * cap
    smaller = max((c for c in lost if c < cap), default=cap)
    if lost[cap] < lost[smaller] and wanted > 0.0:
        rate = np.log(lost[smaller] / lost[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(lost[cap] / wanted) / rate
    return min(max(needed, 1.25 * cap), 4.0 * cap)


def outer_tails(base: AccumulatedCost) -> tuple[IntArray, LayeredTails]:
    """The policies that fail least and most, by MAXPROB and MINPROB (paper, section 2.3).

    Both are value iterations on the discounted process without accumulated cost. The paper follows
    pi'_or, which fails most, beyond M. Where failing is dear, M would have to be very large for
    that: there the policy that fails least is followed until as much has been paid that pi'_or is
    no worse. Section 3.5.1 leaves the tail's J_obj undiscounted; it is discounted here like what
    comes before M, so that c-hat does not depend on M once M is large.

    Args:
        base: the process.

    Returns:
        The pairs of both, [2, nodes], and what they attain, with bounds of every policy.
    """
    quotient, gamma = base.quotient, base.survival
    dynamics, _ = quotient.dynamics(gamma, departing=False)
    watched = np.full(base.n_nodes, 1.0 / max(base.n_nodes, 1))
    success = np.where(quotient.pair_at >= 0, gamma * base.gain, 0.0)
    safest, riskiest = (
        iterate_values(
            Discounted(dynamics, costs[:, None], gamma), np.ones(1), watched, accuracy=_ACCURACY
        )
        for costs in (base.failure, success)
    )
    both = np.stack([safest.choice, riskiest.choice])
    early, cost = followed_tails(base, both, gamma)
    tails = LayeredTails(
        decisions=np.stack([quotient.pull_back(choice) for choice in both]),
        values=TailValues(gamma * early, 1.0 - gamma * early, early, cost, np.zeros_like(cost)),
        greatest_goal=1.0 - safest.values,
        least_goal=riskiest.values,
    )
    return both, tails


def followed_tails(
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
