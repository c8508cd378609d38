"""The criteria of the law of success costs: closed forms, identities, edges, refusals."""

from dataclasses import replace
from fractions import Fraction
from math import exp

import numpy as np
import pytest

import cost_law_models as models
from checks import optimum
from cost_law_models import SAFE_OR_FAST, SHARP
from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import (
    solve,
)


@pytest.mark.parametrize("p", [Fraction(1, 2), Fraction(3, 10), Fraction(9, 10)])
def test_trying_again_until_it_works(p):
    """The geometric law."""
    model = model_of(models.retry(float(p)))
    for bound in (0, 1, 2, 5, 5.5):
        value = float(models.retry_within(p, int(bound)))
        assert optimum(CostBoundedReach(model, "x", bound)) == pytest.approx(value, **SHARP)
    for level in (0.2, 0.51, 0.75, 0.99):
        tries = models.retry_quantile(float(p), level)
        assert optimum(CostQuantile(model, "x", level)) == tries
        assert optimum(CostQuantile(model, "x", level, 0.5)) == tries
        cvar = models.retry_cvar(float(p), level)
        assert optimum(CVaR(model, "x", level)) == pytest.approx(cvar, **SHARP)
    assert optimum(CVaR(model, "x", 0.0)) == pytest.approx(float(1 / p), **SHARP)
    for risk_factor in (-0.1, -1.0):
        for bonus in (0.0, 2.0):
            value = models.retry_utility(float(p), risk_factor) + bonus
            found = optimum(EGUBS(model, "x", risk_factor, bonus))
            assert found == pytest.approx(value, **SHARP)


@pytest.mark.parametrize("risk_factor", [-0.7, -1.5])
def test_the_bonus_at_which_the_safe_move_pays(risk_factor):
    """Below the bonus "fast" is played, above it "safe", and at it both are worth the same."""
    bonus = models.switching_bonus(risk_factor)
    assert bonus > 0.1
    below = solve(EGUBS(SAFE_OR_FAST, "x", risk_factor, bonus - 0.05))
    above = solve(EGUBS(SAFE_OR_FAST, "x", risk_factor, bonus + 0.05))
    assert (below.failure_probability, above.failure_probability) == (0.25, 0.0)
    assert below.objective == pytest.approx(0.75 * (exp(risk_factor) + bonus - 0.05), **SHARP)
    assert above.objective == pytest.approx(exp(3 * risk_factor) + bonus + 0.05, **SHARP)
    value = exp(3 * risk_factor) + bonus
    assert optimum(EGUBS(SAFE_OR_FAST, "x", risk_factor, bonus)) == pytest.approx(value, **SHARP)


@pytest.mark.parametrize("cost", [0.1, Fraction(1, 10)])
def test_a_deadline_just_reachable(cost):
    """0.1 + 0.1 + 0.1 <= 0.3, though not in floating point."""
    choices = {
        "a": {"go": [(1.0, "b", cost)]},
        "b": {"go": [(1.0, "c", cost)]},
        "c": {"go": [(0.5, "g", cost), (0.5, "c", cost)]},
    }
    model = model_of(choices)
    assert optimum(CostBoundedReach(model, "a", 0.3)) == 0.5
    assert optimum(CostBoundedReach(model, "a", 0.29)) == 0.0
    assert optimum(CostBoundedReach(model, "a", 0.7)) == pytest.approx(1 - 2.0**-5, **SHARP)
    assert optimum(CostQuantile(model, "a", 0.5)) == pytest.approx(0.3, abs=1e-12)
    assert optimum(CVaR(model, "a", 0.0)) == pytest.approx(0.4, **SHARP)


def test_trying_a_limited_number_of_times():
    """Within a budget late successes are done without: quantile, CVaR and bounded reach."""
    model = model_of(models.QUIT_OR_RETRY)
    for budget in (0.05, 0.3):
        for level in (0.4, 0.7, 0.95):
            value = models.quit_or_retry_quantile(level, budget)
            assert optimum(CostQuantile(model, "x", level, budget)) == value
        assert optimum(CostBoundedReach(model, "x", 2, budget)) == pytest.approx(0.75, **SHARP)
    assert optimum(CVaR(model, "x", 0.5, 0.25)) == pytest.approx(5 / 3, **SHARP)
    assert optimum(CVaR(model, "x", 0.5)) == pytest.approx(3.0, **SHARP)
    assert optimum(CVaR(model, "x", 0.5, 0.0)) == pytest.approx(3.0, **SHARP)


