"""The lemmas of the paper's appendices, on closed forms and on random models."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from formulations import MCMP, S3P
from games import (
    RETRY,
    WASTE,
    criteria,
    drawn_problem,
    game_at,
    gammas,
    hand_problem,
    mixture,
)
from operators import cost_game, cost_tail
from references import s3p
from references.chain import plain_model
from ssp_lp import InfeasibleError, evaluate
from ssp_lp.game import bayes_adaptive, play, stationary_game, thresholds
from ssp_lp.game.optimum import bayes_player, extremes, find_threshold, stationary_player
from strategies import often, problems

few = often(12)
shares = st.sampled_from([0.25, 0.1, 0.5, 0.02])
ALPHAS = np.linspace(0.0, 1.0, 21)


@criteria
@few
@given(problems(most_live=2), gammas, shares)
def test_t3_m1_above_c_the_game_can_be_held_and_its_policy_keeps_to_the_budget(
    criterion, drawn, gamma, share
):
    """t3-m1: for c >= c* the value is at most eta(c) and the mixture's J_cond at most epsilon.

    Below c* the value exceeds eta(c). The lemma is stated for x' = (x, 0); it holds for (x, s).
    """
    problem = drawn_problem(criterion, drawn, share, gamma)
    player = stationary_player(problem)
    known = extremes(player, 1e-10)
    room = 1.0 - problem.failure_budget if problem.ratio else 1.0
    least = find_threshold(player, problem.failure_budget, room, known, tolerance=1e-8).high
    if least < 1e-6:
        return
    for factor in (1.0 + 1e-6, 1.1, 5.0):
        game = game_at(problem, factor * least)
        found = play(player, game, known, accuracy=1e-9)
        assert found.upper <= game.stake * (1.0 + 1e-9)
        objective, condition = mixture(found)
        assert objective <= found.upper * (1.0 + 1e-9)
        assert condition <= problem.failure_budget * (1.0 + 1e-9)
    for factor in (0.5, 0.999):
        game = game_at(problem, factor * least)
        assert play(player, game, known, accuracy=1e-9).lower > game.stake


@pytest.mark.parametrize("gamma", [0.9, 0.99, 0.999])
def test_t3_5_the_threshold_of_a_cap_falls_to_that_of_none(gamma):
    """t3-5, M -> infinity: whoever follows pi'_or from M on does so from each M' beyond it, too.

    J_obj is discounted up to M' then, so that c-hat_M never rises with M, at any gamma.
    """
    problem = hand_problem(S3P, WASTE, 0.5, gamma)
    found = stationary_game(problem)
    capped = [stationary_game(problem, tail=cap) for cap in (2, 3, 4, 6, 8, 12, 24, 48, 96)]
    values = [each.objective for each in capped]
    assert all(later <= earlier * (1 + 1e-9) for earlier, later in pairwise(values))
    assert values[0] > found.objective * (1 + 1e-4)
    assert values[-1] == pytest.approx(found.objective, rel=1e-8)
    for each in capped:  # the second limit: its policy keeps to the budget, and costs as much
        assert each.lower_bound == pytest.approx(each.objective, rel=1e-8)
        told = evaluate(each.policy, problem)
        assert told.discounted_failure <= 0.5 + 1e-12
        assert found.lower_bound <= told.objective <= each.objective * (1 + 1e-12)
    tight = hand_problem(S3P, WASTE, 0.1, gamma)  # there is room, but not at M = 2
    with pytest.raises(InfeasibleError, match="follows pi'_or from a total cost of 2 on"):
        stationary_game(tight, tail=2)


def test_l3_8_the_value_of_a_cap_tends_to_that_of_none():
    """l3-8: at fixed c, the unapproximated game over Pi_{M, pi'_or} falls to the one over Pi.

    Seen at every alpha, so in the maximum over alpha too.
    """
    model, gamma = plain_model(RETRY, {"g"}), 0.95
    problem = hand_problem(S3P, RETRY, 0.2, gamma)
    game = game_at(problem, 3.0)
    tail = cost_tail(model, {"x": "rush"}, gamma, game.scale, discounted=False)
    exact = play(bayes_player(problem), game, accuracy=1e-10)
    before = np.inf
    for cap, error in ((1, 2.0), (5, 1.0), (20, 0.1), (60, 1e-6), (100, 1e-9)):
        values = [
            cost_game(model, "x", gamma, float(a), game.scale, cap, tail, bayes=True)
            for a in [*ALPHAS, exact.alpha]
        ]
        assert max(values) <= before + 1e-12
        before = max(values)
        assert -1e-9 <= before - exact.upper <= error
    assert before == pytest.approx(exact.upper, rel=1e-8)


def test_l3_8_needs_the_tail_given_success():
    """Proof of l3-8: ``J(pi-hat) - J(pi*) <= delta_2 + delta_1 L_M`` is false as printed.

    delta_1 bounds the runs that succeed at a cost of M or more, and many more may come to M: what
    each adds is the tail's E[cost; goal] / P(goal). Here M = 2, P = 0.1 beyond it for pi* and 0.09
    for pi'_or; the difference is 0.39, the printed bound 0.202, with L_M from (x, M) 0.2565.
    """
    choices = {
        "x": {"on": [(0.5, "g", 1), (0.5, "y", 2)]},
        "y": {
            "cheap": [(0.1, "g", 1), (0.9, "d", 1)],
            "dear": [(0.09, "g", 10), (0.91, "d", 10)],
        },
    }
    model = plain_model(choices, {"g"})
    star = {"x": "on", "y": "cheap"}
    worst = {"x": "on", "y": "dear"}
    goal, cost = s3p.values(model, worst, None)
    difference = cost["x"] - s3p.values(model, star, None)[1]["x"]
    first, second = 0.5 * 0.1, 0.5 * 0.1 * 3.0
    assert difference == pytest.approx(0.39)
    assert second + first * max(cost.values()) < difference
    assert second + first * max(cost[s] + 2.0 * goal[s] for s in "xy") < difference
    given_success = max(cost[s] / goal[s] for s in "xy")
    assert second + first * given_success >= difference


def _values(problem, c):
    """The values of the approximate and of the unapproximated game, and the first one's policy."""
    game = game_at(problem, c)
    player = stationary_player(problem)
    approximate = play(player, game)
    return approximate, play(bayes_player(problem), game, accuracy=1e-9), player, game


@pytest.mark.slow
@pytest.mark.parametrize(("criterion", "lemma"), [(S3P, "l3-9"), (MCMP, "l3-12")])
def test_l3_9_and_l3_12_the_approximate_value_tends_to_the_true_one(criterion, lemma):
    """l3-9 (M beyond all need) and l3-12: at fixed c, the two values approach as gamma -> 1."""
    for c in (2.0, 5.0):
        gaps = []
        for gamma in (0.99, 0.999, 1 - 1e-4):
            problem = hand_problem(criterion, RETRY, 0.2, gamma)
            approximate, true, _, _ = _values(problem, c)
            gaps.append(true.upper - approximate.upper)
            assert gaps[-1] >= -1e-8, lemma
        assert all(later <= 0.5 * earlier for earlier, later in pairwise(gaps))
        assert gaps[-1] <= 1e-3


def test_l3_9_at_a_fixed_cap():
    """l3-9 as stated, M = 20: T_alpha over T of section 3.3, both with pi'_or from M on."""
    model, gaps = plain_model(RETRY, {"g"}), []
    for gamma in (0.99, 0.999, 1 - 1e-4, 1 - 1e-6):
        scale = 5.0 * (1 - 0.12) / 0.12
        tail = cost_tail(model, {"x": "rush"}, gamma, scale, discounted=False)
        peaks = [
            max(cost_game(model, "x", gamma, float(a), scale, 20, tail, bayes=b) for a in ALPHAS)
            for b in (False, True)
        ]
        gaps.append(peaks[1] - peaks[0])
    assert min(gaps) >= -1e-12
    assert all(later <= 0.5 * earlier for earlier, later in pairwise(gaps))
    assert gaps[-1] <= 1e-5


def test_l3_8_at_a_fixed_cap_is_the_literal_operator():
    """The player of Pi_{M, pi'_or} and T_alpha written out, at every alpha, M and gamma."""
    model = plain_model(RETRY, {"g"})
    for gamma in (0.9, 0.999):
        problem = hand_problem(S3P, RETRY, 0.2, gamma)
        game = game_at(problem, 3.0)
        tail = cost_tail(model, {"x": "rush"}, gamma, game.scale, discounted=False)
        for cap in (1, 2, 5, 20):
            player = stationary_player(problem, tail=cap)
            for alpha in ALPHAS.tolist():
                exact = cost_game(model, "x", gamma, alpha, game.scale, cap, tail, bayes=False)
                told = game.best_response(player, alpha, 1e-12)
                assert game.payoff(alpha, told) == pytest.approx(exact, rel=1e-12)


DEAR = {
    "x": {"on": [(1.0, "y", 1)]},
    "y": {"safe": [(1.0, "g", 1)], "dear": [(0.9, "g", 10), (0.1, "d", 10)]},
    "d": {"stuck": [(1.0, "d", 1)]},
}
"""pi'_or plays ``dear``: it fails more, and costs ten times as much."""


def test_l3_10_is_true_in_the_limit_of_the_cap_only():
    """DEAR with M = 1: pi'_or is forced on every policy from y on.

    The lemma is printed for every M and called obvious; it holds for c-hat = lim c-hat_M. At
    epsilon 1/2 c-hat_1 is (0.9 * 11) gamma / (1 - epsilon) = 19.78, and c* = 2 / (1 - epsilon).
    """
    gamma, budget = 0.999, 0.5
    problem = hand_problem(S3P, DEAR, budget, gamma)
    (least,) = thresholds(problem, [budget])
    values = []
    for cap in (1, 2, 4, 64):
        (capped,) = thresholds(problem, [budget], tail=cap)
        assert capped.low == pytest.approx(capped.high, rel=1e-9)
        values.append(capped.high)
    true = 2.0 / (1.0 - budget)  # undiscounted, of ``safe``
    assert values[0] == pytest.approx(9.9 * gamma / (1.0 - budget), rel=1e-12)
    assert values[0] > 4.9 * true
    for value in values[1:]:  # beyond the cap nothing is left
        assert value == pytest.approx(2.0 * gamma / (1.0 - budget), rel=1e-12)
        assert least.low <= value <= true
    assert bayes_adaptive(problem, tolerance=1e-8).objective == pytest.approx(2 / gamma**2)
    whole = stationary_game(problem, tail=1)  # the least over epsilon', too: slack within 1/2
    assert whole.objective == pytest.approx(11 / gamma, rel=1e-9)
    assert whole.objective > 5 * stationary_game(problem).objective


@pytest.mark.slow
@few
@given(problems(most_live=2, most_cost=2), st.sampled_from([0.5, 0.7]), shares)
def test_l3_10_discounting_the_objective_can_only_lower_the_threshold(drawn, gamma, share):
    """l3-10 with M -> infinity: c-hat <= c* in case S."""
    _check_order(drawn_problem(S3P, drawn, share, gamma))


@few
@given(problems(most_live=3), gammas, shares)
def test_l3_13_discounting_the_objective_can_only_lower_the_threshold(drawn, gamma, share):
    """l3-13: c-hat <= c* in case M."""
    _check_order(drawn_problem(MCMP, drawn, share, gamma))


def _check_order(problem):
    approximate = stationary_game(problem)
    true = bayes_adaptive(problem, tolerance=1e-6)
    assert approximate.lower_bound <= true.objective * (1 + 1e-9)
    assert approximate.objective <= true.objective * (1 + 1e-5) + 1e-12
