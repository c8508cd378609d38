"""The player of the game: best responses on layers of accumulated cost (paper, 3.1 to 3.5).

The objective MDP M_o and the failure MDP M_{d,gamma} have the same states, actions and successors.
They differ in the costs, and a step of M_{d,gamma} goes on with probability gamma only. In case S a
state includes the accumulated cost (section 3.1.1). Case M (section 3.1.2) has a single layer: the
states with label s, at which the run has not failed. Two kinds of states are left out:

- States with label f (failed): nothing is paid there, and the failure cost from there on is ``sum
  (1 - gamma) gamma^t = 1``.
- Dead-ends, since giving up at once is best there.

To stay for ever among actions of cost 0 is worth as much as giving up free of charge. States where
this is possible have a pair for giving up.

Value iteration from below stops by a proved bound (sections 3.3 and 3.5).
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
from ssp_lp.compiled.deadline import WithIncumbent, backward, closing
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import ModelError, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.graph import end_components
from ssp_lp.policies.policy import DeterministicPolicy, Policy
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    dead_end_charges,
    give_up_charges,
    giving_up_states,
)
from ssp_lp.processes.goal_reach import least_goal_reach
from ssp_lp.processes.live_rows import cost_means, costless_pairs, successor_means
from ssp_lp.processes.quotient import build_quotient

_MOST_ENTRIES = 200_000_000
"""Most entries of a table of decisions, nodes x layers."""

_MOST_LAYERS = 500_000
_FIRST_LAYERS = 16

_LAYER_ROUNDING = 16.0 * MACHINE_EPSILON
"""Relative rounding of a bound, per layer of the sweep, which more layers cannot reduce."""

_RARE = 1e-3
"""Greatest success at which J_cond is counted from 1; above it few digits are lost."""

_STALLED = 1e-8
"""Relative gap that counts as rounding if more layers do not reduce it."""

_ACCURACY = 1e-13  # relative accuracy of values, the best of a sum of many products
_ROUNDED = 8.0 * MACHINE_EPSILON  # relative rounding of a tail's value
_DEAREST = 1e100  # a price of J_cond at which J_obj is negligible

_FIRST_SWEEPS = 16  # of value iteration, before the first policy iteration
_MOST_SWEEPS = 1 << 14  # of value iteration, after which only rounding is left
_FIRST_HORIZON = 32
_SLOW = 0.9  # share of the last gap from which on a larger table does not help
_MOST_STEPS = 100_000
_MOST_TIMED_ENTRIES = 100_000_000
"""Most entries of a table of decisions, nodes x layers x time."""

_ROUGH = 1e-6
"""Accuracy of a bound that counts only for runs that last until the horizon."""

_ROUNDED_SUCCESS = 1e-12
"""Success that counts as rounding if it is computed as 1 - J_cond."""

_BACKUP_ROUNDING = 64.0 * MACHINE_EPSILON
"""Relative rounding of one backup; over a run it adds up to this times 1 / (1 - gamma)."""


def check_alpha(alpha: object) -> None:
    """Raise :class:`ModelError` unless the adversary's weight of M_o lies in [0, 1]."""
    if not (isinstance(alpha, Real) and 0.0 <= float(alpha) <= 1.0):
        raise wrong_argument("alpha", "lie between 0 and 1", alpha)


