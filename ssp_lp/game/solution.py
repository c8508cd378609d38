"""What the game hands back: c*, its proof, the adversary's weight, and the mixed policy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.game.best_responses.best_response import Player
from ssp_lp.game.optimum import Optimum
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem


@dataclass(frozen=True, eq=False)
class GameSolution:
    """c* of a problem under one construction of the paper."""

    problem: Problem
    player: Player  # the construction: which policies there are and how their costs are counted
    optimum: Optimum

    @property
    def objective(self) -> float:
        """c*, attained by the policy; under the stationary construction c-hat."""
        return self.optimum.objective

    @property
    def lower_bound(self) -> float:
        """No policy whose J_cond keeps to the budget has less."""
        return self.optimum.lower_bound

    @property
    def alpha(self) -> float:
        """alpha*: the adversary's weight of the objective MDP at epsilon*."""
        return self.optimum.alpha

    @property
    def policy(self) -> MixedPolicy:
        """A lottery over one or two deterministic policies on the original states."""
        threshold = self.optimum.threshold
        members = tuple(self.player.policy(r) for r in threshold.members)
        return MixedPolicy(members, np.array(threshold.weights))
