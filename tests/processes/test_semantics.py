"""Closed forms of case M, one for each choice of semantics, and of case S: a ratio of means."""

from fractions import Fraction

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
from ssp_lp import InfeasibleError, certify, evaluate, solve
from written_models import written

each_formulation = pytest.mark.parametrize("formulation", [MCMP, S3P])


@each_method
@each_meaning
@pytest.mark.parametrize("charge", [True, False])
@pytest.mark.parametrize("budget", [0.0, 0.25, 0.5, 1.0])
def test_wandering_in_a_free_loop_is_failure_at_no_cost(method, give_up, charge, budget):
    """A loop of cost 0 and a way out of cost 5: cost 5 (1 - budget), price 5, always."""
    meaning = {"give_up": give_up, "charge_failing_step": charge}
    solution = solve(MCMP(model_of(FREE_LOOP), "x", budget, **meaning), method=method)
    assert solution.objective == pytest.approx(5 * (1 - budget), **EXACT)
    assert solution.failure_probability == pytest.approx(budget, **EXACT)
    assert certify(solution).accepted
    found = evaluate(solution.policy, solution.problem).objective
    assert found == pytest.approx(solution.objective, **EXACT)
    if 0 < budget < 1:
        assert solution.failure_price == pytest.approx(5.0, **EXACT)
        assert solve(S3P(model_of(FREE_LOOP), "x", budget), method).objective == pytest.approx(5.0)


@each_method
@each_meaning
@pytest.mark.parametrize(("budget", "value"), [(0.0, 6.0), (0.25, 3.5), (0.75, 0.5), (1.0, 0.0)])
def test_a_free_component_of_two_states(method, give_up, budget, value):
    """Sure way out 6, even way out 1, or swap for ever at 0: the frontier 6, 1 at 1/2, 0."""
    problem = MCMP(model_of(FREE_PAIR), start="x", failure_budget=budget, give_up=give_up)
    assert solve(problem, method=method).objective == pytest.approx(value, **EXACT)


@each_meaning
def test_an_end_component_that_never_pays(give_up):
    """Toured for free; "out" is taken twice on average; failing with 0.1 saves a tenth of 4."""
    model = written(
        """
        a on: b 0
        b on: 0.5 c 0, 0.5 a 0
        b back: a 0
        c on: a 0
        c out: 0.5 g 2, 0.5 a 2
        """
    )
    solution = solve(MCMP(model, "a", 0.1, give_up=give_up))
    assert [solution.objective, solution.evaluation.objective] == pytest.approx([3.6, 3.6])
    assert solve(MCMP(model, "a", give_up=give_up)).objective == pytest.approx(4.0)
    assert solve(S3P(model, "a")).objective == pytest.approx(4.0)
    relaxed = solve(S3P(model, "a", 0.5))  # succeed at the first "out", else wander off
    assert (relaxed.objective, relaxed.failure_probability) == pytest.approx((2.0, 0.5))


@each_method
@pytest.mark.parametrize(
    ("give_up", "charged", "free"),
    [("anywhere", 3.5, 2.5), ("attention", 3.5, 2.5), ("dead_ends", 5.0, 5.0)],
)
def test_a_paying_loop_charges_one_step_or_is_never_left(method, give_up, charged, free):
    """Loop of cost 2, budget 1/2: giving up costs one stay or nothing, wandering has no end."""
    for charge, value in ((True, charged), (False, free)):
        meaning = {"give_up": give_up, "charge_failing_step": charge}
        solution = solve(MCMP(model_of(PAYING_LOOP), "x", 0.5, **meaning), method=method)
        assert solution.objective == pytest.approx(value, **EXACT)


@each_method
@pytest.mark.parametrize(("give_up", "value"), [("anywhere", 2.5), ("attention", 3.5)])
def test_where_to_stop_and_which_action_is_charged(method, give_up, value):
    """At x only the costly action stays: anywhere charges the free one, 5/2 + 0; else 5/2 + 1."""
    model = written(
        """
        x stay: x 2
        x go: g 5
        x free: 0.5 x 0, 0.5 y 0
        y go: g 5
        """
    )
    problem = MCMP(model, start="x", failure_budget=0.5, give_up=give_up)
    assert solve(problem, method=method).objective == pytest.approx(value, **EXACT)


