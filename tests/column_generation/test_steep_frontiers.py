"""Tiny budgets, and frontiers on which failing saves much: the lottery is known in fractions."""

from fractions import Fraction

import pytest

from formulations import MCMP, S3P, ConstrainedCost, CostLimit
from small_models import model_of
from ssp_lp import certify, solve

PLAIN = {"give_up": "dead_ends", "charge_failing_step": False}
PRICES = (1e1, 1e4, 1e7, 1e9, 1e11, 1e12)
BUDGETS = (1e-3, 1e-8, 1e-10, 1e-12, 1e-14)


def road(**ways):
    """Ways home, by their failure and their cost, which is paid in failing too."""
    table = {
        way: [(1 - failing, "g", cost), (failing, "pit", cost)] if failing else [(1.0, "g", cost)]
        for way, (failing, cost) in ways.items()
    }
    return model_of({"x": table, "pit": {}})


def three_ways(least, most):
    """Two units safely, one boldly, and a third way above the line between them."""
    return road(safe=(least, 2), bold=(most, 1), odd=((least + most) / 2, 1.6))


def between(least, most, share):
    """A budget, and what the lottery that spends it pays."""
    budget = float(Fraction(least) + Fraction(share) * (Fraction(most) - Fraction(least)))
    weight = (Fraction(budget) - Fraction(least)) / (Fraction(most) - Fraction(least))
    return budget, float(2 - weight)


@pytest.mark.parametrize("price", PRICES)
@pytest.mark.parametrize("share", [1e-9, 1e-6, 1e-3, 0.3, 0.999])
@pytest.mark.parametrize("least", [0.0, 1e-6, 1e-2, 0.3])
def test_a_second_row_that_limits_nothing_changes_no_digit(price, share, least):
    most = least + 1 / price
    budget, paid = between(least, most, share)
    model = three_ways(least, most)
    fuel = CostLimit({"x": {"safe": 1.0, "bold": 1.0, "odd": 1.0}}, bound=9.0)
    one = solve(MCMP(model, start="x", failure_budget=budget, **PLAIN))
    several = solve(ConstrainedCost(model, "x", {"fuel": fuel}, failure_budget=budget, **PLAIN))
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
    spent = {"safe": least, "bold": most, "odd": (least + most) / 2}
    limits = {"fuel": CostLimit({"x": spent}, bound=budget)}
    found = solve(ConstrainedCost(three_ways(least, most), "x", limits, 1.0, **PLAIN))
    rounding = price * 1e-16  # of a mean of equal numbers, in the last place
    assert found.objective == pytest.approx(paid, rel=max(1e-12, rounding))
    assert found.secondary_costs["fuel"] <= budget * (1 + 1e-15)


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("least", [0.0, 1e-3, 0.5, 0.99])  # failure of the safe way, in budgets
@pytest.mark.parametrize("most", [1.01, 2.0, 1e3])
def test_the_lottery_spends_a_tiny_budget_exactly(budget, least, most):
    model = road(safe=(least * budget, 2), bold=(most * budget, 1))
    safe, bold = Fraction(least * budget), Fraction(most * budget)
    weight = (Fraction(budget) - safe) / (bold - safe)
    reached = 2 * (1 - weight) * (1 - safe) + weight * (1 - bold)
    for problem, objective in (
        (MCMP(model, start="x", failure_budget=budget, **PLAIN), 2 - weight),
        (S3P(model, start="x", failure_budget=budget), reached / (1 - Fraction(budget))),
    ):
        found = solve(problem, method="columns")
        assert found.objective == pytest.approx(float(objective), rel=1e-12)
        if objective == 2 and bold == 1:
            assert found.failure_probability <= budget  # failing surely costs and saves nothing
            continue
        assert float(found.policy.weights[-1]) == pytest.approx(float(weight), rel=1e-10)
        assert found.failure_probability == pytest.approx(budget, rel=1e-12, abs=0)


@pytest.mark.parametrize("budget", BUDGETS)
def test_no_lottery_where_a_single_policy_must_keep_a_tiny_budget(budget):
    """The bold way breaks the budget by a millionth of it: the safe one is all there is."""
    for most, cost in ((1 + 1e-6, 2.0), (1 - 1e-6, 1.0)):
        model = road(safe=(0.5 * budget, 2), bold=(most * budget, 1))
        found = solve(MCMP(model, "x", budget, **PLAIN), method="deterministic")
        assert found.objective == pytest.approx(cost)
