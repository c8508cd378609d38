"""What the paper prints where it slips, beside what is true (``docs/paper.md``, section 3)."""

import numpy as np
import pytest

from formulations import MCMP, S3P
from games import game_at, hand_problem
from small_models import TWO_MOVES
from ssp_lp import evaluate, solve
from ssp_lp.game import Game, delta_mixture, play, stationary_game
from ssp_lp.game.optimum import stationary_player
from ssp_lp.policies import DeterministicPolicy

EXACT = {"rel": 1e-9}


def test_c_star_is_an_infimum_over_positive_c():
    """Slip 1: ``c = 0`` passes the printed test wherever a policy has J_obj = 0.

    x: go (g, 3), stay (x, 1), gamma = 0.9, epsilon = 0.5. At c = 0 nothing is at stake and staying
    pays nothing; at c = 1 the game is worth 10/13, more than eta = 1/2; c* = 3 / 0.9.
    """
    problem = hand_problem(S3P, {"x": {"go": [(1.0, "g", 3)], "stay": [(1.0, "x", 1)]}}, 0.5, 0.9)
    player = stationary_player(problem)
    go, stay = player.response(0.0, 1.0, 1e-13), player.response(1.0, 0.0, 1e-13)
    nothing = Game(0.0, 0.5)
    for alpha in np.linspace(0.0, 1.0, 11):
        assert min(nothing.payoff(alpha, r) for r in (go, stay)) == 0.0
    assert play(player, game_at(problem, 1.0)).upper == pytest.approx(10 / 13, **EXACT)
    for c in (1e-6, 1e-3, 0.1, 1.0, 3.0, 10 / 3 * (1 - 1e-6)):
        game = game_at(problem, c)
        assert play(player, game).lower > game.stake
    found = stationary_game(problem)
    assert found.objective == pytest.approx(10 / 3, **EXACT)
    assert solve(problem).objective == pytest.approx(10 / 3, **EXACT)


def test_three_readings_of_the_discount_of_an_arrival():
    """Slip 11: success for sure at time 3 and cost 6; Phi gives gamma, T_alpha gamma^2.

    M_{o,gamma} gives gamma^3. T_alpha is followed: the cost given success is gamma^2 6 / gamma^3.
    """
    gamma = 0.9
    choices = {
        "x": {"a": [(1.0, "y", 1)]},
        "y": {"a": [(1.0, "z", 2)]},
        "z": {"a": [(1.0, "g", 3)]},
    }
    problem = hand_problem(S3P, choices, 0.5, gamma)
    phi, own_process, operator = (gamma**k * 6.0 / gamma**3 for k in (1, 3, 2))
    for method in ("columns", "game"):
        assert solve(problem, method).objective == pytest.approx(operator, **EXACT)
    assert abs(operator - phi) > 0.5
    assert abs(operator - own_process) > 0.5


def test_the_second_display_of_the_discounted_objective_is_gamma_times_the_first():
    """Slip 12: the sum of gamma^t G_o, and the sum in the process that is left with 1 - gamma.

    Where ``*`` comes instead of the step's own disturbance, that step's cost is not paid: its
    probability gamma p multiplies the stage cost, too. Two steps of cost 1 and 2 pay 1 + 2 gamma
    by the first display, which is followed, and gamma (1 + 2 gamma) by the second.
    """
    gamma = 0.8
    choices = {"x": {"a": [(1.0, "y", 1)]}, "y": {"a": [(1.0, "g", 2)]}}
    problem = hand_problem(MCMP, choices, 0.5, gamma)
    first = 1.0 + gamma * 2.0
    second = gamma * 1.0 + gamma**2 * 2.0
    policy = DeterministicPolicy.from_actions(problem.model, {"x": "a", "y": "a"})
    assert evaluate(policy, problem).objective == pytest.approx(first, **EXACT)
    assert solve(problem, "game").objective == pytest.approx(first, **EXACT)
    assert second == pytest.approx(gamma * first, **EXACT)


def test_the_two_sides_of_alpha_end_at_0_and_1():
    """Slip 13: TWO_MOVES (M), epsilon = 0.5: alpha* = 1, and alpha* + delta is no probability.

    Deltas as large as 1 leave both ends, too.
    """
    problem = hand_problem(MCMP, TWO_MOVES, 0.5, 0.99)
    found, player = stationary_game(problem), stationary_player(problem)
    game = found.threshold.game.game
    assert found.alpha == 1.0
    for delta in (1e-6, 0.1, 1.0, 5.0):
        lottery = delta_mixture(player, game, found.alpha, delta)
        assert 0.0 <= lottery.weight <= 1.0
        assert lottery.condition <= 0.5
    slim = delta_mixture(player, game, found.alpha, 1e-6)
    assert slim.objective == pytest.approx(found.objective, **EXACT)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_one_delta_times_the_slope_bounds_the_lottery(criterion):
    """Proof of t3-4: 2 delta times the steepest slope is printed, and half of it is enough."""
    retry = {
        "x": {
            "rush": [(0.5, "g", 1), (0.3, "x", 1), (0.2, "d", 1)],
            "care": [(0.25, "g", 1), (0.74, "x", 1), (0.01, "d", 1)],
            "wait": [(0.1, "g", 2), (0.85, "x", 2), (0.05, "d", 2)],
        },
        "d": {"stuck": [(1.0, "d", 1)]},
    }
    problem = hand_problem(criterion, retry, 0.3, 0.95)
    found, player = stationary_game(problem), stationary_player(problem)
    game = found.threshold.game.game
    for delta in (0.3, 0.1, 1e-2, 1e-4, 1e-6):
        lottery = delta_mixture(player, game, found.alpha, delta)
        slope = max(abs(game.excess(lottery.minus)), abs(game.excess(lottery.plus)))
        assert lottery.value - game.stake <= delta * slope + 1e-9 * game.stake


def test_assumption_2_1_isolated_totals_are_enough():
    """Assumption 2-1: costs need no common step; the layers are the totals that can occur."""
    root = 2.0**0.5
    choices = {
        "x": {"a": [(0.5, "g", 1.0), (0.3, "x", root), (0.1, "x", 1.0), (0.1, "d", 1.0)]},
        "d": {"stuck": [(1.0, "d", 1.0)]},
    }
    discounted = hand_problem(S3P, choices, 0.9, 0.9)
    played, best = solve(discounted, "game"), solve(discounted)
    assert played.objective == pytest.approx(best.objective, **EXACT)
    cost_given_success = 1.0 + (0.3 * root + 0.1) / 0.6
    found = solve(hand_problem(S3P, choices, 0.9, None))
    assert found.objective == pytest.approx(cost_given_success, **EXACT)
