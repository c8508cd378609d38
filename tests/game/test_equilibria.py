"""Games of policies that are given by their costs alone: every quantity by hand or by search."""

from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP, S3P, MinCost
from games import RETRY, criteria, game_at, hand_problem, matrix_game_value, max_min
from references.frontier import Point, constrained_optimum, constrained_ratio
from refusing import refused
from small_models import TWO_MOVES, model_of
from ssp_lp import InfeasibleError, ModelError, SolverError, evaluate
from ssp_lp.compiled.deadline import until
from ssp_lp.game import (
    Equilibrium,
    Game,
    Mixture,
    bayes_adaptive,
    delta_mixture,
    optimum as games,
    play,
    player as players,
    stationary_game,
    stationary_player,
    thresholds,
)
from ssp_lp.game.equilibrium import cheapest_crossing, crossing, unplayed_game
from ssp_lp.game.optimum import (
    _threshold_from_game_value,
    bayes_player,
    cheapest_mixture,
    extremes,
    find_optimum,
    find_threshold,
)
from ssp_lp.game.player import BestResponse, horizon_of
from ssp_lp.policies import TimedPolicy

SAFE, RASH = BestResponse(3.0, 0.1, 0.0), BestResponse(1.0, 0.5, 0.0)
RARE = BestResponse(4.0, -0.2, 0.0, origin=1.0)
"""Counted from 1: it fails with 0.8."""


def test_the_terms_of_a_payoff():
    """Scale 8 = 2 / 0.25: alpha J_obj + (1 - alpha) 8 J_cond; the origin is left out."""
    game = Game(2.0, 0.25)
    assert game.scale == 8.0
    assert game.payoff(0.75, SAFE) == pytest.approx(0.75 * 3.0 + 0.25 * 8.0 * 0.1)
    assert game.payoff(0.75, RARE) == pytest.approx(0.75 * 4.0 - 0.25 * 8.0 * 0.2)
    assert game.size(0.75, RARE) == pytest.approx(0.75 * 4.0 + 0.25 * 8.0 * 0.2)
    assert game.excess(RARE) == pytest.approx(4.0 - 8.0 * 0.8)
    assert (RARE.condition, RARE.success) == pytest.approx((0.8, 0.2))
    assert RARE.ratio == pytest.approx(20.0)
    for success, origin, hopeful in (
        (1e-14, 1.0, True), (0.0, 1.0, False), (1e-11, 0.0, True), (1e-13, 0.0, False),
    ):  # fmt: skip
        reply = BestResponse(1.0, (1.0 - origin) - success, 0.0, origin=origin)
        assert reply.has_conditional_cost is hopeful


@pytest.mark.parametrize("origin", [0.0, 1.0])
@pytest.mark.parametrize("room", [None, "stated"])
def test_whoever_uses_up_the_budget_owes_the_payoff_less_its_objective(origin, room):
    """It is (1 - alpha) (eta / epsilon) J_cond at J_cond = epsilon, from either origin."""
    stated = None if room is None else 0.25 - origin
    game, spends = Game(2.0, 0.25, stated), BestResponse(3.0, 0.25 - origin, 0.0, origin=origin)
    for alpha in (0.0, 0.3, 0.9, 1.0):
        owed = game.payoff(alpha, spends) - alpha * spends.objective
        assert game.failure_term(alpha, origin) == pytest.approx(owed, abs=1e-15)


def test_a_room_of_more_digits_than_the_budget():
    """1 - 1e-20 is 1 in double precision; the room of -1e-20 keeps what is owed."""
    assert Game(3.0, 1.0, -1e-20).failure_term(0.5, 1.0) == pytest.approx(-1.5e-20, rel=1e-12)
    assert Game(3.0, 1.0).failure_term(0.5, 1.0) == 0.0


@pytest.mark.parametrize(("stake", "budget"), [(-1e-9, 0.5), (1.0, 0.0), (1.0, -0.5)])
def test_games_that_there_are_not(stake, budget):
    with pytest.raises(ModelError, match="a stake >= 0 and a budget above 0"):
        Game(stake, budget)


@pytest.mark.parametrize("alpha", [0.0, 0.25, 1.0])
def test_the_bounds_of_a_game_count_failing_from_0(alpha):
    """Whatever the origin of the responses: alpha 4 + (1 - alpha) 8 * 0.8, less 1 below."""
    game = Game(2.0, 0.25)
    counted = game.payoff(alpha, RARE)
    found = Equilibrium(game, RARE, RARE, alpha, counted - 1.0, (RARE,))
    assert found.upper == pytest.approx(alpha * 4.0 + (1.0 - alpha) * 8.0 * 0.8)
    assert found.lower == pytest.approx(found.upper - 1.0)
    above = Equilibrium(game, RARE, RARE, alpha, counted + 1.0, (RARE,))
    assert above.lower == above.upper  # a bound above what is attained is rounding
    price = np.inf if alpha == 0.0 else 8.0 * (1.0 - alpha) / alpha
    assert found.failure_price == pytest.approx(price)


def test_lines_cross_where_both_policies_pay_alike():
    """3 a + 0.8 (1 - a) = a + 4 (1 - a) at a = 3.2 / 5.2; one line above the other: at an end."""
    game = Game(2.0, 0.25)
    alpha = crossing(game, SAFE, RASH)
    assert alpha == pytest.approx(3.2 / 5.2)
    assert game.payoff(alpha, SAFE) == pytest.approx(game.payoff(alpha, RASH))
    near = BestResponse(3.0 - 1e-12, 0.1 - 1e-14, 0.0)
    assert 0.0 <= crossing(game, SAFE, near) <= 1.0
    assert crossing(game, SAFE, BestResponse(1.0, 0.1, 0.0)) == 0.0
    assert crossing(game, SAFE, BestResponse(3.0, 0.5, 0.0)) == 1.0


