"""ConstrainedCost by hand: closed forms, conflicts, refusals, identities; the goal is "g"."""

import pytest

from constrained_models import FUEL, RISKY, THREE, TIME, check
from formulations import ConstrainedCost, CostLimit
from small_models import EXACT, FREE_LOOP, FREE_PAIR, each_meaning, each_method, model_of
from ssp_lp import (
    InfeasibleError,
    evaluate,
    solve,
)


@each_method
def test_two_rows(method):
    """7/12 x + 1/3 y + 1/12 z spends 3 of fuel and 2 of time and costs 5/3."""
    limits = {"fuel": CostLimit(FUEL, 3), "time": CostLimit(TIME, 2)}
    solution = solve(ConstrainedCost(THREE, "a", limits), method)
    check(solution, 5 / 3, fuel=1, time=1 / 3)
    assert solution.secondary_costs == pytest.approx({"fuel": 3, "time": 2}, **EXACT)
    assert sorted(solution.policy.weights) == pytest.approx([1 / 12, 1 / 3, 7 / 12], **EXACT)
    assert set(solution.prices) == {"fuel", "time"}
    assert solution.failure_price is None
    assert "fuel" in solution.summary()
    mixed = evaluate(solution.randomised_policy, solution.problem).secondary_costs
    assert mixed == pytest.approx(solution.secondary_costs, **EXACT)


@each_method
def test_three_rows(method):
    """Each dearer action spares one row: weights 1/4, 1/6 and 1/10 of them are needed."""
    model = model_of(
        {"a": {name: [(1.0, "g", cost)] for name, cost in zip("xabc", (1, 3, 4, 5), strict=True)}}
    )
    limits = {
        name: CostLimit({"a": {other: 2.0 for other in "xabc" if other != name}}, bound)
        for name, bound in (("a", 3 / 2), ("b", 5 / 3), ("c", 9 / 5))
    }
    solution = solve(ConstrainedCost(model, "a", limits), method)
    check(solution, 12 / 5, a=1, b=3 / 2, c=2)
    assert len(solution.policy.policies) == 4


@each_method
def test_redundant_and_duplicated_rows(method):
    """A row that follows from another has price 0; two equal rows share one price."""
    limits = {"fuel": CostLimit(FUEL, 3), "wide": CostLimit(FUEL, 3.5)}
    solution = solve(ConstrainedCost(THREE, "a", limits), method)
    check(solution, 3 / 2, fuel=1 / 2, wide=0)
    twice = {"fuel": CostLimit(FUEL, 3), "again": CostLimit(FUEL, 3)}
    solution = solve(ConstrainedCost(THREE, "a", twice), method)
    check(solution, 3 / 2)
    assert sum(solution.prices.values()) == pytest.approx(1 / 2, **EXACT)
    assert len(solution.policy.policies) == 2


@each_method
def test_a_row_that_is_never_active(method):
    """What is not short has no price, and one policy is enough."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 9)}), method)
    check(solution, 1, fuel=0)
    assert solution.prices["fuel"] == 0.0
    assert len(solution.policy.policies) == 1


@each_method
def test_contradictory_rows_are_named(method):
    """The smallest conflict is named, with the sum that proves it; the others are left out."""
    seven = {"a": {"x": 1, "y": 0, "z": 1}}
    limits = {
        "noise": CostLimit({"a": {"x": 1}}, 2),
        "fuel": CostLimit(FUEL, 1),
        "time": CostLimit({"a": {"y": 2, "z": 9}}, 1),
        "wear": CostLimit(seven, 5),
    }
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(THREE, "a", limits), method)
    error = caught.value
    assert error.conflicting_rows == ("fuel", "time")
    assert error.failure_budget is None
    assert error.least_failure == 0.0
    assert "no policy keeps to 'fuel' <= 1 and 'time' <= 1 together" in str(error)
    assert "under every policy" in str(error)
    limits["low"] = CostLimit({"a": {"x": 9, "y": 4.2, "z": 5}}, 3)
    with pytest.raises(
        InfeasibleError, match=r"'low' is at least 4\.2 under every policy.*, 3 all"
    ):
        solve(ConstrainedCost(THREE, "a", limits), method)


@each_method
def test_a_bound_at_the_least_attainable_value(method):
    """Exactly there, or by rounding below it, only the policies of that value are left."""
    third = {"a": {"x": 1.0, "y": 0.7, "z": 0.7}}
    for bound, noted in ((0.7, False), (0.7 * (1 - 1e-11), True)):
        solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(third, bound)}), method)
        check(solution, 2)
        assert ("counts as equal" in solution.note) == noted
    with pytest.raises(InfeasibleError):
        solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(third, 0.7 * (1 - 1e-8))}), method)


@each_method
def test_a_zero_bound_forbids(method):
    """What must not be spent at all."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, 0)}), method)
    check(solution, 5)
    assert solution.secondary_costs["fuel"] == 0.0
    both = {"fuel": CostLimit(FUEL, 0), "time": CostLimit(TIME, 0)}
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(THREE, "a", both), method)
    assert caught.value.conflicting_rows == ("time",)


