"""Frontiers on which failing saves much: one row or several, the lottery is the same."""

from fractions import Fraction

import pytest

from formulations import MCMP, ConstrainedCost, CostLimit
from small_models import model_of
from ssp_lp import certify, solve

PLAIN = {"give_up": "dead_ends", "charge_failing_step": False}
PRICES = (1e1, 1e4, 1e7, 1e9, 1e11, 1e12)
SHARES = (1e-9, 1e-6, 1e-3, 0.3, 0.999)
LEAST = (0.0, 1e-6, 1e-2, 0.3)


def ways(least, most):
    """Two units safely, one boldly, and a third way above the line between them."""
    middle = (least + most) / 2
    table = {
        way: [(1 - failing, "home", cost), (failing, "pit", cost)]
        if failing
        else [(1.0, "home", cost)]
        for way, failing, cost in (("safe", least, 2), ("bold", most, 1), ("odd", middle, 1.6))
    }
    return model_of({"x": table, "pit": {}}, "home")


def between(least, most, share):
    """A budget, and what the lottery that spends it pays."""
    budget = float(Fraction(least) + Fraction(share) * (Fraction(most) - Fraction(least)))
    weight = (Fraction(budget) - Fraction(least)) / (Fraction(most) - Fraction(least))
    return budget, float(2 - weight)


@pytest.mark.parametrize("price", PRICES)
@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("least", LEAST)
def test_a_second_row_that_limits_nothing_changes_no_digit(price, share, least):
    most = least + 1 / price
    budget, paid = between(least, most, share)
    model = ways(least, most)
    fuel = CostLimit({"x": {"safe": 1.0, "bold": 1.0, "odd": 1.0}}, bound=9.0)
    one = solve(MCMP(model, start="x", failure_budget=budget, **PLAIN))
    rows = ConstrainedCost(model, "x", {"fuel": fuel}, failure_budget=budget, **PLAIN)
    several = solve(rows)
    for found in (one, several):
        assert found.objective == pytest.approx(paid, rel=1e-12)
        assert found.lower_bound <= found.objective
        assert found.failure_probability <= budget * (1 + 1e-15)
    assert certify(several).accepted


@pytest.mark.parametrize("price", PRICES)
def test_a_limit_that_mirrors_the_budget_is_kept_as_exactly(price):
    """Each way takes as much fuel as it fails: the same row under another name."""
    least, most = 0.25, 0.25 + 1 / price
    budget, paid = between(least, most, 0.3)
    model = ways(least, most)
    spent = {"safe": least, "bold": most, "odd": (least + most) / 2}
    fuel = CostLimit({"x": spent}, bound=budget)
    found = solve(ConstrainedCost(model, "x", {"fuel": fuel}, failure_budget=1.0, **PLAIN))
    rounding = price * 1e-16  # of a mean of equal numbers, in the last place
    assert found.objective == pytest.approx(paid, rel=max(1e-12, rounding))
    assert found.secondary_costs["fuel"] <= budget * (1 + 1e-15)
