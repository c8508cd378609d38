"""Every LP backend on the same drawn problems: one answer, whatever kind of point it ends at."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, strategies as st

from checks import CLOSE, budget_of, check_bounds, check_evaluation, library_model, plain
from formulations import MCMP, S3P, MaxProb, MinProb
from references import mcmp, s3p
from references.frontier import least_failure
from small_models import model_of
from ssp_lp import LinearProgramming, solve
from ssp_lp.linear_programming.backends import LinearProgram
from ssp_lp.linear_programming.highs import solve_with_highs
from strategies import discounts, often, problems
from written_models import written

ROOT = Path(__file__).parents[2]
every_backend = pytest.mark.parametrize("backend", ["highs", "highs-simplex", "highs-ipx", "cvxpy"])
shares = st.sampled_from([0.0, 0.1, 0.3, 0.5, 0.75])


def check(problem, backend):
    """Interior points without crossover give no vertex; the lottery is exact all the same."""
    solution = solve(problem, LinearProgramming(backend))
    reference = solve(problem, method="columns")
    assert solution.objective == pytest.approx(reference.objective, **CLOSE)
    check_bounds(solution, problem.failure_budget)
    check_evaluation(solution)


@every_backend
@often(12)
@given(problems(), discounts, shares)
def test_mcmp(backend, drawn, discount, share):
    budget = budget_of(share, mcmp.points(plain(drawn), drawn.start, discount=discount))
    check(MCMP(library_model(drawn), drawn.start, budget, discount), backend)


@every_backend
@often(12)
@given(problems(most_live=3, attention=True), discounts, shares)
def test_s3p(backend, drawn, discount, share):
    points = s3p.stationary_points(plain(drawn), drawn.start, discount)
    if least_failure(points) < 1 - 1e-12:
        budget = budget_of(share, points)
        check(S3P(library_model(drawn), drawn.start, budget, discount), backend)


@pytest.mark.slow
def test_highs_may_run_on_other_threads_before():
    """HiGHS refuses a number of threads other than the one that it began with in a process."""
    script = """
import highspy
from examples.domains.river import river
from formulations import MCMP
from ssp_lp import solve, visits
other = highspy.Highs()
other.setOptionValue('output_flag', False)
other.setOptionValue('threads', 2)
other.addVar(0.0, 1.0)
other.run()
problem = MCMP(*river(4, 3), 0.3, constraints={'water': visits((1, 1)) <= 0.2})
print(solve(problem).objective, problem.program().solve('highs').objective)
"""
    told = subprocess.run(  # noqa: S603
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    solved, stated = map(float, told.stdout.splitlines()[-1].split())
    assert solved == pytest.approx(stated, rel=1e-9)


# Processes that are hardly left: what a row misses by counts a million times

hardly_left = pytest.mark.parametrize("backend", ["highs", "cvxpy"])


@hardly_left
@pytest.mark.parametrize("seed", range(6))
def test_programs_left_once_in_a_million_steps(backend, seed):
    """Two states that lead to each other, but for a little, by drawn shares of goal and pit."""
    rng = np.random.default_rng(seed)
    choices = {"d": {}}
    for here, there in (("x", "y"), ("y", "x")):
        choices[here] = {}
        for action, share in enumerate(rng.uniform(0.2, 0.8, 2).tolist()):
            gone = 1e-6 * float(rng.uniform(0.2, 1.0))
            moves = [(gone * share, "g", 1.0), (gone * (1.0 - share), "d", 1.0)]
            choices[here][action] = [*moves, (1.0 - gone, there, float(rng.integers(1, 4)))]
    for criterion in (MaxProb, MinProb):
        problem = criterion(model_of(choices), "x")
        found = solve(problem, method=LinearProgramming(backend))
        assert found.objective == pytest.approx(solve(problem).objective, rel=1e-9)


@hardly_left
def test_an_unreachable_loop_that_is_hardly_left(backend):
    """x: 1 unit at a risk of 0.1, or 5 surely: half of each keeps to 0.05."""
    stays = 1.0 - 1e-9
    model = written(
        f"""
        x bold: 0.9 g 1, 0.1 d 1
        x sure: g 5
        u on: {stays} v 1, 1e-9 g 1
        v back: {stays} u 1, 1e-9 d 1
        v wait: u 2
        """
    )
    within = {"failure_budget": 0.05, "give_up": "dead_ends", "charge_failing_step": False}
    for problem, best in (
        (MCMP(model, "x", **within), 3.0),
        (S3P(model, "x", failure_budget=0.05), (0.5 * 5.0 + 0.5 * 0.9) / 0.95),
        (MaxProb(model, "x"), 1.0),
    ):
        found = solve(problem, method=LinearProgramming(backend))
        assert found.objective == pytest.approx(best, rel=1e-12 if best == 1.0 else 1e-6)


@pytest.mark.parametrize("bound", [1.0, 1e14, 1e16])
def test_a_start_at_a_basis_keeps_large_bounds(bound):
    """Two columns have a given sum, which is infinite for HiGHS once it is magnified."""
    rows = {"sum": slice(0, 1)}
    side, matrix = np.array([bound]), sp.csc_array(np.ones((1, 2)))
    program = LinearProgram(np.ones(2), matrix, side, side, rows)
    basis = np.array([True, False, False])
    answer = solve_with_highs(program, "highs-simplex", np.inf, basis)
    assert answer.x.sum() == pytest.approx(bound, rel=1e-9)
