"""Closed forms of case S: a ratio of means, its price, the lattice of costs and the cap on them."""

from fractions import Fraction

import pytest

from formulations import MCMP, S3P
from small_models import EXACT, TWO_MOVES, each_method, model_of
from ssp_lp import InfeasibleError, evaluate, solve


@each_method
def test_discounted_s3p_charges_at_the_time_of_the_action(method):
    """Success p, else again, cost 1 a try: E[gamma^(T-1) T] / E[gamma^T] in closed form."""
    p, gamma = 0.25, 0.9
    model = model_of({"x": {"try": [(p, "g", 1), (1 - p, "x", 1)]}})
    turn = gamma * (1 - p)
    success = gamma * p / (1 - turn)
    solution = solve(S3P(model, start="x", failure_budget=0.5, discount=gamma), method=method)
    assert solution.objective == pytest.approx(p / (1 - turn) ** 2 / success, **EXACT)
    assert solution.discounted_failure == pytest.approx(1 - success, **EXACT)
    assert solution.failure_probability == pytest.approx(0.0, abs=1e-12)
    assert solution.conditional_cost == pytest.approx(4.0, **EXACT)


@each_method
def test_the_conditional_cost_of_a_lottery_is_a_ratio_of_means(method):
    """79/49, not the mean of 2 and 1; the price and the slope follow from the two policies."""
    problem = S3P(model_of(TWO_MOVES), start="x", failure_budget=0.02)
    solution = solve(problem, method=method)
    value = 79 / 49
    assert solution.objective == pytest.approx(value, **EXACT)
    assert solution.conditional_cost == pytest.approx(value, **EXACT)
    assert solution.expected_cost == pytest.approx(0.6 * 2 + 0.4 * 1, **EXACT)
    assert solution.failure_price == pytest.approx((2 - value) / 0.02, rel=1e-8)
    assert solution.budget_slope == pytest.approx((2 - value) / 0.02 / 0.98, rel=1e-8)
    assert sorted(solution.policy.weights) == pytest.approx([0.4, 0.6], **EXACT)


@each_method
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_the_slope_is_the_derivative(method, formulation):
    """Central difference of the optimum over the budget, away from kinks."""
    model = model_of(TWO_MOVES)
    width = 1e-4
    low, middle, high = (
        solve(formulation(model, start="x", failure_budget=0.02 + shift), method=method)
        for shift in (-width, 0.0, width)
    )
    slope = (low.objective - high.objective) / (2 * width)
    assert middle.budget_slope == pytest.approx(slope, rel=1e-4)


@each_method
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_the_adversary_weight_ties_price_and_value(method, formulation):
    """alpha* = c*/(c* + price eps), or c*(1-eps)/(c*(1-eps) + (c* + price) eps) in case S."""
    eps = 0.02
    solution = solve(formulation(model_of(TWO_MOVES), start="x", failure_budget=eps), method=method)
    value, price = solution.objective, solution.failure_price
    if formulation is S3P:
        expected = value * (1 - eps) / (value * (1 - eps) + (value + price) * eps)
    else:
        expected = value / (value + price * eps)
    assert solution.adversary_weight == pytest.approx(expected, **EXACT)


@each_method
@pytest.mark.parametrize("budget", [None, 0.0, 0.5, 1.0])
def test_s3p_from_where_the_goal_is_out_of_reach(method, budget):
    """Infeasible at any budget, with least failure 1; MCMP with budget 1 has an answer."""
    model = model_of({"x": {"go": [(1.0, "g", 1)]}, "d": {"stuck": [(1.0, "d", 2)]}})
    with pytest.raises(InfeasibleError) as caught:
        solve(S3P(model, start="d", failure_budget=budget), method=method)
    assert caught.value.least_failure == 1.0
    assert solve(MCMP(model, start="d", failure_budget=1.0), method=method).objective == 2.0


@each_method
@pytest.mark.parametrize(
    "unit", [Fraction(1, 3), Fraction(1, 7), 0.1, 0.25], ids=["1/3", "1/7", "0.1", "0.25"]
)
def test_the_cost_lattice_is_exact(unit, method):
    """Fractions are taken as they are, a float means its shortest decimal."""
    costs = {1: unit, 2: 2 * unit, 3: Fraction(3, 10) if unit == 0.1 else 3 * unit}
    choices = {
        "x": {
            "slow": [(0.5, "g", costs[2]), (0.5, "x", costs[3])],
            "fast": [(0.9, "g", costs[1]), (0.1, "d", costs[1])],
            "wait": [(1.0, "x", costs[1])],
        },
        "d": {},
    }
    whole = {
        s: {a: [(p, t, round(c / unit)) for p, t, c in o] for a, o in acts.items()}
        for s, acts in choices.items()
    }
    for budget in (0.05, 0.3):
        scaled = solve(S3P(model_of(choices), start="x", failure_budget=budget), method=method)
        plain = solve(S3P(model_of(whole), start="x", failure_budget=budget), method=method)
        assert scaled.objective == pytest.approx(plain.objective * float(unit), **EXACT)


@pytest.mark.parametrize("cap", [1, 2, 4, 8])
def test_a_cap_on_the_accumulated_cost_keeps_the_bounds_honest(cap):
    """Whatever the cap, the policy is real and the bound is a bound: 79/49 lies between."""
    model = model_of(TWO_MOVES)
    solution = solve(S3P(model, start="x", failure_budget=0.02, cost_cap=cap))
    assert solution.lower_bound <= 79 / 49 + 1e-12
    assert solution.objective >= 79 / 49 - 1e-12
    found = evaluate(solution.policy, solution.problem)
    assert found.objective == pytest.approx(solution.objective, **EXACT)
    assert found.failure_probability <= 0.02 + 1e-12
    if cap >= 2:
        assert solution.objective == pytest.approx(79 / 49, **EXACT)
