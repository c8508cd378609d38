"""c-hat and the mixed policy of section 3.5 of the paper, by the game alone: no LP anywhere."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, FloatArray
from ssp_lp.crosscheck.cost_game import CostPlayer
from ssp_lp.crosscheck.label_game import LabelPlayer
from ssp_lp.crosscheck.models import label_models
from ssp_lp.crosscheck.reply import Reply
from ssp_lp.crosscheck.setting import checked_setting, infeasible, unreachable
from ssp_lp.crosscheck.threshold import ENDLESS, Patience, Threshold, extremes, find_threshold
from ssp_lp.errors import SolverError
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.process.accumulated_cost import accumulate_cost
from ssp_lp.process.semantics import start_distribution

_MOST_STEPS = 100
_MARGINS = (0.25, 4.0, 64.0, 1024.0)
"""Multiples of the tolerance by which a bound of the least ratio is put below it."""

_SURE_FAILURE = 1.0 - 1e-12
"""J_cond from which a policy's success is rounding and no cost given success can be told."""

StationaryPlayer = LabelPlayer | CostPlayer


@dataclass(frozen=True, eq=False)
class StationaryGame:
    """c-hat with its proof, alpha*, and the mixed policy that attains it (Theorems 3-5, 3-11)."""

    problem: Problem
    player: StationaryPlayer
    threshold: Threshold  # the games at epsilon*
    spent: float  # epsilon*: the budget; in case S the epsilon' in (0, epsilon] of least c*
    objective: float  # c-hat, attained by the policy
    lower_bound: float  # no policy within the budget has less
    alpha: float  # alpha* at epsilon*
    price: float  # weight of J_cond against J_obj at alpha*: lambda in case M, kappa in case S

    @property
    def policy(self) -> MixedPolicy:
        """P_{gamma,epsilon}: a lottery over one or two deterministic stationary policies."""
        members = tuple(self.player.policy(r) for r in self.threshold.members)
        return MixedPolicy(members, np.array(self.threshold.weights))

    @property
    def values(self) -> FloatArray:
        """A checked lower bound of ``J_obj + price * J_cond`` from each state of the process.

        Case S: infinite, [layers, nodes], which asks ``certify`` for the best it can prove.
        """
        if isinstance(self.player, CostPlayer):
            best = self.player.reply(1.0, self.price, 1e-10)
            return np.broadcast_to(np.inf, best.strategy.choice.shape)
        best = self.player.reply(1.0, self.price, 1e-12)
        return self.player.values(best, self.price)


def stationary_player(problem: Problem) -> StationaryPlayer:
    """The operator T_alpha of the problem's case."""
    discount = checked_setting(problem)[1]
    start = start_distribution(problem.model, problem.start)
    if problem.ratio:
        return CostPlayer(accumulate_cost(problem.model, start, discount))
    return LabelPlayer(label_models(problem.model, start, problem.semantics, discount))


def stationary_game(
    problem: Problem, *, tolerance: float = 1e-9, patience: Patience = ENDLESS
) -> StationaryGame:
    """Solve a problem by the paper's game and value iteration.

    Case M: c-hat is the least c whose game value is at most c. Case S: c-hat is the least such
    value over all epsilon' in (0, epsilon] (Theorem 3-1). Where failing is worth more than c at
    epsilon itself, that is where it lies; otherwise it lies where failing is worth exactly c.

    Args:
        problem: with a discount and a failure budget above 0.
        tolerance: relative distance between c-hat and its lower bound to reach.
        patience: when to stop before that, with the bounds as they are.

    Raises:
        ModelError: no discount, no budget, or a budget of 0.
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    budget, _ = checked_setting(problem)
    player = stationary_player(problem)
    if isinstance(player, CostPlayer) and not player.base.start_goal + player.base.start.sum():
        raise unreachable(budget)
    known = extremes(player, 0.1 * tolerance, patience)
    if known[0].condition > budget + LEAST_BUDGET:
        raise infeasible(problem, budget, known[0].condition)
    if isinstance(player, CostPlayer):
        return _ratio_game(problem, player, budget, known, tolerance, patience)
    found = find_threshold(player, budget, 1.0, known, tolerance=tolerance, patience=patience)
    return StationaryGame(
        problem, player, found, found.budget, found.high, found.low, found.game.alpha,
        found.failure_price,
    )  # fmt: skip


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
    known, found = extremes(player, 0.1 * tolerance), []
    for budget in budgets:
        share = 1.0 - budget if problem.ratio else 1.0
        found.append(find_threshold(player, budget, share, known, tolerance=tolerance))
        known = found[-1].replies
    return found


def _ratio_game(
    problem: Problem,
    player: CostPlayer,
    budget: float,
    known: tuple[Reply, ...],
    tolerance: float,
    patience: Patience,
) -> StationaryGame:
    """Theorem 3-1: the least c* over epsilon' in (0, epsilon].

    c* = F(e) / (1 - e), with F the convex least J_obj at J_cond = e, falls while ``-F'(e) > c*``
    and rises after: either it still falls at the budget, or its minimum is where failing is worth
    exactly c*, at a single policy.
    """
    best, replies = _least_ratio(player, known, tolerance, patience)
    spent = min(best.condition, budget)
    found = find_threshold(
        player, spent, 1.0 - spent, replies, tolerance=tolerance, patience=patience
    )
    if best.condition > budget:
        price, alpha = found.failure_price, found.game.alpha
        return StationaryGame(problem, player, found, found.budget, found.high, found.low,
                              alpha, price)  # fmt: skip
    lower = _slack_bound(player, found.high, tolerance)
    return StationaryGame(problem, player, found, spent, found.high, lower, 1.0 - spent, found.high)


def _slack_bound(player: CostPlayer, ratio: float, tolerance: float) -> float:
    """A ratio a little below the least one, such that every policy is seen to have more.

    There it is strictly best to fail, by a margin that no rounding reaches.
    """
    for share in _MARGINS:
        below = ratio * (1.0 - share * tolerance)
        if player.surplus(below, 0.1 * tolerance) >= 0.0:
            return below
    return 0.0


def _least_ratio(
    player: CostPlayer, known: tuple[Reply, ...], tolerance: float, patience: Patience
) -> tuple[Reply, tuple[Reply, ...]]:
    """A policy of least J_obj / (1 - J_cond), whatever it fails, and all replies so far.

    A ratio c is least if no policy has less than c of ``J_obj + c J_cond``: a policy that has less
    has a smaller ratio, which is tried next.

    Raises:
        SolverError: every policy fails but for rounding.
    """
    replies = list(known)
    hopeful = [r for r in replies if r.condition < _SURE_FAILURE]
    if not hopeful:
        raise SolverError(
            f"the game cannot tell costs given success: the goal is reached with a (discounted) "
            f"probability of at most {1.0 - known[0].condition:.1e}"
        )
    best = min(hopeful, key=_ratio)
    for _ in range(_MOST_STEPS):
        c = _ratio(best)
        if time.perf_counter() > patience.deadline:
            break
        reply = player.reply(1.0, c, 0.1 * tolerance)
        if reply.condition >= _SURE_FAILURE or _ratio(reply) >= c * (1.0 - 1e-15):
            break
        replies.append(reply)
        best = reply
    return best, tuple(replies)


def _ratio(reply: Reply) -> float:
    return reply.objective / (1.0 - reply.condition)
