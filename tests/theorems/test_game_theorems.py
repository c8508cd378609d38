"""Lemmas and theorems of section 3, and statements that do not hold as printed."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from games import (
    RETRY,
    WASTE,
    criteria,
    drawn_problem,
    game_at,
    gammas,
    hand_problem,
    least_payoff,
    matrix_game_value,
    max_min,
    mixture,
    real_cost,
    shares,
    stake,
    without_dead_choices,
)
from operators import cost_game, cost_tail
from plain_policies import library_policy, stationary_policies
from references import mcmp, s3p
from references.chain import mean, plain_model, start_distribution
from references.frontier import constrained_ratio
from small_models import TWO_MOVES, model_of
from ssp_lp import InfeasibleError, evaluate, solve
from ssp_lp.game import Game, bayes_adaptive, delta_mixture, play, stationary_game, thresholds
from ssp_lp.game.equilibrium import crossing
from ssp_lp.game.optimum import bayes_player, extremes, find_threshold, stationary_player
from ssp_lp.game.player import BestResponse
from ssp_lp.policies import DeterministicPolicy
from strategies import Draw, acyclic_problems, often, problems

# The theorems of section 3 of the paper, on closed forms, on random models and on the robot.


few = often(12)
some = often(16)
NEAR_ONE = [0.9, 0.99, 0.999, 1 - 1e-4, 1 - 1e-5, 1 - 1e-6]


@some
@given(problems(), st.data())
def test_t3_0_the_surrogate_of_the_conditional_cost_lies_above_it_and_tends_to_it(drawn, data):
    """t3-0: J / (1 - L) >= J / (1 - F), and the two differ by at most (1 - gamma) E[T | goal].

    The theorem asks for a policy of the discounted budget; any that may reach the goal will do.
    """
    reference = plain(drawn)
    decisions = data.draw(stationary_policies(drawn, reference, "dead_ends"))
    begin = start_distribution(drawn.start)
    weight, cost = (mean(begin, part) for part in s3p.values(reference, decisions, None))
    if weight == 0.0:
        return
    model = library_model(drawn)
    policy = library_policy(model, decisions)
    before = np.inf
    for gamma in (0.5, 0.9, 0.999, 1 - 1e-6, 1 - 1e-9):
        found = evaluate(policy, S3P(model, start=drawn.start, failure_budget=1.0, discount=gamma))
        surrogate = found.success_cost / (1.0 - found.discounted_failure)
        assert surrogate >= cost / weight * (1.0 - 1e-9)
        assert surrogate <= before * (1.0 + 1e-9) + 1e-12
        before = surrogate
    assert before == pytest.approx(cost / weight, rel=1e-6, abs=1e-12)


def test_t3_0_on_a_closed_form():
    """RETRY, ``rush``: E[gamma^T; goal] = gamma/2 / (1 - 0.3 gamma), E[cost; goal] = 0.5 / 0.49."""
    for gamma in NEAR_ONE:
        problem = hand_problem(S3P, RETRY, 1.0, gamma)
        found = evaluate(library_policy(problem.model, {"x": "rush"}), problem)
        surrogate = found.success_cost / (1.0 - found.discounted_failure)
        assert found.conditional_cost == pytest.approx(10 / 7, rel=1e-12)
        closed = (0.5 / 0.49) * (1 - 0.3 * gamma) / (0.5 * gamma)
        assert surrogate == pytest.approx(closed, rel=1e-9)


@pytest.mark.slow
@few
@given(problems(most_live=3), gammas, shares)
def test_t3_1_the_least_c_over_smaller_budgets_is_the_optimum_of_case_s(drawn, gamma, share):
    """t3-1, eq. s3p_c*: min over (0, epsilon] of c* is the optimum, attained at epsilon*.

    The right side comes from column generation. At epsilon = 1 the equation is false as printed:
    c* of epsilon' = 1 is 0, because eta(1; c) = 0; the theorem needs epsilon < 1.
    """
    problem = drawn_problem(S3P, drawn, share, gamma)
    found = stationary_game(problem)
    optimum = solve(problem, "columns").objective
    assert found.objective == pytest.approx(optimum, rel=1e-7, abs=1e-9)
    spent, budget = found.spent, problem.failure_budget
    assert 0.0 < spent <= budget
    least = found.player.response(0.0, 1.0, 1e-13).condition
    grid = [least + k / 8 * (budget - least) for k in (8, 6, 4, 2, 1)]
    curve = thresholds(problem, [*grid, spent])
    assert min(t.low for t in curve[:-1]) >= optimum * (1.0 - 1e-7) - 1e-9
    assert curve[-1].high == pytest.approx(optimum, rel=1e-7, abs=1e-9)
    lottery = evaluate(found.policy, problem)  # eq. s3p_c*-2
    paid = lottery.objective * (1.0 - lottery.discounted_failure) / (1.0 - spent)
    assert paid == pytest.approx(optimum, rel=1e-7, abs=1e-9)


@few
@given(acyclic_problems(most_live=2), gammas, shares)
def test_t3_1_against_all_policies_of_state_and_cost(drawn, gamma, share):
    """t3-1 under a discount: every policy of (state, accumulated cost) is enumerated."""
    problem = drawn_problem(S3P, drawn, share, gamma)
    points = s3p.product_points(plain(without_dead_choices(drawn)), drawn.start, 100, gamma)
    brute = constrained_ratio(points, problem.failure_budget)
    assert stationary_game(problem).objective == pytest.approx(brute, rel=1e-7, abs=1e-9)


def test_t3_1_where_the_budget_is_slack():
    """TWO_MOVES: ``fast`` alone has the least ratio, so that epsilon* = 1 - 0.95 gamma < epsilon.

    c* = 1 / gamma there, failing is worth c* exactly, and c* rises beyond epsilon*.
    """
    gamma = 0.99
    problem = hand_problem(S3P, TWO_MOVES, 0.5, gamma)
    found = stationary_game(problem)
    spent = 1.0 - 0.95 * gamma
    assert found.objective == pytest.approx(1 / gamma, rel=1e-9)
    assert found.spent == pytest.approx(spent, rel=1e-9)
    assert found.alpha == pytest.approx(1 - spent, rel=1e-9)
    assert found.price == pytest.approx(1 / gamma, rel=1e-9)
    # J_obj cannot fall below 0.95 any more: c* = 0.95 / (1 - epsilon')
    for threshold in thresholds(problem, [0.1, 0.3, 0.5, 0.9]):
        assert threshold.high == pytest.approx(0.95 / (1 - threshold.budget), rel=1e-9)


def test_t3_1_is_false_where_the_budget_is_one():
    """At epsilon' = 1 eta vanishes: sure failure pays 0 <= eta(1; 0), so that c* = 0 there.

    The optimum over the policies that may succeed at all is 1 / gamma nevertheless.
    """
    gamma = 0.9
    choices = {"x": {**TWO_MOVES["x"], "fail": [(1.0, "d", 1)]}, "d": {}}
    problem = hand_problem(S3P, choices, 1.0, gamma)
    cheapest = stationary_player(problem).response(1.0, 0.0, 1e-12)
    assert cheapest.objective == 0.0
    assert cheapest.condition == pytest.approx(1.0)
    for budget in (0.999, 1.0):
        problem = hand_problem(S3P, choices, budget, gamma)
        assert stationary_game(problem).objective == pytest.approx(1 / gamma, rel=1e-9)


@pytest.mark.slow
@some
@given(problems(most_live=3), gammas, shares)
def test_t3_2_the_threshold_is_the_optimum_of_case_m(drawn, gamma, share):
    """t3-2 with J_obj discounted (section 3.5): c* = least cost of a lottery within the budget.

    Every stationary policy is enumerated.
    """
    problem = drawn_problem(MCMP, drawn, share, gamma)
    points = mcmp.points(plain(drawn), drawn.start, discount=gamma)
    found = stationary_game(problem)
    game = game_at(problem, found.objective)
    if found.objective > 1e-9:
        assert matrix_game_value(points, game) == pytest.approx(found.objective, rel=1e-7)
    lottery = evaluate(found.policy, problem)
    assert lottery.objective == pytest.approx(found.objective, rel=1e-8, abs=1e-12)
    assert lottery.discounted_failure <= problem.failure_budget + 1e-10
    by_columns = solve(problem, "columns").objective
    assert found.objective == pytest.approx(by_columns, rel=1e-7, abs=1e-9)


def test_t3_2_on_a_closed_form():
    """TWO_MOVES: c* = 2 - q where q = (epsilon - (1 - gamma)) / (0.05 gamma) spends the budget."""
    for gamma, budget in ((0.99, 0.03), (0.999, 0.03), (0.98, 0.05)):
        problem = hand_problem(MCMP, TWO_MOVES, budget, gamma)
        found = stationary_game(problem)
        share, price = (budget - (1 - gamma)) / (0.05 * gamma), 1 / (0.05 * gamma)
        assert found.objective == pytest.approx(2 - share, rel=1e-9)
        assert found.price == pytest.approx(price, rel=1e-6)
        assert found.alpha == pytest.approx((2 - share) / (2 - share + price * budget), rel=1e-6)


def _all_points(problem, drawn):
    """(J_cond, J_obj) of every stationary policy of the augmented process."""
    if problem.ratio:
        return s3p.product_points(
            plain(without_dead_choices(drawn)), drawn.start, 100, problem.discount
        )
    return mcmp.points(plain(drawn), drawn.start, discount=problem.discount)


@criteria
@few
@given(
    acyclic_problems(most_live=2),
    gammas,
    shares,
    st.sampled_from([0.5, 1.0, 3.0]),
)
def test_t3_3_min_max_is_max_min(criterion, drawn, gamma, share, c):
    """t3-3: with lotteries among the policies the two orders agree, below c* as well.

    Min max is a linear program over all policies, max min the peak of their least payoff.
    """
    problem = drawn_problem(criterion, drawn, share, gamma)
    points, game = _all_points(problem, drawn), game_at(problem, c)
    found = play(stationary_player(problem), game)
    value = matrix_game_value(points, game)
    assert found.lower <= found.upper
    assert found.upper == pytest.approx(value, rel=1e-7, abs=1e-9)
    assert found.lower == pytest.approx(value, rel=1e-7, abs=1e-9)
    assert max_min(points, game) == pytest.approx(value, rel=1e-7, abs=1e-9)
    assert least_payoff(points, game, found.alpha) == pytest.approx(value, rel=1e-7, abs=1e-9)


def test_t3_3_needs_lotteries_among_the_policies():
    """TWO_MOVES at c* = 1.6: the better deterministic policy guarantees 2, a lottery 1.6.

    Pi of section 2.2 is randomised; over deterministic policies alone the orders do not agree.
    """
    gamma, budget = 0.99, 0.01 + 0.4 * 0.05 * 0.99
    problem = hand_problem(MCMP, TWO_MOVES, budget, gamma)
    game = game_at(problem, 1.6)
    points = mcmp.points(plain(Draw(TWO_MOVES, frozenset("g"), "x")), "x", discount=gamma)
    alone = min(max(cost, game.scale * failure) for failure, cost in points)
    assert alone == pytest.approx(2.0)
    assert max_min(points, game) == pytest.approx(1.6)
    assert play(stationary_player(problem), game).upper == pytest.approx(1.6)


@criteria
@some
@given(problems(most_live=3), gammas, shares, st.sampled_from([0.5, 1.0, 4.0]))
def test_the_least_payoff_is_concave(criterion, drawn, gamma, share, c):
    """Proof of t3-3: J*(alpha) is a minimum of lines; its peak is the game's value."""
    problem = drawn_problem(criterion, drawn, share, gamma)
    player, game = stationary_player(problem), game_at(problem, c)
    alphas = np.linspace(0.0, 1.0, 9)
    replies = [game.best_response(player, alpha, 1e-12) for alpha in alphas]
    values = np.array([game.payoff(a, r) for a, r in zip(alphas, replies, strict=True)])
    room = 1e-9 * (1.0 + values.max())
    assert (np.diff(values, 2) <= room).all()
    found = play(player, game, replies)
    assert values.max() <= found.upper + room
    assert game.best_response(player, found.alpha, 1e-12).bound <= found.upper + room


