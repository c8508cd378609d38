"""Frontiers over any limit: closed forms, optima at thirty bounds, refusals."""

from functools import cache

import numpy as np
import pytest

from formulations import GUBS, MCMP, S3P, ConstrainedCost, CostLimit, CVaR, MaxProb
from small_models import model_of
from ssp_lp import (
    InfeasibleError,
    ModelError,
    end_probability,
    evaluate,
    expected_cost,
    secondary_cost,
    solve,
    trace_frontier,
    visits,
)
from written_models import written

SKID = written(
    """
    a fast: 0.9 g 1, 0.1 skid 1
    a mid: 0.98 g 4, 0.02 wreck 4
    a slow: g 10
    skid slide: 0.5 wreck 0, 0.5 ash 0
    """,
    labels={"crash": ["wreck"], "fire": ["ash"]},
)
FUEL = secondary_cost({k: {0: 0.5, 1: 1.0, 2: 1.5} for k in range(6)})


@cache
def town(seed):
    """Six places in a row with three ways on each, from dear and safe to cheap and risky."""
    rng, choices = np.random.default_rng(seed), {}
    for k in range(6):
        on, choices[k] = "g" if k == 5 else k + 1, {}
        for way in range(3):
            pit, ice = 0.02 * way * rng.random(), 0.03 * way * rng.random()
            back = 0.2 * rng.random()
            cost = float(np.round(1.0 + (3.0 - way) * (1.0 + rng.random())))
            choices[k][way] = [(1.0 - pit - ice - back, on, cost), (pit, "pit", cost)]
            choices[k][way] += [(ice, "ice", cost), (back, max(k - 1, 0), cost)]
    choices["pit"], choices["ice"] = {}, {}
    return model_of(choices, labels={"crash": ["pit"], "cold": ["ice"]})


def ending(label, bound):
    return {label: end_probability(label) <= bound}


def crashes(bound):
    return MCMP(SKID, "a", 0.1, constraints=ending("crash", bound) | ending("fire", 0.03))


def test_the_frontier_over_crashes_in_closed_form():
    """Slow, mid, and as much of fast as 3 % of fires leave: three points on two lines."""
    frontier = trace_frontier(crashes(1.0), over="crash")
    assert frontier.over == "crash"
    assert frontier.spent == pytest.approx([0.0, 0.02, 0.038], abs=1e-12)
    assert frontier.objective == pytest.approx([10.0, 4.0, 2.2], rel=1e-12)
    assert frontier.price == pytest.approx([300.0, 100.0], rel=1e-9)
    assert frontier.failure == pytest.approx([0.0, 0.02, 0.068], abs=1e-12)
    assert frontier.objective_at(0.01) == pytest.approx(7.0, rel=1e-12)
    assert frontier.bounds_at(0.5) == pytest.approx((2.2, 2.2), rel=1e-9)
    policy = frontier.policy_at(0.029)
    assert evaluate(policy, crashes(0.029)).secondary_costs["crash"] == pytest.approx(0.029)
    assert repr(frontier).startswith("Frontier(3 points, crash 0 .. 0.038, objective 10 .. 2.2")


FINE, ROUGH = 1e-9, 2e-2
FUELLED = {"fuel": FUEL <= 9.0}
STATED = {
    "cold held": lambda b: MCMP(town(1), 0, b, constraints=ending("cold", 0.06)),
    "given success": lambda b: S3P(town(2), 0, 0.4, constraints=ending("crash", b)),
    "given success, fuel held": lambda b: S3P(town(3), 0, b, constraints=FUELLED),
    "greatest goal": lambda b: MaxProb(
        town(4), 0, constraints=FUELLED | {"cost": expected_cost() <= b}
    ),
    "horizon": lambda b: MCMP(town(5), 0, 0.6, horizon=9, constraints=ending("crash", b)),
    "discount": lambda b: MCMP(town(6), 0, 0.5, 0.95, constraints={"few": visits(3) <= b}),
    "the criterion's own": lambda b: ConstrainedCost(
        town(7), 0, {"fuel": CostLimit(FUEL.terms[0][1].cost, b)}, 0.5
    ),
}


@pytest.mark.parametrize(
    ("case", "over", "gap"),
    [
        ("cold held", "failure", FINE),
        ("given success", "crash", ROUGH),
        ("given success, fuel held", "failure", ROUGH),
        ("greatest goal", "cost", FINE),
        ("horizon", "crash", FINE),
        ("discount", "few", FINE),
        ("the criterion's own", "fuel", FINE),
    ],
)
def test_no_optimum_lies_outside_the_bounds(case, over, gap):
    stated = STATED[case]
    frontier = trace_frontier(stated(0.5), over, gap=gap)
    assert (np.diff(frontier.spent) > 0.0).all()
    assert frontier.gap <= gap * (1.0 + 1e-12)
    first, last = float(frontier.spent[0]), float(frontier.spent[-1])
    assert len(frontier.spent) > 2
    count = 10 if gap == FINE else 4  # given success each bound takes a search of its own
    for bound in np.linspace(first + 1e-9, min(1.05 * last, last + 0.01), count).tolist():
        optimum = solve(stated(bound)).objective
        low, high = frontier.bounds_at(bound)
        assert low - 1e-9 * abs(low) <= optimum <= high + 1e-9 * abs(high)
        assert high - low <= 2.0 * gap * max(frontier.objective)
    middle = 0.5 * (first + last)
    policy = frontier.policy_at(middle)
    assert policy.model is stated(0.5).model
    found = evaluate(policy, stated(middle))
    spent = found.limited_failure if over == "failure" else found.secondary_costs[over]
    assert spent == pytest.approx(middle, rel=1e-9)
    assert found.objective == pytest.approx(frontier.objective_at(middle), rel=1e-8)
    with pytest.raises(InfeasibleError) as refused:
        frontier.bounds_at(first - 0.01)
    assert refused.value.least_failure <= 1.0


