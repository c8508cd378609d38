"""The unapproximated game of sections 3.2 to 3.4 of the paper, and the belief of section 3.3."""

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
    real_cost,
    shares,
    without_dead_choices,
)
from references import mcmp, s3p
from references.chain import start_distribution
from references.frontier import Point, constrained_optimum, constrained_ratio
from small_models import TWO_MOVES
from ssp_lp import ModelError, evaluate, solve
from ssp_lp.game import (
    Game,
    bayes_adaptive,
    belief_at,
    delta_mixture,
    play,
    posterior,
    stationary_game,
)
from ssp_lp.game.optimum import stationary_player
from strategies import Draw, acyclic_problems, often, problems

few = often(12)


@given(
    st.floats(0.0, 1.0, exclude_min=True), st.floats(0.1, 1.0, exclude_max=True), st.integers(0, 50)
)
@often(33)
def test_the_belief_follows_one_trajectory(alpha, gamma, time):
    """Section 3.3: nu^t(alpha) = alpha / (alpha + gamma^t (1 - alpha)), whatever was observed."""
    belief = alpha
    for _ in range(time):
        after = posterior(belief, gamma)
        assert after >= belief * (1 - 1e-12)  # a run that goes on speaks for M_o
        belief = after
    assert belief_at(alpha, gamma, np.array([time]))[0] == pytest.approx(belief, rel=1e-9)


def test_beliefs_out_of_range_are_refused():
    assert belief_at(0.0, 0.5, np.array([0, 5000])).tolist() == [0.0, 0.0]
    for alpha, gamma, time in ((1.1, 0.9, 1), ("x", 0.9, 1), (0.5, 1.0, 1), (0.5, 0.9, -1)):
        with pytest.raises(ModelError, match="must"):
            belief_at(alpha, gamma, np.array(time))
    with pytest.raises(ModelError, match="discount must"):
        posterior(0.5, 0.0)
    with pytest.raises(ModelError, match="a budget above 0"):
        Game(1.0, 0.0)
    with pytest.raises(ModelError, match="accuracy must"):
        play(None, Game(1.0, 0.1), accuracy=0.0)
    with pytest.raises(ModelError, match="play: player must"):
        play(None, Game(1.0, 0.1))


@pytest.mark.slow
@few
@given(problems(most_live=3), gammas, shares)
def test_the_true_value_lies_between_the_bounds_in_case_m(drawn, gamma, share):
    """The stationary game's lower bound <= c* <= what its own policy really pays."""
    _check_bracket(drawn_problem(MCMP, drawn, share, gamma))


@pytest.mark.slow
@few
@given(problems(most_live=2, most_cost=2), st.sampled_from([0.5, 0.3]), shares)
def test_the_true_value_lies_between_the_bounds_in_case_s(drawn, gamma, share):
    """The same for J_obj / (1 - J_cond); the policy really pays success_cost / (1 - L)."""
    _check_bracket(drawn_problem(S3P, drawn, share, gamma))


def _check_bracket(problem):
    approximate = stationary_game(problem, tolerance=1e-8)
    true = bayes_adaptive(problem, tolerance=1e-5)
    room = 1e-9
    assert approximate.lower_bound <= true.objective * (1 + 1e-9) + room
    above = real_cost(problem, approximate.policy)
    assert true.lower_bound <= above * (1 + 1e-9) + room
    assert true.objective <= above * (1 + 2e-5) + room
    policy = evaluate(true.policy, problem)
    assert policy.discounted_failure <= true.spent + 1e-9
    assert real_cost(problem, true.policy) == pytest.approx(true.objective, rel=1e-6, abs=1e-9)


@criteria
def test_the_bracket_closes_as_the_discount_goes_to_one(criterion):
    """RETRY: the two ends meet at the exact optimum; the discount changes the budget's row too."""
    gaps = []
    for gamma in (0.99, 0.999, 1 - 1e-4, 1 - 1e-5):
        problem = hand_problem(criterion, RETRY, 0.2, gamma)
        approximate = stationary_game(problem)
        gaps.append(real_cost(problem, approximate.policy) - approximate.lower_bound)
    exact = solve(hand_problem(criterion, RETRY, 0.2, None), "columns").objective
    assert all(0 < later <= 0.2 * earlier for earlier, later in pairwise(gaps))
    assert approximate.lower_bound == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
