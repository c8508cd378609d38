"""Budgets far below rounding of 1: two actions, whose lottery is known in fractions."""

from fractions import Fraction

import pytest

from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import solve

BUDGETS = (1e-3, 1e-8, 1e-10, 1e-12, 1e-14)
LEAST = (0.0, 1e-3, 0.5, 0.99)  # failure of the safe action, in budgets
MOST = (1.01, 2.0, 1e3)  # failure of the bold one


def road(least, most):
    """Two units for the safe action, one for the bold one, charged in failing too."""
    safe = [(1 - least, "home", 2), (least, "pit", 2)] if least else [(1.0, "home", 2)]
    table = {"x": {"safe": safe, "bold": [(1 - most, "home", 1), (most, "pit", 1)]}, "pit": {}}
    return model_of(table, "home")


def lottery(budget, least, most):
    """The weight of the bold action, and the two failures."""
    safe, bold = Fraction(least), Fraction(most)
    return (Fraction(budget) - safe) / (bold - safe), safe, bold


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("least", LEAST)
@pytest.mark.parametrize("most", MOST)
def test_the_lottery_spends_a_tiny_budget_exactly(budget, least, most):
    model = road(least * budget, most * budget)
    weight, safe, bold = lottery(budget, least * budget, most * budget)
    paid = 2 * (1 - weight) + weight
    reached = 2 * (1 - weight) * (1 - safe) + weight * (1 - bold)
    plain = {"give_up": "dead_ends", "charge_failing_step": False}
    problems = {
        float(paid): MCMP(model, start="x", failure_budget=budget, **plain),
        float(reached / (1 - Fraction(budget))): S3P(model, start="x", failure_budget=budget),
    }
    for objective, problem in problems.items():
        found = solve(problem, method="columns")
        assert found.objective == pytest.approx(objective, rel=1e-12)
        assert float(found.policy.weights[-1]) == pytest.approx(float(weight), rel=1e-10)
        assert found.failure_probability == pytest.approx(budget, rel=1e-12, abs=0)


@pytest.mark.parametrize("budget", BUDGETS)
def test_no_lottery_where_a_single_policy_must_keep_a_tiny_budget(budget):
    """The bold action breaks the budget by a millionth of it: the safe one is all there is."""
    plain = {"give_up": "dead_ends", "charge_failing_step": False}
    for most, cost in ((1 + 1e-6, 2.0), (1 - 1e-6, 1.0)):
        model = road(0.5 * budget, most * budget)
        problem = MCMP(model, start="x", failure_budget=budget, **plain)
        assert solve(problem, method="deterministic").objective == pytest.approx(cost)