@pytest.mark.parametrize("seed", range(20))
def test_the_mixture_of_two_policies_is_that_of_the_matrix_game(seed):
    """Its worst payoff is least among the lotteries over the two, also where one is enough."""
    rng = np.random.default_rng(seed)
    game = Game(float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.1, 0.9)))
    both = [BestResponse(float(c), float(f), 0.0) for c, f in rng.uniform(0.0, 2.0, (2, 2))]
    lottery = Mixture(game, *both)
    known = matrix_game_value([Point(r.failing, r.objective) for r in both], game)
    assert lottery.value == pytest.approx(known, rel=1e-9)
    weights = np.linspace(0.0, 1.0, 101)
    costs = np.outer(1.0 - weights, [both[0].objective, both[0].condition])
    costs += np.outer(weights, [both[1].objective, both[1].condition])
    assert lottery.value <= np.maximum(costs[:, 0], game.scale * costs[:, 1]).min() + 1e-12
    assert lottery.value == max(lottery.objective, game.scale * lottery.condition)


@pytest.mark.parametrize("seed", range(10))
def test_the_cheapest_lottery_within_a_budget(seed):
    """Beside a search over all pairs; a policy alone where no lottery is cheaper."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 1.0, (6, 2)).tolist()
    responses = [BestResponse(c, f, 0.0) for c, f in points]
    room = sorted(f for _, f in points)[seed % 6]
    members, weights, cost = cheapest_mixture(responses, room)
    safe, risky = ([p for p in points if (p[1] <= room) is side] for side in (True, False))
    lotteries = [
        ((g - room) * c + (room - f) * d) / (g - f) for c, f in safe for d, g in risky
    ]  # fmt: skip
    assert cost == pytest.approx(min([c for c, _ in safe] + lotteries), rel=1e-12)
    assert sum(weights) == pytest.approx(1.0)
    assert min(weights) > 0.0
    assert sum(w * r.objective for w, r in zip(weights, members, strict=True)) == pytest.approx(
        cost
    )
    assert sum(w * r.failing for w, r in zip(weights, members, strict=True)) <= room + 1e-15
    if risky:
        left, right = [[BestResponse(c, f, 0.0) for c, f in side] for side in (safe, risky)]
        one, other, share, pays = cheapest_crossing(left, right, lambda r: r.failing - room)
        assert pays == pytest.approx(min(lotteries), rel=1e-12)
        assert (1.0 - share) * one.failing + share * other.failing == pytest.approx(room)


# Searches that end before a game is played.


def test_without_a_game_nothing_is_proved_and_the_best_lottery_is_kept():
    """Three policies are known; the two whose lines cross highest below stand for the game."""
    game, dear = Game(2.0, 0.25), BestResponse(9.0, 0.0, 0.0)
    found = unplayed_game(game, [dear, RASH, SAFE])
    assert found.least == found.lower == -np.inf
    assert (found.minus, found.plus) == (SAFE, RASH)
    assert found.alpha == crossing(game, SAFE, RASH)
    assert found.upper == pytest.approx(matrix_game_value(
        [Point(r.failing, r.objective) for r in (dear, RASH, SAFE)], game))  # fmt: skip
    for alone in (SAFE, RASH):
        one = unplayed_game(game, [alone])
        assert (one.minus, one.plus, one.alpha, one.failure_price) == (alone, alone, 1.0, 0.0)
        assert one.upper == alone.objective
    assert _threshold_from_game_value(found) == -np.inf


def test_an_adversary_of_failing_alone_proves_nothing_of_the_cost():
    """At alpha = 0 the payoff is independent of J_obj, and any c >= 0 may be the least."""
    found = Equilibrium(Game(2.0, 0.25), SAFE, SAFE, 0.0, 0.8, (SAFE,))
    assert _threshold_from_game_value(found) == 0.0


@criteria
@pytest.mark.parametrize("budget", [0.3, 1.0])
def test_a_deadline_that_has_passed_leaves_known_policies_and_no_bound(criterion, budget):
    """RETRY: the cheapest lottery of the extremes within the budget, which is the optimum here."""
    problem = hand_problem(criterion, RETRY, budget, 0.95)
    player, share = stationary_player(problem), 1.0 - budget if criterion is S3P else 1.0
    known = extremes(player, 1e-10)
    exact = find_threshold(player, budget, share or 1.0, known, tolerance=1e-9)
    with until(0.0):
        hasty = find_threshold(player, budget, share or 1.0, known, tolerance=1e-9)
    assert exact.in_time
    assert not hasty.in_time
    assert (hasty.games, hasty.low) == (1, 0.0)
    assert hasty.high >= exact.high * (1 - 1e-12)
    assert hasty.condition <= budget + 1e-12


def test_a_distance_from_alpha_is_above_0():
    problem = hand_problem(MCMP, TWO_MOVES, 0.5, 0.99)
    player, game = stationary_player(problem), game_at(problem, 2.0)
    for delta in (0.0, -0.1, float("nan")):
        refused("delta must be above 0", delta_mixture, player, game, 0.5, delta)


def test_a_policy_that_is_best_against_both_is_played_alone():
    """alpha* = 1: the two sides are one policy, whose lottery has one member."""
    problem = hand_problem(MCMP, TWO_MOVES, 0.5, 0.99)
    player = stationary_player(problem)
    found = play(player, game_at(problem, 2.0))
    assert found.minus is found.plus
    assert len(found.policy(player).policies) == 1


# What the game does not answer is refused, and with the remedy.


@pytest.mark.parametrize("game", [stationary_game, bayes_adaptive])
def test_problems_without_a_game(game):
    model = model_of(TWO_MOVES)
    for problem, words in (
        (MinCost(model_of(RETRY), "x"), "supports costs with a failure budget, not MinCost"),
        (MCMP(model, "x", 0.5), "the game needs a discount"),
        (MCMP(model, "x", 0.0, discount=0.9), "needs failure_budget above 0, not 0.0"),
    ):
        with pytest.raises(ModelError, match=words):
            game(problem)


def test_a_goal_out_of_reach_is_named():
    """From the dead-end itself; and where its discounted probability is 0 in double precision."""
    model = model_of({"x": {"on": [(1.0, "y", 1)]}, "y": {"on": [(1.0, "g", 1)]}, "d": {}})
    with pytest.raises(InfeasibleError, match=r"fails surely, above the budget 0\.5"):
        stationary_game(MCMP(model, "d", 0.5, discount=0.9))
    with pytest.raises(InfeasibleError):
        stationary_player(S3P(model, "d", 0.5, discount=0.9))
    with pytest.raises(SolverError, match=r"a \(discounted\) probability of at most 0.0e\+00"):
        stationary_game(S3P(model, "x", 1.0, discount=1e-200))


def test_totals_that_are_too_many_are_refused(monkeypatch):
    """Layers of whole costs, and sums of costs without a unit."""
    whole = {"x": {"go": [(0.5, "g", 1), (0.5, "x", 1)]}}
    odd = {"x": {"go": [(0.4, "g", 1), (0.3, "x", 1), (0.3, "x", 2.0**0.5)]}}
    for choices in (whole, odd):
        problem = hand_problem(S3P, choices, 0.9, 0.99)
        assert stationary_player(problem).totals(8.0).size >= 8
        with monkeypatch.context() as small:
            small.setattr(players, "_MOST_LAYERS", 7)
            with pytest.raises(ModelError, match="the totals below 8 are too many for the game"):
                stationary_player(problem).totals(8.0)


def test_what_a_solution_shows():
    found = stationary_game(hand_problem(MCMP, TWO_MOVES, 0.03, 0.99))
    shown = found.summary()
    for word, number in (
        ("c*", found.objective), ("lower bound", found.lower_bound), ("alpha*", found.alpha),
        ("price", found.price), ("epsilon*", 0.03),
    ):  # fmt: skip
        line = next(line for line in shown.splitlines() if line.strip().startswith(word))
        assert float(line.split()[-1]) == pytest.approx(number, rel=1e-5)


def test_what_the_least_failure_says():
    """Whether a discount nearer to 1 would help, and what the least failures are, exactly."""
    model = model_of(TWO_MOVES)
    for budget, words in ((0.005, "a discount nearer to 1 is feasible"), (0.0, None)):
        problem = MCMP(model, "x", max(budget, 1e-9), discount=0.9)
        with pytest.raises(InfeasibleError) as caught:
            stationary_game(problem)
        assert caught.value.least_failure == pytest.approx(0.0, abs=1e-15)
        assert caught.value.least_discounted_failure == pytest.approx(0.1)
        assert (words or "a discount nearer to 1 is feasible") in str(caught.value)
    risky = model_of({"x": {"go": [(0.75, "g", 1), (0.25, "d", 1)]}, "d": {}})
    with pytest.raises(InfeasibleError) as caught:
        stationary_game(MCMP(risky, "x", 0.25, discount=0.9))
    assert "nearer" not in str(caught.value)
    assert caught.value.least_failure == pytest.approx(0.25)
    with pytest.raises(InfeasibleError) as caught:
        stationary_game(S3P(risky, "x", 0.3, discount=0.9), tail=2)
    assert "nearer" not in str(caught.value)
    assert caught.value.failure_budget == 0.3


# Best responses.


def test_a_horizon_is_long_enough_and_no_longer():
    """gamma^N w <= error, from the first such N, but for one."""
    assert horizon_of(0.5, 1.0, 1.0) == horizon_of(0.5, 0.25, 0.5) == 1
    for gamma, weight, error in ((0.5, 1.0, 1e-3), (0.9, 7.0, 1e-6), (0.99, 1e3, 1e-9)):
        steps = horizon_of(gamma, weight, error)
        assert weight * gamma**steps <= error < weight * gamma ** (steps - 2)


@pytest.mark.parametrize("accuracy", [1e-3, 1e-12, 0.0])
def test_value_iteration_ends_with_two_bounds_at_any_accuracy(accuracy):
    """RETRY by hand: J_obj + 10 J_cond of the better action; none is as accurate as 0."""
    gamma, price = 0.95, 10.0
    player = stationary_player(hand_problem(MCMP, RETRY, 0.5, gamma))
    exact = min(
        (1.0 + (1 - goal - stay) * gamma + price * (1 - gamma + gamma * (1 - goal - stay)))
        / (1 - gamma * stay)
        for goal, stay in ((0.5, 0.3), (0.25, 0.74))
    )
    found = player.values_of(np.array([1.0, price]), player.base.start, accuracy)
    assert found.values[0] <= exact * (1 + 1e-15)
    assert found.values[0] == pytest.approx(exact, rel=max(accuracy, 1e-11))
    assert found.totals[0] @ [1.0, price] == pytest.approx(exact, rel=1e-12)


def test_a_cap_where_costs_have_no_unit():
    """pi'_or takes a from y on, where M = 1 is paid: 1 + sqrt 2 with 1/2, discounted once.

    The detour of greater goal probability is no tail, as in the case with a unit.
    """
    root = 2.0**0.5
    model = model_of(
        {
            "x": {"on": [(1.0, "y", 1.0)]},
            "y": {"a": [(0.5, "g", root), (0.5, "d", root)], "b": [(1.0, "z", 1.0)]},
            "z": {"c": [(0.6, "g", root), (0.4, "d", 1.0)]},
            "d": {},
        }
    )
    problem = S3P(model, "x", failure_budget=0.95, discount=0.8)
    known = 0.8 * 0.5 * (1.0 + root) / 0.32
    for tail in (1e-9, 1.0, 1.0 + 1e-9, 2.0):
        found = stationary_game(problem, tail=tail)
        assert found.objective == pytest.approx(known, rel=1e-12), tail
        assert found.lower_bound == pytest.approx(known, rel=1e-9)


def test_a_cap_is_a_cost_where_costs_have_no_unit():
    """pi'_or takes a from y on where M < 1 is paid there; M = 3 / 2 leaves the choice of b.

    a pays 1 + 10 sqrt 2 with 1/2, discounted once. b leads to c, discounted twice: 2 + sqrt 2 is
    paid with 3/5; of the others, which come to y again, half pay 3 + 11 sqrt 2.
    """
    root, gamma = 2.0**0.5, 0.8
    y = {"a": [(0.5, "g", 10.0 * root), (0.5, "d", root)], "b": [(1.0, "z", 1.0)]}
    z = {"c": [(0.6, "g", root), (0.4, "x", root)]}
    model = model_of({"x": {"on": [(1.0, "y", 1.0)]}, "y": y, "z": z, "d": {}})
    problem = S3P(model, "x", failure_budget=0.95, discount=gamma)
    assert stationary_player(problem).base.by_steps
    paid = gamma**2 * (0.6 * (2.0 + root) + 0.2 * (3.0 + 11.0 * root))
    later = paid / (gamma**3 * 0.6 + gamma**5 * 0.2)
    for tail, known in ((0.9, (1.0 + 10.0 * root) / gamma), (1.5, later)):
        found = stationary_game(problem, tail=tail)
        assert found.objective == pytest.approx(known, rel=1e-12), tail


def test_decisions_change_with_time_only_where_they_differ():
    """One stage for all times where nothing is worth remembering; else as many as decisions."""
    problem = hand_problem(MCMP, TWO_MOVES, 0.5, 0.99)
    found = bayes_adaptive(problem)
    (alone,) = found.policy.policies
    if isinstance(alone, TimedPolicy):
        assert len({id(stage) for stage in alone.stages}) == 1


@pytest.mark.parametrize("begin", [0, 1])
@pytest.mark.parametrize("price", [0.1, 100.0])
def test_a_policy_is_improved_to_the_best_one_from_any(begin, price):
    """RETRY: at a low price ``rush`` is best, at a high one ``care``; few steps are enough."""
    player = stationary_player(hand_problem(MCMP, RETRY, 0.5, 0.95))
    base, weights = player.base, np.array([1.0, price])
    costs = np.stack([base.gain_cost, base.failure], axis=1)
    each = [
        players.improved_response(base.instant_dynamics, costs, weights, np.array([k], np.int32))
        for k in (0, 1)
    ]
    choice, totals, steps = each[begin]
    assert choice.tolist() == each[1 - begin][0].tolist() == [0 if price == 0.1 else 1]
    assert totals[0] @ weights == pytest.approx(player.response(1.0, price, 1e-12).bound, rel=1e-11)
    assert steps <= 2


ONE_STEP = {
    "likely": {"cheap": (0.5, 1.0), "dear": (0.875, 4.0)},
    "rare": {"cheap": (2.0**-16, 1.0), "dear": (2.0**-15, 4.0)},
}
STARTS = [{"x": 1.0}, {"x": 0.5, "g": 0.5}, {"x": 0.5, "g": 0.25, "d": 0.25},
          {"x": 1.0 - 2.0**-14, "g": 2.0**-14}, {"x": 1.0 - 2.0**-14, "d": 2.0**-14}]  # fmt: skip


@pytest.mark.parametrize("chances", ONE_STEP)
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("make", [stationary_player, bayes_player])
def test_bounds_count_the_start_on_goals_and_on_dead_ends(make, start, chances):
    """One step in fractions: no bound lies above the best of two actions, nor far below it.

    J_obj is E[cost; goal], J_cond is 1 - gamma E[goal] - (start on goals).
    """
    table = {
        name: [(goal, "g", cost), (1.0 - goal, "d", cost)]
        for name, (goal, cost) in ONE_STEP[chances].items()
    }
    problem = S3P(model_of({"x": table, "d": {}}), start, failure_budget=0.99999, discount=0.75)
    player = make(problem)
    points = [
        (Fraction(start["x"]) * Fraction(goal) * Fraction(cost),
         1 - Fraction(0.75) * Fraction(start["x"]) * Fraction(goal) - Fraction(start.get("g", 0.0)))
        for goal, cost in ONE_STEP[chances].values()
    ]  # fmt: skip
    for price in (0.5, 3.0, 100.0):
        exact = min(c - Fraction(price) * (1 - f) for c, f in points)
        told = player.surplus(price, 1e-12)
        size = max(float(c + Fraction(price) * (1 - f)) for c, f in points)
        assert Fraction(told) <= exact
        assert float(exact) - told <= 1e-14 * size
        reply = player.response(1.0, price, 1e-12)
        best = min(c + Fraction(price) * (f - Fraction(reply.origin)) for c, f in points)
        assert Fraction(reply.bound) <= best
        assert reply.payoff(1.0, price) == pytest.approx(float(best), rel=1e-13)
        assert reply.bound == pytest.approx(float(best), rel=1e-12)
        rare = max(1 - f for _, f in points) <= 1e-3
        assert reply.origin == (1.0 if rare and make is stationary_player else 0.0)


@criteria
def test_extremes_fail_least_and_cost_least(criterion):
    """RETRY: ``care`` fails less and ``rush`` costs less; undiscounted goal 0.25 / 0.26."""
    problem = hand_problem(criterion, RETRY, 0.5, 0.95)
    safest, cheapest = extremes(stationary_player(problem), 1e-10)
    care, rush = (0.95 * goal / (1 - 0.95 * stay) for goal, stay in ((0.25, 0.74), (0.5, 0.3)))
    assert safest.condition == pytest.approx(1.0 - max(care, rush), rel=1e-12)
    assert cheapest.objective <= safest.objective


# A player of listed policies: whatever the search does, its bounds hold and meet.


@dataclass(frozen=True)
class Listed:
    """Policies by their costs; every bound is too low by this share of the payoff's size."""

    points: tuple[Point, ...]
    origin: float = 0.0
    slack: float = 0.0
    tail: float | None = None

    def response(self, objective_weight, condition_weight, accuracy):
        """Return the policy of least payoff."""
        each = [BestResponse(c, f - self.origin, 0.0, origin=self.origin) for f, c in self.points]
        best = min(each, key=lambda r: r.payoff(objective_weight, condition_weight))
        least = best.payoff(objective_weight, condition_weight)
        size = best.size(objective_weight, condition_weight)
        return replace(best, bound=least - self.slack * size, sweeps=1)

    def surplus(self, price, accuracy):
        """Bound J_obj - price * (1 - J_cond)."""
        least = min(c - price * (1.0 - f) for f, c in self.points)
        return least - self.slack * price