def test_the_bracket_on_the_robot(robot):
    """Case M of the paper's robot at gamma = 0.999: 15.371 <= c* <= 15.4914 or so."""
    model, start = robot
    problem = MCMP(model, start=start, failure_budget=0.05, discount=0.999)
    approximate = stationary_game(problem, tolerance=1e-8)
    true = bayes_adaptive(problem, tolerance=1e-6)
    above = real_cost(problem, approximate.policy)
    assert approximate.lower_bound <= true.objective  # l3-13
    assert true.lower_bound <= above * (1 + 1e-12)
    assert true.objective - true.lower_bound <= 1e-6 * true.objective
    assert above <= approximate.lower_bound * 1.02


def _timed(drawn):
    """The drawn problem whose live states carry the time; every run ends within their number."""
    live = {s: a for s, a in drawn.choices.items() if not s.startswith("d")}

    def at(state, time):
        return (state, time) if state in live else state

    choices = {
        (s, t): {
            a: [(p, at(x, t + 1), cost) for p, x, cost in outcomes] for a, outcomes in table.items()
        }
        for s, table in live.items()
        for t in range(len(live) + 1)
    } | {s: a for s, a in drawn.choices.items() if s not in live}
    begin = {at(s, 0): mass for s, mass in start_distribution(drawn.start).items()}
    return Draw(choices, drawn.goals, begin)


def _check_enumerated(problem, points, best):
    """The least undiscounted cost within the discounted budget, over lotteries of two policies."""
    real, faded = (points(discount) for discount in (None, problem.discount))
    both = [Point(f.failure, r.cost) for f, r in zip(faded, real, strict=True)]
    brute = best(both, problem.failure_budget)
    found = bayes_adaptive(problem, tolerance=1e-8)
    assert found.objective == pytest.approx(brute, rel=1e-6, abs=1e-9)


@few
@given(acyclic_problems(most_actions=2), st.sampled_from([0.5, 0.9]), shares)
def test_t3_2_against_all_policies_of_state_and_time(drawn, gamma, share):
    """t3-2 as stated: c* is the least undiscounted J_MCMP within the discounted budget."""
    timed = _timed(drawn)
    _check_enumerated(
        drawn_problem(MCMP, drawn, share, gamma),
        lambda discount: mcmp.points(plain(timed), timed.start, discount=discount),
        constrained_optimum,
    )


@pytest.mark.slow
@few
@given(acyclic_problems(most_live=2), st.sampled_from([0.5, 0.9]), shares)
def test_t3_1_against_all_policies_of_state_cost_and_time(drawn, gamma, share):
    """t3-1 as stated: the least J^gamma_S3P within the discounted budget, by enumeration."""
    timed = _timed(without_dead_choices(drawn))
    _check_enumerated(
        drawn_problem(S3P, drawn, share, gamma),
        lambda discount: s3p.product_points(plain(timed), timed.start, 100, discount=discount),
        constrained_ratio,
    )


def test_time_is_worth_remembering():
    """Section 3.5: members of the optimal lottery are in general not stationary.

    What a failure uses up of the budget fades like gamma^t: from "y", which "x" reaches at once or
    a step later, ``fast`` saves 2 at either time but costs 0.025 of the budget early and 0.0125
    late. With 0.0125 to spend, time saves 1 and the best stationary lottery 2/3.
    """
    choices = {
        "x": {"go": [(0.5, "y", 1), (0.5, "z", 1)]},
        "z": {"go": [(1.0, "y", 1)]},
        "y": {"slow": [(1.0, "g", 3)], "fast": [(0.8, "g", 1), (0.2, "d", 1)]},
        "d": {},
    }
    drawn = Draw(choices, frozenset("g"), "x")
    problem = MCMP(library_model(drawn), start="x", failure_budget=0.825, discount=0.5)
    assert bayes_adaptive(problem, tolerance=1e-9).objective == pytest.approx(3.5, rel=1e-8)
    real, faded = (mcmp.points(plain(drawn), "x", discount=g) for g in (None, 0.5))
    points = [Point(f.failure, r.cost) for f, r in zip(faded, real, strict=True)]
    assert constrained_optimum(points, 0.825) == pytest.approx(4.5 - 2 / 3)