@each_method
@pytest.mark.parametrize("bound", [1e-3, 1e-6, 1e-9, 1e-12])
def test_tiny_bounds(method, bound):
    """The saving of y per unit of fuel is 3/2, that of x only 1."""
    solution = solve(ConstrainedCost(THREE, "a", {"fuel": CostLimit(FUEL, bound)}), method)
    check(solution, 5 - 1.5 * bound)
    assert solution.secondary_costs["fuel"] == pytest.approx(bound, rel=1e-9)


@each_method
def test_costs_by_pair_and_by_outcome(method):
    """An array of pairs, one of outcomes and nested dicts state the same."""
    model = model_of({"a": {"x": [(0.5, "g", 1), (0.5, "b", 1)], "z": [(1.0, "g", 5)]},
                      "b": {"x": [(1.0, "g", 1)]}})  # fmt: skip
    forms = ({"a": {"x": 2}, "b": {"x": 2}}, [2, 0, 2], [1, 3, 0, 2])
    for cost in forms:
        solution = solve(ConstrainedCost(model, "a", {"fuel": CostLimit(cost, 1)}), method)
        check(solution, 1.5 / 3 + 2 * 5 / 3, fuel=3.5 / 3)


@each_method
def test_discounted_rows(method):
    """The second step's fuel counts gamma, as its cost does."""
    model = model_of({"a": {"two": [(1.0, "b", 1)], "one": [(1.0, "g", 3)]},
                      "b": {"on": [(1.0, "g", 1)]}})  # fmt: skip
    limits = {"fuel": CostLimit({"b": {"on": 2}}, 0.9)}
    problem = ConstrainedCost(model, "a", limits, failure_budget=1.0, discount=0.9)
    solution = solve(problem, method)
    check(solution, (1.9 + 3) / 2, fuel=1.1 / 1.8, failure=0)
    assert solution.secondary_costs["fuel"] == pytest.approx(0.9, **EXACT)


@each_method
def test_a_start_distribution_shares_the_bound(method):
    """Fuel is spent where it saves most: all of x at "b", which saves 9, before "a", which saves 4.

    Half of the starts are at "b" and take 2 of the 3 that are allowed; the third one goes to half
    of those at "a".
    """
    model = model_of({"a": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 5)]},
                      "b": {"x": [(1.0, "g", 1)], "z": [(1.0, "g", 10)]}})  # fmt: skip
    limits = {"fuel": CostLimit({"a": {"x": 4}, "b": {"x": 4}}, 3)}
    solution = solve(ConstrainedCost(model, {"a": 0.5, "b": 0.5}, limits), method)
    check(solution, 2, fuel=1)


@each_method
def test_a_failure_budget_and_a_row(method):
    """Failure allows 1/5 fast, fuel 7/10 slow beside it; 1/10 goes the dear way."""
    limits = {"fuel": CostLimit({"a": {"fast": 3, "slow": 1}}, 1.3)}
    solution = solve(ConstrainedCost(RISKY, "a", limits, failure_budget=0.01), method)
    check(solution, 3.05, fuel=0.5, failure=30)
    assert solution.failure_price == solution.prices["failure"] == solution.budget_slope
    assert solution.failure_probability == pytest.approx(0.01, **EXACT)
    assert solution.adversary_weight is None
    none = solve(ConstrainedCost(RISKY, "a", limits, failure_budget=0.0), method)
    check(none, 3.5)
    assert "least failure" in none.note
    assert none.failure_price is None


