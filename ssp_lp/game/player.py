"""The game's player: best responses on a process of layers of accumulated cost (paper, 3.1 to 3.5).

M_o and M_{d,gamma} have the same states, actions and successors; they differ in what a step costs,
and in that a step of M_{d,gamma} goes on with probability gamma only. In case S a state holds the
cost paid so far (section 3.1.1). Case M (section 3.1.2) has a single layer, the live states that
are labelled s. States labelled f are left out: nothing is paid there, and the failure cost from
there on is ``sum (1 - gamma) gamma^t = 1``. So are dead-ends, where giving up at once is best.
Wandering for ever at no cost costs the same as giving up free of charge, so that a pair of that
kind is added where the model allows wandering.

Value iteration from below has a stopping rule that is a bound (sections 3.3 and 3.5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredProcess, LayeredTails
from ssp_lp.accumulated_cost.sweep import Sweep, at_price
from ssp_lp.accumulated_cost.totals import MOST_SUMS, StepClasses, Totals, step_costs, sums_in
from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    SAME_TOTAL,
    FloatArray,
    IntArray,
    least_integer_type,
)
from ssp_lp.compiled.deadline import backward
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import ModelError, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states, end_components, goal_pairs
from ssp_lp.policies.policy import DeterministicPolicy, Policy
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    give_up_charges,
)
from ssp_lp.processes.goal_reach import least_goal_reach
from ssp_lp.processes.live_rows import cost_means, costless_pairs, successor_means
from ssp_lp.processes.quotient import build_quotient

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

_ACCURACY = 1e-13  # relative, of the tails' values, and of a sum of many products at best
_SETTLED = 1e-10  # accuracy at which it is settled how many layers a value function has
_TIGHT = 1e-12  # accuracy of a value function of one layer
_ROUNDED = 8.0 * MACHINE_EPSILON  # relative, of what a tail is worth
_DEAREST = 1e100  # a price of J_cond at which nothing else counts

_FIRST_HORIZON = 32
_SLOW = 0.9  # of the gap: a longer horizon that leaves more of it is not what was missing
_MOST_STEPS = 100_000
_MOST_TIMED_ENTRIES = 100_000_000
"""Largest table of decisions, nodes x layers x time."""

_ROUGH = 1e-6
"""Accuracy of a bound that only counts as far as a run lasts until the horizon."""

_ROUNDED_SUCCESS = 1e-12
"""Success up to which it is rounding, where it is what J_cond leaves over."""

_BACKUP_ROUNDING = 64.0 * MACHINE_EPSILON
"""Relative rounding of one backup; over a run it adds up to this share of 1 / (1 - gamma)."""


def check_alpha(alpha: object) -> None:
    """Raise :class:`ModelError` unless the adversary's weight of M_o lies in [0, 1]."""
    if not (isinstance(alpha, Real) and 0.0 <= float(alpha) <= 1.0):
        raise wrong_argument("alpha", "lie between 0 and 1", alpha)


@dataclass(frozen=True, eq=False)
class BestResponse:
    """A deterministic policy that minimises a weighted sum of the game's two costs.

    Where the goal is hardly ever reached J_cond is 1 but for rounding. Its player then counts it
    from ``origin`` 1: minus the success, a sum of its own in which no digit is lost.
    """

    objective: float  # J_obj(x'; pi), exact for the policy
    failing: float  # J_cond(x'; pi) - origin, exact for the policy
    bound: float  # no policy has less of weight * J_obj + weight * failing, at the weights asked
    strategy: Any = None  # the policy in the player's own form
    sweeps: int = 0  # Bellman backups that it took
    origin: float = 0.0  # 0, or 1 where the goal is hardly ever reached

    @property
    def condition(self) -> float:
        """J_cond(x'; pi) of the best response."""
        return self.origin + self.failing

    @property
    def success(self) -> float:
        """1 - J_cond of the best response: in case S E[gamma^T; goal]."""
        return (1.0 - self.origin) - self.failing

    @property
    def is_hopeful(self) -> bool:
        """Whether the best response's cost given success can be told."""
        return self.success > (0.0 if self.origin else _ROUNDED_SUCCESS)

    @property
    def ratio(self) -> float:
        """The best response's cost given success, J_obj / (1 - J_cond)."""
        return self.objective / self.success

    def payoff(self, objective_weight: float, condition_weight: float) -> float:
        """Payoff of the best response at other weights, J_cond counted from its origin."""
        return objective_weight * self.objective + condition_weight * self.failing

    def size(self, objective_weight: float, condition_weight: float) -> float:
        """Size of the best response's payoff in its parts, to which rounding is relative."""
        return objective_weight * self.objective + condition_weight * abs(self.failing)