@dataclass(frozen=True, eq=False)
class BestResponse:
    """A deterministic policy that minimises a weighted sum of the game's costs J_obj and J_cond.

    If the goal is hardly ever reached, J_cond equals 1 up to rounding. ``origin`` is then 1, and
    ``failing`` is J_cond - 1, minus the success probability, computed without J_cond to keep its
    digits.
    """

    objective: float  # J_obj(x'; pi), exact for the policy
    failing: float  # J_cond(x'; pi) - origin, exact for the policy
    bound: float  # lower bound of all policies' weighted sum of J_obj and failing
    strategy: Any = None  # the policy in the player's own form
    sweeps: int = 0  # number of Bellman backups
    origin: float = 0.0  # 0, or 1 if the goal is hardly ever reached

    @property
    def condition(self) -> float:
        """J_cond: the policy's discounted failure probability."""
        return self.origin + self.failing

    @property
    def success(self) -> float:
        """1 - J_cond; in case S the discounted success probability E[gamma^T; goal]."""
        return (1.0 - self.origin) - self.failing

    @property
    def has_conditional_cost(self) -> bool:
        """Whether the success is large enough to compute the cost given success."""
        return self.success > (0.0 if self.origin else _ROUNDED_SUCCESS)

    @property
    def ratio(self) -> float:
        """The cost given success, J_obj / (1 - J_cond)."""
        return self.objective / self.success

    def payoff(self, objective_weight: float, condition_weight: float) -> float:
        """Return the payoff at given weights of J_obj and of J_cond - origin."""
        return objective_weight * self.objective + condition_weight * self.failing

    def size(self, objective_weight: float, condition_weight: float) -> float:
        """Return the sum of the absolute terms of the payoff, to which tolerances are relative."""
        return objective_weight * self.objective + condition_weight * abs(self.failing)


@dataclass(frozen=True, eq=False)
class _Iterated:
    """Result of value iteration: a policy, its exact costs, and bounds of the optimal values."""

    values: FloatArray  # [nodes] checked: at most the optimal value at every node
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
) -> _Iterated:
    """Minimise ``weights @ costs`` by value iteration, with T_alpha of section 3.5.

    The iterates ``T^N J_0`` increase to the optimum from ``J_0 = 0``. Each round has two bounds:

    - Upper bound: the exact value of the greedy policy, improved by policy iteration.
    - Lower bound: the iterate, or the policy's value if this is greater. Both are lowered until one
      Bellman backup, less its rounding errors, confirms that they are lower bounds. The policy's
      value saves the many iterations that slow cycles would need.

    The iteration ends when the two bounds agree at the watched nodes, or differ by rounding only.

    Args:
        dynamics: every transition scaled by gamma, so that T is a contraction.
        costs: costs of each pair, non-negative, [pairs, costs].
        discount: gamma.
        weights: weights of the costs, non-negative, [costs].
        watched: weight of each node in the comparison of bounds, [nodes].
        accuracy: relative distance of the two bounds at which the iteration ends.
    """
    pair_cost = costs @ weights
    values = np.zeros(dynamics.n_states)
    before, sweeps, rounding = -np.inf, 0, _BACKUP_ROUNDING / (1.0 - discount)
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    while True:
        for _ in range(max(sweeps, _FIRST_SWEEPS)):  # of values that are at most their backup
            backup = best_pairs(offsets, transitions, pair_cost, values)
            values = np.maximum(values, backup.minima)
            sweeps += 1
        choice, totals, steps = improved_response(dynamics, costs, weights, backup.choice)
        attained, sweeps = totals @ weights, sweeps + steps
        lifted = sub_solution(dynamics, pair_cost, attained)
        values = np.maximum(lifted, sub_solution(dynamics, pair_cost, values))
        below, above = float(watched @ values), float(watched @ attained)
        stuck = before > -np.inf and above - below <= rounding * above
        if above - below <= accuracy * above or stuck or sweeps > _MOST_SWEEPS:
            return _Iterated(values, choice, totals, sweeps)
        before = below


def improved_response(
    dynamics: Dynamics, costs: FloatArray, weights: FloatArray, choice: IntArray
) -> tuple[IntArray, FloatArray, int]:
    """Improve a policy, given as a pair for each node, by policy iteration.

    Returns:
        The improved policy, [nodes]; its exact costs, [nodes, costs]; and the number of steps.
    """
    pair_cost, steps = costs @ weights, 0
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    while True:
        totals = dynamics.chain(choice).solve(costs[choice])
        steps += 1
        backup = best_pairs(offsets, transitions, pair_cost, totals @ weights, choice)
        better = backup.minima < backup.current_values - IMPROVEMENT * np.abs(backup.current_values)
        if steps >= 100 or not better.any():  # later steps change the rounding alone
            return choice, totals, steps
        choice = np.where(better, backup.choice, choice)


