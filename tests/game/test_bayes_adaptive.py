"""The unapproximated game: values within bounds, at all times."""

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, reject, strategies as st

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
from references.s3p import goal_probability_range
from small_models import TWO_MOVES, model_of
from ssp_lp import InfeasibleError, ModelError, evaluate, solve
from ssp_lp.compiled.deadline import until
from ssp_lp.game import (
    Equilibrium,
    Game,
    bayes_adaptive,
    belief_at,
    delta_mixture,
    play,
    player as players,
    posterior,
    stationary_game,
    thresholds,
)
from ssp_lp.game.optimum import (
    _slack_bound_of_optimum,
    _threshold_from_game_value,
    bayes_player,
    extremes,
    find_threshold,
    stationary_player,
)
from ssp_lp.game.player import BestResponse
from strategies import Draw, acyclic_problems, often, problems

# The unapproximated game of sections 3.2 to 3.4 of the paper, and the belief of section 3.3.


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


# Bounds of the game: however early a search ends, no policy pays less than they say.


@dataclass(frozen=True)
class Haste:
    """One state, left slowly or at once: a policy of (time, cost) is when to dare, or never."""

    gamma: float = 0.99
    stay: float = 0.9
    wait: float = 1.0  # the cost of a step that leads back
    slow: float = 1.0  # of one that arrives
    dare: float = 1.0

    def problem(self, criterion, budget=0.5):
        """Its problem; a dead-end entered charges 1 in case M."""
        choices = {
            "x": {
                "slow": [(1.0 - self.stay, "g", self.slow), (self.stay, "x", self.wait)],
                "fast": [(0.5, "g", self.dare), (0.5, "d", self.dare)],
            },
            "d": {"stuck": [(1.0, "d", 1)]},
        }
        return hand_problem(criterion, choices, budget, self.gamma)

    def points(self, criterion, most=4_000):
        """(J_obj, J_cond) of daring after 0, 1, ..., most steps: geometric sums."""
        t, gamma, stay = np.arange(most + 1), self.gamma, self.stay
        alive, fading = stay**t, (stay * gamma) ** t
        condition = (1.0 - gamma) * (np.cumsum(fading) - fading)
        condition += fading * ((1.0 - gamma) + gamma * 0.5)
        if criterion is MCMP:
            step = stay * self.wait + (1.0 - stay) * self.slow
            return step * (np.cumsum(alive) - alive) + alive * (self.dare + 0.5), condition
        arriving = alive * (1.0 - stay) * (self.wait * t + self.slow)
        dared = alive * 0.5 * (self.wait * t + self.dare)
        return np.cumsum(arriving) - arriving + dared, condition


HASTE = Haste()
PRICES = 10.0 ** np.arange(-1, 4)


def optimum(criterion, budget):
    """The least objective of a lottery over two of them within the budget."""
    cost, failure = HASTE.points(criterion)
    value = cost if criterion is MCMP else cost / (1.0 - failure)
    safe = np.flatnonzero(failure <= budget)[:, None]
    risky = np.flatnonzero(failure > budget)[None, :]
    weight = (budget - failure[safe]) / (failure[risky] - failure[safe])
    mixed = (1.0 - weight) * cost[safe] + weight * cost[risky]
    mixed = mixed if criterion is MCMP else mixed / (1.0 - budget)
    return min(float(value[safe].min()), float(mixed.min(initial=np.inf)))


@criteria
@pytest.mark.parametrize("budget", [0.15, 0.3, 0.9])
def test_the_optimum_over_all_times(criterion, budget):
    solution = bayes_adaptive(HASTE.problem(criterion, budget), tolerance=1e-6)
    best = optimum(criterion, budget)
    assert best * (1 - 1e-6) <= solution.lower_bound <= best * (1 + 1e-13)
    assert solution.objective == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("horizon", [1, 4, 32, 128])
@pytest.mark.parametrize("cap", [None, 1, 2, 8, 64])
def test_what_is_beyond_a_horizon_and_a_cap_is_bounded(horizon, cap):
    """However short the table: no policy pays less than the bound, the policy no less than that.

    Beyond the horizon a failure has faded by gamma^horizon; beyond the cap by gamma^time.
    """
    criterion = MCMP if cap is None else S3P
    player = bayes_player(HASTE.problem(criterion))
    cost, failure = HASTE.points(criterion)
    for price in PRICES:
        reply = player._response(np.array([1.0, price]), cap or 1, horizon)
        best = float((cost + price * failure).min())
        assert reply.bound <= best * (1 + 1e-13)
        assert reply.payoff(1.0, price) >= best * (1 - 1e-13)
        if horizon == 128 and cap in (None, 64):
            assert reply.bound >= best * (1 - 1e-3)


@pytest.mark.parametrize("price", [0.5, 1.9, 5.0])
@pytest.mark.parametrize(
    "haste", [HASTE, Haste(gamma=0.9, stay=0.99, wait=0.0, slow=3.0, dare=2.0)]
)
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-11])
def test_a_surplus_over_sure_failure_is_as_near_as_asked(haste, price, accuracy):
    """J_obj - price * (1 - J_cond) of the best time: what has faded counts as faded, too."""
    player = bayes_player(haste.problem(S3P))
    cost, failure = haste.points(S3P)
    best = float((cost - price * (1.0 - failure)).min())
    told = player.surplus(price, accuracy)
    assert best - 2.0 * accuracy * float((cost + price * failure).min()) <= told <= best + 1e-13