@dataclass(frozen=True, eq=False)
class Iterated:
    """Result of value iteration: a policy, its exact costs, and a bound below all policies."""

    values: FloatArray  # [nodes] checked: at most the optimal value everywhere
    choice: IntArray  # [nodes] greedy pairs
    totals: FloatArray  # [nodes, costs] exact expected costs of that policy
    sweeps: int


def iterate_values(
    dynamics: Dynamics,
    costs: FloatArray,
    discount: float,
    weights: FloatArray,
    watched: FloatArray,
    *,
    accuracy: float,
    first_sweeps: int = 16,
    most_sweeps: int = 1 << 14,
) -> Iterated:
    """Best response by value iteration, T_alpha of section 3.5: minimise ``weights @ costs``.

    The iterates ``T^N J_0`` increase to the optimum from ``J_0 = 0``. The greedy policy, improved
    by its own values while that helps, bounds the optimum from above with its exact value; the
    iterate, once a backup with its rounding has confirmed it, from below. The iteration ends when
    the two meet where a run may begin; it is lifted to the policy's own value, lowered as far as
    that backup demands, so that slow loops do not hold it up. Where rounding keeps the two apart it
    ends too, with the distance that is left.

    Args:
        dynamics: every transition scaled by gamma, so that T is a contraction.
        costs: of each pair, non-negative, [pairs, costs].
        discount: gamma.
        weights: of the costs, non-negative, [costs].
        watched: how much each node counts when bounds are compared, [nodes].
        accuracy: relative distance of the two bounds to reach.
        first_sweeps: before a policy is improved by its own values.
        most_sweeps: beyond them sweeps only fight rounding.
    """
    pair_cost = costs @ weights
    values = np.zeros(dynamics.n_states)
    best, block, sweeps = -np.inf, first_sweeps, 0
    rounding = _BACKUP_ROUNDING / (1.0 - discount)
    choice: IntArray | None = None
    while True:
        if choice is None:
            for _ in range(block):  # of values that are nowhere above their backup
                backup = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values)
                values = np.maximum(values, backup.minima)
            choice, sweeps = backup.choice, sweeps + block
        choice, totals, steps = improved_response(dynamics, costs, weights, choice)
        attained, sweeps = totals @ weights, sweeps + steps
        lifted = sub_solution(dynamics, pair_cost, attained)
        values = np.maximum(lifted, sub_solution(dynamics, pair_cost, values))
        below, above = float(watched @ values), float(watched @ attained)
        stuck = best > -np.inf and above - below <= rounding * above
        if above - below <= accuracy * above or stuck or sweeps > most_sweeps:
            return Iterated(values, choice, totals, sweeps)
        best, block, choice = below, max(sweeps, first_sweeps), None


def improved_response(
    dynamics: Dynamics,
    costs: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    most_steps: float = 100,
) -> tuple[IntArray, FloatArray, int]:
    """A best response improved by its own values, its exact costs, and the backups that took."""
    pair_cost, steps = costs @ weights, 0
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    while True:
        totals = dynamics.chain(choice).solve(costs[choice])
        steps += 1
        backup = best_pairs(offsets, transitions, pair_cost, totals @ weights, choice)
        better = backup.minima < backup.here - IMPROVEMENT * np.abs(backup.here)
        if steps >= most_steps or not better.any():
            return choice, totals, steps
        choice = np.where(better, backup.choice, choice)