def _paying(drawn):
    """Every step costs at least 1, dead-ends included, so that failing costs without end (a2-3)."""
    choices = {
        state: {a: [(p, s, cost + 1) for p, s, cost in outs] for a, outs in actions.items()}
        for state, actions in drawn.choices.items()
    }
    return Draw(choices, drawn.goals, drawn.start)


@pytest.mark.parametrize(("criterion", "theorem"), [(S3P, "t3-5"), (MCMP, "t3-11")])
def test_t3_5_and_t3_11_on_a_closed_form(criterion, theorem):
    """RETRY: c-hat tends to the exact optimum, and so does what the policy really pays.

    Case S: the cap M has grown until it loses nothing, so the limit in M is inside.
    """
    exact = solve(hand_problem(criterion, RETRY, 0.12, None), "columns").objective
    errors = []
    for gamma in NEAR_ONE[2:]:
        problem = hand_problem(criterion, RETRY, 0.12, gamma)
        found = stationary_game(problem)
        lottery = evaluate(found.policy, problem)
        real = real_cost(problem, found.policy)
        errors.append((abs(found.objective - exact), abs(real - exact)))
        assert found.objective <= real * (1 + 1e-9), theorem
        assert lottery.failure_probability <= lottery.discounted_failure <= 0.12 + 1e-10
    assert all(later <= 0.2 * earlier for earlier, later in pairwise([e[0] for e in errors]))
    assert all(later <= 0.2 * earlier for earlier, later in pairwise([e[1] for e in errors]))
    assert max(errors[-1]) <= 1e-4


