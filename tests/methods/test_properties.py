"""Drawn problems, solved by every method and by enumeration: one answer."""

import pytest
from hypothesis import given, strategies as st

from checks import (
    CLOSE,
    budget_of,
    check_bounds,
    check_certificate,
    check_evaluation,
    check_price,
    library_model,
    plain,
)
from formulations import MCMP, S3P
from plain_policies import mcmp_point, s3p_point
from references import mcmp, s3p, s3p_program
from references.chain import start_distribution
from references.frontier import constrained_optimum, least_failure, price_interval
from ssp_lp import InfeasibleError, solve
from ssp_lp.processes import goal_reach
from strategies import acyclic_problems, budgets, discounts, often, problems, semantics

METHODS = ("lp", "columns")
NEAR_LEAST = 1e-9
"""Nearer to the least failure than this, the price is without bound and the program too tight."""


def check_infeasible(problem, method, least, discount):
    """The error carries the least failure, exact or discounted."""
    with pytest.raises(InfeasibleError) as caught:
        solve(problem, method=method)
    error = caught.value
    found = error.least_failure if discount is None else error.least_discounted_failure
    assert found == pytest.approx(least, abs=1e-9)


@often(400)
@given(problems(), semantics, discounts, budgets | st.sampled_from([1e-9, 1e-6]))
def test_mcmp_is_the_best_lottery_over_all_policies(drawn, meaning, discount, place):
    """Both methods meet the enumerated optimum, its price and its infeasibility."""
    points = mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning)
    budget = budget_of(place, points)
    value = constrained_optimum(points, budget)
    model = library_model(drawn)
    problem = MCMP(model, start=drawn.start, failure_budget=budget, discount=discount, **meaning)
    for method in METHODS:
        if value is None:
            check_infeasible(problem, method, least_failure(points), discount)
            continue
        solution = solve(problem, method=method)
        assert solution.method.startswith(method)
        assert solution.objective == pytest.approx(value, **CLOSE)
        assert solution.lower_bound <= value * (1 + 1e-9) + 1e-9
        check_bounds(solution, budget)
        check_evaluation(solution)
        check_certificate(solution)
        check_price(solution.failure_price, *price_interval(points, budget, value))
        begin = start_distribution(drawn.start)
        failure, cost = mcmp_point(plain(drawn), begin, solution, discount, **meaning)
        assert cost == pytest.approx(solution.objective, **CLOSE)
        assert failure <= budget + 1e-12


@often(150)
@given(problems(), semantics)
def test_mcmp_at_least_failure(drawn, meaning):
    """Without a budget: the least failure first, then the least cost."""
    charge = meaning["charge_failing_step"]
    failure, cost = mcmp.at_least_failure(plain(drawn), drawn.start, charge_failing_step=charge)
    model = library_model(drawn)
    problem = MCMP(model, start=drawn.start, failure_budget=None, **meaning)
    for method in METHODS:
        solution = solve(problem, method=method)
        assert solution.objective == pytest.approx(cost, **CLOSE)
        assert solution.failure_probability == pytest.approx(failure, abs=1e-12)
        check_bounds(solution, failure)
        check_evaluation(solution)


@often(150)
@given(problems(), discounts)
def test_goal_probabilities(drawn, discount):
    """MAXPROB and MINPROB of every state, by enumeration."""
    model = library_model(drawn)
    greatest = goal_reach.max_goal_probability(model)
    least = goal_reach.min_goal_probability(model)
    for state in drawn.choices:
        low, high = s3p.goal_probability_range(plain(drawn), state)
        position = model.index_of(state)
        assert (least[position], greatest[position]) == pytest.approx((low, high), abs=1e-12)


def check_s3p(drawn, discount, place):
    """Both methods against the explicit program (or, at least failure, against enumeration)."""
    reference = plain(drawn)
    points = s3p.stationary_points(reference, drawn.start, discount)
    least = least_failure(points)
    budget = budget_of(place, points)
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget, discount=discount)
    if least >= 1 - 1e-12 or budget < least - 1e-10:
        for method in METHODS:
            check_infeasible(problem, method, least, discount)
        return
    if budget <= least + NEAR_LEAST:
        low = high = s3p.at_least_failure(reference, drawn.start, discount)[1]
    else:
        low, high = s3p_program.ratio_bounds(reference, drawn.start, budget, discount=discount)
    for method in METHODS:
        solution = solve(problem, method=method)
        assert solution.objective >= low * (1 - 1e-7) - 1e-8
        assert solution.objective <= high * (1 + 1e-7) + 1e-8
        assert solution.lower_bound <= high * (1 + 1e-7) + 1e-8
        check_bounds(solution, budget)
        check_evaluation(solution)
        check_certificate(solution)
        begin = start_distribution(drawn.start)
        failure, cost = s3p_point(reference, begin, solution, discount)
        assert cost / (1 - failure) == pytest.approx(solution.objective, **CLOSE)
        assert failure <= budget + 1e-12
        if budget > least + NEAR_LEAST:
            check_s3p_price(reference, drawn.start, budget, solution, discount)


def check_s3p_price(reference, start, budget, solution, discount):
    """No policy has a reduced cost below 0 at the reported value and price."""
    price = solution.failure_price
    assert price >= 0.0
    if budget < 1:
        assert solution.budget_slope == pytest.approx(price / (1 - budget), **CLOSE)
    low, high = s3p_program.price_slack(
        reference, start, budget, solution.objective, price, discount=discount, horizon=128
    )
    room = 1e-6 * (1 + price)
    assert high >= -room
    if high - low <= room:
        assert low >= -room


@often(120)
@given(problems(most_live=3, attention=True), discounts, budgets)
def test_s3p_where_every_state_can_wait(drawn, discount, place):
    """Every live state is an attention state: layers up to kappa are exact."""
    check_s3p(drawn, discount, place)


@often(80)
@given(acyclic_problems(), discounts, budgets)
def test_s3p_where_every_run_ends(drawn, discount, place):
    """Acyclic models: the layers are finitely many."""
    check_s3p(drawn, discount, place)


@often(120)
@given(problems(most_live=3), discounts, budgets)
def test_s3p_with_cycles_that_cannot_be_left(drawn, discount, place):
    """Cycles outside the attention states: the library's tail against growing horizons."""
    check_s3p(drawn, discount, place)


@often(150)
@given(problems())
def test_s3p_at_least_failure(drawn):
    """Without a budget: the least failure first, then the least conditional cost."""
    failure, value = s3p.at_least_failure(plain(drawn), drawn.start)
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=None)
    for method in METHODS:
        if value is None:
            check_infeasible(problem, method, 1.0, None)
            continue
        solution = solve(problem, method=method)
        assert solution.objective == pytest.approx(value, **CLOSE)
        assert solution.conditional_cost == pytest.approx(value, **CLOSE)
        assert solution.failure_probability == pytest.approx(failure, abs=1e-12)
        check_bounds(solution, failure)
        check_evaluation(solution)