def label_process(
    model: SSP, start: FloatArray, semantics: FailureSemantics, discount: float, *, later: float
) -> tuple[AccumulatedCost, float]:
    """Build the process of case M: one layer, whose pairs pay all of their expected cost in it.

    Args:
        model: the model.
        start: distribution over states, [states].
        semantics: where giving up is allowed and whether failing is charged.
        discount: gamma.
        later: weight of the charge of a dead-end, paid one step after the step that enters it:
            gamma in M_{o,gamma}^(M) of section 3.5, 1 in M_o^(M).

    Returns:
        The process, with E[G_o] as ``gain_cost`` and E[G_{d,gamma}] as ``failure`` of its pairs,
        and J_obj of start mass on dead-ends.
    """
    attention = attention_states(model)
    wandering = end_components(model, costless_pairs(model))[0] >= 0
    exits = {
        GiveUp.ANYWHERE: ~model.goal_mask,
        GiveUp.ATTENTION: attention,
        GiveUp.DEAD_ENDS: np.zeros(model.n_states, dtype=np.bool_),
    }[semantics.give_up]
    quotient = build_quotient(model, exits=exits | wandering)
    charge = quotient.least_over_members(give_up_charges(model, attention, wandering, semantics))
    entering = dead_end_charges(model, quotient.dead, semantics)
    paid = quotient.at_pairs(cost_means(model), charge)
    lost = quotient.at_pairs(successor_means(model, quotient.dead))
    process = AccumulatedCost(
        quotient=quotient,
        step_classes=StepClasses(Fraction(1), np.zeros(model.n_outcomes, dtype=np.int32), 1, 0),
        survival=discount,
        instant=quotient.transitions(discount, departing=False).matrix,
        later=sp.csr_array((len(paid), 0)),
        gain=quotient.at_pairs(successor_means(model, model.goal_mask)),
        gain_cost=paid + later * quotient.at_pairs(successor_means(model, entering)),
        failure=np.where(quotient.gives_up, 1.0, (1.0 - discount) + discount * lost),
        start=quotient.gather(start),
        start_goal=float(start[model.goal_mask].sum()),
        start_failure=float(start[quotient.dead].sum()),
        departs=np.ones(len(paid)),
    )
    return process, float(start @ entering)


class Strategy(NamedTuple):
    """A decision for each (time, layer, node), of which the last time's is for good."""

    choice: IntArray  # [times, layers, nodes] position among the pairs of the node
    totals: Totals  # of the layers
    values: FloatArray | None = None  # [nodes] checked lower bounds, where there is one layer
    process: LayeredProcess | None = None  # with what follows beyond the layers, if anything does
    price: float = 0.0  # J_cond's weight in units of J_obj's, by which tails are chosen


