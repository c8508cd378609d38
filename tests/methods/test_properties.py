"""Drawn problems, solved by every method and by enumeration or explicit programs: one answer."""

from itertools import pairwise

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
from random_models import drawn_model
from references import mcmp, mcmp_program, s3p, s3p_program
from references.chain import start_distribution
from references.frontier import constrained_optimum, least_failure, price_interval
from small_models import each_meaning
from ssp_lp import InfeasibleError, solve
from ssp_lp.processes import goal_reach
from strategies import acyclic_problems, budgets, discounts, meanings, often, problems, semantics

# Drawn problems, solved by every method and by enumeration or explicit programs: one answer.


METHODS = ("lp", "columns")
NEAR_LEAST = 1e-9
"""Nearer to the least failure than this, the price is without bound and the program too tight."""

NEAR = {"rel": 1e-7, "abs": 1e-8}
"""The explicit program is solved by HiGHS to a tolerance of 1e-10, times the longest runs."""


def check_infeasible(problem, method, least, discount):
    """The error carries the least failure, exact or discounted."""
    with pytest.raises(InfeasibleError) as caught:
        solve(problem, method=method)
    error = caught.value
    found = error.least_failure if discount is None else error.least_discounted_failure
    assert found == pytest.approx(least, abs=1e-9)


def checked(problem, method, budget):
    """The solution within its budget, evaluated, and certified where it has one of its own."""
    solution = solve(problem, method=method)
    check_bounds(solution, budget)
    check_evaluation(solution)
    if problem.failure_budget is not None:
        assert solution.method.startswith(method)
        check_certificate(solution)
    return solution


@pytest.mark.slow
@often(66)
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
        solution = checked(problem, method, budget)
        assert solution.objective == pytest.approx(value, **CLOSE)
        assert solution.lower_bound <= value * (1 + 1e-9) + 1e-9
        check_price(solution.failure_price, *price_interval(points, budget, value))
        begin = start_distribution(drawn.start)
        failure, cost = mcmp_point(plain(drawn), begin, solution, discount, **meaning)
        assert cost == pytest.approx(solution.objective, **CLOSE)
        assert failure <= budget + 1e-12


@pytest.mark.slow
@often(26)
@given(problems(), semantics)
def test_least_failure_and_then_least_cost(drawn, meaning):
    """Without a budget, in both cases."""
    model, charge = library_model(drawn), meaning["charge_failing_step"]
    known = mcmp.at_least_failure(plain(drawn), drawn.start, charge_failing_step=charge)
    given_success = s3p.at_least_failure(plain(drawn), drawn.start)
    for problem, (failure, value) in (
        (MCMP(model, start=drawn.start, failure_budget=None, **meaning), known),
        (S3P(model, start=drawn.start, failure_budget=None), given_success),
    ):
        for method in METHODS:
            if value is None:
                check_infeasible(problem, method, 1.0, None)
                continue
            solution = checked(problem, method, failure)
            assert solution.objective == pytest.approx(value, **CLOSE)
            assert solution.failure_probability == pytest.approx(failure, abs=1e-12)
            if isinstance(problem, S3P):
                assert solution.conditional_cost == pytest.approx(value, **CLOSE)


@pytest.mark.slow
@often(33)
@given(problems())
def test_goal_probabilities(drawn):
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
        solution = checked(problem, method, budget)
        assert solution.objective >= low * (1 - 1e-7) - 1e-8
        assert solution.objective <= high * (1 + 1e-7) + 1e-8
        assert solution.lower_bound <= high * (1 + 1e-7) + 1e-8
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


@pytest.mark.slow
@often(26)
@given(problems(most_live=3, attention=True), discounts, budgets)
def test_s3p_where_every_state_can_wait(drawn, discount, place):
    """Every live state is an attention state: layers up to kappa are exact."""
    check_s3p(drawn, discount, place)


@pytest.mark.slow
@often(20)
@given(acyclic_problems(), discounts, budgets)
def test_s3p_where_every_run_ends(drawn, discount, place):
    """Acyclic models: the layers are finitely many."""
    check_s3p(drawn, discount, place)