@each_method
def test_a_conflict_with_the_failure_budget(method):
    """To fail half the time takes 1 of fuel, to succeed 4: at least 5/2, and 2 is too little."""
    model = model_of({"a": {"out": [(1.0, "g", 5)], "wait": [(1.0, "a", 2)]}})
    limits = {"fuel": CostLimit({"a": {"out": 4, "wait": 1}}, 5 / 2)}
    solution = solve(ConstrainedCost(model, "a", limits, failure_budget=0.5), method)
    check(solution, 7 / 2)
    low = {"fuel": CostLimit(limits["fuel"].cost, 2)}
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.5), method)
    assert set(caught.value.conflicting_rows) == {"failure", "fuel"}
    assert caught.value.failure_budget == 0.5
    assert caught.value.least_failure == 0.0
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.0), method)
    assert caught.value.conflicting_rows == ("failure", "fuel")
    with pytest.raises(InfeasibleError, match="'fuel' is at least 4") as caught:
        solve(ConstrainedCost(model, "a", low, failure_budget=0.5, give_up="dead_ends"), method)
    assert caught.value.conflicting_rows == ("fuel",)
    with pytest.raises(InfeasibleError) as caught:
        solve(ConstrainedCost(RISKY_AT_BEST, "a", failure_budget=0.1), method)
    assert caught.value.conflicting_rows == ("failure",)


RISKY_AT_BEST = model_of({"a": {"go": [(0.5, "g", 1), (0.5, "d", 1)]}, "d": {}})


@each_method
@pytest.mark.parametrize(("charged", "paid", "burnt"), [(True, 1, 1), (False, 0, 0)])
@pytest.mark.parametrize("give_up", ["anywhere", "attention"])
def test_giving_up_charges_the_least_of_each_cost(method, charged, paid, burnt, give_up):
    """Two ways to stay: one is the cheapest, the other takes the least fuel."""
    model = model_of({"a": {"out": [(1.0, "g", 5)], "w": [(1.0, "a", 2)], "v": [(1.0, "a", 1)]}})
    limits = {"fuel": CostLimit({"a": {"out": 4, "w": 1, "v": 3}}, 9)}
    problem = ConstrainedCost(
        model, "a", limits, failure_budget=1.0, give_up=give_up, charge_failing_step=charged
    )
    solution = solve(problem, method)
    check(solution, paid, fuel=0)
    assert solution.secondary_costs["fuel"] == pytest.approx(burnt, **EXACT)


@each_method
def test_a_free_cycle_that_burns_fuel_is_no_place_to_stay(method):
    """Staying for ever costs nothing but fuel: no policy does; giving up there takes one step's."""
    limits = {"fuel": CostLimit({"x": {"loop": 1}}, 3)}
    never = {"failure_budget": 1.0, "give_up": "dead_ends"}
    model = model_of(FREE_LOOP)
    check(solve(ConstrainedCost(model, "x", limits, **never), method), 5, fuel=0)
    check(solve(ConstrainedCost(model, "x", {"f": CostLimit({}, 0)}, **never), method), 0)
    gives_up = ConstrainedCost(model, "x", limits, failure_budget=1.0)
    check(solve(gives_up, method), 0, fuel=0)
    short = {"fuel": CostLimit({"x": {"loop": 1}}, 1 / 4)}
    check(solve(ConstrainedCost(model, "x", short, failure_budget=1.0), method), 15 / 4, fuel=5)


@each_method
@each_meaning
def test_a_free_cycle_of_two_states(method, give_up):
    """At price 0 the cycle is free: the proof holds although no value there has any slack."""
    fuel = {"x": {"swap": 1}, "y": {"swap": 1}}
    model = model_of(FREE_PAIR)
    for bound, objective in ((9, 1), (1, 1)):
        problem = ConstrainedCost(
            model, "y", {"fuel": CostLimit(fuel, bound)}, failure_budget=0.5, give_up=give_up
        )
        check(solve(problem, method), objective if give_up == "dead_ends" else min(objective, 3))
    least = ConstrainedCost(model, "x", {"fuel": CostLimit(fuel, 9)}, give_up=give_up)
    check(solve(least, method), 6, fuel=0)
    tight = ConstrainedCost(
        model, "y", {"fuel": CostLimit(fuel, 0.5)}, failure_budget=0.4, give_up="dead_ends"
    )
    check(solve(tight, method), 7 / 2, fuel=5)