def test_a_budget_makes_the_fast_move_affordable():
    """Bounded reach 3/4 w, with the weight w = 4 * budget of the fast move, for bounds 1 and 2."""
    for budget in (0.05, 0.1, 0.2):
        weight = 4 * budget
        for bound, value in ((0, 0.0), (1, 0.75 * weight), (2, 0.75 * weight)):
            found = optimum(CostBoundedReach(SAFE_OR_FAST, "x", bound, budget))
            assert found == pytest.approx(value, **SHARP)
        assert optimum(CostBoundedReach(SAFE_OR_FAST, "x", 3, budget)) == pytest.approx(1.0)
        early = 0.75 * weight / (1 - budget)  # given success
        assert optimum(CostQuantile(SAFE_OR_FAST, "x", early - 1e-6, budget)) == 1.0
        assert optimum(CostQuantile(SAFE_OR_FAST, "x", early + 1e-6, budget)) == 3.0
        assert optimum(CVaR(SAFE_OR_FAST, "x", 0.0, budget)) == pytest.approx(3 - 2 * early)
    assert optimum(CostBoundedReach(SAFE_OR_FAST, "x", 1, None)) == 0.0
    assert optimum(CostQuantile(SAFE_OR_FAST, "x", 0.5, 0.25)) == 1.0


CHANCY = {
    "x": {
        "fast": [(0.75, "g", 1), (0.25, "d", 1)],
        "slow": [(0.5, "g", 2), (0.4, "y", 2), (0.1, "d", 1)],
    },
    "y": {"again": [(0.5, "g", 1), (0.5, "x", 1)], "quit": [(1.0, "d", 0)]},
    "d": {},
}
MODEL = model_of(CHANCY)
LEAST = 1 / 8
"""Of "slow" and "again": f = 1/10 + 2/5 * 1/2 * f."""


def rises(values, room=1e-7):
    """Whether a sequence does not fall."""
    return bool((np.diff(np.asarray(values, dtype=float)) >= -room).all())


def test_monotone_in_bound_budget_and_level():
    budgets = [*np.linspace(LEAST, 0.6, 6)[1:], 0.9]
    for budget in (None, budgets[1], 1.0):
        assert rises([optimum(CostBoundedReach(MODEL, "x", b, budget)) for b in range(9)])
        assert rises([optimum(CVaR(MODEL, "x", v, budget)) for v in (0.0, 0.3, 0.6, 0.9, 0.99)])
        assert rises([optimum(CostQuantile(MODEL, "x", v, budget)) for v in (0.3, 0.6, 0.9, 0.99)])
    for bound in (1, 3, 6):
        reached = [optimum(CostBoundedReach(MODEL, "x", bound, b)) for b in (None, *budgets)]
        assert rises(reached)
    for level in (0.3, 0.75, 0.9):
        quantiles = [optimum(CostQuantile(MODEL, "x", level, b)) for b in (None, *budgets)]
        tails = [optimum(CVaR(MODEL, "x", level, b)) for b in (None, *budgets)]
        assert rises(quantiles[::-1])
        assert rises(tails[::-1])
        assert rises(np.stack([quantiles, tails]).T)


def test_the_ends_of_the_scales():
    """CVaR at level 0 is S3P; late bounds and great bonuses are MAXPROB."""
    for budget in (None, LEAST + 0.1, 0.8):
        mean = solve(S3P(MODEL, "x", budget)).objective
        assert optimum(CVaR(MODEL, "x", 0.0, budget)) == pytest.approx(mean, **SHARP)
    late = optimum(CostBoundedReach(MODEL, "x", 200))
    assert late == pytest.approx(1 - LEAST, **SHARP)
    assert late <= 1 - LEAST + 1e-12
    for bonus in (1e3, 1e5):
        safest = solve(EGUBS(MODEL, "x", -0.5, bonus))
        assert safest.goal_probability >= 1 - LEAST - 1 / bonus - 1e-8
    assert solve(EGUBS(MODEL, "x", -0.5, 1e3)).failure_probability == pytest.approx(LEAST)


def test_utilities_that_are_other_criteria():
    """GUBS with u = exp is eGUBS, and with a step at the bound CostBoundedReach."""
    for risk_factor, bonus in ((-0.3, 0.0), (-0.3, 1.5), (-2.0, 0.1)):
        general = GUBS(MODEL, "x", lambda c, r=risk_factor: np.exp(r * np.asarray(c)), bonus)
        special = EGUBS(MODEL, "x", risk_factor, bonus)
        assert optimum(general) == pytest.approx(optimum(special), **SHARP)
        lower = replace(general, utility_at_infinity=-2.0)
        dearer = EGUBS(MODEL, "x", risk_factor, bonus + 2.0)
        assert optimum(lower) == pytest.approx(optimum(dearer) - 2.0, **SHARP)
        scaled = {
            s: {a: [(p, t, 5 * c) for p, t, c in o] for a, o in actions.items()}
            for s, actions in CHANCY.items()
        }
        slower = EGUBS(model_of(scaled), "x", risk_factor / 5, bonus)
        assert optimum(slower) == pytest.approx(optimum(special), **SHARP)
    for bound in (0, 1, 2, 5):
        step = GUBS(MODEL, "x", lambda c, b=bound: np.where(np.asarray(c) <= b, 1.0, 0.0), 0.0)
        assert optimum(step) == pytest.approx(optimum(CostBoundedReach(MODEL, "x", bound)), **SHARP)
