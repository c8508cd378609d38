"""The paper's robot (section 4): the methods agree and the answers are certified."""

from functools import cache

import numpy as np
import pytest

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP, S3P
from ssp_lp import LinearProgramming, certify, evaluate, simulate, solve

BUDGET = 0.05


@cache
def solved(criterion, model, start, discount=None):
    """The robot within its budget, for all tests of one worker."""
    return solve(criterion(model, start, failure_budget=BUDGET, discount=discount))


@pytest.mark.parametrize("discount", [None, 0.999])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_answers_are_certified(robot, criterion, discount):
    solution = solved(criterion, *robot, discount)
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap <= 1e-8
    assert solution.gap <= 1e-8
    assert len(solution.policy.policies) <= 2
    limited = solution.discounted_failure if discount else solution.failure_probability
    assert limited is not None
    assert limited <= BUDGET + 1e-12
    assert solution.failure_probability <= limited + 1e-12  # t2-2
    assert evaluate(solution.policy, solution.problem).objective == pytest.approx(
        solution.objective, rel=1e-10
    )


@pytest.mark.parametrize("discount", [None, 0.999])
def test_the_full_linear_program_agrees_in_case_m(robot, discount):
    by_columns = solved(MCMP, *robot, discount)
    by_program = solve(by_columns.problem, "lp")
    assert by_columns.method == "columns"
    assert by_program.method == "lp"
    assert by_program.objective == pytest.approx(by_columns.objective, rel=1e-7)
    assert by_program.failure_price == pytest.approx(by_columns.failure_price, rel=1e-6)
    assert float(by_program.run.program.split()[1].rstrip(",")) == pytest.approx(
        by_columns.objective, rel=1e-7
    )


@pytest.mark.parametrize("backend", ["highs-ipx", "clarabel", "cvxpy"])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_every_backend_agrees_on_a_coarse_robot(small_robot, criterion, backend):
    model, start = small_robot
    least = solve(criterion(model, start=start))
    budget = least.failure_probability + 0.1
    for discount in (None, 0.999):
        extra = {"cost_cap": 6.0} if criterion is S3P else {}
        problem = criterion(model, start=start, failure_budget=budget, discount=discount, **extra)
        by_columns = solve(problem, "columns")
        by_program = solve(problem, LinearProgramming(backend))
        assert by_program.objective == pytest.approx(by_columns.objective, rel=1e-7)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_the_equivalent_randomised_policy(robot, criterion):
    """Section 2.2: one randomised stationary policy does what the lottery does."""
    for discount in (None, 0.999):
        solution = solved(criterion, *robot, discount)
        found = evaluate(solution.randomised_policy, solution.problem)
        assert found.objective == pytest.approx(solution.objective, rel=1e-9)
        limited = found.failure_probability if discount is None else found.discounted_failure
        assert limited == pytest.approx(BUDGET, abs=1e-11)


def test_simulation_agrees_with_evaluation(robot):
    solution = solved(MCMP, *robot)
    play = {"episodes": 40_000, "rng": np.random.default_rng(7), "confidence": 0.9999}
    report = simulate(solution.policy, solution.problem, **play)
    exact = solution.evaluation
    for name in ("goal_probability", "conditional_cost", "expected_cost"):
        estimate = getattr(report, name)
        assert estimate.low <= getattr(exact, name) <= estimate.high
    assert sum(report.ends.values()) == report.episodes


def test_a_dearer_wall_changes_only_case_m(robot):
    grid = RobotGrid(wall_cost=100.0)
    dear = grid_model(grid), start_state(grid)
    values = [[solved(c, *one).objective for c in (MCMP, S3P)] for one in (robot, dear)]
    assert values[1][1] == pytest.approx(values[0][1], rel=1e-12)
    assert values[1][0] > values[0][0] + 0.1
