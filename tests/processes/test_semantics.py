"""Closed forms of case M, one for each choice of semantics that changes the numbers."""

import pytest

from formulations import MCMP, S3P
from small_models import (
    EXACT,
    FREE_LOOP,
    FREE_PAIR,
    PAYING_LOOP,
    TWO_MOVES,
    each_meaning,
    each_method,
    model_of,
)
from ssp_lp import InfeasibleError, ModelError, evaluate, solve


@each_method
@each_meaning
@pytest.mark.parametrize("charge", [True, False])
def test_wandering_in_a_free_loop_is_failure_at_no_cost(method, give_up, charge):
    """A loop of cost 0 and a way out of cost 5: cost 5 (1 - budget), price 5, always."""
    problem = MCMP(
        model_of(FREE_LOOP),
        start="x",
        failure_budget=0.25,
        give_up=give_up,
        charge_failing_step=charge,
    )
    solution = solve(problem, method=method)
    assert solution.objective == pytest.approx(3.75, **EXACT)
    assert solution.failure_price == pytest.approx(5.0, **EXACT)
    assert solution.failure_probability == pytest.approx(0.25, **EXACT)
    assert evaluate(solution.policy, problem).objective == pytest.approx(3.75, **EXACT)


@each_method
@each_meaning
@pytest.mark.parametrize(("budget", "value"), [(0.0, 6.0), (0.25, 3.5), (0.75, 0.5), (1.0, 0.0)])
def test_a_free_component_of_two_states(method, give_up, budget, value):
    """Sure way out 6, even way out 1, or swap for ever at 0: the frontier 6, 1 at 1/2, 0."""
    problem = MCMP(model_of(FREE_PAIR), start="x", failure_budget=budget, give_up=give_up)
    assert solve(problem, method=method).objective == pytest.approx(value, **EXACT)


@each_method
@pytest.mark.parametrize(
    ("give_up", "charge", "value"),
    [
        ("anywhere", True, 3.5),
        ("attention", True, 3.5),
        ("dead_ends", True, 5.0),
        ("anywhere", False, 2.5),
        ("attention", False, 2.5),
        ("dead_ends", False, 5.0),
    ],
)
def test_a_paying_loop_charges_one_step_or_is_never_left(method, give_up, charge, value):
    """Loop of cost 2, budget 1/2: giving up costs one stay or nothing, wandering has no end."""
    problem = MCMP(
        model_of(PAYING_LOOP),
        start="x",
        failure_budget=0.5,
        give_up=give_up,
        charge_failing_step=charge,
    )
    assert solve(problem, method=method).objective == pytest.approx(value, **EXACT)


@each_method
@pytest.mark.parametrize(("give_up", "value"), [("anywhere", 2.5), ("attention", 3.5)])
def test_where_to_stop_and_which_action_is_charged(method, give_up, value):
    """At x only the costly action stays: anywhere charges the free one, 5/2 + 0; else 5/2 + 1."""
    choices = {
        "x": {
            "stay": [(1.0, "x", 2)],
            "go": [(1.0, "g", 5)],
            "free": [(0.5, "x", 0), (0.5, "y", 0)],
        },
        "y": {"go": [(1.0, "g", 5)]},
    }
    problem = MCMP(model_of(choices), start="x", failure_budget=0.5, give_up=give_up)
    assert solve(problem, method=method).objective == pytest.approx(value, **EXACT)


@each_method
def test_a_dead_end_charges_its_least_action_once(method):
    """Unlabelled dead-ends too, inside or at the start; discounted, one step after the action."""
    choices = {
        "x": {"go": [(0.5, "g", 1), (0.5, "d", 1)]},
        "d": {"a": [(1.0, "e", 7)], "b": [(1.0, "d", 3)]},
        "e": {"a": [(1.0, "d", 0)]},
    }
    model = model_of(choices)

    def cost(start, **settings):
        problem = MCMP(model, start=start, failure_budget=0.9, **settings)
        return solve(problem, method=method).objective

    assert cost("x") == pytest.approx(2.5, **EXACT)
    assert cost("x", charge_failing_step=False) == pytest.approx(1.0, **EXACT)
    assert cost("x", discount=0.5) == pytest.approx(1.75, **EXACT)
    assert cost({"x": 0.25, "d": 0.5, "g": 0.25}) == pytest.approx(0.25 * 2.5 + 0.5 * 3, **EXACT)
    with pytest.raises(InfeasibleError):
        cost("d")


