"""c-hat and the mixed policy of section 3.5 of the paper, by the game alone: no LP anywhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.crosscheck.cost_game import CostPlayer
from ssp_lp.crosscheck.label_game import LabelPlayer
from ssp_lp.crosscheck.models import label_models
from ssp_lp.crosscheck.optimum import Optimum, find_optimum
from ssp_lp.crosscheck.reply import Player, Reply
from ssp_lp.crosscheck.setting import check_reachable, checked_setting
from ssp_lp.crosscheck.threshold import ENDLESS, Patience, Threshold, extremes, find_threshold
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.process.accumulated_cost import accumulate_cost
from ssp_lp.process.semantics import start_distribution

StationaryPlayer = LabelPlayer | CostPlayer


@dataclass(frozen=True, eq=False)
class StationaryGame:
    """c-hat with its proof, alpha*, and the mixed policy that attains it (Theorems 3-5, 3-11)."""

    problem: Problem
    player: StationaryPlayer
    optimum: Optimum

    @property
    def objective(self) -> float:
        """c-hat, attained by the policy."""
        return self.optimum.objective

    @property
    def lower_bound(self) -> float:
        """No policy within the budget has less."""
        return self.optimum.lower_bound

    @property
    def alpha(self) -> float:
        """alpha*: the adversary's weight of the objective MDP at epsilon*."""
        return self.optimum.alpha

    @property
    def policy(self) -> MixedPolicy:
        """P_{gamma,epsilon}: a lottery over one or two deterministic stationary policies."""
        return lottery(self.player, self.optimum.threshold)

    @property
    def values(self) -> FloatArray:
        """A checked lower bound of ``J_obj + price * J_cond`` from each state of the process.

        Case S: infinite, [layers, nodes], which asks ``certify`` for the best it can prove.
        """
        price = self.optimum.price
        if isinstance(self.player, CostPlayer):
            best = self.player.reply(1.0, price, 1e-10)
            return np.broadcast_to(np.inf, best.strategy.choice.shape)
        return self.player.values(self.player.reply(1.0, price, 1e-12))


def lottery(player: Player, threshold: Threshold) -> MixedPolicy:
    """The mixture of a threshold on the original states."""
    members = tuple(player.policy(r) for r in threshold.members)
    return MixedPolicy(members, np.array(threshold.weights))


def stationary_player(problem: Problem) -> StationaryPlayer:
    """The operator T_alpha of the problem's case.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    discount = checked_setting(problem)[1]
    start = start_distribution(problem.model, problem.start)
    if not problem.ratio:
        return LabelPlayer(label_models(problem.model, start, problem.semantics, discount))
    check_reachable(problem)
    return CostPlayer(accumulate_cost(problem.model, start, discount))


def stationary_game(
    problem: Problem, *, tolerance: float = 1e-9, patience: Patience = ENDLESS
) -> StationaryGame:
    """Solve a problem by the paper's game and value iteration over stationary policies.

    Args:
        problem: with a discount and a failure budget above 0.
        tolerance: relative distance between c-hat and its lower bound to reach.
        patience: when to stop before that, with the bounds as they are.

    Raises:
        ModelError: no discount, no budget, or a budget of 0.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    player = stationary_player(problem)
    optimum = find_optimum(problem, player, tolerance=tolerance, patience=patience)
    return StationaryGame(problem, player, optimum)


def thresholds(
    problem: Problem, budgets: Iterable[float], *, tolerance: float = 1e-9
) -> list[Threshold]:
    """c* of each epsilon' by itself: the curve whose minimum Theorem 3-1 takes in case S.

    Args:
        problem: says the case, the start and the discount; its own budget does not matter.
        budgets: each above the least discounted failure, and below 1 in case S.
        tolerance: relative distance between each c* and its lower bound to reach.
    """
    player = stationary_player(problem)
    known: tuple[Reply, ...] = extremes(player, 0.1 * tolerance)
    found: list[Threshold] = []
    for budget in budgets:
        share = 1.0 - budget if problem.ratio else 1.0
        found.append(find_threshold(player, budget, share, known, tolerance=tolerance))
        known = found[-1].replies
    return found
