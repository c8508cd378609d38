"""Every LP backend on the same drawn problems: one answer, whatever kind of point it ends at."""

import pytest
from hypothesis import given, strategies as st

from checks import CLOSE, budget_of, check_bounds, check_evaluation, library_model, plain
from formulations import MCMP, S3P
from references import mcmp, s3p
from references.frontier import least_failure
from ssp_lp import LinearProgramming, solve
from strategies import discounts, often, problems

BACKENDS = ["highs", "highs-simplex", "highs-ipx", "clarabel", "cvxpy"]
shares = st.sampled_from([0.0, 0.1, 0.3, 0.5, 0.75])
drawn_settings = often(15)


@pytest.mark.parametrize("backend", BACKENDS)
@drawn_settings
@given(drawn=problems(), discount=discounts, share=shares)
def test_mcmp(backend, drawn, discount, share):
    """Interior points without crossover give no vertex; the lottery is exact all the same."""
    points = mcmp.points(plain(drawn), drawn.start, discount=discount)
    budget = budget_of(share, points)
    problem = MCMP(
        library_model(drawn), start=drawn.start, failure_budget=budget, discount=discount
    )
    solution = solve(problem, LinearProgramming(backend))
    reference = solve(problem, method="columns")
    assert solution.objective == pytest.approx(reference.objective, **CLOSE)
    check_bounds(solution, budget)
    check_evaluation(solution)


@pytest.mark.parametrize("backend", BACKENDS)
@drawn_settings
@given(drawn=problems(most_live=3, attention=True), discount=discounts, share=shares)
def test_s3p(backend, drawn, discount, share):
    """The same for the ratio."""
    points = s3p.stationary_points(plain(drawn), drawn.start, discount)
    if least_failure(points) >= 1 - 1e-12:
        return
    budget = budget_of(share, points)
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget, discount=discount)
    solution = solve(problem, LinearProgramming(backend))
    reference = solve(problem, method="columns")
    assert solution.objective == pytest.approx(reference.objective, **CLOSE)
    check_bounds(solution, budget)
    check_evaluation(solution)
