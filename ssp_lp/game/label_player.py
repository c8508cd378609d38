"""Case M: its two MDPs (paper, section 3.1.2) on the live states labelled s, and their player.

M_o and M_{d,gamma} have the same states, actions and successors; they differ in what a step costs,
and in that a step of M_{d,gamma} goes on with probability gamma only. States labelled f are left
out: nothing is paid there, and the failure cost from there on is ``sum (1 - gamma) gamma^t = 1``.
So are dead-ends, where giving up at once is best. Wandering for ever at no cost costs the same as
giving up free of charge, so that a pair of that kind is added where the model allows wandering.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.game.best_response import BestResponse, Discounted, Iterated, iterate_values
from ssp_lp.model import SSP
from ssp_lp.model.graph.end_components import end_components
from ssp_lp.model.graph.reachability import attention_states
from ssp_lp.policies.policy import GIVE_UP_CODE
from ssp_lp.policies.stationary import DeterministicPolicy
from ssp_lp.processes.expectations import cost_means, costless_pairs, successor_means
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    give_up_charges,
)
from ssp_lp.processes.quotient import Quotient, build_quotient


@dataclass(frozen=True, eq=False)
class LabelModels:
    """M_o^(M) and M_{d,gamma}^(M): common pairs, the stage costs of each, and the start."""

    quotient: Quotient
    discount: float
    dynamics: Dynamics  # real probabilities of going on
    paid: FloatArray  # [pairs] E[G_o] of the step itself
    charged: FloatArray  # [pairs] E[G_o] of the step after it, where that enters a dead-end
    lost: FloatArray  # [pairs] probability of entering a dead-end
    hit: FloatArray  # [pairs] probability of reaching the goal
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
        """Pairs of each node, [nodes + 1]."""
        return self.quotient.pair_offsets

    @property
    def discounted_dynamics(self) -> Dynamics:
        """The same, where each step is survived with probability gamma."""
        real, gamma = self.dynamics, self.discount
        exits = (1.0 - gamma) + gamma * real.exits
        return Dynamics(real.pair_offsets, sp.csr_array(gamma * real.transitions), exits)

    @property
    def gives_up(self) -> BoolArray:
        """Pairs (u, f) that declare failure, [pairs]."""
        return np.asarray(self.quotient.pair_at == GIVE_UP_CODE)

    @property
    def condition(self) -> FloatArray:
        """E[G_{d,gamma}] of each pair, with all that follows an entered dead-end, [pairs]."""
        gamma = self.discount
        return np.where(self.gives_up, 1.0, (1.0 - gamma) + gamma * self.lost)

    @property
    def discounted_objective(self) -> FloatArray:
        """E[G_o] in M_{o,gamma}^(M) of section 3.5, where an entered dead-end is paid later."""
        return self.paid + self.discount * self.charged

    @property
    def objective(self) -> FloatArray:
        """E[G_o] in M_o^(M), with what an entered dead-end charges, [pairs]."""
        return self.paid + self.charged


def label_models(
    model: SSP, start: FloatArray, semantics: FailureSemantics, discount: float
) -> LabelModels:
    """Build the two MDPs.

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
        hit=quotient.at_pairs(successor_means(model, model.goal_mask)),
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
        """M_{o,gamma}^(M) and M_{d,gamma}^(M), whose transitions agree under discounting."""
        models = self.models
        return Discounted(
            dynamics=models.discounted_dynamics,
            costs=np.stack([models.discounted_objective, models.condition], axis=1),
            discount=models.discount,
        )

    def response(
        self, objective_weight: float, condition_weight: float, accuracy: float
    ) -> BestResponse:
        """A stationary policy of least weighted cost."""
        models, weights = self.models, np.array([objective_weight, condition_weight])
        found = iterate_values(self.process, weights, models.start, accuracy=accuracy)
        fixed = np.array([models.start_objective, models.start_condition])
        objective, condition = (models.start @ found.totals + fixed).tolist()
        bound = float(models.start @ found.values + fixed @ weights)
        return BestResponse(objective, condition, bound, found, found.sweeps)

    def values(self, response: BestResponse) -> FloatArray:
        """A checked lower bound of ``J_obj + price * J_cond``, from a response to (1, price).

        Returns:
            [nodes], and at the end that of the start, where it is not live with certainty.
        """
        found: Iterated = response.strategy
        settled = self.models.start_settled > 0.0
        return np.append(found.values, response.bound) if settled else found.values

    def policy(self, response: BestResponse) -> DeterministicPolicy:
        """The response's policy on the model's states."""
        found: Iterated = response.strategy
        quotient = self.models.quotient
        return DeterministicPolicy(quotient.model, quotient.pull_back(found.choice))