def label_process(
    model: SSP, start: FloatArray, semantics: FailureSemantics, discount: float, *, later: float
) -> tuple[AccumulatedCost, float]:
    """Build the process of case M: one layer, in which a pair pays its whole expected cost.

    Args:
        model: the model.
        start: distribution over states, [states].
        semantics: where giving up is allowed and whether failing is charged.
        discount: gamma.
        later: weight of a dead-end's charge, which is paid one step after the step that enters it:
            gamma in M_{o,gamma}^(M) of section 3.5, 1 in M_o^(M).

    Returns:
        The process, whose pairs have E[G_o] as ``gain_cost`` and E[G_{d,gamma}] as ``failure``; and
        the J_obj of episodes that start in a dead-end.
    """
    wandering = end_components(model, costless_pairs(model))[0] >= 0
    exits = giving_up_states(model, semantics.give_up)
    quotient = build_quotient(model, exits=exits | wandering)
    charge = quotient.least_over_members(give_up_charges(model, wandering, semantics))
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
        escape=np.ones(len(paid)),
    )
    return process, float(start @ entering)


class _Strategy(NamedTuple):
    """A chosen pair for each (time, layer, node); the last time stands for all later times."""

    choice: IntArray  # [times, layers, nodes] position among the pairs of the node
    totals: Totals  # accumulated costs of the layers
    values: FloatArray | None = None  # [nodes] checked lower bounds, if there is one layer
    process: LayeredProcess | None = None  # layers and tails, if costs are accumulated
    price: float = 0.0  # J_cond's weight in units of J_obj's, by which tails are chosen


