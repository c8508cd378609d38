"""The players of case S: backward over the accumulated cost up to M (paper, section 3.5.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess, LayeredTails
from ssp_lp.accumulated_cost.sweep import Sweep, at_price
from ssp_lp.accumulated_cost.totals import MOST_SUMS, Totals, step_costs, sums_in
from ssp_lp.arrays import (
    MACHINE_EPSILON,
    SAME_TOTAL,
    FloatArray,
    IntArray,
    least_integer_type,
)
from ssp_lp.compiled.deadline import backward
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse, Discounted, iterate_values
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.processes.goal_reach import least_goal_reach
from ssp_lp.processes.live_rows import cost_means

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
_SETTLED = 1e-10  # accuracy at which it is settled how many layers a value function has
_ROUNDED = 8.0 * MACHINE_EPSILON  # relative, of what a tail is worth
_DEAREST = 1e100  # a price of J_cond at which nothing else counts

_FIRST_HORIZON = 32
_SLOW = 0.9  # of the gap: a longer horizon that leaves more of it is not what was missing
_MOST_TIMED_ENTRIES = 100_000_000
"""Largest table of decisions, nodes x layers x time."""

_SMALLEST_ERROR = 1e-13  # relative, of a sum of many products


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
        """The cost player that counts J_cond so that neither success nor failure loses digits."""
        player = cls(base)
        greatest = float(base.start @ player.tails.greatest_goal) + base.start_goal
        return player if greatest > _RARE else cls(base, origin=1.0)

    @property
    def tails(self) -> LayeredTails:
        """What follows beyond M: the policies that fail least and most."""
        return self.outer_tails[1]

    @cached_property
    def outer_tails(self) -> tuple[IntArray, LayeredTails]:
        """The pairs that these take, [2, nodes], and what they attain (see ``outer_tails``)."""
        return outer_tails(self.base)

    @property
    def dearest(self) -> float:
        """Units by which the cost player moves M at least: the dearest step's and a little more."""
        steps = step_costs(self.base.quotient.model)[1]
        return float(steps[-1]) if self.base.by_steps else float(self.base.width)

    def totals(self, cap: float) -> Totals:
        """Totals of the cost player below M, and those at which tails take over.

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
        """The cost player's best response: a policy of (state, accumulated cost).

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
        """A cap M of the cost player as a whole number of layers, if a unit makes them."""
        return cap if self.base.by_steps else float(np.ceil(cap))

    def surplus(self, price: float, accuracy: float) -> float:
        """The cost player's lower bound of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Sure failure counts 0 here, so that a policy that is a little worse than it is not lost in
        the rounding of ``price``. The sign says whether ``J_obj / (1 - J_cond) >= price`` for all.
        """
        best: LayeredStrategy = self.response(1.0, price, accuracy).strategy
        return float(lower_bounds(best.process, price, 0.0)[0][0])

    def value_function(self, price: float) -> FloatArray:
        """Infinite values of the cost player, to ask ``certify`` for the best by so many layers.

        Returns:
            [layers, nodes]; [1] where costs have no common unit.
        """
        if self.base.by_steps:
            return np.array([np.inf])
        return np.broadcast_to(np.inf, self.value_shape([self.response(1.0, price, _SETTLED)]))

    def value_shape(self, responses: Sequence[BestResponse]) -> tuple[int, ...]:
        """Shape of the cost player's value function: as many layers as responses had."""
        return max(response.strategy.choice.shape for response in responses)

    def policy(self, response: BestResponse) -> CostAwarePolicy:
        """The cost player's response on the model's states, with the cost paid as its memory."""
        strategy: LayeredStrategy = response.strategy
        return strategy.process.policy(strategy.choice, strategy.price)

    def _first_cap(self, weights: FloatArray) -> float:
        """Units after which the cost player best fails, where it surely can, if they are few.

        Otherwise as many as the least failing policies may need, to be doubled soon.
        """
        base, cap = self.base, _FIRST_LAYERS * self.dearest
        if weights[0] == 0.0:
            return cap
        lossless = base.survival * weights[1] / (weights[0] * base.unit)
        once_more = self.dearest if base.by_steps else 1.0
        return self._whole(lossless) + once_more if lossless <= 8 * cap else cap

    def _response(self, weights: FloatArray, cap: float) -> BestResponse:
        """The cost player's best response with a tail from M = cap units on; a bound for all.

        Where J_obj does not count, the policy that fails least is best whatever has been paid.
        """
        base, process = self.base, LayeredProcess(self.base, self.totals(cap), self.tails)
        settled = -base.start_goal if self.origin else base.start_failure
        sweep, price = Sweep.of_ends(process), _DEAREST
        choice = sweep.room_for_choice()
        if weights[0] == 0.0:
            choice[:] = self.outer_tails[0][0] - base.pair_offsets[:-1]
            first = self.tails.first
            measures = np.stack([first.cost, first.failure, first.goal])
            objective, failure, goal = (measures @ base.start).tolist()
            least = lower_bounds(process, price, 0.0 if self.origin else price)[0][0] / price
            bound = weights[1] * least  # the sweep leads to digits that the tails' bounds lack
        else:
            price = float(weights[1] / weights[0])
            failing = 0.0 if self.origin else price
            objective, failure, goal = sweep.minimise(
                at_price(process, price, failing), choice
            ).tolist()
            bound = weights[0] * lower_bounds(process, price, failing)[0][0]
            bound = max(bound, -weights[1] * self.origin)  # J_obj is never negative
        failed = settled - goal if self.origin else settled + failure
        strategy = LayeredStrategy(process, choice, price)
        return BestResponse(objective, failed, float(bound), strategy, 2 * process.cap, self.origin)


