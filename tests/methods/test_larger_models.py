"""Random models of some dozen states: both methods against an explicit program, no enumeration."""

import pytest

from checks import check_bounds, check_certificate, check_evaluation
from formulations import MCMP, S3P
from random_models import drawn_model
from references import mcmp_program, s3p
from ssp_lp import solve

NEAR = {"rel": 1e-7, "abs": 1e-8}
"""The explicit program is solved by HiGHS to a tolerance of 1e-10, times the longest runs."""


@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("charge", [True, False])
@pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])
@pytest.mark.parametrize("seed", range(3))
def test_mcmp_against_the_explicit_program(seed, give_up, charge, discount):
    """Optimum, least failure and price, from a start spread over all states."""
    model, reference = drawn_model(seed, 15 + 15 * seed)
    start = {state: 1 / len(reference.choices) for state in reference.choices}
    meaning = {"give_up": give_up, "charge_failing_step": charge, "discount": discount}
    data = mcmp_program.program(reference, start, **meaning)
    least = mcmp_program.least_failure(data)
    for share in (0.1, 0.4):
        budget = least + share * (1 - least)
        value = mcmp_program.least_cost(data, budget)
        problem = MCMP(model, start=start, failure_budget=budget, **meaning)
        for method in ("lp", "columns"):
            solution = solve(problem, method=method)
            assert solution.objective == pytest.approx(value, **NEAR)
            check_bounds(solution, budget)
            check_evaluation(solution)
            check_certificate(solution)
            price = solution.failure_price
            priced = mcmp_program.least_priced(data, price)
            assert priced - price * budget == pytest.approx(value, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("seed", [3, 4, 6])
def test_s3p_engines_agree(seed, discount):
    """The program over cost layers and column generation, exact and discounted."""
    model, reference = drawn_model(100 + seed, 6 + 3 * seed)
    start = {state: 1 / len(reference.choices) for state in reference.choices}
    meaning = {"give_up": "dead_ends", "charge_failing_step": False, "discount": discount}
    smallest = mcmp_program.least_failure(mcmp_program.program(reference, start, **meaning))
    values = []
    for share in (0.05, 0.4):
        budget = smallest + share * (1 - smallest)
        problem = S3P(model, start=start, failure_budget=budget, discount=discount)
        found = [solve(problem, method=method) for method in ("lp", "columns")]
        assert found[0].objective == pytest.approx(found[1].objective, rel=1e-8)
        for solution in found:
            check_bounds(solution, budget)
            check_evaluation(solution)
            check_certificate(solution)
        values.append(found[1].objective)
    assert values == sorted(values, reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_s3p_at_least_failure_by_enumeration(seed):
    """Six states with all their stationary policies."""
    model, reference = drawn_model(200 + seed, 6)
    failure, value = s3p.at_least_failure(reference, "s0")
    for method in ("lp", "columns"):
        solution = solve(S3P(model, start="s0", failure_budget=None), method=method)
        assert solution.failure_probability == pytest.approx(failure, abs=1e-12)
        assert solution.objective == pytest.approx(value, rel=1e-9)
