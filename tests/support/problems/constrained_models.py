"""Small models with secondary costs, and what a solution within limits must satisfy."""

import pytest

from small_models import EXACT, model_of
from ssp_lp import InfeasibleError, SolverError, certify, solve

THREE = model_of({"a": {"x": [(1.0, "g", 1)], "y": [(1.0, "g", 2)], "z": [(1.0, "g", 5)]}})
FUEL = {"a": {"x": 4, "y": 2}}
TIME = {"a": {"x": 1, "y": 4, "z": 1}}
RISKY = model_of(
    {
        "a": {
            "fast": [(0.95, "g", 1), (0.05, "d", 1)],
            "slow": [(1.0, "g", 3.5)],
            "dear": [(1.0, "g", 4)],
        },
        "d": {},
    }
)


def attempt(problem, **arguments):
    """The solution, or the error that says that there is none."""
    try:
        return solve(problem, **arguments)
    except (InfeasibleError, SolverError) as error:
        return error


def check(solution, objective, **prices):
    """The value, its proof, and the prices by name."""
    assert solution.objective == pytest.approx(objective, **EXACT)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= 1e-9
    assert solution.evaluation.objective == pytest.approx(objective, **EXACT)
    for name, price in prices.items():
        assert solution.prices[name] == pytest.approx(price, **EXACT), name