def test_tracing_that_was_cut_short_bounds_the_rest():
    whole = trace_frontier(STATED["cold held"](0.5))
    part = trace_frontier(STATED["cold held"](0.5), point_limit=3)
    assert len(part.open_segments) > 0
    for bound in np.linspace(float(whole.spent[0]), float(whole.spent[-1]), 20).tolist():
        low, high = part.bounds_at(bound)
        assert low * (1.0 - 1e-9) <= whole.objective_at(bound) <= high * (1.0 + 1e-9)


def test_what_no_limit_or_no_program_is_is_refused():
    with pytest.raises(ModelError, match="'crahs'; did you mean 'crash'"):
        trace_frontier(crashes(1.0), over="crahs")
    kept = {"fire": end_probability("fire") >= 0.01}
    with pytest.raises(ModelError, match="bounds from below"):
        trace_frontier(MCMP(SKID, "a", 0.1, constraints=kept), over="fire")
    with pytest.raises(ModelError, match="no linear program"):
        trace_frontier(CVaR(SKID, "a", 0.9, 0.1, constraints=ending("crash", 0.1)), over="crash")
    with pytest.raises(ModelError, match="steepest_price"):
        trace_frontier(crashes(1.0), over="crash", steepest_price=10.0)


def test_a_utility_over_a_limit():
    limits = ending("crash", 0.5)
    problem = GUBS(SKID, "a", lambda c: np.exp(-0.1 * c), 1.0, constraints=limits)
    frontier = trace_frontier(problem, over="crash")
    assert frontier.maximises
    assert (np.diff(frontier.objective) > 0.0).all()
    assert frontier.objective[0] == pytest.approx(np.exp(-1.0) + 1.0)


def quitting(fuel, calls=1.0):
    """Who gives up takes 1 of fuel; who goes takes 5, or 1 and 4, and has paid 2."""
    ways = {
        "a": {"go": [(1.0, "g", 2.0)], "quit": [(1.0, "b", 1.0)]},
        "b": {"on": [(1.0, "pit", 1.0)], "back": [(1.0, "g", 1.0)]},
    }
    taken = secondary_cost({"a": {"go": 5.0, "quit": 1.0}, "b": {"on": 3.0, "back": 4.0}})
    limits = {"fuel": taken <= fuel, "calls": visits("b") <= calls}
    return S3P(model_of(ways, "g"), "a", 1.0, constraints=limits)


def test_the_least_that_is_spent_may_be_that_of_giving_up():
    """Given success 2 is paid whatever fuel there is: a tenth of the runs go with 0.5 of it."""
    assert solve(quitting(0.5)).objective == pytest.approx(2.0)
    assert trace_frontier(quitting(0.5)).spent == pytest.approx([0.9])
    assert trace_frontier(quitting(0.5), over="calls").objective == pytest.approx([2.0])
    frontier = trace_frontier(quitting(5.0), over="fuel")
    assert not frontier.complete  # nobody succeeds with none of it
    for fuel in (0.5, 1.0, 4.5):
        assert frontier.bounds_at(fuel) == pytest.approx((2.0, 2.0))
    with pytest.raises(ModelError, match="was traced from"):
        frontier.bounds_at(0.0)


def test_who_may_not_give_up_may_wait_for_ever():
    """The least visits are those of waiting, which is dear: the frontier begins where one goes."""
    ways = {
        "a": {"stay": [(1.0, "a", 1.0)], "go": [(0.5, "b", 1.0), (0.5, "g", 1.0)]},
        "b": {"on": [(0.5, "g", 1.0), (0.5, "pit", 1.0)]},
    }
    problem = MCMP(
        model_of(ways, "g"), "a", 1.0, give_up="dead_ends", charge_failing_step=False,
        constraints={"b": visits("b") <= 1.0},
    )  # fmt: skip
    frontier = trace_frontier(problem, over="b")
    assert frontier.spent == pytest.approx([0.5])
    assert frontier.objective.tolist() == pytest.approx([1.5])
    assert solve(problem).objective == pytest.approx(1.5)


def test_a_budget_that_is_traced_may_be_stated_or_not() -> None:
    """What a problem allows of what is traced does not matter, be it the least failure."""
    yard = written("a fast: 0.9 g 1, 0.1 yard 1\na slow: g 10\nyard on: 0.5 g 2, 0.5 pit 2")
    limits = {"yard": visits("yard") <= 0.05}
    for budget in (None, 0.02, 1.0):
        frontier = trace_frontier(MCMP(yard, "a", budget, constraints=limits))
        assert frontier.spent == pytest.approx([0.0, 0.025])
        assert frontier.objective == pytest.approx([10.0, 5.6])
