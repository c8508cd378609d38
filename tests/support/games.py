"""What the tests of the paper's game share: problems with room in the budget, matrix games."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import scipy.optimize
from hypothesis import reject, strategies as st

from checks import library_model
from formulations import MCMP, S3P
from references.frontier import Point
from small_models import model_of
from ssp_lp import InfeasibleError, evaluate
from ssp_lp.game import Equilibrium, Game, bayes_adaptive
from ssp_lp.game.optimum import stationary_player
from strategies import Draw

gammas = st.sampled_from([0.9, 0.5, 0.99])
shares = st.sampled_from([0.25, 0.1, 0.5, 0.02, 0.8])
"""Where the budget lies between the least discounted failure (0) and 1."""

criteria = pytest.mark.parametrize("criterion", [MCMP, S3P])

RETRY = {
    "x": {
        "rush": [(0.5, "g", 1), (0.3, "x", 1), (0.2, "d", 1)],
        "care": [(0.25, "g", 1), (0.74, "x", 1), (0.01, "d", 1)],
    },
    "d": {"stuck": [(1.0, "d", 1)]},
}
"""Every run that fails pays for ever (assumption a2-3); ``rush`` reaches the goal least often."""


WASTE = {
    "x": {**RETRY["x"], "dear": [(0.1, "g", 3), (0.6, "x", 3), (0.3, "d", 3)]},
    "d": RETRY["d"],
}
"""The policy that reaches the goal least often pays three times as much a step."""


def with_room(criterion: Any, model: Any, start: Any, share: float, gamma: float) -> Any:
    """A problem whose budget lies so far between the least discounted failure and 1."""
    problem = criterion(model, start=start, failure_budget=0.5, discount=gamma)
    least = stationary_player(problem).response(0.0, 1.0, 1e-13).condition
    budget = least + share * (1.0 - least)
    return criterion(model, start=start, failure_budget=budget, discount=gamma)


def drawn_problem(criterion: Any, drawn: Draw, share: float, gamma: float) -> Any:
    """A drawn problem with room in the budget, unless its goal is (almost) out of reach."""
    try:
        problem = with_room(criterion, library_model(drawn), drawn.start, share, gamma)
    except InfeasibleError:
        reject()
    if problem.failure_budget > 1.0 - 1e-6:
        reject()
    return problem


def without_dead_choices(drawn: Draw) -> Draw:
    """The same problem, whose dead-ends offer nothing; in case S what they offer is immaterial."""
    choices = {s: {} if s.startswith("d") else a for s, a in drawn.choices.items()}
    return Draw(choices, drawn.goals, drawn.start)


def hand_problem(criterion: Any, choices: Any, budget: float, gamma: float | None) -> Any:
    """A hand model with start "x"."""
    return criterion(model_of(choices), start="x", failure_budget=budget, discount=gamma)


def stake(problem: Any, c: float) -> float:
    """eta(epsilon; c) at the problem's budget."""
    return c * (1.0 - problem.failure_budget) if problem.ratio else c


def game_at(problem: Any, c: float) -> Game:
    """The game of section 3.2 at c."""
    return Game(stake(problem, c), problem.failure_budget)


def real_cost(problem: Any, policy: Any) -> float:
    """J_MCMP, or J^gamma_S3P: J_obj undiscounted and L_d discounted."""
    found = evaluate(policy, problem)
    if problem.ratio:
        return found.success_cost / (1.0 - found.discounted_failure)
    return found.expected_cost


def mixture(found: Equilibrium) -> tuple[float, float]:
    """(J_obj, J_cond) of the player's optimal mixture of the two policies that meet."""
    low, high = 1.0 - found.weight, found.weight
    return (
        low * found.minus.objective + high * found.plus.objective,
        low * found.minus.condition + high * found.plus.condition,
    )


def matrix_game_value(points: Sequence[Point], game: Game) -> float:
    """The value of the game with every listed policy as a row, by a linear program."""
    rows = np.array([(cost, game.scale * failure) for failure, cost in points])
    count = len(rows)
    upper = np.column_stack([rows.T, -np.ones(2)])
    weights = np.append(np.ones(count), 0.0)[None, :]
    found = scipy.optimize.linprog(np.append(np.zeros(count), 1.0), upper, [0, 0], weights, [1.0])
    return float(found.fun)


def least_payoff(points: Sequence[Point], game: Game, alpha: float) -> float:
    """J*(alpha) over the listed policies."""
    return min(alpha * cost + (1.0 - alpha) * game.scale * failure for failure, cost in points)


def max_min(points: Sequence[Point], game: Game) -> float:
    """Max over alpha of the least payoff: at 0, at 1, or where two lines cross."""
    lines = {(round(cost, 12), round(failure, 14)) for failure, cost in points}
    slopes = [cost - game.scale * failure for cost, failure in lines]
    heights = [game.scale * failure for _, failure in lines]
    alphas = {0.0, 1.0}
    for s, h in zip(slopes, heights, strict=True):
        for t, k in zip(slopes, heights, strict=True):
            if abs(s - t) > 1e-12:
                alphas.add(min(max((k - h) / (s - t), 0.0), 1.0))
    return max(least_payoff(points, game, alpha) for alpha in alphas)


def bayes(problem: Any, tolerance: float = 1e-9) -> Any:
    """The unapproximated game of a problem."""
    return bayes_adaptive(problem, tolerance=tolerance)
