"""Closed forms, one for each choice of semantics that changes the numbers."""

from fractions import Fraction

import pytest

from formulations import MCMP, S3P
from ssp_lp import SSP, InfeasibleError, ModelError, evaluate, solve

EXACT = {"rel": 1e-9, "abs": 1e-12}
each_engine = pytest.mark.parametrize("engine", ["lp", "columns"])
each_meaning = pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])


def model_of(choices):
    """A model whose goal is "g"; states without actions are dead-ends."""
    return SSP.from_transitions(choices, goal={"g"}, treat_actionless_as_dead_ends=True)


FREE_LOOP = {"x": {"loop": [(1.0, "x", 0)], "out": [(1.0, "g", 5)]}}
FREE_PAIR = {
    "x": {"swap": [(1.0, "y", 0)], "out": [(0.5, "g", 1), (0.5, "d", 1)]},
    "y": {"swap": [(1.0, "x", 0)], "out": [(1.0, "g", 6)]},
    "d": {},
}
PAYING_LOOP = {"x": {"loop": [(1.0, "x", 2)], "out": [(1.0, "g", 5)]}}
TWO_MOVES = {"x": {"slow": [(1.0, "g", 2)], "fast": [(0.95, "g", 1), (0.05, "d", 1)]}, "d": {}}


@each_engine
@each_meaning
@pytest.mark.parametrize("charge", [True, False])
def test_wandering_in_a_free_loop_is_failure_at_no_cost(engine, give_up, charge):
    """A loop of cost 0 and a way out of cost 5: cost 5 (1 - budget), price 5, always."""
    problem = MCMP(
        model_of(FREE_LOOP),
        start="x",
        failure_budget=0.25,
        give_up=give_up,
        charge_failing_step=charge,
    )
    solution = solve(problem, engine=engine)
    assert solution.objective == pytest.approx(3.75, **EXACT)
    assert solution.failure_price == pytest.approx(5.0, **EXACT)
    assert solution.failure_probability == pytest.approx(0.25, **EXACT)
    assert evaluate(solution.policy, problem).objective == pytest.approx(3.75, **EXACT)


@each_engine
@each_meaning
@pytest.mark.parametrize(("budget", "value"), [(0.0, 6.0), (0.25, 3.5), (0.75, 0.5), (1.0, 0.0)])
def test_a_free_component_of_two_states(engine, give_up, budget, value):
    """Sure way out 6, even way out 1, or swap for ever at 0: the frontier 6, 1 at 1/2, 0."""
    problem = MCMP(model_of(FREE_PAIR), start="x", failure_budget=budget, give_up=give_up)
    assert solve(problem, engine=engine).objective == pytest.approx(value, **EXACT)


@each_engine
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
def test_a_paying_loop_charges_one_step_or_is_never_left(engine, give_up, charge, value):
    """Loop of cost 2, budget 1/2: giving up costs one stay or nothing, wandering has no end."""
    problem = MCMP(
        model_of(PAYING_LOOP),
        start="x",
        failure_budget=0.5,
        give_up=give_up,
        charge_failing_step=charge,
    )
    assert solve(problem, engine=engine).objective == pytest.approx(value, **EXACT)


@each_engine
@pytest.mark.parametrize(("give_up", "value"), [("anywhere", 2.5), ("attention", 3.5)])
def test_where_to_stop_and_which_action_is_charged(engine, give_up, value):
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
    assert solve(problem, engine=engine).objective == pytest.approx(value, **EXACT)


@each_engine
def test_a_dead_end_charges_its_least_action_once(engine):
    """Unlabelled dead-ends too, inside or at the start; discounted, one step after the action."""
    choices = {
        "x": {"go": [(0.5, "g", 1), (0.5, "d", 1)]},
        "d": {"a": [(1.0, "e", 7)], "b": [(1.0, "d", 3)]},
        "e": {"a": [(1.0, "d", 0)]},
    }
    model = model_of(choices)

    def cost(start, **settings):
        problem = MCMP(model, start=start, failure_budget=0.9, **settings)
        return solve(problem, engine=engine).objective

    assert cost("x") == pytest.approx(2.5, **EXACT)
    assert cost("x", charge_failing_step=False) == pytest.approx(1.0, **EXACT)
    assert cost("x", discount=0.5) == pytest.approx(1.75, **EXACT)
    assert cost({"x": 0.25, "d": 0.5, "g": 0.25}) == pytest.approx(0.25 * 2.5 + 0.5 * 3, **EXACT)
    with pytest.raises(InfeasibleError):
        cost("d")


