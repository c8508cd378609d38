"""Every LP backend on the same drawn problems: one answer, whatever kind of point it ends at."""

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from checks import CLOSE, budget_of, check_bounds, check_evaluation, library_model, plain
from formulations import MCMP, S3P
from references import mcmp, s3p
from references.frontier import least_failure
from ssp_lp import LinearProgramming, solve
from strategies import discounts, often, problems

ROOT = Path(__file__).parents[2]
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


def test_highs_may_run_on_other_threads_before() -> None:
    """HiGHS refuses a number of threads other than the one that it began with in a process."""
    script = (
        "import highspy\n"
        "from examples.domains.river import river\n"
        "from formulations import MCMP\n"
        "from ssp_lp import solve, visits\n"
        "other = highspy.Highs()\n"
        "other.setOptionValue('output_flag', False)\n"
        "other.setOptionValue('threads', 2)\n"
        "other.addVar(0.0, 1.0)\n"
        "other.run()\n"
        "limits = {'water': visits((1, 1)) <= 0.2}\n"
        "problem = MCMP(*river(4, 3), 0.3, constraints=limits)\n"
        "print(solve(problem).objective, problem.program().solve('highs').objective)\n"
    )
    told = subprocess.run(  # noqa: S603
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    solved, stated = map(float, told.stdout.splitlines()[-1].split())
    assert solved == pytest.approx(stated, rel=1e-9)
