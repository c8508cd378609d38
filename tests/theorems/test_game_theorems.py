"""The theorems of section 3 of the paper, on closed forms, on random models and on the robot."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from games import (
    RETRY,
    criteria,
    drawn_problem,
    game_at,
    gammas,
    hand_problem,
    least_payoff,
    matrix_game_value,
    max_min,
    real_cost,
    shares,
    stake,
    without_dead_choices,
)
from plain_policies import library_policy, stationary_policies
from references import mcmp, s3p
from references.chain import mean, start_distribution
from references.frontier import constrained_ratio
from small_models import TWO_MOVES, model_of
from ssp_lp import evaluate, solve
from ssp_lp.game import Game, play, stationary_game, thresholds
from ssp_lp.game.equilibrium import crossing
from ssp_lp.game.optimum import stationary_player
from ssp_lp.game.player import BestResponse
from strategies import Draw, acyclic_problems, often, problems

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
