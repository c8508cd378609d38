"""Bounds of the game: however early a search ends, no policy pays less than they say."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, reject, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from games import criteria, hand_problem
from references.chain import start_distribution
from references.s3p import goal_probability_range
from small_models import model_of
from ssp_lp import InfeasibleError, ModelError
from ssp_lp.compiled.deadline import until
from ssp_lp.game import Equilibrium, Game, bayes_adaptive, player as players, thresholds
from ssp_lp.game.optimum import (
    _slack_bound_of_optimum,
    _threshold_from_game_value,
    bayes_player,
    extremes,
    find_threshold,
    stationary_player,
)
from ssp_lp.game.player import BestResponse
from strategies import often, problems


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
        assert tails.goal[:, node].tolist() == pytest.approx([greatest, least], abs=1e-11)


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
        told = _threshold_from_game_value(Equilibrium(game, reply, reply, alpha, least, least, ()))
        weight = Fraction(alpha)
        exact = (Fraction(least) - (1 - weight) * Fraction(stake)) / weight
        assert told <= exact
        assert float(exact) - told <= 1e-14 * stake / alpha


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
    with pytest.raises(ModelError, match="64 steps on 5 states are too many"):
        player.response(1.0, 90.0, 1e-9)