@dataclass(frozen=True, eq=False)
class CappedCostPlayer:
    """Best responses within Pi_{M,pi'_or}: once M has been paid pi'_or is followed (section 3.5.1).

    J_obj is discounted below M only, J_cond everywhere: V of the paper as it is printed. A bound is
    one for the policies of this class.
    """

    base: AccumulatedCost
    cap: float  # M, in units of cost

    @cached_property
    def process(self) -> LayeredProcess:
        """Totals below M, and pi'_or from there on.

        Raises:
            ModelError: the totals are too many.
        """
        stationary, units = CostPlayer(self.base), self.cap / self.base.unit
        units = units if self.base.by_steps else float(np.ceil(units * (1.0 - SAME_TOTAL)))
        return LayeredProcess(self.base, stationary.totals(units), undiscounted_tail(stationary)[1])

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """The capped cost player's best response, by one sweep: its own bound but for rounding."""
        base, process, sweep = self.base, self.process, Sweep.of_ends(self.process)
        choice, only_failing = sweep.room_for_choice(), objective_weight == 0.0
        price = _DEAREST if only_failing else condition_weight / objective_weight
        objective, failure, _ = sweep.minimise(at_price(process, price, price), choice).tolist()
        scale = condition_weight / price if only_failing else objective_weight
        bound = scale * self._least(price, price)
        strategy = LayeredStrategy(process, choice, price)
        failing = failure + base.start_failure
        return BestResponse(objective, failing, bound, strategy, 2 * process.cap)

    def surplus(self, price: float, accuracy: float) -> float:
        """The capped cost player's lower bound of ``J_obj - price * (1 - J_cond)``."""
        return self._least(price, 0.0)

    def _least(self, price: float, failing: float) -> float:
        """Lower bound of the class at the start, rounding counted; ``failing`` as in a sweep."""
        process, base = self.process, self.base
        anything = np.broadcast_to(np.inf, (process.cap, base.n_nodes))
        charge, failure, goal = process.beyond(price)
        size = charge + failing * failure + (price - failing) * goal
        beyond = process.beyond_value(price, failing) - _ROUNDED * size
        priced = at_price(process, price, failing, bounds=True)._replace(beyond=beyond)
        return float(Sweep.of_ends(process).bound(priced, anything)[0][0])

    def policy(self, response: BestResponse) -> CostAwarePolicy:
        """The capped cost player's response on the model's states, with the cost paid as memory."""
        strategy: LayeredStrategy = response.strategy
        return strategy.process.policy(strategy.choice, strategy.price)


def undiscounted_tail(stationary: CostPlayer) -> tuple[IntArray, LayeredTails]:
    """The tail pi'_or of section 3.5.1, which is of Pi_{d,or}: undiscounted MINPROB (section 2.3).

    It gives up at attention states; of pairs that reach the goal with equal probability it takes
    the one stated first. J_obj is undiscounted, J_cond discounted.

    Args:
        stationary: the cost player, whose bounds hold for the tail too.

    Returns:
        Its pair at each node, [nodes], and what it attains.
    """
    base, tails = stationary.base, stationary.tails
    quotient, giving_up = base.quotient, np.full(base.n_nodes, -1, dtype=np.int32)
    giving_up[quotient.pair_node[quotient.gives_up]] = quotient.gives_up.nonzero()[0]
    placed = quotient.placed(least_goal_reach(quotient.model).decision)
    pairs = np.where(placed >= 0, placed, giving_up)
    (early, _), (goal, cost) = (
        followed_tails(base, pairs[None], survival) for survival in (base.survival, 1.0)
    )
    saved = base.survival * early
    values = TailValues(saved, 1.0 - saved, goal, cost, np.zeros_like(cost))
    return pairs, replace(tails, decisions=quotient.pull_back(pairs)[None], values=values)


