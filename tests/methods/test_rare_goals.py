"""Goals that are hardly ever reached: costs given success in fractions, by two methods."""

from fractions import Fraction

import pytest

from formulations import S3P
from ssp_lp import SSP, cross_check, solve

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
