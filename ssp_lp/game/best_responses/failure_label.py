"""The player of case M: value iteration on the label of section 3.1.2 (paper, section 3.5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.game.best_responses.best_response import BestResponse
from ssp_lp.game.best_responses.value_iteration import Discounted, Iterated, iterate_values
from ssp_lp.game.models import LabelModels
from ssp_lp.policies.deterministic import DeterministicPolicy


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
