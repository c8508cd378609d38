"""The simplex method, started at column generation's policies: it confirms, or it moves on."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from checks import CLOSE, check_bounds, check_certificate
from formulations import MCMP, S3P
from random_models import drawn_model
from ssp_lp import LinearProgramming, Solution, solve
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.linear_programming.highs import solve_with_highs
from ssp_lp.linear_programming.linear_program import program_residuals
from ssp_lp.methods.policy_basis import policy_basis
from ssp_lp.programs.program_rows import rows_program

TIGHT, SLACK = 0.4, 1.0


def iterations(solution: Solution) -> int:
    """How far the simplex method went from where it started, as the report says."""
    found = re.search(r"highs-warm: .* ([\d,]+) simplex iterations", solution.run.program)
    assert found is not None, solution.run.program
    return int(found[1].replace(",", ""))


@pytest.mark.parametrize("budget", [TIGHT, SLACK])
@pytest.mark.parametrize("discount", [None, 0.999])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_the_robot_is_confirmed(
    small_robot: Any, criterion: Any, discount: float | None, budget: float
) -> None:
    """With two policies, and with one where the budget is slack."""
    model, start = small_robot
    problem = criterion(model, start=start, failure_budget=budget, discount=discount)
    checked, searched = solve(problem, LinearProgramming("highs-warm")), solve(problem)
    assert iterations(checked) == 0
    assert checked.objective == pytest.approx(searched.objective, **CLOSE)
    check_bounds(checked, budget)
    check_certificate(checked)


@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("seed", range(3))
def test_random_models_are_confirmed(seed: int, criterion: Any, discount: float | None) -> None:
    model, _ = drawn_model(seed, 15)
    problem = criterion(model, start="s0", failure_budget=0.9, discount=discount)
    checked = solve(problem, LinearProgramming("highs-warm"))
    assert iterations(checked) == 0
    assert checked.objective == pytest.approx(solve(problem).objective, **CLOSE)


def test_a_budget_that_a_policy_spends_exactly_is_confirmed() -> None:
    """There the price is positive although one policy is the whole answer."""
    model, _ = drawn_model(10, 15)
    solution = solve(MCMP(model, start="s0", failure_budget=0.5), LinearProgramming("highs-warm"))
    assert solution.failure_price is not None
    assert solution.failure_price > 1.0
    assert iterations(solution) == 0


def test_a_budget_equal_to_the_least_failure_needs_no_program(small_robot: Any) -> None:
    model, start = small_robot
    least = solve(MCMP(model, start=start)).failure_probability
    problem = MCMP(model, start=start, failure_budget=least)
    solution = solve(problem, LinearProgramming("highs-warm"))
    assert solution.run.program == ""
    check_bounds(solution, least)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_a_basis_is_regular_and_its_policies_lie_on_both_sides(
    small_robot: Any, criterion: Any
) -> None:
    model, start = small_robot
    problem = criterion(model, start=start, failure_budget=TIGHT)
    instance = problem.compile().for_program()
    process, row = instance.explicit(), FailureRow(TIGHT, problem.ratio)
    basis = policy_basis(instance, process, row, np.inf)
    assert not basis.slack
    first, extra = basis.pairs[:-1], basis.pairs[-1]
    assert np.array_equal(process.pair_state[first], np.arange(process.n_states))
    second = first.copy()
    second[process.pair_state[extra]] = extra
    inside, outside = (
        float(process.start @ process.dynamics.chain(pairs).solve(process.failure[pairs]))
        for pairs in (first, second)
    )
    assert inside <= TIGHT < outside


def test_a_wrong_basis_is_refuted(small_robot: Any) -> None:
    """Started at the optimum of another budget, HiGHS moves to the right one."""
    model, start = small_robot
    problem = MCMP(model, start=start, failure_budget=TIGHT)
    instance = problem.compile()
    process = instance.explicit()
    program = rows_program(process, {"failure": (process.failure, TIGHT)}, ratio=False)
    basis = policy_basis(instance, process, FailureRow(SLACK, ratio=False), np.inf)
    answer = solve_with_highs(program, "highs-warm", np.inf, basis)
    assert answer.iterations is not None
    assert answer.iterations > 0
    assert max(program_residuals(program, answer)) < 1e-8
    assert program.cost @ answer.x == pytest.approx(solve(problem).objective, rel=1e-6)