def convex(rng, count=8):
    """Points of which each fails more and costs less than the one before."""
    failures = np.sort(rng.uniform(0.05, 0.9, count)).tolist()
    return tuple(Point(f, 5.0 * (1.0 - f) ** 2 + 0.2) for f in failures)


@pytest.mark.parametrize("origin", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(8))
def test_the_least_c_of_listed_policies(seed, origin, monkeypatch):
    """By search over all lotteries; games alternate between the upper end and the midpoint.

    The last one is played at the optimum, where its value is the stake (eq. def_c*).
    """
    rng, stakes, told = np.random.default_rng(seed), [], []
    points = convex(rng) if seed % 2 else tuple(map(Point, *rng.uniform(0.1, 0.9, (2, 9)).tolist()))
    player, budget = Listed(points, origin), float(rng.uniform(0.3, 0.8))
    budget = max(budget, min(f for f, _ in points) + 0.01)
    known = extremes(player, 1e-10)
    first = cheapest_mixture(known, budget - origin)[2]
    monkeypatch.setattr(games, "play", lambda *a, **k: stakes.append(a[1].stake) or play(*a, **k))
    for share in (1.0, 1.0 - budget):
        stakes.clear(), told.clear()
        found = find_threshold(
            player, budget, share, known, tolerance=1e-9, progress=lambda *at: told.append(at)
        )
        best = constrained_optimum(points, budget) / share
        assert found.high == pytest.approx(best, rel=1e-10)
        assert best * (1 - 1e-9) <= found.low <= found.high
        assert found.condition <= budget + 1e-12
        assert found.in_time
        assert found.games == len(stakes) == len(told) <= 5
        assert stakes[0] == pytest.approx(first, rel=1e-12)
        assert stakes[-1] == share * found.high
        played = found.game
        assert played.upper == pytest.approx(share * found.high, rel=1e-9)
        assert [high for *_, high in told] == sorted((high for *_, high in told), reverse=True)
        assert told[-1] == (len(played.responses), found.failure_price, found.high)
        value = max_min(points, Game(share * found.high, budget))
        assert played.lower <= value * (1 + 1e-9)
        assert value <= played.upper * (1 + 1e-9)


