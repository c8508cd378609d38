"""A certificate trusts nothing: corrupt each part of a solution in turn."""

from dataclasses import replace

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import DeterministicPolicy, MixedPolicy, ModelError, certify, solve

MAZE = model_of(
    {
        "start": {
            "cliff": [(0.8, "goal", 2.0), (0.2, "pit", 1.0)],
            "road": [(0.95, "town", 3.0), (0.05, "pit", 1.0)],
            "detour": [(1.0, "town", 6.0)],
            "loop": [(1.0, "start", 1.0)],
        },
        "town": {
            "bus": [(0.5, "goal", 1.0), (0.49, "town", 1.0), (0.01, "pit", 1.0)],
            "walk": [(1.0, "goal", 5.0)],
            "rest": [(1.0, "town", 0.0)],
        },
        "pit": {"stay": [(1.0, "pit", 1.0)]},
    },
    "goal",
)

PROBLEMS = [
    MCMP(MAZE, start="start", failure_budget=0.07),
    MCMP(MAZE, start="start", failure_budget=0.07, discount=0.99),
    MCMP(MAZE, start="start", failure_budget=0.07, give_up="dead_ends"),
    S3P(MAZE, start="start", failure_budget=0.07),
    S3P(MAZE, start="start", failure_budget=0.12, discount=0.99),
]


@pytest.fixture(params=PROBLEMS, ids=lambda p: f"{type(p).__name__}-{p.discount}")
def solution(request):
    return solve(request.param)


def test_a_true_solution_is_certified(solution):
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap <= 1e-8
    assert certificate.budget_slack >= -1e-12
    assert certificate.objective == pytest.approx(solution.objective, rel=1e-12)
    assert certificate.lower_bound <= certificate.objective


def test_a_policy_that_breaks_the_budget_is_refused(solution):
    riskiest = max(
        solution.policy.policies,
        key=lambda p: certify(replace(solution, policy=MixedPolicy((p,), np.ones(1)))).failure,
    )
    certificate = certify(replace(solution, policy=MixedPolicy((riskiest,), np.ones(1))))
    assert not certificate.accepted
    assert certificate.gap == np.inf
    assert "budget" in certificate.reason


@pytest.mark.parametrize(
    "problem", [p for p in PROBLEMS if p.discount is None], ids=lambda p: type(p).__name__
)
def test_a_worse_policy_has_an_honest_gap(problem):
    solution = solve(problem)
    detour = DeterministicPolicy.from_actions(MAZE, {"start": "detour", "town": "walk"})
    certificate = certify(replace(solution, policy=MixedPolicy((detour,), np.ones(1))))
    assert certificate.accepted
    assert certificate.objective == pytest.approx(11.0)
    assert certificate.lower_bound <= solution.objective + 1e-9
    assert certificate.gap >= 0.1


@pytest.mark.parametrize("factor", [0.0, 0.5, 0.999, 1.001, 2.0, 100.0])
def test_a_wrong_price_never_lifts_the_bound(solution, factor):
    assert solution.failure_price is not None
    certificate = certify(replace(solution, failure_price=factor * solution.failure_price))
    assert certificate.lower_bound <= solution.objective * (1.0 + 1e-12)
    assert certificate.gap >= certify(solution).gap


@pytest.mark.parametrize("price", [-1.0, float("nan"), float("inf")])
def test_an_impossible_price_is_refused(solution, price):
    assert not certify(replace(solution, failure_price=price)).accepted


@pytest.mark.parametrize("seed", range(5))
def test_a_wrong_value_function_never_lifts_the_bound(solution, seed):
    rng = np.random.default_rng(seed)
    values = solution.value_function
    assert values is not None
    shifts = [
        values * 2.0,
        values * 0.5,
        values + rng.normal(size=values.shape),
        np.full_like(values, np.inf),
        np.full_like(values, np.nan),
        -values,
        rng.permutation(values.ravel()).reshape(values.shape),
    ]
    for wrong in shifts:
        certificate = certify(replace(solution, value_function=wrong))
        assert certificate.lower_bound <= solution.objective * (1.0 + 1e-12)


def test_a_value_function_of_another_shape_is_an_error(solution):
    with pytest.raises(ModelError):
        certify(replace(solution, value_function=np.zeros(1)))
    with pytest.raises(ModelError):
        certify(replace(solution, value_function=None))


def test_least_failure_is_certified_too():
    for criterion in (MCMP, S3P):
        certificate = certify(solve(criterion(MAZE, start="start", failure_budget=None)))
        assert certificate.accepted
        assert certificate.gap <= 1e-8
        assert certificate.failure == 0.0


def test_the_cap_of_case_s_is_reported():
    exact = certify(solve(S3P(MAZE, start="start", failure_budget=0.07)))
    assert exact.tail_gap <= 1e-9
    tight = certify(solve(S3P(MAZE, start="start", failure_budget=0.07, cost_cap=3.0)))
    assert tight.accepted
    assert tight.gap > 1e-3
    assert tight.tail_gap > 1e-3
    assert tight.lower_bound <= exact.objective <= tight.objective