@criteria
@few
@given(problems(most_live=3).map(_paying), st.sampled_from([0.3, 0.1, 0.6]))
def test_t3_5_and_t3_11_on_paying_models(criterion, drawn, share):
    """t3-5, t3-11: where every improper policy pays for ever, gamma -> 1 gives the exact optimum.

    The budget has room above the least failure, without which the discounted problem is
    infeasible at every gamma < 1.
    """
    problem = drawn_problem(criterion, drawn, share, 1 - 1e-6)
    budget = problem.failure_budget
    exact = solve(
        criterion(problem.model, start=drawn.start, failure_budget=budget), "columns"
    ).objective
    found = stationary_game(problem)
    assert found.objective == pytest.approx(exact, rel=1e-3, abs=1e-6)
    real = real_cost(problem, found.policy)
    assert real == pytest.approx(exact, rel=1e-3, abs=1e-6)


@pytest.mark.slow
@criteria
@some
@given(problems(most_live=3), gammas, shares)
def test_the_adversary_weight_ties_the_engines(criterion, drawn, gamma, share):
    """M: alpha* = c / (c + price epsilon); S: alpha* = c (1 - e) / (c (1 - e) + kappa e).

    Where a lottery over two policies is needed the price is unique and column generation has the
    same; at a kink only the identity holds.
    """
    problem = drawn_problem(criterion, drawn, share, gamma)
    found = stationary_game(problem)
    c, spent, price = found.objective, found.spent, found.price
    if c < 1e-6:
        return
    own = stake(problem, c) if not problem.ratio else c * (1.0 - spent)
    assert found.alpha == pytest.approx(own / (own + price * spent), rel=1e-6)
    solution = solve(problem, "columns")
    if len(found.policy.policies) == 2 and min(found.policy.weights) > 1e-3:
        multiplier = solution.failure_price + (solution.objective if problem.ratio else 0.0)
        assert price == pytest.approx(multiplier, rel=1e-5)
        assert found.alpha == pytest.approx(solution.adversary_weight, rel=1e-5)


