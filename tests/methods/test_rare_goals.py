"""Goals that are hardly ever reached, and limits so small that rounding might decide."""

import math
from collections import Counter
from fractions import Fraction

import pytest

from formulations import MCMP, S3P, AlphaMCMP, CVaR, MaxProb
from ssp_lp import SSP, certify, cross_check, goal_probability, secondary_cost, solve
from tests.campaigns import program_check

# Goals that are hardly ever reached: costs given success in fractions, by two methods.


GAMMA = 0.999
RARE = (4e-3, 4e-6, 4e-9, 4e-12, 4e-13)
SHARES = (0.1, 0.5, 0.7, 0.9, 0.99)  # of the greatest success, that the budget demands


def gamble(success):
    """One decision: 3 units for the better chance, 2 for half of it, 1 or 3 for a quarter."""
    table = {
        "x": {
            "dear": [(success, "G", 3), (1 - success, "pit", 1)],
            "cheap": [(success / 2, "G", 2), (1 - success / 2, "pit", 1)],
            "long": [(success / 4, "y", 1), (1 - success / 4, "pit", 1)],
        },
        "y": {"on": [(0.5, "G", 1), (0.5, "G", 3)]},
        "pit": {"stuck": [(1.0, "pit", 1)]},
    }
    return SSP.from_transitions(table, goal={"G"})


def problem_at(success, share):
    budget = 1 - share * GAMMA * success
    return S3P(gamble(success), start="x", failure_budget=budget, discount=GAMMA)


def least_cost(success, budget):
    """c-hat of the gamble: costs before discounting over successes with weight gamma."""
    p, gamma, demanded = Fraction(success), Fraction(GAMMA), 1 - Fraction(budget)
    if demanded <= gamma * p / 2:
        return float(2 / gamma)
    weight = (demanded - gamma * p / 2) / (gamma * p / 2)  # of "dear"
    return float((weight * 3 * p + (1 - weight) * p) / demanded)


@pytest.mark.parametrize("success", RARE)
@pytest.mark.parametrize("share", SHARES)
def test_the_game_keeps_the_digits_of_a_rare_success(success, share):
    problem = problem_at(success, share)
    found = solve(problem, method="game")
    assert found.objective == pytest.approx(least_cost(success, problem.failure_budget), rel=1e-12)
    assert found.gap <= 1e-9
    assert found.lower_bound <= found.objective
    assert not found.note


@pytest.mark.parametrize("success", RARE)
@pytest.mark.parametrize("share", SHARES)
def test_column_generation_spends_a_budget_near_1_exactly(success, share):
    problem = problem_at(success, share)
    found = solve(problem, method="columns")
    assert found.objective == pytest.approx(least_cost(success, problem.failure_budget), rel=1e-12)
    assert found.lower_bound <= found.objective
    assert found.gap <= 1e-9 or "misses the tolerance" in found.note


@pytest.mark.parametrize("success", RARE)
def test_the_game_s_value_is_eta_at_c_hat(success):
    """At the price of failing the two members pay the same, whatever J_cond is counted from."""
    problem = problem_at(success, 0.7)
    found = solve(problem, method="game")
    safe, risky = Fraction(GAMMA) * Fraction(success), Fraction(GAMMA) * Fraction(success) / 2
    price = (3 * Fraction(success) - Fraction(success)) / (safe - risky)
    assert found.failure_price == pytest.approx(float(price) - found.objective, rel=1e-10)


def test_the_cross_check_agrees_where_the_goal_is_hardly_reached():
    """Where the budget leaves all policies free nothing hangs on its own rounding."""
    for success in RARE:
        agreement = cross_check(problem_at(success, 0.1))
        assert agreement.agrees, agreement.summary()
        assert agreement.objective_distance <= 1e-9


# Limits so small that rounding might decide, and shares of goals that are hardly ever reached.


PERILOUS = SSP.from_transitions(
    {
        "a": {
            "risky": [(0.75, "g", 1.0), (0.25, "b", 1.0)],
            "safe": [(0.5, "g", 1.0), (0.5, "pit", 1.0)],
        },
        "b": {"burn": [(1.0, "g", 1.0)], "stop": [(1.0, "pit", 1.0)]},
        "pit": {},
    },
    goal={"g"},
    treat_actionless_as_dead_ends=True,
)
FUEL = secondary_cost({"a": {"risky": 1e-10}, "b": {"burn": 1e5}})


@pytest.mark.parametrize("method", ["columns", "lp"])
def test_half_of_what_the_risky_way_takes(method):
    """5e-11 of fuel are half of the risky way's 1e-10: (0.75 + 0.5) / 2."""
    solution = solve(MaxProb(PERILOUS, "a", constraints={"fuel": FUEL <= 5e-11}), method)
    assert solution.objective == pytest.approx(0.625, rel=1e-12)
    assert solution.secondary_costs["fuel"] <= 5e-11 * (1.0 + 1e-12)
    assert solution.upper_bound >= solution.objective
    assert certify(solution).accepted


