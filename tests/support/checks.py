"""What every solution must satisfy, and drawn problems as library problems."""

from typing import Any

import pytest

from formulations import MCMP, S3P, MaxProb
from references.chain import PlainModel, plain_model
from references.frontier import Point, least_failure, lower_hull
from ssp_lp import SSP, certify, evaluate, solve
from strategies import Draw

GAP = 1e-8
CLOSE = {"rel": 1e-7, "abs": 1e-9}
"""The library certifies 1e-8; the references carry the rounding of a dense solve or of HiGHS."""


def library_model(drawn: Draw) -> SSP:
    """The drawn dictionaries as a library model."""
    return SSP.from_transitions(drawn.choices, goal=drawn.goals, treat_actionless_as_dead_ends=True)


def plain(drawn: Draw) -> PlainModel:
    """The drawn dictionaries as a reference model."""
    return plain_model(drawn.choices, drawn.goals)


def budget_of(place: float | str, points: list[Point]) -> float:
    """A budget at a named place of the frontier, or at a share of the way to sure failure."""
    least = least_failure(points)
    if place == "below":
        return 0.5 * least
    if place == "kink":
        hull = lower_hull(points)
        return hull[len(hull) // 2].failure
    return least + float(place) * (1.0 - least)


def check_bounds(solution: Any, budget: float) -> None:
    """Gap, lottery and budget: what holds for every solution with one failure row."""
    assert 0.0 <= solution.gap <= GAP
    assert solution.lower_bound <= solution.objective + 1e-12
    assert 1 <= len(solution.policy.policies) <= 2
    assert len(solution.policy.policies) == len(solution.policy.weights)
    assert min(solution.policy.weights) > 0.0
    assert sum(solution.policy.weights) == pytest.approx(1.0, abs=1e-12)
    discounted = solution.discounted_failure
    used = solution.failure_probability if discounted is None else discounted
    assert used <= budget + 1e-12
    assert solution.failure_probability <= used + 1e-12
    assert solution.goal_probability == pytest.approx(1 - solution.failure_probability, abs=1e-12)


def check_certificate(solution: Any) -> None:
    """The certificate is computed afresh and says the same."""
    certificate = certify(solution)
    assert certificate.lower_bound <= certificate.objective + 1e-12
    assert certificate.objective == pytest.approx(solution.objective, **CLOSE)
    assert certificate.gap <= GAP
    assert certificate.budget_slack >= -1e-12


def check_evaluation(solution: Any) -> None:
    """The policy, pulled back to the original states, has the numbers of the solution."""
    evaluation = evaluate(solution.policy, solution.problem)
    for name in (
        "objective",
        "failure_probability",
        "goal_probability",
        "discounted_failure",
        "expected_cost",
        "conditional_cost",
    ):
        found, stated = getattr(evaluation, name), getattr(solution, name)
        if stated is None:
            assert found is None, name
        else:
            assert found == pytest.approx(stated, nan_ok=True, **CLOSE), name
    assert sum(evaluation.ends.values()) == pytest.approx(1.0, abs=1e-9)
    assert evaluation.ends.get("goal", 0.0) == pytest.approx(solution.goal_probability, abs=1e-9)


def check_price(price: float, low: float, high: float) -> None:
    """The price is a subgradient; at a kink these form an interval."""
    room = 1e-6 * (1.0 + abs(price))
    assert low - room <= price <= high + room


def optima(model: SSP, start: Any, budget: float) -> list[float]:
    """The values of three criteria."""
    within = (criterion(model, start, failure_budget=budget) for criterion in (MCMP, S3P))
    return [solve(problem).objective for problem in (*within, MaxProb(model, start))]


def optimum(problem: Any) -> float:
    """The value of a criterion without discount, once its proof has been looked at."""
    solution = solve(problem)
    assert 0.0 <= solution.gap <= GAP
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    found = evaluate(solution.policy, problem).objective
    assert found == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
    return solution.objective