@criteria
def test_the_robot_has_one_optimum_by_game_and_by_columns(criterion, robot):
    """Theorems t3-1 and t3-2 and the identities of alpha* on the paper's robot."""
    model, start = robot
    problem = criterion(model, start=start, failure_budget=0.05, discount=0.999)
    found, solution = stationary_game(problem, tolerance=1e-8), solve(problem, "columns")
    c, spent = found.objective, found.spent
    assert c == pytest.approx(solution.objective, rel=1e-9)
    assert spent == pytest.approx(0.05, abs=1e-12)
    assert found.alpha == pytest.approx(solution.adversary_weight, rel=1e-8)
    kappa = solution.failure_price + (c if problem.ratio else 0.0)
    own = c * (1.0 - spent) if problem.ratio else c
    assert found.alpha == pytest.approx(own / (own + kappa * spent), rel=1e-8)
    if problem.ratio:  # t3-1: c* falls all the way to the budget
        curve = [t.high for t in thresholds(problem, [0.03, 0.04, 0.05], tolerance=1e-7)]
        assert curve == sorted(curve, reverse=True)
        assert curve[-1] == pytest.approx(c, rel=1e-6)


def test_a_game_is_told_by_its_stake_and_its_budget():
    """Eq. j_c_gamma_def: eta is c in case M and c (1 - epsilon) in case S."""
    for criterion, eta in ((MCMP, 3.0), (S3P, 3.0 * 0.75)):
        problem = hand_problem(criterion, TWO_MOVES, 0.25, 0.9)
        assert game_at(problem, 3.0) == Game(eta, 0.25)
        assert game_at(problem, 3.0).scale == pytest.approx(eta / 0.25)