@pytest.mark.parametrize("slack", [1e-3, 1e-6])
@pytest.mark.parametrize("seed", range(4))
def test_a_bracket_that_does_not_close_is_left(seed, slack):
    """Bounds of responses that are too low keep it open; it still holds the optimum."""
    points, budget = convex(np.random.default_rng(seed)), 0.6
    player = Listed(points, slack=slack)
    found = find_threshold(player, budget, 1.0, extremes(player, 1e-10), tolerance=1e-9)
    best = constrained_optimum(points, budget)
    assert found.low <= best <= found.high * (1 + 1e-12)
    assert found.high - found.low <= 100.0 * slack * best
    assert found.games <= 8
    assert found.in_time


def test_a_midpoint_halves_the_bracket(monkeypatch):
    """Between a lower end that one game proves and the upper end, to 0.5 of their sum."""
    points, ends, stakes = convex(np.random.default_rng(3)), [], []
    player = Listed(points, slack=1e-2)
    monkeypatch.setattr(games, "play", lambda *a, **k: stakes.append(a[1].stake) or play(*a, **k))
    proved = games._threshold_from_game_value
    monkeypatch.setattr(
        games, "_threshold_from_game_value", lambda p: ends.append(proved(p)) or ends[-1]
    )
    highs = []
    find_threshold(player, 0.6, 1.0, extremes(player, 1e-10), tolerance=1e-9,
                   progress=lambda *at: highs.append(at[-1]))  # fmt: skip
    assert len(stakes) > 1
    for k in range(1, len(stakes)):
        low = max(0.0, *ends[:k])
        assert stakes[k] == (highs[k - 1] if k % 2 == 0 else 0.5 * (low + highs[k - 1]))