def test_what_is_left_is_burnt():
    """Beside 1e-10 for the risky way 9e-10 are left, for 9e-10 / 2.5e4 of burning."""
    solution = solve(MaxProb(PERILOUS, "a", constraints={"fuel": FUEL <= 1e-9}))
    assert solution.objective - 0.75 == pytest.approx(0.25 * 9e-10 / 2.5e4, rel=1e-2)
    assert solution.secondary_costs["fuel"] == pytest.approx(1e-9, rel=1e-12)


def test_a_greatest_probability_as_small_as_its_limit():
    """Nothing but burning reaches the goal: a limit of 1e-12 leaves 1e-17 of it."""
    model = SSP.from_transitions(
        {"b": {"burn": [(1.0, "g", 1.0)], "stop": [(1.0, "pit", 1.0)]}, "pit": {}},
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    fuel = secondary_cost({"b": {"burn": 1e5}})
    solution = solve(MaxProb(model, "b", constraints={"fuel": fuel <= 1e-12}))
    assert solution.objective == pytest.approx(1e-17, rel=1e-12)
    assert solution.gap <= 1e-9
    free = {"give_up": "anywhere", "charge_failing_step": False}
    asked = MCMP(model, "b", 1.0, constraints={"goal": goal_probability() >= 1e-12}, **free)
    solution = solve(asked)
    assert solution.objective == pytest.approx(1e-12, rel=1e-12)
    assert solution.goal_probability == pytest.approx(1e-12, rel=1e-12)


def ladder(n, up=(0.1, 0.2)):
    """Each rung: 0.1 up at cost 1, or 0.2 up at cost 5, else down."""
    rungs = {
        k: {
            "slow": [(up[0], k + 1, 1.0), (1.0 - up[0], "pit", 1.0)],
            "fast": [(up[1], k + 1, 5.0), (1.0 - up[1], "pit", 5.0)],
        }
        for k in range(n)
    }
    return SSP.from_transitions({**rungs, "pit": {}}, goal={n}, treat_actionless_as_dead_ends=True)


@pytest.mark.parametrize("n", [5, 24, 25, 40, 100])
def test_half_of_the_greatest_probability_of_a_ladder(n):
    """The first rung is climbed slowly, all others fast: 1 + 0.1 * 5 (1 - 0.2^(n-1)) / 0.8."""
    cost = 1.0 + 0.1 * 5.0 * (1.0 - 0.2 ** (n - 1)) / 0.8
    for problem in (
        MCMP(ladder(n), 0, reach_fraction=0.5, charge_failing_step=False),
        AlphaMCMP(ladder(n), 0, 0.5),
    ):
        solution = solve(problem)
        assert solution.objective == pytest.approx(cost, rel=1e-12)
        assert solution.goal_probability == pytest.approx(0.5 * 0.2**n, rel=1e-12)
        assert solution.gap <= 1e-9
        assert certify(solution).gap <= 1e-9


@pytest.mark.parametrize("n", [5, 25, 40])
def test_given_success_half_of_the_rungs_may_be_slow_with_log_2_of_them(n):
    """One slow rung halves the chance, and costs 1 for 5."""
    solution = solve(S3P(ladder(n), 0, reach_fraction=0.5))
    assert solution.objective == pytest.approx(5.0 * (n - 1) + 1.0, rel=1e-12)
    assert solution.goal_probability == pytest.approx(0.5 * 0.2**n, rel=1e-12)
    assert certify(solution).accepted


def test_a_share_is_kept_beside_a_limit_and_with_a_discount():
    model = ladder(30)
    fuel = secondary_cost({k: {"slow": 1.0, "fast": 2.0} for k in range(30)})
    free = solve(AlphaMCMP(model, 0, 0.5))
    enough = solve(AlphaMCMP(model, 0, 0.5, constraints={"fuel": fuel <= 1e3}))
    assert enough.objective == pytest.approx(free.objective, rel=1e-9)
    discounted = solve(MCMP(model, 0, reach_fraction=0.1, discount=0.95))
    assert discounted.evaluation.discounted_goal == pytest.approx(0.1 * 0.2**30, rel=1e-11)
    assert discounted.gap <= 1e-9


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.parametrize("kind", ["tiny", "shares"])
def test_drawn_limits_and_shares_against_fractions(kind, seed):
    assert program_check.wrong_of(kind, seed, Counter()) == []


def test_a_tail_mean_without_failing_fails_with_nothing():
    """Masses of the law add up to 1 + 2e-16 here."""
    shares = [0.1, 0.2, 0.3, 0.15, 0.05, 0.2]
    moves = [(p, "g", float(k)) for k, p in enumerate(shares, 1)]
    model = SSP.from_transitions(
        {"a": {"go": [*moves[:-1], (0.2, "a", 1.0)]}, "pit": {}},
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    solution = solve(CVaR(model, "a", 0.3, 0.0))
    assert solution.budget_used >= 0.0
    assert math.isfinite(solution.objective)
