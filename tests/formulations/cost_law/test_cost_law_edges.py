"""The criteria of the law of success costs at the edges: starts, loops, ties, wrong arguments."""

from dataclasses import replace
from math import exp, inf, nan

import numpy as np
import pytest

import cost_law_models as models
from checks import optimum
from cost_law_models import SAFE_OR_FAST, SHARP, falling
from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import (
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    certify,
    evaluate,
    solve,
)


def test_starts_at_the_goal_at_a_dead_end_and_in_between():
    """C = 0 at the goal; at a dead-end failing's worth, or nothing to be conditioned on."""
    model = SAFE_OR_FAST
    assert optimum(EGUBS(model, "g", -0.5, 2.0)) == 3.0
    assert optimum(GUBS(model, "g", lambda c: np.maximum(0.5 - c, -4.0), 2.0, -4.0)) == 2.5
    for budget in (None, 0.0, 1.0):
        assert optimum(CostBoundedReach(model, "g", 0, budget)) == 1.0
        assert optimum(CostQuantile(model, "g", 0.9, budget)) == 0.0
        assert optimum(CVaR(model, "g", 0.9, budget)) == 0.0
    check_hopeless(model, "d")
    start = {"g": 0.5, "d": 0.25, "x": 0.25}
    for bound, value in enumerate((0.5, 0.6875, 0.6875, 0.75)):
        assert optimum(CostBoundedReach(model, start, bound)) == pytest.approx(value, **SHARP)
    assert optimum(CostQuantile(model, start, 0.6)) == 0.0
    assert optimum(CostQuantile(model, start, 0.7)) == 3.0
    value = 0.5 * 3.0 + 0.25 * (exp(-1.5) + 2.0)
    assert optimum(EGUBS(model, start, -0.5, 2.0)) == pytest.approx(value, **SHARP)
    assert optimum(CVaR(model, start, 0.0)) == pytest.approx(1.0, **SHARP)


def check_hopeless(model, start):
    """Where the goal cannot be reached."""
    assert optimum(EGUBS(model, start, -0.5, 2.0)) == 0.0
    assert optimum(GUBS(model, start, lambda c: np.exp(-np.asarray(c)), 2.0, -3.0)) == -3.0
    assert optimum(CostBoundedReach(model, start, 3)) == 0.0
    assert optimum(CostBoundedReach(model, start, 3, None)) == 0.0
    for budget in (None, 0.5, 1.0):
        for problem in (CostQuantile(model, start, 0.5, budget), CVaR(model, start, 0.5, budget)):
            with pytest.raises(InfeasibleError) as caught:
                solve(problem)
            assert caught.value.least_failure == 1.0
    with pytest.raises(InfeasibleError):
        solve(CostBoundedReach(model, start, 3, 0.5))


def test_a_goal_out_of_reach():
    check_hopeless(model_of(models.UNREACHABLE), "x")


def test_free_cycles():
    """Trying for nothing in a loop reaches the goal at cost 0; a bound of 0 is a bound."""
    model = model_of(models.FREE_CYCLE)
    for start in ("x", "y"):
        assert optimum(CostBoundedReach(model, start, 0)) == pytest.approx(1.0, **SHARP)
        assert optimum(CostQuantile(model, start, 0.99)) == 0.0
        assert optimum(CostQuantile(model, start, 0.9, 0.3)) == 0.0
        assert optimum(CVaR(model, start, 0.9)) == pytest.approx(0.0, abs=1e-9)
        assert optimum(EGUBS(model, start, -1.0, 0.5)) == pytest.approx(1.5, **SHARP)
    loop = model_of({"x": {"loop": [(1.0, "x", 0)], "out": [(1.0, "g", 5)]}})
    assert optimum(CVaR(loop, "x", 0.5)) == pytest.approx(5.0, **SHARP)
    assert optimum(CostQuantile(loop, "x", 0.5, 0.9)) == 5.0
    assert optimum(CostBoundedReach(loop, "x", 4)) == 0.0
    assert optimum(GUBS(loop, "x", lambda c: -np.minimum(c, 9.0), 0.0, -9.0)) == -5.0