@often(13)
@given(problems(most_live=3), st.sampled_from([0.5, 0.9, 0.99]))
def test_tails_know_the_greatest_and_the_least_success(drawn, gamma):
    """E[gamma^T; goal] of the two tails from every state, beside an enumeration of policies."""
    if {"G0", "G1"} >= set(start_distribution(drawn.start)):
        reject()
    problem = S3P(library_model(drawn), drawn.start, failure_budget=0.5, discount=gamma)
    try:
        player = stationary_player(problem)
    except InfeasibleError:
        reject()
    tails, quotient = player.tails, player.base.quotient
    for state in drawn.choices:
        node = quotient.node_of[problem.model.index_of(state)]
        if node < 0:
            continue
        least, greatest = goal_probability_range(plain(drawn), state, gamma)
        assert tails.greatest_goal[node] == pytest.approx(greatest, rel=1e-11, abs=1e-13)
        assert tails.least_goal[node] == pytest.approx(least, rel=1e-11, abs=1e-13)
        assert tails.values.goal[:, node].tolist() == pytest.approx([greatest, least], abs=1e-11)


RUNGS = np.arange(9)
SAVED, RISK = (RUNGS - 9.0) ** 2, 0.1 * RUNGS
LADDER = {
    "x": {
        f"u{k}": [(1.0 - risk, "g", cost), (risk, "d", cost)]
        for k, (risk, cost) in enumerate(zip(RISK.tolist(), SAVED.tolist(), strict=True))
    },
    "d": {"stuck": [(1.0, "d", 0)]},
}
"""Each tenth of failure more saves less than the one before: every rung is a turning point."""


@criteria
@pytest.mark.parametrize("budget", [0.15, 0.22, 0.35])
def test_a_search_that_is_stopped_after_one_game_claims_no_more_than_it_proved(criterion, budget):
    """The lower end is then the value of that game, far from what the extremes attain."""
    problem = hand_problem(criterion, LADDER, budget, 0.99)
    player, share = stationary_player(problem), 1.0 - budget if problem.ratio else 1.0
    (exact,) = thresholds(problem, [budget])
    known = extremes(player, 1e-10)

    def stop(*_):
        raise KeyboardInterrupt

    with until(float("inf")):
        hasty = find_threshold(player, budget, share, known, tolerance=1e-9, progress=stop)
    assert (hasty.games, hasty.in_time) == (1, False)
    assert 0.0 < hasty.low <= exact.high * (1 + 1e-12)
    assert exact.low <= hasty.high
    if criterion is MCMP:
        failure = 1.0 - 0.99 * (1.0 - RISK)
        assert exact.high == pytest.approx(np.interp(budget, failure, SAVED), rel=1e-12)


def test_a_games_value_proves_no_more_than_it_does_in_fractions():
    """The least c is (J*(alpha) - (1 - alpha) eta) / alpha at least, but for rounding."""
    rng, reply = np.random.default_rng(0), BestResponse(1.0, 0.5, 0.0)
    for _ in range(300):
        alpha, stake, spare = rng.uniform(0.01, 1.0), rng.uniform(0.1, 100.0), rng.uniform(0.0, 0.1)
        least = (1.0 - alpha) * stake * (1.0 + spare**8)
        game = Game(stake, 0.25)
        told = _threshold_from_game_value(Equilibrium(game, reply, reply, alpha, least, ()))
        weight = Fraction(alpha)
        exact = (Fraction(least) - (1 - weight) * Fraction(stake)) / weight
        assert told <= exact
        assert float(exact) - told <= 1e-14 * stake / alpha


def test_a_game_whose_value_is_what_is_owed_proves_nothing_but_rounding():
    """No policy within the budget is known to cost more than nothing."""
    reply = BestResponse(1.0, 0.5, 0.0)
    for alpha in (1e-6, 0.3, 0.5, 1.0):
        game = Game(7.0, 0.25)
        least = game.failure_term(alpha, 0.0)
        told = _threshold_from_game_value(Equilibrium(game, reply, reply, alpha, least, ()))
        assert -1e-14 * 7.0 / alpha <= told <= 0.0


@pytest.mark.parametrize("budget", [0.0, 0.5, 0.9, 1.0])
def test_a_slack_bound_without_a_margin_divides_what_is_lacking_by_the_success(budget):
    """J >= price * (1 - J_cond) - lack for all, so J / (1 - J_cond) >= price - lack / success."""

    class Lacking:
        """A player whose surplus at each price lies a little below 0."""

        def surplus(self, price, accuracy):
            return -1e-6 * price

    told = _slack_bound_of_optimum(Lacking(), 8.0, budget, 1e-9)
    if budget == 1.0:
        assert told == 0.0
    else:
        assert told == pytest.approx(8.0 * (1.0 - 1e-6 / (1.0 - budget)), rel=1e-8)
        assert told < 8.0 * (1.0 - 1e-6 / (1.0 - budget))


def test_a_table_of_times_may_be_too_large(monkeypatch):
    """Entries are steps times states: 64 steps of five states, where 170 are room enough for 32."""
    choices = {
        k: {
            "go": [(0.2, k + 1 if k < 4 else "g", 1), (0.8, k, 1)],
            "rush": [(0.5, "g", 9), (0.5, "d", 9)],
        }
        for k in range(5)
    }
    problem = MCMP(model_of({**choices, "d": {}}), 0, failure_budget=0.6, discount=0.99)
    player = bayes_player(problem)
    assert player.response(1.0, 90.0, 1e-9).sweeps > 64
    monkeypatch.setattr(players, "_MOST_TIMED_ENTRIES", 170)
    with pytest.raises(ModelError, match=r"too long .* \(64 steps on 5 states\)"):
        player.response(1.0, 90.0, 1e-9)