def test_policies_that_differ_by_rounding_do_not_cross_outside():
    """The least failing policies of a tight budget: equal to eight digits, and one dominates."""
    game = Game(2.0, 1e-6)
    minus, plus = BestResponse(2.0, 1e-6, 0.0), BestResponse(2.0 + 1e-11, 1e-6 * (1 + 1e-11), 0.0)
    assert crossing(game, minus, plus) == 1.0
    assert 0.0 < crossing(game, minus, BestResponse(1.0, 0.5, 0.0)) < 1.0
    choices = {
        "x": {"a": [(0.9, "x", 2), (0.1, "g", 2)], "b": [(0.25, "g", 2), (0.75, "x", 3)]},
    }
    model = model_of(choices)
    problem = S3P(model, start={"x": 0.25, "g": 0.75}, failure_budget=0.1, discount=1 - 1e-6)
    optimum = solve(problem, "columns").objective
    assert stationary_game(problem).objective == pytest.approx(optimum, rel=1e-7)


# The lemmas of the paper's appendices, on closed forms and on random models.


places = st.sampled_from([0.25, 0.1, 0.5, 0.02])
ALPHAS = np.linspace(0.0, 1.0, 21)


@criteria
@few
@given(problems(most_live=2), gammas, places)
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
@given(problems(most_live=2, most_cost=2), st.sampled_from([0.5, 0.7]), places)
def test_l3_10_discounting_the_objective_can_only_lower_the_threshold(drawn, gamma, share):
    """l3-10 with M -> infinity: c-hat <= c* in case S."""
    _check_order(drawn_problem(S3P, drawn, share, gamma))


@few
@given(problems(most_live=3), gammas, places)
def test_l3_13_discounting_the_objective_can_only_lower_the_threshold(drawn, gamma, share):
    """l3-13: c-hat <= c* in case M."""
    _check_order(drawn_problem(MCMP, drawn, share, gamma))


def _check_order(problem):
    approximate = stationary_game(problem)
    true = bayes_adaptive(problem, tolerance=1e-6)
    assert approximate.lower_bound <= true.objective * (1 + 1e-9)
    assert approximate.objective <= true.objective * (1 + 1e-5) + 1e-12


# What the paper prints where it slips, beside what is true (``docs/paper.md``, section 3).


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
