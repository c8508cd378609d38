"""Certificates of policies whose law of costs takes too large a table."""

import numpy as np
import pytest

import ssp_lp.verification.certify as certificates
from formulations import GUBS, CostBoundedReach, CostQuantile, CVaR
from ssp_lp import SSP, ModelError, certify, solve

MODEL = SSP.from_transitions(
    {
        "a": {
            "fast": [(0.5, "goal", 1.0), (0.3, "a", 2.0), (0.2, "pit", 1.0)],
            "slow": [(0.4, "goal", 3.0), (0.55, "a", 1.0), (0.05, "pit", 1.0)],
        },
        "pit": {},
    },
    goal={"goal"},
    treat_actionless_as_dead_ends=True,
)


@pytest.mark.parametrize(
    "problem",
    [
        CVaR(MODEL, "a", 0.8, 0.3),
        CostQuantile(MODEL, "a", 0.8, 0.3),
        GUBS(MODEL, "a", lambda cost: np.exp(-cost / 5.0), 0.5),
        CostBoundedReach(MODEL, "a", 6.0, 0.3),
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