@dataclass(frozen=True, eq=False)
class Player:
    """Best responses among policies of (state, accumulated cost), by the operator T_alpha.

    A single layer is solved by value iteration. Of several, up to M, the tables are swept backward
    over the accumulated cost, and M grows until nothing is lost beyond it. With a ``tail`` M is
    that, and pi'_or is followed once it is paid (section 3.5.1): J_obj is then discounted below M
    only, J_cond everywhere, V of the paper as it is printed, and bounds are of the policies of
    that class, Pi_{M,pi'_or}.
    """

    base: AccumulatedCost
    counts_total: bool = True  # whether states hold the cost paid: case S
    start_cost: float = 0.0  # J_obj of start mass on dead-ends
    tail: float | None = None  # M, in units of cost

    @cached_property
    def outer_tails(self) -> tuple[IntArray, LayeredTails]:
        """The tails that fail least and most, MAXPROB and MINPROB (section 2.3).

        Both are value iterations on the discounted process without accumulated cost. The paper
        follows pi'_or, which fails most, beyond M. Where failing is dear, M would have to be very
        large for that: there the policy that fails least is followed until as much has been paid
        that failing most is no worse. The paper leaves pi'_or and J_obj undiscounted there
        (``undiscounted_tail``); both are discounted here as before M, so that c-hat does not depend
        on M once M is large.

        Returns:
            The pairs of both, [2, nodes], and what they attain, with bounds of every policy.
        """
        base, gamma = self.base, self.base.survival
        dynamics, _ = base.quotient.dynamics(gamma, departing=False)
        watched = np.full(base.n_nodes, 1.0 / max(base.n_nodes, 1))
        success = np.where(base.quotient.pair_at >= 0, gamma * base.gain, 0.0)
        safest, riskiest = (
            iterate_values(dynamics, costs[:, None], gamma, np.ones(1), watched, accuracy=_ACCURACY)
            for costs in (base.failure, success)
        )
        both = np.stack([safest.choice, riskiest.choice])
        early, cost = self.followed_tails(both, gamma)
        tails = LayeredTails(
            decisions=np.stack([base.quotient.pull_back(choice) for choice in both]),
            values=TailValues(gamma * early, 1.0 - gamma * early, early, cost, np.zeros_like(cost)),
            greatest_goal=1.0 - safest.values,
            least_goal=riskiest.values,
        )
        return both, tails

    @property
    def tails(self) -> LayeredTails:
        """What follows beyond M: the policies that fail least and most."""
        return self.outer_tails[1]

    @cached_property
    def origin(self) -> float:
        """Origin of J_cond (see ``BestResponse``): neither success nor failure loses digits."""
        base, is_rare = self.base, False
        if self.counts_total:
            is_rare = float(base.start @ self.tails.greatest_goal) + base.start_goal <= _RARE
        return float(is_rare)

    @cached_property
    def undiscounted_tail(self) -> LayeredTails:
        """The tail pi'_or of section 3.5.1, of Pi_{d,or}: undiscounted MINPROB (section 2.3).

        It gives up at attention states; of pairs that reach the goal with equal probability it
        takes the one stated first. J_obj is undiscounted, J_cond discounted.
        """
        base, quotient = self.base, self.base.quotient
        giving_up = np.full(base.n_nodes, -1, dtype=np.int32)
        giving_up[quotient.pair_node[quotient.gives_up]] = quotient.gives_up.nonzero()[0]
        placed = quotient.placed(least_goal_reach(quotient.model).decision)
        pairs = np.where(placed >= 0, placed, giving_up)[None]
        early, _ = self.followed_tails(pairs, base.survival)
        goal, cost = self.followed_tails(pairs, 1.0)
        saved = base.survival * early
        values = TailValues(saved, 1.0 - saved, goal, cost, np.zeros_like(cost))
        return replace(self.tails, decisions=quotient.pull_back(pairs[0])[None], values=values)

    def followed_tails(self, choices: IntArray, survival: float) -> tuple[FloatArray, FloatArray]:
        """Goal and cost E[survival^(T-1) * ...; goal] of some choices, [policies, nodes] each."""
        quotient, (early, cost) = self.base.quotient, np.zeros((2, *choices.shape))
        dynamics, _ = quotient.dynamics(survival, departing=False)
        for k, choice in enumerate(choices):
            chain = dynamics.chain(choice)
            early[k] = chain.solve(self.base.gain[choice])
            weight = np.where(quotient.model.goal_mask, 1.0, survival * quotient.lift(early[k]))
            priced = quotient.at_pairs(cost_means(quotient.model, weight))
            cost[k] = chain.solve(priced[choice])
        return early, cost

    @property
    def dearest(self) -> float:
        """Units by which M moves at least: the dearest step's and a little more."""
        steps = step_costs(self.base.quotient.model)[1]
        return float(steps[-1]) if self.base.by_steps else float(self.base.width)

    def totals(self, cap: float) -> Totals:
        """Totals below M, and those at which tails take over.

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
        """Best response: a policy of least ``objective_weight J_obj + condition_weight J_cond``.

        All responses of a player count J_cond from the same origin. M is first put where failing
        at attention states has become optimal, ``w_o r = w_d``, as far as that is near; then it
        grows until the bound that holds for every policy comes within the accuracy, or only
        rounding is left. What the cap costs falls geometrically, so two caps foretell a third.

        Args:
            objective_weight: alpha(M_o) of section 3.2 of the paper, not negative.
            condition_weight: alpha(M_d) * eta / epsilon, not negative.
            accuracy: largest distance between the policy's payoff and its bound, relative to the
                payoff's size.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        if not self.counts_total:
            return self._iterated(weights, accuracy)
        if self.tail is not None:
            units = self.tail / self.base.unit
            return self._swept(
                weights, units if self.base.by_steps else float(np.ceil(units * (1.0 - SAME_TOTAL)))
            )
        cap, sweeps, lost = self._first_cap(weights), 0, dict[float, float]()
        while True:
            response = self._swept(weights, cap)
            layers = response.strategy.totals.size
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            stalled = pays - response.bound > 0.9 * min(lost.values(), default=np.inf)
            lost[cap] = pays - response.bound
            size = response.size(objective_weight, condition_weight)
            wanted = max(accuracy, _LAYER_ROUNDING * layers) * size
            if lost[cap] <= wanted or (stalled and lost[cap] <= _STALLED * size):
                return replace(response, sweeps=sweeps)
            cap = self._whole(_larger_cap(lost, wanted)) + self.dearest

    def _whole(self, cap: float) -> float:
        """A cap M as a whole number of layers, if a unit makes them."""
        return cap if self.base.by_steps else float(np.ceil(cap))

    def _first_cap(self, weights: FloatArray) -> float:
        """Units after which it is best to fail, where that is surely possible, if they are few.

        Otherwise as many as the least failing policies may need, to be doubled soon.
        """
        base, cap = self.base, _FIRST_LAYERS * self.dearest
        if weights[0] == 0.0:
            return cap
        lossless = base.survival * weights[1] / (weights[0] * base.unit)
        once_more = self.dearest if base.by_steps else 1.0
        return self._whole(lossless) + once_more if lossless <= 8 * cap else cap

    def values_of(self, weights: FloatArray, watched: FloatArray, accuracy: float) -> Iterated:
        """Value iteration on one layer, at weights of J_obj and J_cond."""
        base = self.base
        costs = np.stack([base.gain_cost, base.failure], axis=1)
        dynamics, gamma = base.instant_dynamics, base.survival
        return iterate_values(dynamics, costs, gamma, weights, watched, accuracy=accuracy)

    def _iterated(self, weights: FloatArray, accuracy: float) -> BestResponse:
        """Best response on one layer: a policy of the state alone."""
        base = self.base
        iterated = self.values_of(weights, base.start, accuracy)
        fixed = np.array([self.start_cost, base.start_failure])
        objective, condition = (base.start @ iterated.totals + fixed).tolist()
        bound = float(base.start @ iterated.values + fixed @ weights)
        choice = (iterated.choice - base.pair_offsets[:-1])[None, None]
        strategy = Strategy(choice, base.totals(1), iterated.values)
        return BestResponse(objective, condition, bound, strategy, iterated.sweeps)

    def _swept(self, weights: FloatArray, cap: float) -> BestResponse:
        """Best response with a tail from M = cap units on, by one sweep backward, and its bound."""
        base, is_fixed = self.base, self.tail is not None
        tails = self.undiscounted_tail if is_fixed else self.tails
        process = LayeredProcess(base, self.totals(cap), tails)
        price = float(weights[1] / weights[0]) if weights[0] > 0.0 else _DEAREST
        scale = float(weights[0]) if weights[0] > 0.0 else float(weights[1]) / _DEAREST
        sweep, failing = Sweep.of_ends(process), 0.0 if self.origin else price
        choice = sweep.room_for_choice()
        priced = at_price(sweep, price, failing)
        objective, failure, goal = sweep.minimise(priced, choice).tolist()
        bound = max(scale * self.lower_bounds(sweep, price, failing)[0][0],
                    -weights[1] * self.origin)  # J_obj is never negative  # fmt: skip
        failed = -base.start_goal - goal if self.origin else base.start_failure + failure
        strategy = Strategy(choice[None], process.totals, process=process, price=price)
        return BestResponse(objective, failed, float(bound), strategy, 2 * process.cap, self.origin)

    def lower_bounds(
        self, sweep: Sweep, price: float, failing: float
    ) -> tuple[FloatArray, FloatArray]:
        """Lower bounds of J_obj and, at a price, J_cond: of every policy, or of those of the tail.

        Args:
            sweep: over the process cut at M.
            price: of J_cond.
            failing: the price, or 0 where J_cond is counted from 1.

        Returns:
            If a run began in each layer, [layers]; and of each state, [layers, nodes].
        """
        process: Any = sweep.process
        priced = at_price(sweep, price, failing, bounds=True)
        if self.tail is not None:
            charge, failure, goal = process.beyond(price)
            size = charge + failing * failure + (price - failing) * goal
            beyond = process.beyond_value(price, failing) - _ROUNDED * size
            priced = priced._replace(beyond=beyond)
        anything = np.broadcast_to(np.inf, (process.cap, process.base.n_nodes))
        return sweep.bound(priced, anything)

    def surplus(self, price: float, accuracy: float) -> float:
        """Lower bound of ``J_obj - price * (1 - J_cond)``, rounding counted.

        Sure failure counts 0 here, so that a policy that is a little worse than it is not lost in
        the rounding of ``price``. The sign says whether ``J_obj / (1 - J_cond) >= price`` for all.
        """
        process = self.response(1.0, price, accuracy).strategy.process
        return float(self.lower_bounds(Sweep.of_ends(process), price, 0.0)[0][0])

    def value_function(self, price: float) -> FloatArray:
        """Checked lower bounds of ``J_obj + price * J_cond``.

        Returns:
            In case M [nodes], and at the end that of the start, where it is not live with
            certainty. In case S infinite values, to ask ``certify`` for the best by so many
            layers, [layers, nodes]; [1] where costs have no common unit.
        """
        if self.counts_total and self.base.by_steps:
            return np.array([np.inf])
        response = self.response(1.0, price, _SETTLED if self.counts_total else _TIGHT)
        if self.counts_total:
            return np.broadcast_to(np.inf, self.value_shape([response]))
        values: FloatArray = response.strategy.values
        return np.append(values, response.bound) if self._is_settled_at_start else values

    def value_shape(self, responses: Sequence[BestResponse]) -> tuple[int, ...]:
        """Shape of the value function: in case S as many layers as responses had."""
        if self.counts_total:
            return max(response.strategy.choice.shape[1:] for response in responses)
        return (self.base.n_nodes + int(self._is_settled_at_start),)

    @property
    def _is_settled_at_start(self) -> bool:
        """Whether start mass lies on goals or dead-ends."""
        return self.base.start_goal + self.base.start_failure > 0.0

    def policy(self, response: BestResponse) -> Policy:
        """The best response's policy on the original states, with what it remembers.

        Successive stages that decide alike are one object.
        """
        strategy: Strategy = response.strategy
        stages: list[Policy] = []
        for time, choice in enumerate(strategy.choice):
            if time == 0 or not np.array_equal(choice, strategy.choice[time - 1]):
                stage = self._stage_policy(strategy, choice)
            stages.append(stage)
        return TimedPolicy(tuple(stages)) if len(stages) > 1 else stages[0]

    def _stage_policy(self, strategy: Strategy, choice: IntArray) -> Policy:
        """The policy on the original states of a choice at one time, [layers, nodes]."""
        if strategy.process is not None:
            return strategy.process.policy(choice, strategy.price)
        quotient, first = self.base.quotient, self.base.pair_offsets[:-1]
        return DeterministicPolicy(quotient.model, quotient.pull_back(first + choice[0]))