@dataclass(frozen=True, eq=False)
class Player:
    """Best responses among policies that depend on the state and, in case S, the accumulated cost.

    In case M there is one layer, solved by value iteration with the operator T_alpha. In case S the
    layers up to an accumulated cost M are solved by one backward sweep. Beyond M fixed policies,
    the *tails*, are followed. M grows until the response's payoff and its lower bound agree.

    If ``tail`` is given, M is equal to it, and the tail is pi'_or (section 3.5.1). J_obj is then
    discounted only below M, and J_cond everywhere, like V in the paper. Bounds hold for the
    policies of the class Pi_{M,pi'_or}.
    """

    base: AccumulatedCost
    counts_total: bool = True  # whether states include the accumulated cost: case S
    start_cost: float = 0.0  # J_obj of start mass on dead-ends
    tail: float | None = None  # M, in units of cost

    @cached_property
    def outer_tails(self) -> tuple[IntArray, LayeredTails]:
        """The policies of least and of greatest failure, followed beyond M: MAXPROB and MINPROB.

        Both are found by value iteration on the discounted process without accumulated cost
        (section 2.3). There are two differences from the paper:

        - Beyond M the paper follows pi'_or, which fails most. If failing is expensive, this needs a
          very large M. Here the policy that fails least is followed beyond M until so much has been
          paid that failing most is no worse.
        - The paper leaves pi'_or and J_obj undiscounted beyond M (``undiscounted_tail``). Here both
          are discounted as below M, so that c-hat does not depend on M once M is large.

        Returns:
            The pairs of the two policies, [2, nodes]; and their values, with bounds of every
            policy's goal probability.
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
        """The policies of least and of greatest failure, which are followed beyond M."""
        return self.outer_tails[1]

    @cached_property
    def origin(self) -> float:
        """Origin from which J_cond is counted: 1 if success is rare, else 0 (see ``BestResponse``).

        It applies in case S. In case M, J_cond is always counted from 0.
        """
        reachable = float(self.base.start @ self.tails.greatest_goal) + self.base.start_goal
        return float(reachable <= _RARE)

    @cached_property
    def undiscounted_tail(self) -> LayeredTails:
        """The tail pi'_or of section 3.5.1: the policy of least goal probability (MINPROB).

        The probability is undiscounted. The policy gives up at attention states, from which the
        goal can surely be avoided. Among pairs that reach the goal with equal probability it takes
        the one that was stated first. Its J_obj is undiscounted, its J_cond discounted.
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
        """Evaluate stationary policies, each given by a pair for every node, [policies, nodes].

        Returns:
            E[survival^(T-1); goal] and E[survival^(T-1) * cost; goal], [policies, nodes] each,
            where T is the number of steps to the goal.
        """
        quotient, (early, cost) = self.base.quotient, np.zeros((2, *choices.shape))
        dynamics, _ = quotient.dynamics(survival, departing=False)
        for k, choice in enumerate(choices):
            chain = dynamics.chain(choice)
            early[k] = chain.solve(self.base.gain[choice])
            weight = np.where(quotient.model.goal_mask, 1.0, survival * quotient.lift(early[k]))
            costs = quotient.at_pairs(cost_means(quotient.model, weight))
            cost[k] = chain.solve(costs[choice])
        return early, cost

    @property
    def dearest(self) -> float:
        """Least amount by which M is increased, in units: at least the greatest cost of a step."""
        steps = step_costs(self.base.quotient.model)[1]
        return float(steps[-1]) if self.base.by_steps else float(self.base.width)

    def totals(self, cap: float) -> Totals:
        """Return the totals below M = ``cap``, and the first ones beyond, where the tails begin.

        Raises:
            ModelError: the totals are too many.
        """
        base, most = self.base, _MOST_ENTRIES // max(self.base.n_nodes, 1)
        most = min(most, _MOST_LAYERS)
        if not base.by_steps and cap <= most:
            return base.totals(int(np.ceil(cap)))
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
        """Find a policy of least ``objective_weight J_obj + condition_weight J_cond``.

        The first M is the total r from which failing at attention states is optimal, ``w_o r =
        w_d`` for the two weights, unless r is too large. M then grows until the lower bound of
        every policy's payoff agrees with the response's payoff within the accuracy, or up to
        rounding. Their distance falls geometrically as M grows, so the next M is extrapolated from
        the last two. All responses of a player count J_cond from the same origin.

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
            return self._swept(weights, units * (1.0 if self.base.by_steps else 1.0 - SAME_TOTAL))
        cap, sweeps, lost = self._first_cap(weights), 0, dict[float, float]()
        while True:
            response = self._swept(weights, cap)
            layers = response.strategy.totals.size
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            stalled = pays - response.bound > _SLOW * min(lost.values(), default=np.inf)
            lost[cap] = pays - response.bound
            size = response.size(objective_weight, condition_weight)
            wanted = max(accuracy, _LAYER_ROUNDING * layers) * size
            if lost[cap] <= wanted or (stalled and lost[cap] <= _STALLED * size):
                return replace(response, sweeps=sweeps)
            cap = _larger_cap(lost, wanted) + self.dearest

    def _first_cap(self, weights: FloatArray) -> float:
        """Return the first M, in units: the total from which failing is optimal.

        If this total is too large, return a few times the greatest cost of a step instead.
        """
        base, cap = self.base, _FIRST_LAYERS * self.dearest
        if weights[0] == 0.0:
            return cap
        lossless = base.survival * weights[1] / (weights[0] * base.unit)
        return lossless + self.dearest if lossless <= 8 * cap else cap

    def values_of(self, weights: FloatArray, watched: FloatArray, accuracy: float) -> _Iterated:
        """Run value iteration on a single layer.

        Args:
            weights: weights of J_obj and J_cond, [2].
            watched: weight of each node in the comparison of bounds, [nodes].
            accuracy: relative distance of the bounds at which the iteration ends.
        """
        base = self.base
        costs = np.stack([base.gain_cost, base.failure], axis=1)
        dynamics, gamma = base.instant_dynamics, base.survival
        return iterate_values(dynamics, costs, gamma, weights, watched, accuracy=accuracy)

    def _iterated(self, weights: FloatArray, accuracy: float) -> BestResponse:
        """Find the best response on one layer, a policy that depends on the state only."""
        base = self.base
        iterated = self.values_of(weights, base.start, accuracy)
        fixed = np.array([self.start_cost, base.start_failure])
        objective, condition = (base.start @ iterated.totals + fixed).tolist()
        bound = float(base.start @ iterated.values + fixed @ weights)
        choice = (iterated.choice - base.pair_offsets[:-1])[None, None]
        strategy = _Strategy(choice, base.totals(1), iterated.values)
        return BestResponse(objective, condition, bound, strategy, iterated.sweeps)

    def _swept(self, weights: FloatArray, cap: float) -> BestResponse:
        """Find a best response and its bound by a sweep over the layers up to M = ``cap``."""
        base, is_fixed = self.base, self.tail is not None
        tails = self.undiscounted_tail if is_fixed else self.tails
        process = LayeredProcess(base, self.totals(cap), tails)
        price = float(weights[1] / weights[0]) if weights[0] > 0.0 else _DEAREST
        scale = float(weights[0]) if weights[0] > 0.0 else float(weights[1]) / _DEAREST
        sweep, failing = Sweep.of_ends(process), 0.0 if self.origin else price
        choice = sweep.empty_choice()
        costs = at_price(sweep, price, failing)
        objective, failure, goal = sweep.minimise(costs, choice).tolist()
        bound = max(scale * self.lower_bounds(sweep, price, failing)[0][0],
                    -weights[1] * self.origin)  # J_obj is never negative  # fmt: skip
        failed = -base.start_goal - goal if self.origin else base.start_failure + failure
        strategy = _Strategy(choice[None], process.totals, process=process, price=price)
        return BestResponse(objective, failed, float(bound), strategy, 2 * process.cap, self.origin)

    def lower_bounds(
        self, sweep: Sweep, price: float, failing: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return lower bounds of ``J_obj + price * J_cond`` that hold for every policy.

        If ``tail`` is given, they hold for every policy that follows pi'_or beyond M.

        Args:
            sweep: sweep over the layers up to M.
            price: price of J_cond.
            failing: equal to ``price``; or 0, to bound ``J_obj - price * (1 - J_cond)`` instead.

        Returns:
            The bound for the start distribution placed in each layer, [layers]; and for each state
            in each layer, [layers, nodes].
        """
        process: Any = sweep.process
        costs = at_price(sweep, price, failing, bounds=True)
        if self.tail is not None:
            charge, failure, goal = np.moveaxis(process.measures_beyond(price), -1, 0)
            size = charge + failing * failure + (price - failing) * goal
            beyond = process.beyond_value(price, failing) - _ROUNDED * size
            costs = costs._replace(beyond=beyond)
        anything = np.broadcast_to(np.inf, (process.cap, process.base.n_nodes))
        return sweep.bound(costs, anything)

    def surplus(self, price: float, accuracy: float) -> float:
        """Return a lower bound of ``J_obj - price * (1 - J_cond)`` for all policies, rounded down.

        A bound >= 0 proves ``J_obj / (1 - J_cond) >= price`` for all policies. The expression is 0
        for a policy that fails surely, so differences from such a policy keep their digits.
        """
        process = self.response(1.0, price, accuracy).strategy.process
        return float(self.lower_bounds(Sweep.of_ends(process), price, 0.0)[0][0])

    def value_function(self, price: float, responses: Sequence[BestResponse]) -> FloatArray:
        """Compute a value function for ``certify``: lower bounds of ``J_obj + price * J_cond``.

        Args:
            price: price of J_cond.
            responses: the player's responses so far.

        Returns:
            In case M a checked bound for each node, [nodes], followed by that of the start if
            episodes may start in goals or dead-ends; infinite if time is up. In case S only
            infinite entries, so that ``certify`` computes the values itself: [layers, nodes] with
            the most layers of a response, or [1] if the costs have no common unit.
        """
        base = self.base
        if self.counts_total and base.by_steps:
            return np.array([np.inf])
        if self.counts_total:
            shape = max(response.strategy.choice.shape[1:] for response in responses)
            return np.broadcast_to(np.inf, shape)
        is_settled = base.start_goal + base.start_failure > 0.0
        with WithIncumbent(), closing():
            response = self.response(1.0, price, _ACCURACY)
            return np.append(response.strategy.values, [response.bound] * is_settled)
        return np.full(base.n_nodes + is_settled, np.inf)

    def policy(self, response: BestResponse) -> Policy:
        """Return a best response as a policy on the original states, with its memory.

        Successive times with equal decisions share one policy object.
        """
        strategy: _Strategy = response.strategy
        quotient, first, process = self.base.quotient, self.base.pair_offsets[:-1], strategy.process
        stages: list[Policy] = []
        for time, choice in enumerate(strategy.choice):
            if time > 0 and np.array_equal(choice, strategy.choice[time - 1]):
                stages.append(stages[-1])
            elif process is not None:
                stages.append(process.policy(choice, strategy.price))
            else:
                decision = quotient.pull_back(first + choice[0])
                stages.append(DeterministicPolicy(quotient.model, decision))
        return TimedPolicy(tuple(stages)) if len(stages) > 1 else stages[0]