RATIOS = {
    "slack": (0.9, 0.95), "tight": (0.2, 0.3), "at the best one": (None, 0.5), "sure": (1.0, 1.0),
}  # fmt: skip


@pytest.mark.parametrize("origin", [0.0, 1.0])
@pytest.mark.parametrize("low", RATIOS)
@pytest.mark.parametrize("seed", range(4))
def test_the_least_ratio_of_listed_policies(seed, low, origin):
    """J_obj / (1 - J_cond) over all lotteries within the budget, by search.

    The price where the budget is slack is the optimum itself.
    """
    rng = np.random.default_rng(seed)
    points = convex(rng)
    if low != "tight":
        points = tuple(Point(f, c) for f, c in [*points, Point(0.5, 0.5)])
    budget = RATIOS[low][1]
    problem = S3P(model_of(RETRY), "x", failure_budget=budget, discount=0.9)
    found = find_optimum(problem, Listed(points, origin), tolerance=1e-9)
    best = constrained_ratio(points, budget)
    assert found.objective == pytest.approx(best, rel=1e-9)
    assert best * (1 - 2e-9) <= found.lower_bound <= best * (1 + 1e-12)
    assert 0.0 < found.spent <= budget + 1e-15
    single = min(points, key=lambda p: p.cost / (1.0 - p.failure))
    if single.failure <= budget:
        assert (found.price, found.spent) == pytest.approx((best, single.failure))
        assert found.alpha == pytest.approx(1.0 - single.failure)
    else:
        assert found.spent == pytest.approx(budget)
        assert found.price == found.threshold.failure_price


def test_the_least_cost_of_listed_policies():
    points = convex(np.random.default_rng(5))
    problem = MCMP(model_of(RETRY), "x", failure_budget=0.4, discount=0.9)
    found = find_optimum(problem, Listed(points), tolerance=1e-9)
    best = constrained_optimum(points, 0.4)
    assert found.objective == pytest.approx(best, rel=1e-9)
    assert best * (1 - 1e-9) <= found.lower_bound <= best * (1 + 1e-12)
    assert (found.spent, found.alpha) == (0.4, found.threshold.game.alpha)
    assert found.price == found.threshold.failure_price
    least = min(f for f, _ in points)
    below = replace(problem, failure_budget=least - 5e-11)  # it counts as the least failure
    assert find_optimum(below, Listed(points), tolerance=1e-9).spent == least


