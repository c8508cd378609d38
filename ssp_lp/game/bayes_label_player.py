"""Bayes-adaptive value iteration of case M (paper, section 3.3): the unapproximated game.

J_obj is not discounted here and J_cond is, so the two MDPs move alike at different speeds and the
best action depends on the belief, that is on time. Weighed by how likely a run is to go on, the
operator T of section 3.3 along the trajectory of the belief is a backward induction:

    W_t(x) = min_u w_o G_o(x, u) + gamma^t w_d G_d(x, u) + sum_y p(y | x, u) W_{t+1}(y),

with W_t = (w_o + gamma^t w_d) J(x, alpha_t). (T as printed weighs G-bar by probabilities twice.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import best_pairs, chosen_product
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.errors import ModelError
from ssp_lp.game.best_response import BestResponse, iterate_values
from ssp_lp.game.label_player import LabelModels, LabelPlayer
from ssp_lp.model.graph.reachability import goal_pairs
from ssp_lp.policies.remembering import TimedPolicy
from ssp_lp.policies.stationary import DeterministicPolicy

_FIRST_HORIZON = 32
_MOST_STEPS = 100_000
_MOST_ENTRIES = 100_000_000
"""Largest table of decisions, nodes x time."""

_GAIN = 1e-12  # relative improvement below which a pair is kept
_ACCURACY = 1e-13
_ROUGH = 1e-6
"""Accuracy of a bound that only counts as far as a run lasts until the horizon."""


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
    """Best responses among all policies, by backward induction over time."""

    models: LabelModels

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """A non-stationary policy of least weighted cost.

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
        """The response's policy on the model's states, with the time as its memory."""
        strategy: _TimedStrategy = response.strategy
        quotient = self.models.quotient
        rows = [*strategy.choice, strategy.after]
        return TimedPolicy(
            tuple(DeterministicPolicy(quotient.model, quotient.pull_back(r)) for r in rows)
        )

    @cached_property
    def stationary(self) -> LabelPlayer:
        """The player of section 3.5.2, whose game is a lower bound of this one."""
        return LabelPlayer(self.models)

    @cached_property
    def cheapest(self) -> _Cheapest:
        """Least J_obj by policy iteration from a policy that goes for the goal.

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
        """Lower bound of every policy's weighted cost from the horizon on, [nodes].

        Discounting the objective too can only lower it, so the stationary game bounds this one.

        Args:
            weights: with that of J_cond as it has faded by then.
        """
        everywhere = np.full(self.models.n_nodes, 1.0 / max(self.models.n_nodes, 1))
        found = iterate_values(self.stationary.process, weights, everywhere, accuracy=_ROUGH)
        return np.asarray(np.maximum(found.values, weights[0] * self.cheapest.least_objective))

    def _response(
        self, objective_weight: float, condition_weight: float, horizon: int
    ) -> BestResponse:
        """Backward induction from the horizon, where the cheapest policy takes over for good."""
        models, last = self.models, self.cheapest
        costs = np.stack([models.objective, models.condition], axis=1)
        gamma, offsets = models.discount, models.pair_offsets
        weights = np.array([objective_weight, condition_weight])
        lowest = self._beyond(weights * [1.0, gamma**horizon])
        totals, choice = last.totals, np.empty((horizon, models.n_nodes), dtype=np.int32)
        for time in reversed(range(horizon)):
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
    """Steps after which all that is left to fail, ``condition_weight * gamma^N``, is at most error.

    By then J of section 3.3 and that of a player who ignores failing differ by no more.
    """
    if condition_weight <= error:
        return 1
    return int(np.ceil(np.log(error / condition_weight) / np.log(discount))) + 1
