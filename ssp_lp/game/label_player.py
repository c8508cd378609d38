"""Case M: its two MDPs (paper, section 3.1.2) on the live states labelled s, and their players.

M_o and M_{d,gamma} have the same states, actions and successors; they differ in what a step costs,
and in that a step of M_{d,gamma} goes on with probability gamma only. States labelled f are left
out: nothing is paid there, and the failure cost from there on is ``sum (1 - gamma) gamma^t = 1``.
So are dead-ends, where giving up at once is best. Wandering for ever at no cost costs the same as
giving up free of charge, so that a pair of that kind is added where the model allows wandering.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.compiled.deadline import backward
from ssp_lp.dynamic_programming.bellman import best_pairs, chosen_product
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse, Discounted, Iterated, iterate_values
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_states, end_components, goal_pairs
from ssp_lp.policies.policy import DeterministicPolicy
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    give_up_charges,
)
from ssp_lp.processes.live_rows import cost_means, costless_pairs, successor_means
from ssp_lp.processes.quotient import Quotient, build_quotient

_FIRST_HORIZON = 32
_MOST_STEPS = 100_000
_MOST_ENTRIES = 100_000_000
"""Largest table of decisions, nodes x time."""

_TIGHT = 1e-12  # accuracy of value functions
_GAIN = 1e-12  # relative improvement below which a pair is kept
_ACCURACY = 1e-13
_ROUGH = 1e-6
"""Accuracy of a bound that only counts as far as a run lasts until the horizon."""


@dataclass(frozen=True, eq=False)
class LabelModels:
    """M_o^(M) and M_{d,gamma}^(M): common pairs, the stage costs of each, and the start."""

    quotient: Quotient
    discount: float
    dynamics: Dynamics  # real probabilities of going on
    paid: FloatArray  # [pairs] E[G_o] of the step itself
    charged: FloatArray  # [pairs] E[G_o] of the step after it, where that enters a dead-end
    lost: FloatArray  # [pairs] probability of entering a dead-end
    start: FloatArray  # [nodes]
    start_objective: float  # J_obj of start mass on dead-ends
    start_condition: float  # J_cond of it
    start_settled: float  # start mass on dead-ends and goals

    @property
    def n_nodes(self) -> int:
        """Number of live states that the label player moves in."""
        return self.quotient.n_nodes

    @property
    def pair_offsets(self) -> IntArray:
        """Offsets of the label player's pairs by node, [nodes + 1]."""
        return self.quotient.pair_offsets

    @property
    def discounted_dynamics(self) -> Dynamics:
        """Dynamics of the label player's MDPs, each step survived with probability gamma."""
        real, gamma = self.dynamics, self.discount
        exits = (1.0 - gamma) + gamma * real.exits
        return Dynamics(real.pair_offsets, sp.csr_array(gamma * real.transitions), exits)

    @property
    def condition(self) -> FloatArray:
        """E[G_{d,gamma}] of the label player's pairs, [pairs]; of dead-ends all that follows."""
        gamma = self.discount
        return np.where(self.quotient.gives_up, 1.0, (1.0 - gamma) + gamma * self.lost)

    @property
    def discounted_objective(self) -> FloatArray:
        """E[G_o] of the label player in M_{o,gamma}^(M), section 3.5: dead-ends are paid later."""
        return self.paid + self.discount * self.charged

    @property
    def objective(self) -> FloatArray:
        """E[G_o] of the label player in M_o^(M), with the charge of dead-ends entered, [pairs]."""
        return self.paid + self.charged