def test_a_budget_of_1_asks_for_the_cheapest_policy():
    """In case M; given success no policy has to succeed then, and there is no game."""
    problem = hand_problem(MCMP, RETRY, 0.5, 0.95)
    (free,) = thresholds(problem, [1.0])
    assert free.high == extremes(stationary_player(problem), 1e-10)[1].objective
    with pytest.raises(ModelError, match="not defined"):
        thresholds(hand_problem(S3P, RETRY, 0.5, 0.95), [1.0])
    refused("tolerance must", thresholds, problem, [0.5], tolerance=0.0)


@dataclass(frozen=True)
class Interrupted(Listed):
    """The same player; after so many calls somebody presses Ctrl-C in each."""

    after: int = 0
    calls: list[int] = field(default_factory=list)

    def response(self, objective_weight, condition_weight, accuracy):
        """Return the policy of least payoff, if there is time."""
        self.calls.append(1)
        if len(self.calls) > self.after:
            raise KeyboardInterrupt
        return super().response(objective_weight, condition_weight, accuracy)

    def surplus(self, price, accuracy):
        """Bound the surplus, if there is time."""
        self.response(1.0, price, accuracy)
        return super().surplus(price, accuracy)


@pytest.mark.parametrize("origin", [0.0, 1.0])
@pytest.mark.parametrize("budget", [0.051, 0.3, 0.95])
@pytest.mark.parametrize("after", [*range(1, 13), 99])
def test_whenever_a_search_is_interrupted_its_bounds_hold(after, budget, origin):
    """From the second response on there is an answer, of which as much is proved as is stated."""
    points = convex(np.random.default_rng(7))
    points = (Point(0.05, 5.0), *points)
    for criterion, reference in ((MCMP, constrained_optimum), (S3P, constrained_ratio)):
        problem = criterion(model_of(RETRY), "x", failure_budget=budget, discount=0.9)
        player = Interrupted(points, origin if criterion is S3P else 0.0, after=after)
        with until(float("inf")):
            found = find_optimum(problem, player, tolerance=1e-9)
        best = reference(points, budget)
        assert 0.0 <= found.lower_bound <= best * (1 + 1e-12)
        assert found.objective >= best * (1 - 1e-12)
        assert found.threshold.condition <= budget + 1e-12
        if after == 99:
            assert found.lower_bound == pytest.approx(found.objective, rel=2e-9)
            assert found.threshold.in_time


@dataclass(frozen=True)
class Improving(Listed):
    """The same player, whose bounds come nearer with each call; it keeps the weights asked for."""

    asked: list[tuple[float, float]] = field(default_factory=list)

    def response(self, objective_weight, condition_weight, accuracy):
        """Return the policy of least payoff, with a bound that is less low than before."""
        self.asked.append((objective_weight, condition_weight))
        best = super().response(objective_weight, condition_weight, accuracy)
        lacking = 0.2 * 0.6 ** len(self.asked) * best.size(objective_weight, condition_weight)
        return replace(best, bound=best.bound - lacking)


@pytest.mark.parametrize("seed", range(4))
def test_a_bracket_is_narrowed_to_the_tolerance(seed):
    """While two games narrow it: bounds that come nearer close it in the end."""
    points = convex(np.random.default_rng(seed))
    known = extremes(Listed(points), 1e-10)
    found = find_threshold(Improving(points), 0.6, 1.0, known, tolerance=1e-4)
    best = constrained_optimum(points, 0.6)
    assert found.low <= best * (1 + 1e-12)
    assert found.high == pytest.approx(best, rel=1e-9)
    assert found.high - found.low <= 1e-4 * found.high
    assert found.in_time


def test_extremes_of_listed_policies():
    """Neither is that of the least sum of both, 0.9 and 0.5."""
    points = (Point(0.3, 2.0), Point(0.2, 5.0), Point(0.9, 0.5), Point(0.99, 0.45))
    safest, cheapest = extremes(Listed(points), 1e-10)
    assert (safest.failing, safest.objective) == (0.2, 5.0)
    assert (cheapest.failing, cheapest.objective) == (0.99, 0.45)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_at_the_least_failure_the_cheapest_policy_counts(scale):
    """Whatever the unit of cost; failures within 1e-13 are one number, computed twice."""
    for apart, known in ((0.0, 4.0), (5e-14, 4.0), (5e-12, 9.0 - 5e-12 / 0.4 * 8.0)):
        points = (Point(0.2, 9.0 * scale), Point(0.2 + apart, 4.0 * scale), Point(0.6, scale))
        player = Listed(points)
        found = find_threshold(player, 0.2, 1.0, extremes(player, 1e-10), tolerance=1e-9)
        assert found.high == pytest.approx(known * scale, rel=1e-9), apart
        assert found.low <= found.high
    below = find_threshold(player, 0.2 - 1e-11, 1.0, extremes(player, 1e-10), tolerance=1e-9)
    assert below.budget == 0.2  # it counts as the least failure
    assert below.condition == pytest.approx(0.2, abs=1e-15)


def test_steep_prices_are_tried_where_the_budget_is_tight_and_until_they_do():
    """In multiples of the cost of the goal, 5 / 0.8: the first one leads to the least failure."""
    points = (Point(0.2, 5.0), Point(0.6, 1.0))
    for budget, count in ((0.2, 1), (0.2 * (1 + 0.9e-6), 1), (0.2 * (1 + 1e-5), 0), (0.4, 0)):
        player = Improving(points)
        known = extremes(Listed(points), 1e-10)
        steep = list(games._cheap_near_least_failure(player, budget, known, 1e-10))
        assert player.asked == [(1.0, 1e3 * 5.0 / 0.8)] * count
        assert [r.failing for r in steep] == [0.2] * count
    near = (Point(0.2, 5.0), Point(0.2 + 1e-7, 3.0))
    player = Improving(near)
    steep = list(games._cheap_near_least_failure(player, 0.2, extremes(Listed(near), 1e-10), 1e-10))
    assert [price for _, price in player.asked] == [k * 5.0 / 0.8 for k in (1e3, 1e6, 1e9)]
    assert [r.objective for r in steep] == [3.0, 3.0, 5.0]