@each_method
def test_a_start_distribution_shares_one_budget(method):
    """The budget goes where it saves most: all of it to y, whose failure saves 8 per unit."""
    choices = {
        "x": {"safe": [(1.0, "g", 4)], "drop": [(1.0, "d", 0)]},
        "y": {"safe": [(1.0, "g", 8)], "drop": [(1.0, "d", 0)]},
        "d": {},
    }
    problem = MCMP(model_of(choices), start={"x": 0.5, "y": 0.5}, failure_budget=0.25)
    solution = solve(problem, method=method)
    assert solution.objective == pytest.approx(6 - 0.25 * 8, **EXACT)
    assert solution.failure_price == pytest.approx(8.0, **EXACT)


@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_least_failure_is_exact_only(formulation):
    """failure_budget=None together with a discount is refused."""
    with pytest.raises(ModelError):
        solve(formulation(model_of(TWO_MOVES), start="x", failure_budget=None, discount=0.9))


@each_method
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_a_budget_within_rounding_of_the_least_failure(formulation, method):
    """1e-11 below it counts as equal, 1e-6 below it is infeasible."""
    model = model_of({"x": {"go": [(0.9, "g", 1), (0.1, "d", 1)]}, "d": {}})
    solution = solve(formulation(model, start="x", failure_budget=0.1 - 1e-11), method=method)
    assert solution.objective == pytest.approx(1.0, **EXACT)
    with pytest.raises(InfeasibleError) as caught:
        solve(formulation(model, start="x", failure_budget=0.1 - 1e-6), method=method)
    assert caught.value.least_failure == pytest.approx(0.1, **EXACT)


@each_method
def test_a_start_at_the_goal(method):
    """Nothing to do, nothing to pay."""
    model = model_of({"x": {"go": [(1.0, "g", 1)]}})
    for problem in (
        MCMP(model, start="g", failure_budget=0.1),
        S3P(model, start="g", failure_budget=0.1),
        S3P(model, start="g", failure_budget=None),
        MCMP(model, start="g", failure_budget=0.1, discount=0.9),
    ):
        solution = solve(problem, method=method)
        assert (solution.objective, solution.failure_probability) == (0.0, 0.0)
        assert solution.gap == 0.0


@pytest.mark.parametrize("formulation", [MCMP, S3P])
@pytest.mark.parametrize(
    "wrong",
    [
        {"failure_budget": -0.1},
        {"failure_budget": 1.5},
        {"failure_budget": float("nan")},
        {"discount": 0.0},
        {"discount": 1.0},
        {"discount": -0.5},
        {"discount": float("nan")},
        {"start": "nowhere"},
        {"start": {"x": 0.5}},
        {"start": {"x": 1.5, "d": -0.5}},
    ],
    ids=str,
)
def test_what_a_problem_refuses(formulation, wrong):
    """Budgets outside [0, 1], discounts outside (0, 1), starts that are no distribution."""
    settings = {"start": "x", "failure_budget": 0.1} | wrong
    with pytest.raises(ModelError):
        solve(formulation(model_of(TWO_MOVES), **settings))


@each_method
def test_slow_chains_stay_exact(method):
    """A million steps on average: cost 1/p, or a gamble that costs 1 and fails half the time."""
    p = 1e-6
    choices = {
        "x": {"slow": [(p, "g", 1), (1 - p, "x", 1)], "fast": [(0.5, "g", 1), (0.5, "d", 1)]},
        "d": {},
    }
    solution = solve(MCMP(model_of(choices), start="x", failure_budget=0.125), method=method)
    assert solution.objective == pytest.approx(0.75 / p + 0.25, rel=1e-9)
    assert solution.gap <= 1e-8