# The nearly optimal lottery of section 3.4 (Theorem t3-4)


def _check_limit(player, found):
    """The excess over eta falls with delta and is at most delta times the steepest slope."""
    game, alpha = found.threshold.game.game, found.alpha
    room = 1e-9 * game.stake
    excesses = []
    for delta in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        lottery = delta_mixture(player, game, alpha, delta)
        slope = max(abs(game.excess(lottery.minus)), abs(game.excess(lottery.plus)))
        excesses.append(lottery.value - game.stake)
        assert -room <= excesses[-1] <= delta * slope + room
        assert lottery.objective <= lottery.value + room
        assert lottery.condition <= lottery.value / game.scale * (1 + 1e-9)
    assert all(later <= earlier + room for earlier, later in pairwise(excesses))
    return lottery


@criteria
@few
@given(problems(most_live=3), st.sampled_from([0.9, 0.5]), st.sampled_from([0.25, 0.1, 0.5]))
def test_t3_4_the_lottery_tends_to_the_optimum(criterion, drawn, gamma, share):
    """t3-4 for the game over stationary policies: what the lottery pays at worst tends to eta."""
    problem = drawn_problem(criterion, drawn, share, gamma)
    found = stationary_game(problem)
    if found.objective < 1e-3:
        return
    _check_limit(found.player, found)


@criteria
def test_t3_4_for_the_unapproximated_game(criterion):
    """t3-4 as stated: the members depend on time, and the lottery attains c* within the budget."""
    problem = hand_problem(criterion, RETRY, 0.3, 0.95)
    found = bayes_adaptive(problem, tolerance=1e-10)
    lottery = _check_limit(found.player, found)
    spent = found.spent
    share = 1.0 - spent if problem.ratio else 1.0
    assert lottery.objective / share == pytest.approx(found.objective, rel=1e-5)
    assert lottery.condition <= spent * (1 + 1e-5)
    real = evaluate(lottery.policy(found.player), problem)
    paid = real.success_cost if problem.ratio else real.expected_cost
    assert paid == pytest.approx(lottery.objective, rel=1e-9)
    assert real.discounted_failure == pytest.approx(lottery.condition, rel=1e-9)


def test_t3_4_holds_at_the_threshold_only():
    """TWO_MOVES at 1.5 c*: the lottery equalises its two payoffs and costs more than it needs to.

    The proof in the appendix supposes any c >= c*, which gives the value of the game but not the
    least J_obj within the budget, as the theorem states it.
    """
    gamma, budget = 0.99, 0.03
    problem = hand_problem(MCMP, TWO_MOVES, budget, gamma)
    found, player = stationary_game(problem), stationary_player(problem)
    game = game_at(problem, 1.5 * found.objective)
    there = play(player, game)
    lottery = delta_mixture(player, game, there.alpha, 1e-6)
    assert lottery.value == pytest.approx(there.upper, rel=1e-9)
    assert lottery.value < game.stake
    assert lottery.objective > found.objective * 1.05
    assert lottery.condition < budget * 0.9


@criteria
def test_t3_4_on_the_robot(criterion, robot):
    """Delta = 1e-5 on the paper's robot: the cost within 1e-4 of c*, the failure within 5 %."""
    model, start = robot
    problem = criterion(model, start=start, failure_budget=0.05, discount=0.999)
    found = stationary_game(problem, tolerance=1e-8)
    game = found.threshold.game.game
    lottery = delta_mixture(found.player, game, found.alpha, 1e-5)
    share = 1.0 - found.spent if problem.ratio else 1.0
    assert lottery.objective / share == pytest.approx(found.objective, rel=1e-4)
    assert lottery.condition <= 0.05 * (1 + 1e-8)
    real = evaluate(lottery.policy(found.player), problem)
    assert real.objective == pytest.approx(found.objective, rel=1e-4)
    assert real.discounted_failure <= 0.05 * (1 + 1e-8)