def _larger_cap(loss: Mapping[float, float], target: float) -> float:
    """Return the next M, at which the loss is expected to fall to ``target``.

    The loss is the distance of a response's payoff from its lower bound. The result is at least
    1.25 and at most 4 times the last M.

    Args:
        loss: loss at each M so far.
        target: loss to reach.
    """
    cap = max(loss)
    needed = 2.0 * cap
    smaller = max((c for c in loss if c < cap), default=cap)
    if loss[cap] < loss[smaller] and target > 0.0:
        rate = np.log(loss[smaller] / loss[cap]) / (cap - smaller)
        needed = cap + 1.1 * np.log(loss[cap] / target) / rate
    return min(max(needed, 1.25 * cap), 4.0 * cap)


@dataclass(frozen=True, eq=False)
class BayesPlayer(Player):
    """Best responses among all policies, by backward induction over time (paper, section 3.3).

    J_obj is undiscounted here and J_cond is discounted. The best action therefore depends on the
    adversary's belief, which is a function of time. The operator T of section 3.3, applied to
    values weighted by the probability that a run goes on, is a backward induction over time:

        W_t(x) = min_u w_o G_o(x, u) + gamma^t w_d G_d(x, u) + sum_y p(y | x, u) W_{t+1}(y),

    with W_t = (w_o + gamma^t w_d) J(x, alpha_t). (T as printed in the paper weights G-bar twice.)
    """

    @cached_property
    def stationary(self) -> Player:
        """The player of section 3.5; the value of its game is a lower bound of the Bayesian one."""
        return Player(self.base, self.counts_total, self.start_cost)

    @cached_property
    def last_tail(self) -> tuple[IntArray, LayeredTails]:
        """Pairs, [nodes], and values of the policy that is followed beyond cap and horizon.

        In case M it is the policy of least J_obj. In case S it is the policy of greatest discounted
        failure probability: the policy of greatest undiscounted failure probability (MINPROB,
        ``undiscounted_tail``) would need a much greater cap and horizon. In both cases J_obj is
        undiscounted and J_cond discounted (section 3.3).
        """
        if not self.counts_total:
            return self._cheapest()
        pairs, tails = self.outer_tails
        goal, cost = self.followed_tails(pairs[1:], 1.0)
        values = TailValues(*(each[1:] for each in tails.values))._replace(early=goal, cost=cost)
        return pairs[1], replace(tails, decisions=tails.decisions[1:], values=values)

    def _cheapest(self) -> tuple[IntArray, LayeredTails]:
        """Find the policy of least undiscounted J_obj in case M, by policy iteration.

        Only strict improvements are made, so that every run ends surely under each intermediate
        policy.
        """
        base, quotient, cost = self.base, self.base.quotient, self.base.gain_cost
        dynamics = quotient.dynamics(1.0, departing=False)[0]
        choice = quotient.nearer_goal()
        choice = base.pair_offsets[:-1].copy() if choice is None else choice.astype(np.int32)
        choice, totals, _ = improved_response(dynamics, cost[:, None], np.ones(1), choice)
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
        """Return lower bounds of the weighted cost minus that of sure failure, [totals, nodes].

        If a policy's discounted success probability is s, its cost exceeds that of sure failure by
        at least s (w_o * accumulated cost - w_d). The bound is the least value of this expression
        over the known range of s.

        Args:
            paid: accumulated costs, [totals].
            weights: w_o of J_obj and w_d of J_cond, [2].
        """
        per_success = weights[0] * paid[:, None] - weights[1]
        tails = self.last_tail[1]
        goal = np.where(per_success < 0.0, tails.greatest_goal, tails.least_goal)
        return np.asarray(per_success * goal)

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """Find the best policy of (time, state), in case S of (time, state, accumulated cost).

        The first cap on accumulated cost is that of the stationary player. The horizon is doubled
        until the lower bound equals the policy's payoff within the accuracy. If this hardly reduces
        the gap, the cap is doubled as well. In case M the horizon of ``horizon_of`` suffices for
        every model.

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
        """Return a lower bound of ``J_obj - price * (1 - J_cond)`` for all policies, rounded down.

        A policy that fails surely has exactly the value 0.
        """
        base, gamma = self.base, self.base.survival
        strategy: _Strategy = self.response(1.0, price, accuracy).strategy
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
        """Greatest rounding error of one backup, relative to the sum of its absolute terms."""
        longest = int(np.diff(self.base.steps.indptr).max(initial=0)) + self.base.width
        return (longest + 4) * MACHINE_EPSILON

    def _stage(self, totals: Totals) -> FloatArray:
        """Return the stage cost E[G_o] of each pair in each layer, [pairs, layers]."""
        paid = totals.values[:-1]
        return np.asarray(self.base.gain[:, None] * paid + self.base.gain_cost[:, None])

    @cached_property
    def _blocks(self) -> list[sp.csr_array]:
        """Undiscounted transitions, a matrix [pairs, nodes] for each class of steps (by cost)."""
        base, n = self.base, self.base.n_nodes
        steps = sp.csc_array(base.steps / base.survival)
        return [sp.csr_array(steps[:, k * n : (k + 1) * n]) for k in range(base.width)]

    def _ahead(self, values: FloatArray, totals: Totals) -> FloatArray:
        """Return E[value after the step] of each pair in each layer, [pairs, layers].

        Args:
            values: [nodes, totals].
            totals: the totals, and the layer to which each step leads.
        """
        leads = totals.reached
        parts = (b @ values[:, leads[:, k]] for k, b in enumerate(self._blocks) if b.nnz)
        return np.asarray(sum(parts, np.zeros((len(self.base.gain), totals.size))))

    def _response(self, weights: FloatArray, cap: float, horizon: int) -> BestResponse:
        """Find a best response by backward induction; ``last_tail`` follows after cap and horizon.

        Args:
            weights: weights of J_obj and J_cond, [2].
            cap: M, in units.
            horizon: number of steps.
        """
        base, gamma, totals = self.base, self.base.survival, self.totals(cap)
        cap, every = totals.size, totals.with_beyond
        if cap * horizon * base.n_nodes > _MOST_TIMED_ENTRIES or horizon > _MOST_STEPS:
            layers = f" x {cap:,} layers of accumulated cost" if self.counts_total else ""
            raise ModelError(
                f"runs are too long for the Bayes-adaptive iteration ({horizon:,} steps{layers} on "
                f"{base.n_nodes:,} states): lower the discount or raise the tolerance"
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
            costs = now[0] * stage + now[1] * base.failure[:, None]
            best, below = self._least(costs + self._ahead(lowest, totals))
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
            bound=bound * (1.0 - (horizon + 1) * self._lost),  # sums of non-negative terms
            strategy=_Strategy(choice, totals, process=process),
            sweeps=horizon * cap,
        )

    def _beyond(self, totals: Totals, weights: FloatArray) -> FloatArray:
        """Return lower bounds of every policy's weighted cost after the horizon, [nodes, totals].

        They come from the stationary game, whose J_obj is discounted and therefore no greater.

        Args:
            totals: the totals.
            weights: weights of J_obj and, discounted to the horizon, of J_cond, [2].
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

    def _least(self, costs: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the first best pair of each (node, layer), and its value."""
        first = self.base.pair_offsets[:-1]
        least = np.minimum.reduceat(costs, first, axis=0)
        attains = costs == np.repeat(least, np.diff(self.base.pair_offsets), axis=0)
        number = np.where(attains, np.arange(len(costs))[:, None], len(costs))
        return np.minimum.reduceat(number, first, axis=0), least


def horizon_of(discount: float, condition_weight: float, error: float) -> int:
    """Return a number of steps N such that ``condition_weight * gamma^N`` is at most ``error``.

    From step N on, failing can contribute at most ``error`` to J of section 3.3.
    """
    if condition_weight <= error:
        return 1
    return int(np.ceil(np.log(error / condition_weight) / np.log(discount))) + 1