@pytest.mark.slow
@often(26)
@given(problems(most_live=3), discounts, budgets)
def test_s3p_with_cycles_that_cannot_be_left(drawn, discount, place):
    """Cycles outside the attention states: the library's tail against growing horizons."""
    check_s3p(drawn, discount, place)


# Some dozen states, from a start spread over all of them


@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("charge", [True, False])
@each_meaning
@pytest.mark.parametrize("seed", range(3))
def test_larger_models_against_the_explicit_program(seed, give_up, charge, discount):
    """Optimum, least failure and price."""
    model, reference = drawn_model(seed, 15 + 15 * seed)
    start = {state: 1 / len(reference.choices) for state in reference.choices}
    meaning = {"give_up": give_up, "charge_failing_step": charge, "discount": discount}
    data = mcmp_program.program(reference, start, **meaning)
    least = mcmp_program.least_failure(data)
    for share in (0.1, 0.4):
        budget = least + share * (1 - least)
        value = mcmp_program.least_cost(data, budget)
        for method in METHODS:
            problem = MCMP(model, start=start, failure_budget=budget, **meaning)
            solution = checked(problem, method, budget)
            assert solution.objective == pytest.approx(value, **NEAR)
            price = solution.failure_price
            priced = mcmp_program.least_priced(data, price)
            assert priced - price * budget == pytest.approx(value, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("seed", [3, 4, 6])
def test_programs_and_columns_agree_on_larger_models_of_case_s(seed, discount):
    model, reference = drawn_model(100 + seed, 6 + 3 * seed)
    start = {state: 1 / len(reference.choices) for state in reference.choices}
    meaning = {"give_up": "dead_ends", "charge_failing_step": False, "discount": discount}
    smallest = mcmp_program.least_failure(mcmp_program.program(reference, start, **meaning))
    values = []
    for share in (0.05, 0.4):
        budget = smallest + share * (1 - smallest)
        problem = S3P(model, start=start, failure_budget=budget, discount=discount)
        one, other = (checked(problem, method, budget).objective for method in METHODS)
        assert one == pytest.approx(other, rel=1e-8)
        values.append(other)
    assert values[0] >= values[1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("method", METHODS)
def test_least_failure_of_case_s_by_enumeration_of_six_states(seed, method):
    model, reference = drawn_model(200 + seed, 6)
    failure, value = s3p.at_least_failure(reference, "s0")
    solution = solve(S3P(model, start="s0", failure_budget=None), method=method)
    assert solution.failure_probability == pytest.approx(failure, abs=1e-12)
    assert solution.objective == pytest.approx(value, rel=1e-9)


# Changes of a problem that change its answer in a known way, or not at all.


PROBLEM = problems(most_live=3)
SETTING = st.fixed_dictionaries({"discount": discounts, "give_up": meanings})


def answers(drawn, budget, setting):
    """The optimum of both cases, or the least failure where the budget is too small."""
    model, found = library_model(drawn), []
    discounted = {"failure_budget": budget, "discount": setting["discount"]}
    for problem in (MCMP(model, drawn.start, budget, **setting),
                    S3P(model, drawn.start, **discounted)):  # fmt: skip
        try:
            found.append(("optimum", solve(problem).objective))
        except InfeasibleError as error:
            found.append(("infeasible", error.least_failure))
    return found


@pytest.mark.slow
@often(16)
@given(PROBLEM, SETTING)
def test_a_larger_budget_costs_no_more(drawn, setting):
    """The optimum falls with the budget, and case M is convex in it."""
    points = mcmp.points(plain(drawn), drawn.start, **setting)
    grid = [budget_of(share, points) for share in (0.0, 0.25, 0.5, 0.75)]
    for case, row in enumerate(zip(*(answers(drawn, b, setting) for b in grid), strict=True)):
        column = [value for kind, value in row if kind == "optimum"]
        room = 1e-7 * (1 + max(column, default=0.0))
        assert all(a >= b - room for a, b in pairwise(column))
        if case == 0 and len(column) == 4:
            assert column[1] <= (column[0] + column[2]) / 2 + room
            assert column[2] <= (column[1] + column[3]) / 2 + room