def test_a_distance_from_alpha_leaves_no_probability():
    """Both alphas are cut at 0 and 1; one that is beyond them before is refused."""
    player, game = Improving((Point(0.2, 5.0), Point(0.6, 1.0))), Game(2.0, 0.4)
    delta_mixture(player, game, 0.9, 0.5)
    delta_mixture(player, game, 0.1, 0.5)
    weights = [(0.4, 0.6 * 5.0), (1.0, 0.0), (0.0, 5.0), (0.6, 0.4 * 5.0)]
    assert player.asked == pytest.approx(np.array(weights))
    for alpha in (-0.1, 1.1):
        refused("alpha must lie between 0 and 1", delta_mixture, player, game, alpha, 0.1)


@pytest.mark.parametrize("seed", range(6))
def test_a_game_of_listed_policies_is_a_matrix_game(seed):
    """Its bounds meet at the value of the linear program over all rows; both sides are kept."""
    rng = np.random.default_rng(seed)
    points = tuple(map(Point, *rng.uniform(0.1, 0.9, (2, 7)).tolist()))
    game = Game(float(rng.uniform(0.2, 2.0)), float(rng.uniform(0.2, 0.8)))
    found = play(Listed(points), game)
    value = matrix_game_value(points, game)
    assert found.lower == pytest.approx(value, rel=1e-9)
    assert found.upper == pytest.approx(value, rel=1e-9)
    assert found.value == pytest.approx(value, rel=1e-9)
    assert found.minus in found.responses
    assert found.plus in found.responses
    again = play(Listed(points), game, found.responses)
    assert again.upper == pytest.approx(value, rel=1e-9)


def test_times_of_a_belief_are_whole_numbers():
    for time in (0.5, np.array([1, -1]), np.array([1.0])):
        refused("time must be whole numbers >= 0", games.belief_at, 0.5, 0.9, time)


def test_the_least_failure_within_a_horizon():
    """Two tries of 3/4 each: the least failure is 1/16, and 1 - (gamma + gamma^2 / 4) 3 / 4."""
    model = model_of({"x": {"try": [(0.75, "g", 1), (0.25, "x", 1)]}})
    with pytest.raises(InfeasibleError) as caught:
        stationary_game(MCMP(model, "x", 0.05, discount=0.9, horizon=2))
    assert caught.value.least_failure == pytest.approx(1 / 16)
    assert caught.value.least_discounted_failure == pytest.approx(1 - 0.75 * (0.9 + 0.81 / 4))


# What lies beyond a horizon or a cap, where it costs nothing more: the bounds are nearly attained.

PATIENT = {
    "x": {"pay": [(1.0, "y", 2.0)]},
    "y": {
        "likely": [(0.05, "g", 0.0), (0.9, "y", 0.0), (0.05, "d", 0.0)],
        "rarely": [(0.01, "g", 0.0), (0.9, "y", 0.0), (0.09, "d", 0.0)],
    },
    "d": {},
}
"""The goal is reached with 1/2 or with 1/10, after 11 steps in the mean, for 2."""
NEARLY = 1.0 - 1e-7


@pytest.mark.parametrize("horizon", [1, 2, 16, 64])
@pytest.mark.parametrize("cap", [1, 2, 16])
@pytest.mark.parametrize("price", [0.25, 1.5, 2.5, 40.0])
def test_bounds_beyond_are_those_of_the_greatest_and_the_least_success(
    price, cap, horizon, monkeypatch
):
    """(2 - price) q is least at the greatest success if the price is above 2, else at the least."""
    player = bayes_player(S3P(model_of(PATIENT), "x", failure_budget=0.95, discount=NEARLY))
    exact = min(20.0 * q - price * q * NEARLY**2 / (1.0 - 0.9 * NEARLY) for q in (0.05, 0.01))
    room = 1e-5 * (1.0 + price)
    reply = player._response(np.array([1.0, price]), cap, horizon)
    assert exact + price - room <= reply.bound <= (exact + price) * (1 + 1e-13)
    assert reply.payoff(1.0, price) >= (exact + price) * (1 - 1e-13)
    monkeypatch.setattr(type(player), "response", lambda self, *asked: reply)
    assert exact - room <= player.surplus(price, 1e-3) <= exact + 1e-13


def test_responses_of_the_unapproximated_game_are_as_near_as_asked():
    """In both cases; the order of the actions, one of which waits for ever, changes no value."""
    for criterion in (MCMP, S3P):
        told, waits = [], {"wait": [(1.0, "x", 1)]}
        for actions in ({**RETRY["x"], **waits}, {**waits, **RETRY["x"]}):
            problem = hand_problem(criterion, {**RETRY, "x": actions}, 0.5, 0.95)
            player = bayes_player(problem)
            for accuracy in (1e-2, 1e-5, 1e-10):
                for price in (0.5, 5.0, 50.0):
                    reply = player.response(1.0, price, accuracy)
                    pays = reply.payoff(1.0, price)
                    assert 0.0 <= pays - reply.bound <= accuracy * pays * (1 + 1e-9)
            told.append(bayes_adaptive(problem, tolerance=1e-8).objective)
        assert told[0] == pytest.approx(told[1], rel=1e-7)
    slow = {"x": {"slow": [(0.05, "g", 1), (0.95, "x", 1)], "fast": [(0.5, "g", 1), (0.5, "d", 1)]}}
    player = bayes_player(hand_problem(S3P, slow | {"d": {}}, 0.9, 0.5))
    reply = player.response(1.0, 100.0, 1e-6)  # what fails has faded long before what is paid
    assert reply.payoff(1.0, 100.0) - reply.bound <= 1e-6 * reply.payoff(1.0, 100.0)