def test_levels_met_exactly():
    """Pr(C <= 1) = 1/2 is enough for the level 1/2."""
    model = model_of(models.TWO_LENGTHS)
    for budget in (None, 0.4):
        for level, cost in ((0.5, 1), (0.51, 2), (0.75, 2), (0.76, 5)):
            assert optimum(CostQuantile(model, "x", level, budget)) == cost
        assert optimum(CVaR(model, "x", 0.5, budget)) == pytest.approx(3.5, **SHARP)
        assert optimum(CVaR(model, "x", 0.75, budget)) == pytest.approx(5.0, **SHARP)
    assert optimum(CostQuantile(model_of(models.retry(0.3)), "x", 0.51)) == 2.0  # 0.7^2 = 0.49


def test_a_plain_policy_is_evaluated_and_a_worse_one_widens_the_gap():
    fast = DeterministicPolicy.from_actions(SAFE_OR_FAST, {"x": "fast"})
    value = 0.75 * (exp(-0.5) + 2.0)
    for problem, worth in (
        (EGUBS(SAFE_OR_FAST, "x", -0.5, 2.0), value),
        (CostBoundedReach(SAFE_OR_FAST, "x", 3), 0.75),
        (CostQuantile(SAFE_OR_FAST, "x", 0.9, 0.5), 1.0),
        (CVaR(SAFE_OR_FAST, "x", 0.9, 0.5), 1.0),
    ):
        assert evaluate(fast, problem).objective == pytest.approx(worth, **SHARP)
    bounded = CostBoundedReach(SAFE_OR_FAST, "x", 3)
    timid = certify(replace(solve(bounded), policy=MixedPolicy((fast,), np.ones(1))))
    assert timid.objective == pytest.approx(0.75)
    assert timid.upper_bound >= 1.0 - 1e-9
    assert timid.gap >= 0.25 - 1e-9
    safe = DeterministicPolicy.from_actions(SAFE_OR_FAST, {"x": "safe"})
    quantile = CostQuantile(SAFE_OR_FAST, "x", 0.9, 0.5)
    late = certify(replace(solve(quantile), policy=MixedPolicy((safe,), np.ones(1))))
    assert late.objective == 3.0
    assert late.gap > 0.5


@pytest.mark.parametrize(
    "stated",
    [
        lambda m: EGUBS(m, "x", 0.0, 1.0),
        lambda m: EGUBS(m, "x", 0.5, 1.0),
        lambda m: EGUBS(m, "x", nan, 1.0),
        lambda m: EGUBS(m, "nowhere", -0.5, 1.0),
        lambda m: GUBS(m, "x", lambda c: 1.0 - falling(c), 1.0),
        lambda m: GUBS(m, "x", falling, 1.0, 2.0),
        lambda m: GUBS(m, "x", falling, nan),
        lambda m: CostBoundedReach(m, "x", -1.0),
        lambda m: CostBoundedReach(m, "x", nan),
        lambda m: CostBoundedReach(m, "x", 3, 1.5),
        lambda m: CostBoundedReach(m, "x", 3, -0.1),
        lambda m: CostQuantile(m, "x", -0.1),
        lambda m: CostQuantile(m, "x", 1.1),
        lambda m: CostQuantile(m, "x", nan),
        lambda m: CostQuantile(m, "x", 0.5, 1.5),
        lambda m: CVaR(m, "x", -0.1),
        lambda m: CVaR(m, "x", 1.0),
        lambda m: CVaR(m, "x", nan),
        lambda m: CVaR(m, "x", 0.5, -0.1),
        lambda m: CVaR(m, {"x": 0.7}, 0.5),
        lambda m: CVaR(m, "x", inf),
    ],
)
def test_wrong_arguments(stated):
    with pytest.raises(ModelError):
        solve(stated(SAFE_OR_FAST))