def lower_bounds(
    process: LayeredProcess, price: float, failing: float
) -> tuple[FloatArray, FloatArray]:
    """The cost player's lower bounds of every policy's J_obj and, at a price, J_cond.

    Args:
        process: cut at M.
        price: of J_cond.
        failing: the price, or 0 where J_cond is counted from 1.

    Returns:
        If a run began in each layer, [layers]; and of each state, [layers, nodes].
    """
    anything = np.broadcast_to(np.inf, (process.cap, process.base.n_nodes))
    return Sweep.of_ends(process).bound(at_price(process, price, failing, bounds=True), anything)


def _larger_cost_cap(lost: Mapping[float, float], wanted: float) -> float:
    """A larger cap M for the cost player, 1.25 to 4 times the last, to lose as little as wanted."""
    cap = max(lost)
    needed = 2.0 * cap
    smaller = max((c for c in lost if c < cap), default=cap)
    if lost[cap] < lost[smaller] and wanted > 0.0:
        rate = np.log(lost[smaller] / lost[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(lost[cap] / wanted) / rate
    return min(max(needed, 1.25 * cap), 4.0 * cap)


def outer_tails(base: AccumulatedCost) -> tuple[IntArray, LayeredTails]:
    """The cost player's tails that fail least and most, MAXPROB and MINPROB (section 2.3).

    Both are value iterations on the discounted process without accumulated cost. The paper follows
    pi'_or, which fails most, beyond M. Where failing is dear, M would have to be very large for
    that: there the policy that fails least is followed until as much has been paid that failing
    most is no worse. The paper leaves pi'_or and J_obj undiscounted there (``undiscounted_tail``);
    both are discounted here as before M, so that c-hat does not depend on M once M is large.

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
    """Goal and cost E[survival^(T-1) * ...; goal] of the cost player's tails, [policies, nodes]."""
    quotient, (early, cost) = base.quotient, np.zeros((2, *choices.shape))
    dynamics, _ = quotient.dynamics(survival, departing=False)
    for k, choice in enumerate(choices):
        chain = dynamics.chain(choice)
        early[k] = chain.solve(base.gain[choice])
        weight = np.where(quotient.model.goal_mask, 1.0, survival * quotient.lift(early[k]))
        priced = quotient.at_pairs(cost_means(quotient.model, weight))
        cost[k] = chain.solve(priced[choice])
    return early, cost


@dataclass(frozen=True, eq=False)
class _TimedLayers:
    """A decision for each (time, layer, node), followed by pi'_or beyond cap and horizon."""

    choice: IntArray  # [horizon, layers, nodes] position among the pairs of the node
    totals: Totals  # of the layers


@dataclass(frozen=True, eq=False)
class BayesCostPlayer:
    """Best responses among all policies, by backward induction over time and accumulated cost.

    States are (node, accumulated cost) as in section 3.1.1 of the paper and the belief makes time a
    third coordinate, as in case M. J_obj is the undiscounted E[total cost; goal].
    """

    base: AccumulatedCost

    @cached_property
    def outer_tail(self) -> tuple[IntArray, LayeredTails]:
        """The pairs of the policy that fails most under the discount, [nodes], and what it attains.

        J_obj is undiscounted, while J_cond stays discounted (section 3.3). Where M and the horizon
        are not given, undiscounted MINPROB (``undiscounted_tail``) would need much greater ones.
        """
        pairs, tails = self.stationary.outer_tails
        goal, cost = followed_tails(self.base, pairs[1:], 1.0)
        values = TailValues(*(each[1:] for each in tails.values))._replace(early=goal, cost=cost)
        return pairs[1], replace(tails, decisions=tails.decisions[1:], values=values)

    @property
    def tails(self) -> LayeredTails:
        """The Bayesian cost player's tail pi'_or beyond cap and horizon; bounds of all policies."""
        return self.outer_tail[1]

    def _surplus(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """The Bayesian cost player's bound of weighted cost less sure failure's, [totals, nodes].

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
        """The cost player of section 3.5.1, whose game is a lower bound of the Bayesian one."""
        return CostPlayer(self.base)

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """The Bayesian cost player's best response: a policy of (time, state, accumulated cost).

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
        """The Bayesian cost player's lower bound of ``J_obj - price * (1 - J_cond)``.

        Sure failure counts exactly 0 here: rounding is counted where something is summed.
        """
        base, gamma = self.base, self.base.survival
        strategy: _TimedLayers = self.response(1.0, price, accuracy).strategy
        horizon, totals = len(strategy.choice), strategy.totals
        stage, worth = self._stage(totals), price * gamma * base.gain[:, None]
        weights, beyond_cap = np.array([1.0, price]), totals.beyond
        lowest = self._surplus(totals.with_beyond, weights * [1.0, gamma**horizon]).T
        for time in backward(horizon):
            saved = gamma**time * worth
            size = stage + saved + self._ahead(np.abs(lowest), totals)
            below = self._least(stage - saved + self._ahead(lowest, totals) - self._lost * size)[1]
            beyond = self._surplus(beyond_cap, weights * [1.0, gamma**time])
            lowest = np.hstack([below, beyond.T])
        terms = np.append(base.start * lowest[:, 0], -price * base.start_goal)
        return float(terms.sum() - len(terms) * MACHINE_EPSILON * np.abs(terms).sum())

    def policy(self, response: BestResponse) -> TimedPolicy:
        """The Bayesian cost player's response on the model's states, remembering time and cost.

        Successive stages that decide alike are one object.
        """
        strategy: _TimedLayers = response.strategy
        worst = self.outer_tail[0] - self.base.pair_offsets[:-1]
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
        """Relative rounding of one backup of the Bayesian cost player."""
        longest = int(np.diff(self.base.steps.indptr).max(initial=0)) + self.base.width
        return (longest + 4) * MACHINE_EPSILON

    def _stage(self, totals: Totals) -> FloatArray:
        """E[G_o] of each pair in each layer of the Bayesian cost player, [pairs, layers]."""
        paid = totals.values[:-1]
        return np.asarray(self.base.gain[:, None] * paid + self.base.gain_cost[:, None])

    @cached_property
    def _blocks(self) -> list[sp.csr_array]:
        """Real probabilities of the steps that lead 0, 1, ... layers ahead, each [pairs, nodes]."""
        base, n = self.base, self.base.n_nodes
        steps = sp.csc_array(base.steps / base.survival)
        return [sp.csr_array(steps[:, k * n : (k + 1) * n]) for k in range(base.width)]

    def _ahead(self, values: FloatArray, totals: Totals) -> FloatArray:
        """The Bayesian cost player's E[value after the step] in each layer, [pairs, layers].

        Args:
            values: [nodes, totals].
            totals: the totals, and which step leads where.
        """
        leads = totals.reached
        parts = (b @ values[:, leads[:, k]] for k, b in enumerate(self._blocks) if b.nnz)
        return np.asarray(sum(parts, np.zeros((len(self.base.gain), totals.size))))

    def _response(self, weights: FloatArray, m: float, horizon: int) -> BestResponse:
        """Backward induction of the Bayesian cost player from the horizon, then pi'_or.

        Args:
            weights: of J_obj and J_cond, [2].
            m: the cap M, in units.
            horizon: steps.
        """
        base, gamma, totals = self.base, self.base.survival, self.stationary.totals(m)
        cap, every = totals.size, totals.with_beyond
        if cap * horizon * base.n_nodes > _MOST_TIMED_ENTRIES:
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
        for time in backward(horizon):
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
        """The Bayesian cost player's lower bound from the horizon on, [nodes, totals].

        Discounting the objective too can only lower it, so the stationary game bounds this one.

        Args:
            totals: the totals.
            weights: with that of J_cond as it has faded by then.
        """
        bound, cap = weights[1] + self._surplus(totals.with_beyond, weights), totals.size
        if weights[0] > 0.0:
            process = LayeredProcess(self.base, totals, self.stationary.tails)
            price = float(weights[1] / weights[0])
            below = weights[0] * lower_bounds(process, price, price)[1]
            bound[:cap] = np.maximum(bound[:cap], below)
        return np.asarray(bound.T)

    def _least(self, priced: FloatArray) -> tuple[IntArray, FloatArray]:
        """The Bayesian cost player's first best pair of each (node, layer), and its value."""
        first = self.base.pair_offsets[:-1]
        least = np.minimum.reduceat(priced, first, axis=0)
        attains = priced == np.repeat(least, np.diff(self.base.pair_offsets), axis=0)
        number = np.where(attains, np.arange(len(priced))[:, None], len(priced))
        return np.minimum.reduceat(number, first, axis=0), least