@each_engine
def test_discounted_s3p_charges_at_the_time_of_the_action(engine):
    """Success p, else again, cost 1 a try: E[gamma^(T-1) T] / E[gamma^T] in closed form."""
    p, gamma = 0.25, 0.9
    model = model_of({"x": {"try": [(p, "g", 1), (1 - p, "x", 1)]}})
    turn = gamma * (1 - p)
    success = gamma * p / (1 - turn)
    solution = solve(S3P(model, start="x", failure_budget=0.5, discount=gamma), engine=engine)
    assert solution.objective == pytest.approx(p / (1 - turn) ** 2 / success, **EXACT)
    assert solution.discounted_failure == pytest.approx(1 - success, **EXACT)
    assert solution.failure_probability == pytest.approx(0.0, abs=1e-12)
    assert solution.conditional_cost == pytest.approx(4.0, **EXACT)


@each_engine
def test_the_conditional_cost_of_a_lottery_is_a_ratio_of_means(engine):
    """79/49, not the mean of 2 and 1; the price and the slope follow from the two policies."""
    problem = S3P(model_of(TWO_MOVES), start="x", failure_budget=0.02)
    solution = solve(problem, engine=engine)
    value = 79 / 49
    assert solution.objective == pytest.approx(value, **EXACT)
    assert solution.conditional_cost == pytest.approx(value, **EXACT)
    assert solution.expected_cost == pytest.approx(0.6 * 2 + 0.4 * 1, **EXACT)
    assert solution.failure_price == pytest.approx((2 - value) / 0.02, rel=1e-8)
    assert solution.budget_slope == pytest.approx((2 - value) / 0.02 / 0.98, rel=1e-8)
    assert sorted(solution.policy.weights) == pytest.approx([0.4, 0.6], **EXACT)


@each_engine
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_the_slope_is_the_derivative(engine, formulation):
    """Central difference of the optimum over the budget, away from kinks."""
    model = model_of(TWO_MOVES)
    width = 1e-4
    low, middle, high = (
        solve(formulation(model, start="x", failure_budget=0.02 + shift), engine=engine)
        for shift in (-width, 0.0, width)
    )
    slope = (low.objective - high.objective) / (2 * width)
    assert middle.budget_slope == pytest.approx(slope, rel=1e-4)


@each_engine
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_the_adversary_weight_ties_price_and_value(engine, formulation):
    """alpha* = c*/(c* + price eps), or c*(1-eps)/(c*(1-eps) + (c* + price) eps) in case S."""
    eps = 0.02
    solution = solve(formulation(model_of(TWO_MOVES), start="x", failure_budget=eps), engine=engine)
    value, price = solution.objective, solution.failure_price
    if formulation is S3P:
        expected = value * (1 - eps) / (value * (1 - eps) + (value + price) * eps)
    else:
        expected = value / (value + price * eps)
    assert solution.adversary_weight == pytest.approx(expected, **EXACT)


@each_engine
def test_a_start_distribution_shares_one_budget(engine):
    """The budget goes where it saves most: all of it to y, whose failure saves 8 per unit."""
    choices = {
        "x": {"safe": [(1.0, "g", 4)], "drop": [(1.0, "d", 0)]},
        "y": {"safe": [(1.0, "g", 8)], "drop": [(1.0, "d", 0)]},
        "d": {},
    }
    problem = MCMP(model_of(choices), start={"x": 0.5, "y": 0.5}, failure_budget=0.25)
    solution = solve(problem, engine=engine)
    assert solution.objective == pytest.approx(6 - 0.25 * 8, **EXACT)
    assert solution.failure_price == pytest.approx(8.0, **EXACT)


@each_engine
@pytest.mark.parametrize("budget", [None, 0.0, 0.5, 1.0])
def test_s3p_from_where_the_goal_is_out_of_reach(engine, budget):
    """Infeasible at any budget, with least failure 1; MCMP with budget 1 has an answer."""
    model = model_of({"x": {"go": [(1.0, "g", 1)]}, "d": {"stuck": [(1.0, "d", 2)]}})
    with pytest.raises(InfeasibleError) as caught:
        solve(S3P(model, start="d", failure_budget=budget), engine=engine)
    assert caught.value.least_failure == 1.0
    assert solve(MCMP(model, start="d", failure_budget=1.0), engine=engine).objective == 2.0


