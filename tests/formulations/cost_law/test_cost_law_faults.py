"""Faults that were found in the criteria of the law of success costs, one minimal case each."""

import warnings
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from math import exp, inf, nan

import numpy as np
import pytest

from checks import optimum
from cost_law_models import falling
from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR, compare_criteria
from small_models import model_of
from ssp_lp import DeterministicPolicy, MixedPolicy, ModelError, certify, solve
from ssp_lp.methods.risk import _TailMeanSearch, question_of
from ssp_lp.options import CERTIFYING

LAWS = {
    "split": [(0.45, "g", 0), (0.55, "g", 80)],
    "sixty": [(0.999, "g", 60), (0.001, "g", 81)],
    "fifty": [(0.998, "g", 50), (0.002, "g", 81)],
    "seventy": [(0.99, "g", 70), (0.01, "g", 85)],
}
"""One decision: the mean is least for "split", the mean of the worse half for "fifty"."""


def always(model, action):
    """The policy that takes one action at "x"."""
    return MixedPolicy((DeterministicPolicy.from_actions(model, {"x": action}),), np.ones(1))


@pytest.mark.parametrize(("failing", "level"), [(0.5, 0.75), (0.9, 0.75), (0.99, 0.75)])
def test_cvar_refutes_thresholds_at_least_failure_without_a_price(failing, level):
    """All policies fail alike: what failing costs is no part of the risk given success.

    "steady" costs 2, "uncertain" 0 or 3, so that its mean is less and its worst quarter costs 3.
    """
    kept = 1.0 - failing
    model = model_of(
        {
            "x": {
                "uncertain": [(4 / 7 * kept, "g", 3), (3 / 7 * kept, "g", 0), (failing, "d", 0)],
                "steady": [(kept, "g", 2), (failing, "d", 0)],
            },
            "d": {},
        }
    )
    assert optimum(CVaR(model, "x", level)) == pytest.approx(2.0, rel=2e-8)
    assert optimum(CVaR(model, "x", level, failing)) == pytest.approx(2.0, rel=2e-8)


def test_cvar_bounds_all_thresholds_of_an_interval():
    """One sweep bounds the least integrand at every threshold in it, and is sharp at one."""
    problem = CVaR(model_of({"x": LAWS}), "x", 0.5)
    search = _TailMeanSearch(problem, question_of(problem), 0.5, CERTIFYING)
    least, count = {}, 6  # 0, 50, 60, 80, 81, 85
    for threshold in range(count):
        search.attempt(threshold)
        least[threshold] = search.tried[threshold].lower_bound
    assert search.best is not None
    assert search.best.value == pytest.approx(50.124) == pytest.approx(min(least.values()))
    for first in range(count):
        assert search.refuted(first, first) == pytest.approx(least[first], rel=1e-8)
        for last in range(first, count):
            inside = min(least[threshold] for threshold in range(first, last + 1))
            assert search.refuted(first, last) <= inside * (1.0 + 1e-9)


@pytest.mark.parametrize("action", list(LAWS))
def test_the_bound_of_a_cvar_certificate_does_not_depend_on_the_policy(action):
    """A worse policy widens the gap by what it loses, no more."""
    model = model_of({"x": LAWS})
    proved = certify(replace(solve(CVaR(model, "x", 0.5)), policy=always(model, action)))
    assert proved.lower_bound == pytest.approx(50.124)


@pytest.mark.parametrize("level", [1e-12, 1e-17, 1e-300])
def test_the_lowest_quantile_is_the_least_cost(level):
    """However low the level, the objective is what the policy attains: no cost of 0 exists."""
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "g", 2)]}})
    assert optimum(CostQuantile(model, "x", level)) == 1.0