def _larger_cap(lost: Mapping[float, float], wanted: float) -> float:
    """A larger cap M, 1.25 to 4 times the last one, to lose as little beyond it as wanted."""
    cap = max(lost)
    needed = 2.0 * cap
    smaller = max((c for c in lost if c < cap), default=cap)
    if lost[cap] < lost[smaller] and wanted > 0.0:
        rate = np.log(lost[smaller] / lost[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(lost[cap] / wanted) / rate
    return min(max(needed, 1.25 * cap), 4.0 * cap)


@dataclass(frozen=True, eq=False)
class BayesPlayer(Player):
    """Best responses among all policies, by backward induction over time (paper, section 3.3).

    J_obj is not discounted here and J_cond is, so the two MDPs move alike at different speeds and
    the best action depends on the belief, that is on time. Weighed by how likely a run is to go
    on, the operator T of section 3.3 along the trajectory of the belief is a backward induction:

        W_t(x) = min_u w_o G_o(x, u) + gamma^t w_d G_d(x, u) + sum_y p(y | x, u) W_{t+1}(y),

    with W_t = (w_o + gamma^t w_d) J(x, alpha_t). (T as printed weighs G-bar twice.)
    """

    @cached_property
    def origin(self) -> float:
        """Origin of J_cond: failure itself is counted."""
        return 0.0

    @cached_property
    def stationary(self) -> Player:
        """The player of section 3.5, whose game is a lower bound of the Bayesian one."""
        return Player(self.base, self.counts_total, self.start_cost)

    @cached_property
    def last_tail(self) -> tuple[IntArray, LayeredTails]:
        """The pairs of the policy followed beyond cap and horizon, [nodes], and what it attains.

        In case S the one that fails most under the discount: where M and the horizon are not
        given, undiscounted MINPROB (``undiscounted_tail``) would need much greater ones. In case M
        the one of least J_obj. J_obj is undiscounted, while J_cond stays discounted (section 3.3).
        """
        if not self.counts_total:
            return self._cheapest()
        pairs, tails = self.outer_tails
        goal, cost = self.followed_tails(pairs[1:], 1.0)
        values = TailValues(*(each[1:] for each in tails.values))._replace(early=goal, cost=cost)
        return pairs[1], replace(tails, decisions=tails.decisions[1:], values=values)

    def _cheapest(self) -> tuple[IntArray, LayeredTails]:
        """The policy of least undiscounted J_obj in case M, by policy iteration.

        Only strict gains are taken, so that every policy on the way leaves for good.
        """
        base, quotient, cost = self.base, self.base.quotient, self.base.gain_cost
        dynamics = quotient.dynamics(1.0, departing=False)[0]
        choice = quotient.nearer(goal_pairs(quotient.model))
        choice = base.pair_offsets[:-1].copy() if choice is None else choice.astype(np.int32)
        choice, totals, _ = improved_response(dynamics, cost[:, None], np.ones(1), choice, np.inf)
        values = totals[:, 0]
        failing = base.instant_dynamics.chain(choice).solve(base.failure[choice])
        nothing, every = np.zeros((1, base.n_nodes)), np.ones(base.n_nodes)
        tails = LayeredTails(
            decisions=quotient.pull_back(choice)[None],
            values=TailValues(1.0 - failing[None], failing[None], nothing, values[None], nothing),
            greatest_goal=every,
            least_goal=nothing[0],
            least_cost=sub_solution(dynamics, cost, values),
        )
        return choice, tails

    def _surplus(self, paid: FloatArray, weights: FloatArray) -> FloatArray:
        """Lower bound of weighted cost less that of sure failure, [totals, nodes].

        Whoever succeeds with weight E[gamma^T; goal] succeeds with at least that probability, and
        pays for it what has been paid, undiscounted: linear in the success, which lies between two
        bounds.
        """
        per_success = weights[0] * paid[:, None] - weights[1]
        tails = self.last_tail[1]
        goal = np.where(per_success < 0.0, tails.greatest_goal, tails.least_goal)
        return np.asarray(per_success * goal)

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """Best response: a policy of (time, state), in case S of (time, state, accumulated cost).

        The cap is the stationary player's. The horizon is doubled until the bound meets what the
        policy pays; where that no longer helps, so is the cap. In case M the bound meets at the
        horizon that gamma prescribes (``horizon_of``) whatever the model.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        weights = np.array([objective_weight, condition_weight])
        cap, sweeps, horizon, gap, enough = 1.0, 0, _FIRST_HORIZON, np.inf, np.inf
        if self.counts_total:
            first = self.stationary.response(objective_weight, condition_weight, accuracy)
            cap, sweeps = first.strategy.process.end, first.sweeps
        while True:
            response = self._response(weights, cap, horizon)
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            before, gap = gap, pays - response.bound
            error = max(accuracy, _ACCURACY) * pays
            if not self.counts_total and error > 0.0:
                enough = horizon_of(self.base.survival, condition_weight, error)
            if gap <= error or horizon >= enough:
                return replace(response, sweeps=sweeps)
            horizon = int(min(2 * horizon, enough))
            cap *= 2.0 if self.counts_total and gap > _SLOW * before else 1.0

    def surplus(self, price: float, accuracy: float) -> float:
        """Lower bound of ``J_obj - price * (1 - J_cond)``.

        Sure failure counts exactly 0 here: rounding is counted where something is summed.
        """
        base, gamma = self.base, self.base.survival
        strategy: Strategy = self.response(1.0, price, accuracy).strategy
        horizon, totals = len(strategy.choice) - 1, strategy.totals
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
        """E[value after the step] of each pair in each layer, [pairs, layers].

        Args:
            values: [nodes, totals].
            totals: the totals, and which step leads where.
        """
        leads = totals.reached
        parts = (b @ values[:, leads[:, k]] for k, b in enumerate(self._blocks) if b.nnz)
        return np.asarray(sum(parts, np.zeros((len(self.base.gain), totals.size))))

    def _response(self, weights: FloatArray, cap: float, horizon: int) -> BestResponse:
        """Backward induction from the horizon, beyond which and the cap one tail is followed.

        Args:
            weights: of J_obj and J_cond, [2].
            cap: M, in units.
            horizon: steps.
        """
        base, gamma, totals = self.base, self.base.survival, self.totals(cap)
        cap, every = totals.size, totals.with_beyond
        if cap * horizon * base.n_nodes > _MOST_TIMED_ENTRIES or horizon > _MOST_STEPS:
            layers = f" x {cap:,} layers of accumulated cost" if self.counts_total else ""
            raise ModelError(
                f"{horizon:,} steps{layers} on {base.n_nodes:,} states are too many for the "
                "Bayes-adaptive iteration: runs are too long"
            )
        tail, tails = self.last_tail
        last, first = tails.first, base.pair_offsets[:-1]
        objective = np.asarray((every[:, None] * last.early + last.cost).T)
        condition = np.repeat(last.failure[:, None], len(every), axis=1)
        beyond = objective[:, cap:], condition[:, cap:]
        lowest = self._beyond(totals, weights * [1.0, gamma**horizon])
        stage = self._stage(totals)
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((horizon + 1, cap, base.n_nodes), dtype=least_integer_type(most))
        choice[horizon] = tail - first
        for time in backward(horizon):
            now = weights * [1.0, gamma**time]
            priced = now[0] * stage + now[1] * base.failure[:, None]
            best, below = self._least(priced + self._ahead(lowest, totals))
            choice[time] = (best - first[:, None]).T
            on_objective = np.take_along_axis(stage + self._ahead(objective, totals), best, 0)
            on_condition = np.take_along_axis(
                base.failure[:, None] + gamma * self._ahead(condition, totals), best, 0
            )
            objective = np.hstack([on_objective, beyond[0]])
            condition = np.hstack([on_condition, beyond[1]])
            lowest = np.hstack([below, now[1] + self._surplus(every[cap:], now).T])
        fixed = np.array([self.start_cost, base.start_failure])
        bound = float(base.start @ lowest[:, 0] + weights @ fixed)
        process = LayeredProcess(base, totals, tails) if self.counts_total else None
        return BestResponse(
            objective=float(base.start @ objective[:, 0] + fixed[0]),
            failing=float(base.start @ condition[:, 0] + fixed[1]),
            bound=bound * (1.0 - (horizon + 1) * self._lost),  # of non-negative sums
            strategy=Strategy(choice, totals, process=process),
            sweeps=horizon * cap,
        )

    def _beyond(self, totals: Totals, weights: FloatArray) -> FloatArray:
        """Lower bound of every policy's weighted cost from the horizon on, [nodes, totals].

        Discounting the objective too can only lower it, so the stationary game bounds this one.

        Args:
            totals: the totals.
            weights: with that of J_cond as it has faded by then.
        """
        stationary, n = self.stationary, max(self.base.n_nodes, 1)
        bound, cap = weights[1] + self._surplus(totals.with_beyond, weights), totals.size
        below = np.zeros((cap, self.base.n_nodes))
        if not self.counts_total:
            everywhere = np.full(self.base.n_nodes, 1.0 / n)
            below[0] = stationary.values_of(weights, everywhere, _ROUGH).values
            below = np.maximum(below, weights[0] * self.last_tail[1].least_cost)
        elif weights[0] > 0.0:
            process = LayeredProcess(self.base, totals, stationary.tails)
            price = float(weights[1] / weights[0])
            below = weights[0] * stationary.lower_bounds(Sweep.of_ends(process), price, price)[1]
        bound[:cap] = np.maximum(bound[:cap], below)
        return np.asarray(bound.T)

    def _least(self, priced: FloatArray) -> tuple[IntArray, FloatArray]:
        """The first best pair of each (node, layer), and its value."""
        first = self.base.pair_offsets[:-1]
        least = np.minimum.reduceat(priced, first, axis=0)
        attains = priced == np.repeat(least, np.diff(self.base.pair_offsets), axis=0)
        number = np.where(attains, np.arange(len(priced))[:, None], len(priced))
        return np.minimum.reduceat(number, first, axis=0), least


def horizon_of(discount: float, condition_weight: float, error: float) -> int:
    """Horizon of a Bayesian player: steps until ``condition_weight * gamma^N`` is at most error.

    By then J of section 3.3 and that of a player who ignores failing differ by no more.
    """
    if condition_weight <= error:
        return 1
    return int(np.ceil(np.log(error / condition_weight) / np.log(discount))) + 1