@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_least_failure_is_exact_only(formulation):
    """failure_budget=None together with a discount is refused."""
    with pytest.raises(ModelError):
        solve(formulation(model_of(TWO_MOVES), start="x", failure_budget=None, discount=0.9))


@each_engine
@pytest.mark.parametrize("formulation", [MCMP, S3P])
def test_a_budget_within_rounding_of_the_least_failure(formulation, engine):
    """1e-11 below it counts as equal, 1e-6 below it is infeasible."""
    model = model_of({"x": {"go": [(0.9, "g", 1), (0.1, "d", 1)]}, "d": {}})
    solution = solve(formulation(model, start="x", failure_budget=0.1 - 1e-11), engine=engine)
    assert solution.objective == pytest.approx(1.0, **EXACT)
    with pytest.raises(InfeasibleError) as caught:
        solve(formulation(model, start="x", failure_budget=0.1 - 1e-6), engine=engine)
    assert caught.value.least_failure == pytest.approx(0.1, **EXACT)


@each_engine
@pytest.mark.parametrize(
    "unit", [Fraction(1, 3), Fraction(1, 7), 0.1, 0.25], ids=["1/3", "1/7", "0.1", "0.25"]
)
def test_the_cost_lattice_is_exact(unit, engine):
    """Fractions are taken as they are, a float means its shortest decimal."""
    costs = {1: unit, 2: 2 * unit, 3: Fraction(3, 10) if unit == 0.1 else 3 * unit}
    choices = {
        "x": {
            "slow": [(0.5, "g", costs[2]), (0.5, "x", costs[3])],
            "fast": [(0.9, "g", costs[1]), (0.1, "d", costs[1])],
            "wait": [(1.0, "x", costs[1])],
        },
        "d": {},
    }
    whole = {
        s: {a: [(p, t, round(c / unit)) for p, t, c in o] for a, o in acts.items()}
        for s, acts in choices.items()
    }
    for budget in (0.05, 0.3):
        scaled = solve(S3P(model_of(choices), start="x", failure_budget=budget), engine=engine)
        plain = solve(S3P(model_of(whole), start="x", failure_budget=budget), engine=engine)
        assert scaled.objective == pytest.approx(plain.objective * float(unit), **EXACT)


@each_engine
def test_a_start_at_the_goal(engine):
    """Nothing to do, nothing to pay."""
    model = model_of({"x": {"go": [(1.0, "g", 1)]}})
    for problem in (
        MCMP(model, start="g", failure_budget=0.1),
        S3P(model, start="g", failure_budget=0.1),
        S3P(model, start="g", failure_budget=None),
        MCMP(model, start="g", failure_budget=0.1, discount=0.9),
    ):
        solution = solve(problem, engine=engine)
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


@each_engine
def test_slow_chains_stay_exact(engine):
    """A million steps on average: cost 1/p, or a gamble that costs 1 and fails half the time."""
    p = 1e-6
    choices = {
        "x": {"slow": [(p, "g", 1), (1 - p, "x", 1)], "fast": [(0.5, "g", 1), (0.5, "d", 1)]},
        "d": {},
    }
    solution = solve(MCMP(model_of(choices), start="x", failure_budget=0.125), engine=engine)
    assert solution.objective == pytest.approx(0.75 / p + 0.25, rel=1e-9)
    assert solution.gap <= 1e-8


@pytest.mark.parametrize("cap", [1, 2, 4, 8])
def test_a_cap_on_the_accumulated_cost_keeps_the_bounds_honest(cap):
    """Whatever the cap, the policy is real and the bound is a bound: 79/49 lies between."""
    model = model_of(TWO_MOVES)
    solution = solve(S3P(model, start="x", failure_budget=0.02, cost_cap=cap))
    assert solution.lower_bound <= 79 / 49 + 1e-12
    assert solution.objective >= 79 / 49 - 1e-12
    found = evaluate(solution.policy, solution.problem)
    assert found.objective == pytest.approx(solution.objective, **EXACT)
    assert found.failure_probability <= 0.02 + 1e-12
    if cap >= 2:
        assert solution.objective == pytest.approx(79 / 49, **EXACT)