def label_models(
    model: SSP, start: FloatArray, semantics: FailureSemantics, discount: float
) -> LabelModels:
    """Build the label player's two MDPs.

    Args:
        model: the model.
        start: distribution over states, [states].
        semantics: where giving up is allowed and whether failing is charged.
        discount: gamma.
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
    return LabelModels(
        quotient=quotient,
        discount=discount,
        dynamics=quotient.dynamics(1.0, departing=False)[0],
        paid=quotient.at_pairs(cost_means(model), charge),
        charged=quotient.at_pairs(successor_means(model, entering)),
        lost=quotient.at_pairs(successor_means(model, quotient.dead)),
        start=quotient.gather(start),
        start_objective=float(start @ entering),
        start_condition=float(start[quotient.dead].sum()),
        start_settled=float(start[quotient.dead | model.goal_mask].sum()),
    )


@dataclass(frozen=True, eq=False)
class LabelPlayer:
    """Best responses among stationary policies of the state alone, by the operator T_alpha."""

    models: LabelModels

    @cached_property
    def process(self) -> Discounted:
        """The label player's M_{o,gamma}^(M) and M_{d,gamma}^(M) as one process."""
        models = self.models
        return Discounted(
            dynamics=models.discounted_dynamics,
            costs=np.stack([models.discounted_objective, models.condition], axis=1),
            discount=models.discount,
        )

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """The label player's best response: a stationary policy of least weighted cost."""
        models, weights = self.models, np.array([objective_weight, condition_weight])
        iterated = iterate_values(self.process, weights, models.start, accuracy=accuracy)
        fixed = np.array([models.start_objective, models.start_condition])
        objective, condition = (models.start @ iterated.totals + fixed).tolist()
        bound = float(models.start @ iterated.values + fixed @ weights)
        return BestResponse(objective, condition, bound, iterated, iterated.sweeps)

    def value_function(self, price: float) -> FloatArray:
        """The label player's checked lower bounds of ``J_obj + price * J_cond``.

        Returns:
            [nodes], and at the end that of the start, where it is not live with certainty.
        """
        response = self.response(1.0, price, _TIGHT)
        values: FloatArray = response.strategy.values
        return np.append(values, response.bound) if self.models.start_settled > 0.0 else values

    def value_shape(self, responses: Sequence[BestResponse]) -> tuple[int, ...]:
        """Shape of the label player's value function, whatever the responses."""
        return (self.models.n_nodes + int(self.models.start_settled > 0.0),)

    def policy(self, response: BestResponse) -> DeterministicPolicy:
        """The label player's response on the model's states."""
        iterated: Iterated = response.strategy
        quotient = self.models.quotient
        return DeterministicPolicy(quotient.model, quotient.pull_back(iterated.choice))


@dataclass(frozen=True, eq=False)
class _TimedStrategy:
    """A pair for each (time, node) up to the horizon, and one for each node from there on."""

    choice: IntArray  # [horizon, nodes]
    after: IntArray  # [nodes]


@dataclass(frozen=True, eq=False)
class _Cheapest:
    """The policy of least undiscounted J_obj, which is followed beyond the horizon."""

    choice: IntArray  # [nodes]
    totals: FloatArray  # [nodes, 2] (J_obj, J_cond) of it
    least_objective: FloatArray  # [nodes] checked lower bound of every policy's J_obj


