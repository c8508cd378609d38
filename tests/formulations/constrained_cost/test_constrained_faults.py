"""ConstrainedCost where numbers are far apart, and limits that are no plain numbers."""

from dataclasses import replace

import numpy as np
import pytest

from constrained_models import FUEL, THREE, check
from formulations import MCMP, ConstrainedCost, CostLimit
from small_models import EXACT, each_method, model_of
from ssp_lp import InfeasibleError, ModelError, certify, solve


@pytest.mark.parametrize("budget", [1e-11, 5e-11, 9e-11])
def test_a_budget_slightly_above_the_least_failure_is_not_equal_to_it(budget):
    """To fail with 1e-10 saves 99: at least failure 100 would be no bound of the optimum."""
    model = model_of(
        {"a": {"x": [(1 - 1e-10, "g", 1), (1e-10, "d", 1)], "z": [(1.0, "g", 100)]}, "d": {}}
    )
    setting = {"failure_budget": budget, "charge_failing_step": False}
    solution = solve(ConstrainedCost(model, "a", **setting))
    check(solution, 100 - 99 * budget / 1e-10)
    assert solution.objective == pytest.approx(solve(MCMP(model, "a", **setting)).objective)
    assert solution.prices["failure"] == pytest.approx(99e10, **EXACT)


@each_method
@pytest.mark.parametrize("saving", [5e-4, 1e-6])
@pytest.mark.parametrize("bound", [1e-9, 1e-10, 1e-13])
def test_a_small_price_of_a_tiny_bound_is_proved(method, saving, bound):
    """What is allowed is worth nothing, what policies would take is worth the saving."""
    model = model_of({"a": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 1 + saving)]}})
    limits = {"fuel": CostLimit({"a": {"x": 1}}, bound)}
    solution = solve(ConstrainedCost(model, "a", limits), method)
    assert solution.gap <= 1e-9
    check(solution, 1 + saving * (1 - bound))
    assert solution.prices["fuel"] == pytest.approx(saving, rel=1e-9)


@each_method
@pytest.mark.parametrize("taken", [(1, 1e9), (1, 100, 1e9), (1e8, 2, 1e10), (1e9, 1, 1e9)])
def test_rows_whose_bounds_are_far_from_what_is_taken(method, taken):
    """Only the row that is short has a price; the master's basis is completed by slacks."""
    model = model_of({"a": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 2)]}})
    limits = {f"r{k}": CostLimit({"a": {"x": amount}}, 1) for k, amount in enumerate(taken)}
    check(solve(ConstrainedCost(model, "a", limits), method), 2 - 1 / max(taken))


@each_method
def test_a_master_that_is_called_unbounded(method):
    """HiGHS errs on numbers this far apart: no lottery has a cost below the least one."""
    costs = {"x": 718.95, "y": 169.26, "z": 46.66}
    model = model_of({"a": {name: [(1.0, "g", cost)] for name, cost in costs.items()}})
    limits = {
        "r0": CostLimit({"a": {"x": 0.2, "y": 0.2}}, 2e-10),
        "r1": CostLimit({"a": {"x": 0.2}}, 2e-14),
        "r2": CostLimit({"a": {"x": 0.01, "y": 0.01}}, 1e-7),
    }
    check(solve(ConstrainedCost(model, "a", limits), method), 46.66, r0=0, r1=0, r2=0)


@each_method
@pytest.mark.parametrize("bound", [1e-9, 1e-12, 1e-15])
def test_a_conflict_of_a_tiny_bound(method, bound):
    """The risky way saves 1/10 of fuel, but no more risk is allowed than a trifle."""
    model = model_of({"a": {"safe": [(1.0, "g", 1)], "risky": [(1.0, "g", 1)]}})
    limits = {
        "fuel": CostLimit({"a": {"safe": 4, "risky": 3.9}}, 3.99),
        "risk": CostLimit({"a": {"risky": 1}}, bound),
    }
    with pytest.raises(InfeasibleError, match=r"at least 3\.63636 under every policy") as caught:
        solve(ConstrainedCost(model, "a", limits), method)
    assert caught.value.conflicting_rows == ("fuel", "risk")


@pytest.mark.parametrize(
    ("cost", "bound"),
    [
        (FUEL, 10**400),
        ({"a": {"x": 10**400}}, 1),
        (np.array([1j, 0, 0]), 1),
        (np.array(["1", "2", "3"]), 1),
    ],
)
def test_no_plain_numbers(cost, bound):
    """Integers beyond all floats, complex numbers and texts."""
    with pytest.raises(ModelError, match="'fuel'"):
        ConstrainedCost(THREE, "a", {"fuel": CostLimit(cost, bound)})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, -1e308])
def test_certificates_do_not_overflow(value):
    """Absurd prices are refused, absurd values prove no more than a constant; neither warns.

    On one state the greatest constant sub-solution is the optimum itself.
    """
    huge = {"a": {"x": 4e10, "y": 2e10}}
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(huge, 3e10)}))
    assert not certify(replace(solution, prices={"fuel": value})).accepted
    absurd = certify(replace(solution, value_function=np.array([value])))
    assert absurd.accepted
    assert solution.objective * (1.0 - 1e-14) <= absurd.lower_bound <= solution.objective


def test_a_conflict_under_a_discount_says_both_least_failures():
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "d", 1)]}, "d": {}})
    fuel = CostLimit({"x": {"go": 2.0}}, bound=1.0)
    with pytest.raises(InfeasibleError, match="'fuel' is at least") as caught:
        solve(ConstrainedCost(model, "x", {"fuel": fuel}, failure_budget=0.9, discount=0.9))
    assert caught.value.least_failure == pytest.approx(0.5, rel=1e-12)
    assert caught.value.least_discounted_failure == pytest.approx(0.55, rel=1e-12)


@pytest.mark.parametrize("time_limit", [float("nan"), -1.0, "soon"])
def test_a_time_limit_is_a_number_of_seconds(time_limit):
    with pytest.raises(ModelError, match="time_limit"):
        solve(ConstrainedCost(model_of({"x": {"go": [(1.0, "g", 1)]}}), "x"), time_limit=time_limit)
