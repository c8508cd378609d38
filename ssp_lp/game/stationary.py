"""c-hat and the mixed policy of section 3.5 of the paper, by the game alone: no LP anywhere."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, FloatArray
from ssp_lp.compiled.deadline import WithIncumbent, closing
from ssp_lp.errors import ModelError, check_between_0_and_1
from ssp_lp.game.best_response import BestResponse, Player
from ssp_lp.game.cost_player import CostPlayer
from ssp_lp.game.label_player import LabelModels, LabelPlayer
from ssp_lp.game.optimum import GameSolution, find_optimum
from ssp_lp.game.setting import construct, infeasible
from ssp_lp.game.threshold import Threshold, extremes, find_threshold
from ssp_lp.options import Progress
from ssp_lp.problem import Problem

_TIGHT, _LESS_TIGHT = 1e-12, 1e-10
"""Accuracy of value functions; that of case S only settles how many layers there are."""


def stationary_player(problem: Problem) -> LabelPlayer | CostPlayer:
    """The operator T_alpha of the problem's case.

    Raises:
        ModelError: no discount, or a budget that is not above 0.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    built = construct(problem)
    return LabelPlayer(built) if isinstance(built, LabelModels) else CostPlayer.of(built)


def stationary_game(
    problem: Problem, *, tolerance: float = 1e-9, progress: Progress | None = None
) -> GameSolution:
    """Solve a problem by the paper's game and value iteration (Theorems 3-5 and 3-11).

    The policies are stationary in the state, in case S in the state and the cost paid; J_obj and
    J_cond are both discounted.

    Args:
        problem: with a discount and a failure budget above 0.
        tolerance: relative distance between c-hat and its lower bound to reach.
        progress: told after each game of (responses, price of failure, upper end).

    Raises:
        ModelError: no discount, no budget or one of 0, a tolerance outside (0, 1), or a table of
            decisions that would be too large.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = stationary_player(problem)
    return find_optimum(problem, player, tolerance=tolerance, progress=progress)


def value_function(solution: GameSolution) -> FloatArray:
    """A checked value function of the stationary game: lower bounds of ``J_obj + price * J_cond``.

    Case M: [states of the process]. Case S: infinite, [layers, nodes], which asks ``certify`` for
    the best that it can prove with so many layers; [1] where costs have no common unit.

    Where no time is left the values are infinite throughout.

    Raises:
        ModelError: not a solution of ``stationary_game``.
    """
    player, price = solution.player, solution.price
    with WithIncumbent() as search, closing():
        if isinstance(player, LabelPlayer):
            return player.values(player.response(1.0, price, _TIGHT))
        if isinstance(player, CostPlayer) and player.base.by_steps:
            return np.array([np.inf])
        if isinstance(player, CostPlayer):
            best = player.response(1.0, price, _LESS_TIGHT)
            return np.broadcast_to(np.inf, best.strategy.choice.shape)
    if search.stop:
        return np.broadcast_to(np.inf, _stationary_shape(player, solution.threshold))
    raise ModelError("only the stationary game has a value function of the state")


def _stationary_shape(player: Player, found: Threshold) -> tuple[int, ...]:
    """The shape of a value function: [nodes and perhaps the start], or [layers, nodes]."""
    if isinstance(player, LabelPlayer):
        models = player.models
        return (models.discounted_dynamics.n_states + int(models.start_settled > 0.0),)
    return max(r.strategy.choice.shape for r in found.members)


def thresholds(
    problem: Problem, budgets: Iterable[float], *, tolerance: float = 1e-9
) -> list[Threshold]:
    """c* of each epsilon' by itself: the curve whose minimum Theorem 3-1 takes in case S.

    Args:
        problem: says the case, the start and the discount; of its own budget only that there is
            one above 0.
        budgets: each at least the least discounted failure, and in case S below 1.
        tolerance: relative distance between each c* and its lower bound to reach.

    Raises:
        ModelError: no discount, no budget, or one of the budgets outside (0, 1], in case S (0, 1).
        InfeasibleError: a budget below the least discounted failure.
    """
    check_between_0_and_1("tolerance", tolerance)
    player = stationary_player(problem)
    known: tuple[BestResponse, ...] = extremes(player, 0.1 * tolerance)
    found: list[Threshold] = []
    for budget in budgets:
        if not 0.0 < budget <= 1.0 or (problem.ratio and budget == 1.0):
            raise ModelError(f"c* of epsilon' = {budget!r} is not defined: it must be above 0, in "
                             "case S below 1")  # fmt: skip
        least = known[0].bound + known[0].origin
        if least > budget + LEAST_BUDGET:
            raise infeasible(problem, budget, least)
        share = 1.0 - budget if problem.ratio else 1.0
        found.append(find_threshold(player, budget, share, known, tolerance=tolerance))
        known = found[-1].responses
    return found