@dataclass(frozen=True, eq=False)
class BayesLabelPlayer:
    """Best responses among all policies, by backward induction over time (paper, section 3.3).

    J_obj is not discounted here and J_cond is, so the two MDPs move alike at different speeds and
    the best action depends on the belief, that is on time. Weighed by how likely a run is to go
    on, the operator T of section 3.3 along the trajectory of the belief is a backward induction:

        W_t(x) = min_u w_o G_o(x, u) + gamma^t w_d G_d(x, u) + sum_y p(y | x, u) W_{t+1}(y),

    with W_t = (w_o + gamma^t w_d) J(x, alpha_t). (T as printed weighs G-bar twice.)
    """

    models: LabelModels

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """The Bayesian label player's best response: a non-stationary policy.

        The horizon is doubled until the bound meets what the policy pays; at the horizon that
        gamma prescribes (``horizon_of``) it does so whatever the model.

        Raises:
            ModelError: the table of decisions would be too large.
        """
        horizon, sweeps = _FIRST_HORIZON, 0
        while True:
            response = self._response(objective_weight, condition_weight, horizon)
            sweeps += response.sweeps
            pays = response.payoff(objective_weight, condition_weight)
            error = max(accuracy, _ACCURACY) * pays
            enough = horizon_of(self.models.discount, condition_weight, error) if error else 0
            if pays - response.bound <= error or horizon >= enough:
                return replace(response, sweeps=sweeps)
            horizon = min(2 * horizon, enough)
            if horizon * self.models.n_nodes > _MOST_ENTRIES or horizon > _MOST_STEPS:
                raise ModelError(
                    f"{horizon:,} steps on {self.models.n_nodes:,} states are too many for the "
                    "Bayes-adaptive iteration: runs are too long"
                )

    def policy(self, response: BestResponse) -> TimedPolicy:
        """The Bayesian label player's response on the model's states; it remembers the time."""
        strategy: _TimedStrategy = response.strategy
        quotient = self.models.quotient
        rows = [*strategy.choice, strategy.after]
        return TimedPolicy(
            tuple(DeterministicPolicy(quotient.model, quotient.pull_back(r)) for r in rows)
        )

    @cached_property
    def stationary(self) -> LabelPlayer:
        """The label player of section 3.5.2, whose game is a lower bound of the Bayesian one."""
        return LabelPlayer(self.models)

    @cached_property
    def cheapest(self) -> _Cheapest:
        """The Bayesian label player's least J_obj, by policy iteration.

        Only strict gains are taken, so that every policy on the way leaves for good.
        """
        models, offsets = self.models, self.models.pair_offsets
        model, cost = models.quotient.model, models.objective
        choice = models.quotient.nearer(goal_pairs(model))
        choice = offsets[:-1].copy() if choice is None else choice.astype(np.int32)
        while True:
            values = models.dynamics.chain(choice).solve(cost[choice])
            backup = best_pairs(offsets, models.dynamics.transitions, cost, values, choice)
            better = backup.minima < backup.here * (1.0 - _GAIN)
            if not better.any():
                break
            choice = np.where(better, backup.choice, choice)
        discounted = self.stationary.process.dynamics.chain(choice)
        condition = discounted.solve(models.condition[choice])
        return _Cheapest(
            choice=choice,
            totals=np.stack([values, condition], axis=1),
            least_objective=sub_solution(models.dynamics, cost, values),
        )

    def _beyond(self, weights: FloatArray) -> FloatArray:
        """The Bayesian label player's lower bound of weighted cost from the horizon on, [nodes].

        Discounting the objective too can only lower it, so the stationary game bounds this one.

        Args:
            weights: with that of J_cond as it has faded by then.
        """
        everywhere = np.full(self.models.n_nodes, 1.0 / max(self.models.n_nodes, 1))
        iterated = iterate_values(self.stationary.process, weights, everywhere, accuracy=_ROUGH)
        return np.asarray(np.maximum(iterated.values, weights[0] * self.cheapest.least_objective))

    def _response(
        self, objective_weight: float, condition_weight: float, horizon: int
    ) -> BestResponse:
        """Backward induction of the Bayesian label player, then the cheapest policy for good."""
        models, last = self.models, self.cheapest
        costs = np.stack([models.objective, models.condition], axis=1)
        gamma, offsets = models.discount, models.pair_offsets
        weights = np.array([objective_weight, condition_weight])
        lowest = self._beyond(weights * [1.0, gamma**horizon])
        totals, choice = last.totals, np.empty((horizon, models.n_nodes), dtype=np.int32)
        for time in backward(horizon):
            priced = costs @ (weights * [1.0, gamma**time])
            backup = best_pairs(offsets, models.dynamics.transitions, priced, lowest)
            choice[time], lowest = backup.choice, backup.minima
            onward = chosen_product(
                models.dynamics.transitions, backup.choice, totals * [1.0, gamma]
            )
            totals = costs[backup.choice] + onward
        fixed = np.array([models.start_objective, models.start_condition])
        objective, condition = (models.start @ totals + fixed).tolist()
        bound = float(models.start @ lowest + fixed @ weights)
        longest = int(np.diff(models.dynamics.transitions.indptr).max(initial=0))
        bound *= 1.0 - (horizon + 1) * (longest + 4) * MACHINE_EPSILON  # of non-negative sums
        return BestResponse(
            objective, condition, bound, _TimedStrategy(choice, last.choice), horizon
        )


def horizon_of(discount: float, condition_weight: float, error: float) -> int:
    """Horizon of a Bayesian player: steps until ``condition_weight * gamma^N`` is at most error.

    By then J of section 3.3 and that of a player who ignores failing differ by no more.
    """
    if condition_weight <= error:
        return 1
    return int(np.ceil(np.log(error / condition_weight) / np.log(discount))) + 1