@pytest.mark.parametrize("price", [inf, -inf, nan])
def test_an_infinite_price_is_refused(price):
    model = model_of({"x": {"fast": [(0.75, "g", 1), (0.25, "d", 1)]}, "d": {}})
    for problem in (EGUBS(model, "x", -0.5, 1.0), CostBoundedReach(model, "x", 1, 0.5)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            proved = certify(replace(solve(problem), failure_price=price))
        assert not proved.accepted
        assert "price" in proved.reason
        assert proved.gap == inf


@pytest.mark.parametrize(
    "stated",
    [
        lambda m: CostBoundedReach(m, "x", "3"),
        lambda m: CostBoundedReach(m, "x", None),
        lambda m: CostBoundedReach(m, "x", 1j),
        lambda m: CostBoundedReach(m, "x", np.array([1.0, 2.0])),
        lambda m: CostQuantile(m, "x", "0.5"),
        lambda m: CostQuantile(m, "x", None),
        lambda m: CVaR(m, "x", "0.5"),
        lambda m: CVaR(m, "x", Decimal("0.5")),
        lambda m: EGUBS(m, "x", "low", 1.0),
        lambda m: EGUBS(m, "x", -1.0, None),
        lambda m: GUBS(m, "x", falling, "much"),
        lambda m: GUBS(m, "x", 1.0, falling),
        lambda m: GUBS(m, "x", falling, 1.0, "none"),
    ],
)
def test_what_is_no_number_is_refused_by_name(stated):
    with pytest.raises(ModelError, match="must be a number"):
        stated(model_of({"x": {"go": [(1.0, "g", 1)]}}))


def test_numbers_of_any_kind():
    """Fractions and numpy's numbers are numbers, and answers are floats."""
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "g", 3)]}})
    half = Fraction(1, 2)
    for number in (half, np.float32(0.5), np.float64(0.5)):
        for problem, value in (
            (EGUBS(model, "x", -number, number), (exp(-0.5) + exp(-1.5)) / 2 + 0.5),
            (GUBS(model, "x", falling, number, -number), (exp(-1) + exp(-3)) / 2 + 0.5),
            (CVaR(model, "x", number), 3.0),
            (CostQuantile(model, "x", number), 1.0),
            (CostBoundedReach(model, "x", 2 * number, number), 0.5),
        ):
            found = optimum(problem)
            assert type(found) is float
            assert found == pytest.approx(value, rel=2e-8)


@pytest.mark.parametrize("chance", [1e-9, 1e-11, 1e-14])
def test_a_budget_of_one_limits_nothing_however_unlikely_the_goal_is(chance):
    """The fast way succeeds half as often, which a budget of 1 allows."""
    ways = {"slow": (chance, 9), "fast": (chance / 2, 1)}
    model = model_of(
        {"x": {w: [(p, "g", c), (1 - p, "d", 0)] for w, (p, c) in ways.items()}, "d": {}}
    )
    assert optimum(CostQuantile(model, "x", 0.5, 1.0)) == 1.0
    assert optimum(CVaR(model, "x", 0.5, 1.0)) == pytest.approx(1.0, rel=2e-8)
    assert optimum(CostQuantile(model, "x", 0.5)) == 9.0


def test_bounds_that_are_fractions_are_compared_too():
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "g", 3)]}})
    table = compare_criteria(model, "x", cost_bounds=(Fraction(5, 2),))
    found = table["CostBoundedReach, cost 2.5"].solution
    assert found is not None
    assert found.objective == pytest.approx(0.5)


@pytest.mark.parametrize("slow", [10, 100_000])
def test_a_budget_just_above_the_least_failure_is_another_problem(slow):
    """A trifle of failure buys a trifle of cost; only rounding counts as equal."""
    ways = {"slow": [(1.0, "g", slow)], "fast": [(0.999, "g", 0), (0.001, "d", 0)]}
    model = model_of({"x": ways, "d": {}})
    budget = 5e-11
    solution = solve(CVaR(model, "x", 0.0, budget))
    assert solution.objective == pytest.approx(slow * (1.0 - budget / 1e-3), rel=1e-10)
    assert solution.gap <= 1e-8
    assert not solution.note
    assert "above the least failure" in solve(CVaR(model, "x", 0.0, 1e-15)).note
    assert not solve(CVaR(model, "x", 0.0, 0.0)).note


@pytest.mark.parametrize("leak", [1e-6, 1e-9])
def test_free_loops_that_are_slow_to_leave_cost_no_digits(leak):
    """Waiting for free changes no total: half of what leaves the loop arrives."""
    loop = [(leak / 2, "g", 1), (leak / 2, "d", 1), (1.0 - leak, "x", 0)]
    model = model_of({"x": {"wait": loop}, "d": {}})
    solution = solve(CostBoundedReach(model, "x", 1))
    assert solution.objective == pytest.approx(solution.evaluation.objective, rel=1e-12)
    assert solution.budget_used == pytest.approx(solution.failure_probability, rel=1e-12)