@pytest.mark.parametrize("price", [0.5, 2.0, 8.0, 64.0])
@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_a_bound_at_a_fixed_cap_in_fractions(price, weight):
    """One step of either action; then M = 1 is paid, and pi'_or, which is ``rush``, is followed.

    From there on J_obj is undiscounted: 1 / 2 of the runs arrive at each step, 1 / 4 go on.
    """
    chances = {"rush": (0.5, 0.25), "care": (0.25, 0.6875)}
    table = {
        name: [(goal, "g", 1.0), (stay, "x", 1.0), (1.0 - goal - stay, "d", 1.0)]
        for name, (goal, stay) in chances.items()
    }
    problem = S3P(model_of({"x": table, "d": {}}), "x", failure_budget=0.9, discount=0.75)
    gamma, ahead = Fraction(3, 4), Fraction(1, 2) / Fraction(3, 4)  # P(goal) of rush
    cost, early = ahead / Fraction(3, 4), Fraction(1, 2) / (1 - gamma / 4)
    payoffs = [
        Fraction(weight) * (Fraction(goal) + gamma * Fraction(stay) * (ahead + cost))
        + Fraction(price) * (1 - gamma * (Fraction(goal) + Fraction(stay) * gamma * early))
        for goal, stay in chances.values()
    ]
    reply = stationary_player(problem, tail=1).response(weight, price, 1e-12)
    assert Fraction(reply.bound) <= min(payoffs)
    assert reply.bound == pytest.approx(float(min(payoffs)), rel=1e-13)
    assert reply.payoff(weight, price) == pytest.approx(float(min(payoffs)), rel=1e-14)


SLOW = {
    "x": {"slow": [(0.1, "g", 1), (0.85, "y", 2), (0.05, "d", 1)],
          "rash": [(0.3, "g", 1), (0.3, "y", 1), (0.4, "d", 1)]},
    "y": {"back": [(1.0, "x", 1)], "on": [(0.2, "g", 3), (0.7, "y", 1), (0.1, "d", 1)]},
    "d": {},
}  # fmt: skip


@pytest.mark.parametrize("price", [0.5, 5.0, 50.0])
@pytest.mark.parametrize("cap", [1, 2, 7, 40])
def test_what_a_response_states_is_what_its_policy_attains(cap, price):
    """At any cap and horizon, tails included: both costs, by an evaluation of the policy."""
    start, weights = {"x": 0.75, "y": 0.25}, np.array([1.0, price])
    problem = S3P(model_of(SLOW), start, failure_budget=0.9, discount=0.9)
    player = stationary_player(problem)
    reply = player._swept(weights, cap)
    told = evaluate(player.policy(reply), problem)
    assert reply.condition == pytest.approx(told.discounted_failure, rel=1e-12)
    assert reply.ratio == pytest.approx(told.objective, rel=1e-12)
    for criterion, horizon in ((S3P, 1), (S3P, 6), (MCMP, 1), (MCMP, 6)):
        problem = criterion(model_of(SLOW), start, failure_budget=0.9, discount=0.9)
        player = bayes_player(problem)
        reply = player._response(weights, cap if criterion is S3P else 1, horizon)
        told = evaluate(player.policy(reply), problem)
        paid = told.success_cost if criterion is S3P else told.expected_cost
        assert reply.condition == pytest.approx(told.discounted_failure, rel=1e-12)
        assert reply.objective == pytest.approx(paid, rel=1e-12)


def pressed(*_):
    """Somebody presses Ctrl-C."""
    raise KeyboardInterrupt


def test_value_functions_of_the_game(monkeypatch):
    """RETRY by hand, at price 10; a start on goals or dead-ends has a value of its own."""
    price, gamma = 10.0, 0.95
    fails = 1.0 - gamma + gamma * 0.2
    known = (1.0 + gamma * 0.2 + price * fails) / (1.0 - gamma * 0.3)
    for start, value in (
        ({"x": 1.0}, None), ({"x": 0.5, "g": 0.5}, 0.5 * known),
        ({"x": 0.5, "d": 0.5}, 0.5 * known + 0.5 * (1.0 + price)),
    ):  # fmt: skip
        problem = MCMP(model_of(RETRY), start, failure_budget=0.9, discount=gamma)
        player = stationary_player(problem)
        told = player.value_function(price, [])
        assert told == pytest.approx(np.array([known] if value is None else [known, value]))
        assert told[0] <= known * (1 + 1e-15)
        with until(float("inf")), monkeypatch.context() as interrupted:
            interrupted.setattr(type(player), "response", pressed)
            late = player.value_function(price, [])
        assert late.shape == told.shape
        assert np.isinf(late).all()
    whole = stationary_player(hand_problem(S3P, RETRY, 0.5, gamma))
    responses = [whole._swept(np.array([1.0, price]), cap) for cap in (3, 9, 5)]
    layers = responses[1].strategy.choice.shape[1:]
    assert layers[0] >= 9
    assert whole.value_function(price, responses).shape == layers
    root = {"x": {"go": [(0.5, "g", 1.0), (0.4, "x", 2.0**0.5), (0.1, "x", 1.0)]}}
    odd = stationary_player(hand_problem(S3P, root, 0.5, gamma))
    assert odd.value_function(price, []).tolist() == [np.inf]


@criteria
@pytest.mark.parametrize("make", [stationary_player, bayes_player])
def test_decisions_among_many_actions(make, criterion):
    """The last of 300 actions is the best one in x, where y has a single action."""
    costs = [3.0] * 299 + [2.0]
    many = {k: [(0.5, "g", cost), (0.5, "y", cost)] for k, cost in enumerate(costs)}
    table = {"x": many, "y": {"on": [(0.5, "g", 1.0), (0.5, "d", 1.0)]}, "d": {}}
    problem = hand_problem(criterion, table, 0.9, 0.9)
    player = make(problem)
    reply = player.response(1.0, 1.0, 1e-9)
    told = evaluate(player.policy(reply), problem)
    paid = 2.0 * 0.5 + 3.0 * 0.25 if criterion is S3P else 2.0 + 0.5
    real = told.success_cost if criterion is S3P else told.expected_cost
    assert real == pytest.approx(paid, rel=1e-12)
