"""c* of a problem: the threshold at its budget, or in case S at the best epsilon' below it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.compiled.deadline import WithIncumbent, closing, is_late
from ssp_lp.errors import SolverError
from ssp_lp.game.best_response import BestResponse, Player, RatioPlayer
from ssp_lp.game.setting import infeasible
from ssp_lp.game.threshold import Threshold, extremes, find_threshold
from ssp_lp.options import Progress
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem

_MOST_STEPS = 100
_MARGINS = (0.25, 4.0, 64.0, 1024.0)
"""Multiples of the tolerance by which a bound of the least ratio is put below it."""

_ROUNDED_SUCCESS = 1e-12
"""Success up to which it is rounding, where it is what J_cond leaves over."""


@dataclass(frozen=True, eq=False)
class GameSolution:
    """c* of a problem under one construction of the paper, with its proof."""

    problem: Problem
    player: Player  # the construction: which policies there are and how their costs are counted
    threshold: Threshold  # the games at epsilon*, with the mixed policy
    spent: float  # epsilon*: the budget; in case S the epsilon' in (0, epsilon] of least c*
    objective: float  # c*, attained by the policy; under the stationary construction c-hat
    lower_bound: float  # no policy whose J_cond keeps to the budget has less
    alpha: float  # alpha*: the adversary's weight of the objective MDP at epsilon*
    price: float  # weight of J_cond against J_obj at alpha*: lambda in case M, kappa in case S

    @property
    def policy(self) -> MixedPolicy:
        """A lottery over one or two deterministic policies on the original states."""
        members = tuple(self.player.policy(r) for r in self.threshold.members)
        return MixedPolicy(members, np.array(self.threshold.weights))


def find_optimum(
    problem: Problem, player: Player, *, tolerance: float, progress: Progress | None = None
) -> GameSolution:
    """Find c* of a problem by its player's best responses.

    Case M: the least c whose game value is at most c. Case S: the least such value over all
    epsilon' in (0, epsilon] (Theorem 3-1). Where failing is worth more than c at epsilon itself,
    that is where it lies; otherwise it lies where failing is worth exactly c.

    Args:
        problem: says the case and the budget.
        player: of the same case.
        tolerance: relative distance between c* and its lower bound to reach.
        progress: told after each game of (responses, price of failure, upper end).

    Raises:
        InfeasibleError: the discounted failure of every policy exceeds the budget.
    """
    budget = float(problem.failure_budget or 0.0)
    known = extremes(player, 0.1 * tolerance)
    least = known[0].bound + known[0].origin
    if least > budget + LEAST_BUDGET:
        raise infeasible(problem, budget, least)
    if problem.ratio:
        return _ratio_optimum(problem, cast(RatioPlayer, player), known, tolerance, progress)
    found = find_threshold(player, budget, 1.0, known, tolerance=tolerance, progress=progress)
    return _optimum_at_budget(problem, player, found, found.low)


def _optimum_at_budget(
    problem: Problem, player: Player, found: Threshold, lower: float
) -> GameSolution:
    """The optimum of the game at a budget."""
    alpha, price = found.game.alpha, found.failure_price
    return GameSolution(problem, player, found, found.budget, found.high, lower, alpha, price)


def _ratio_optimum(
    problem: Problem,
    player: RatioPlayer,
    known: tuple[BestResponse, ...],
    tolerance: float,
    progress: Progress | None,
) -> GameSolution:
    """Theorem 3-1: the least c* over epsilon' in (0, epsilon].

    c* = F(e) / (1 - e), with F the convex least J_obj at J_cond = e, falls while ``-F'(e) > c*``
    and rises after: either it still falls at the budget, or its minimum is where failing is worth
    exactly c*, at a single policy.
    """
    budget = float(problem.failure_budget or 0.0)
    best, responses, is_least = _least_ratio(player, known, tolerance)
    at_goal = best.condition == 0.0  # from the start on: c* of every epsilon' is 0
    origin = best.origin
    room = 0.5 * budget if at_goal else min(best.failing, budget - origin)
    share, spent = (1.0 - origin) - room, origin + room
    found = find_threshold(
        player, spent, share, responses, room=room, tolerance=tolerance, progress=progress
    )
    if best.failing > budget - origin:
        falls = is_least or _ratio_at_optimum(best) < found.low
        lower = (
            found.low if falls else _slack_bound_of_optimum(player, found.high, budget, tolerance)
        )
        return _optimum_at_budget(problem, player, found, lower)
    c = found.high
    lower = _slack_bound_of_optimum(player, c, budget, tolerance)
    return GameSolution(problem, player, found, spent, c, lower, share, c)


def _slack_bound_of_optimum(
    player: RatioPlayer, ratio: float, budget: float, tolerance: float
) -> float:
    """A ratio a little below the least one, such that every policy is seen to have more.

    There it is strictly best to fail, by a margin that no rounding reaches. Where rounding does
    reach it, a policy within the budget has lost at most its share of it.
    """
    best = 0.0
    for share in _MARGINS:
        below = ratio * (1.0 - share * tolerance)
        if below <= 0.0:
            break
        with WithIncumbent() as search, closing():
            surplus = player.surplus(below, 0.1 * tolerance)
        if search.stop:
            break
        if surplus >= 0.0:
            return max(best, below)
        if budget < 1.0:
            best = max(best, below + surplus / (1.0 - budget))
    return best


def _least_ratio(
    player: RatioPlayer, known: tuple[BestResponse, ...], tolerance: float
) -> tuple[BestResponse, tuple[BestResponse, ...], bool]:
    """A policy of least J_obj / (1 - J_cond), whatever it fails, and all responses so far.

    A ratio c is least if no policy has less than c of ``J_obj + c J_cond``: a policy that has less
    has a smaller ratio, which is tried next.

    Returns:
        The policy, the responses, and whether the search came to its end.

    Raises:
        SolverError: every policy fails but for rounding.
    """
    responses = list(known)
    hopeful = [r for r in responses if _is_hopeful_response(r)]
    if not hopeful:
        raise SolverError(
            "the game cannot tell costs given success: the goal is reached with a (discounted) "
            f"probability of at most {known[0].success:.1e}"
        )
    best = min(hopeful, key=_ratio_at_optimum)
    for _ in range(_MOST_STEPS):
        c = _ratio_at_optimum(best)
        if is_late():
            break
        with WithIncumbent() as search:
            response = player.response(1.0, c, 0.1 * tolerance)
        if search.stop:
            break
        if not _is_hopeful_response(response) or _ratio_at_optimum(response) >= c * (1.0 - 1e-15):
            return best, tuple(responses), True
        responses.append(response)
        best = response
    return best, tuple(responses), False


def _is_hopeful_response(response: BestResponse) -> bool:
    """Whether a policy's cost given success can be told."""
    return response.success > (0.0 if response.origin else _ROUNDED_SUCCESS)


def _ratio_at_optimum(response: BestResponse) -> float:
    """The cost given success of a response."""
    return response.objective / response.success