@each_method
def test_a_dead_end_charges_its_least_action_once(method):
    """Unlabelled dead-ends too, inside or at the start; discounted, one step after the action."""
    model = written("x go: 0.5 g 1, 0.5 d 1\n d a: e 7\n d b: d 3\n e a: d 0")
    for start, settings, cost in (
        ("x", {}, 2.5),
        ("x", {"charge_failing_step": False}, 1.0),
        ("x", {"discount": 0.5}, 1.75),
        ({"x": 0.25, "d": 0.5, "g": 0.25}, {}, 0.25 * 2.5 + 0.5 * 3),
        ("d", {"failure_budget": 1.0}, 3.0),
        ("d", {"failure_budget": None}, 3.0),
        ("d", {"failure_budget": None, "charge_failing_step": False}, 0.0),
    ):
        problem = MCMP(model, start, **{"failure_budget": 0.9, **settings})
        assert solve(problem, method=method).objective == pytest.approx(cost, **EXACT)
    for criterion, budgets in ((MCMP, (0.0, 0.05, 0.999)), (S3P, (None, 0.0, 0.5, 1.0))):
        for budget in budgets:
            with pytest.raises(InfeasibleError) as caught:
                solve(criterion(model, "d", budget), method=method)
            assert caught.value.least_failure == 1.0


# Case S


@each_method
def test_discounted_s3p_charges_at_the_time_of_the_action(method):
    """Success p, else again, cost 1 a try: E[gamma^(T-1) T] / E[gamma^T] in closed form."""
    p, gamma = 0.25, 0.9
    turn = gamma * (1 - p)
    success = gamma * p / (1 - turn)
    model = written(f"x try: {p} g 1, {1 - p} x 1")
    solution = solve(S3P(model, start="x", failure_budget=0.5, discount=gamma), method=method)
    assert solution.objective == pytest.approx(p / (1 - turn) ** 2 / success, **EXACT)
    assert solution.discounted_failure == pytest.approx(1 - success, **EXACT)
    assert solution.failure_probability == pytest.approx(0.0, abs=1e-12)
    assert solution.conditional_cost == pytest.approx(4.0, **EXACT)


@each_method
def test_the_conditional_cost_of_a_lottery_is_a_ratio_of_means(method):
    """79/49, not the mean of 2 and 1; the price and the slope follow from the two policies."""
    problem = S3P(model_of(TWO_MOVES), start="x", failure_budget=0.02)
    solution = solve(problem, method=method)
    value = 79 / 49
    assert solution.objective == pytest.approx(value, **EXACT)
    assert solution.conditional_cost == pytest.approx(value, **EXACT)
    assert solution.expected_cost == pytest.approx(0.6 * 2 + 0.4 * 1, **EXACT)
    assert solution.failure_price == pytest.approx((2 - value) / 0.02, rel=1e-8)
    assert solution.budget_slope == pytest.approx((2 - value) / 0.02 / 0.98, rel=1e-8)
    assert sorted(solution.policy.weights) == pytest.approx([0.4, 0.6], **EXACT)


@each_method
@each_formulation
def test_the_slope_is_the_derivative_and_the_weight_of_the_adversary_follows(method, formulation):
    """alpha* = c*/(c* + price eps), or c*(1-eps)/(c*(1-eps) + (c* + price) eps) in case S."""
    width, eps = 1e-4, 0.02
    low, middle, high = (
        solve(formulation(model_of(TWO_MOVES), "x", failure_budget=eps + shift), method=method)
        for shift in (-width, 0.0, width)
    )
    slope = (low.objective - high.objective) / (2 * width)
    assert middle.budget_slope == pytest.approx(slope, rel=1e-4)
    value, price = middle.objective, middle.failure_price
    if formulation is S3P:
        expected = value * (1 - eps) / (value * (1 - eps) + (value + price) * eps)
    else:
        expected = value / (value + price * eps)
    assert middle.adversary_weight == pytest.approx(expected, **EXACT)


@each_method
@pytest.mark.parametrize("unit", [Fraction(1, 3), Fraction(1, 7), 0.1, 0.25], ids=str)
def test_the_cost_lattice_is_exact(unit, method):
    """Fractions are taken as they are, a float means its shortest decimal."""

    def lattice(one, three):
        return model_of(
            {
                "x": {
                    "slow": [(0.5, "g", 2 * one), (0.5, "x", three)],
                    "fast": [(0.9, "g", one), (0.1, "d", one)],
                    "wait": [(1.0, "x", one)],
                }
            }
        )

    model = lattice(unit, Fraction(3, 10) if unit == 0.1 else 3 * unit)
    for budget in (0.05, 0.3):
        scaled, whole = (solve(S3P(m, "x", budget), method) for m in (model, lattice(1, 3)))
        assert scaled.objective == pytest.approx(whole.objective * float(unit), **EXACT)


@pytest.mark.parametrize("cap", [1, 2, 4, 8])
def test_a_cap_on_the_accumulated_cost_keeps_the_bounds_honest(cap):
    """Whatever the cap, the policy is real and the bound is a bound: 79/49 lies between."""
    problem = S3P(model_of(TWO_MOVES), start="x", failure_budget=0.02, cost_cap=cap)
    solution = solve(problem)
    assert solution.lower_bound <= 79 / 49 + 1e-12
    assert solution.objective >= 79 / 49 - 1e-12
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, **EXACT)
    assert found.failure_probability <= 0.02 + 1e-12
    if cap >= 2:
        assert solution.objective == pytest.approx(79 / 49, **EXACT)
