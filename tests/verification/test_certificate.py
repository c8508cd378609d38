"""A certificate trusts nothing: corrupt each part of a solution in turn."""

from dataclasses import replace

import numpy as np
import pytest

import ssp_lp.verification.certify as certificates
from formulations import GUBS, MCMP, S3P, CostBoundedReach, CostQuantile, CVaR
from mazes import MAZE
from refusing import refused
from small_models import model_of
from ssp_lp import DeterministicPolicy, MixedPolicy, ModelError, certify, solve

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


def alone(solution, member):
    """The solution with one policy instead of its lottery."""
    return replace(solution, policy=MixedPolicy((member,), np.ones(1)))


def test_a_policy_that_breaks_the_budget_is_refused(solution):
    proofs = [certify(alone(solution, member)) for member in solution.policy.policies]
    riskiest = max(proofs, key=lambda proof: proof.failure)
    assert (riskiest.accepted, riskiest.gap) == (False, np.inf)
    assert "budget" in riskiest.reason


@pytest.mark.parametrize(
    "solution", [p for p in PROBLEMS if p.discount is None], indirect=True, ids=range(3)
)
def test_a_worse_policy_has_an_honest_gap(solution):
    detour = DeterministicPolicy.from_actions(MAZE, {"start": "detour", "town": "walk"})
    certificate = certify(alone(solution, detour))
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


def test_a_wrong_value_function_never_lifts_the_bound(solution):
    values, rng = solution.value_function, np.random.default_rng(0)
    nothing = [np.full_like(values, number) for number in (np.inf, np.nan)]
    drawn = [values + rng.normal(size=values.shape) for _ in range(5)]
    shuffled = [rng.permutation(values.ravel()).reshape(values.shape) for _ in range(5)]
    for wrong in (2.0 * values, 0.5 * values, -values, *nothing, *drawn, *shuffled):
        certificate = certify(replace(solution, value_function=wrong))
        assert certificate.lower_bound <= solution.objective * (1.0 + 1e-12)
    for wrong in (np.zeros(1), None):
        refused(None, certify, replace(solution, value_function=wrong))


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_least_failure_is_certified_too(criterion):
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


RETRIES = model_of(
    {
        "a": {
            "fast": [(0.5, "goal", 1.0), (0.3, "a", 2.0), (0.2, "pit", 1.0)],
            "slow": [(0.4, "goal", 3.0), (0.55, "a", 1.0), (0.05, "pit", 1.0)],
        },
        "pit": {},
    },
    "goal",
)


@pytest.mark.parametrize(
    "problem",
    [
        CVaR(RETRIES, "a", 0.8, 0.3),
        CostQuantile(RETRIES, "a", 0.8, 0.3),
        GUBS(RETRIES, "a", lambda cost: np.exp(-cost / 5.0), 0.5),
        CostBoundedReach(RETRIES, "a", 6.0, 0.3),
    ],
    ids=["CVaR", "CostQuantile", "GUBS", "CostBoundedReach"],
)
def test_a_law_that_is_too_long_is_bounded_by_its_moments(problem, monkeypatch):
    """Then the certified value is no better than the exact one, and its bound holds."""

    def too_large(*given):
        raise ModelError("the law of success costs takes too large a table")

    solution = solve(problem)
    exact = certify(solution)
    monkeypatch.setattr(certificates, "evaluate_each", too_large)
    proof = certify(solution)
    assert proof.accepted
    if exact.upper_bound is None:
        assert proof.objective >= solution.objective - 1e-12
        assert proof.lower_bound <= solution.objective
    else:
        assert proof.objective <= solution.objective + 1e-12
        assert proof.upper_bound >= solution.objective
    assert proof.failure == pytest.approx(exact.failure)
