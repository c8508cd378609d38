"""Limits so small that rounding might decide, and shares of goals that are hardly ever reached."""

import math
from collections import Counter

import pytest

from formulations import MCMP, S3P, AlphaMCMP, CVaR, MaxProb
from ssp_lp import SSP, certify, goal_probability, secondary_cost, solve
from tests.campaigns import program_check

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
