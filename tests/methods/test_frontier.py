"""Frontiers over the failure and over any other limit."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from formulations import GUBS, MCMP, S3P, ConstrainedCost, CostLimit, CVaR, MaxProb
from small_models import model_of
from ssp_lp import (
    InfeasibleError,
    ModelError,
    SolverError,
    end_probability,
    evaluate,
    expected_cost,
    secondary_cost,
    solve,
    trace_frontier,
    visits,
)
from written_models import written

# The frontier: convex, exact at every budget, and tangent to the prices.


ROADS = written(
    """
    s a: 0.7 g 1, 0.3 d 1
    s b: 0.9 t 2, 0.1 d 1
    s c: 0.99 t 4, 0.01 d 1
    s worse: 0.9 t 3, 0.1 d 1
    t x: 0.8 g 1, 0.2 d 2
    t y: 0.95 g 2, 0.05 s 1
    t z: g 6
    d stay: d 1
    """
)
SURE = written("s go: g 2")
PROBLEMS = [
    MCMP(ROADS, "s"),
    MCMP(ROADS, "s", give_up="anywhere", charge_failing_step=False),
    MCMP(ROADS, {"s": 0.5, "t": 0.5}, 0.5, discount=0.9),
    S3P(ROADS, "s"),
    S3P(ROADS, {"s": 0.5, "t": 0.4, "g": 0.1}, 0.5, discount=0.9),
]
each_problem = pytest.mark.parametrize(
    "problem", PROBLEMS, ids=lambda p: f"{type(p).__name__}-{p.discount}"
)


@each_problem
def test_the_frontier_is_what_solve_says_and_its_policies_attain_it(problem):
    frontier = trace_frontier(problem)
    assert (np.diff(frontier.failure) > 0).all()
    assert (np.diff(frontier.cost) < 0).all()
    assert (np.diff(frontier.price) < 0).all()
    least = frontier.failure[0]
    for budget in np.linspace(least, 1.0, 23):
        solution = solve(replace(problem, failure_budget=float(budget)))
        assert frontier.objective_at(budget) == pytest.approx(solution.objective, rel=1e-8)
    with pytest.raises(InfeasibleError):
        frontier.objective_at(least - 1e-6)
    middle = 0.5 * (frontier.failure[1:] + frontier.failure[:-1])
    for budget in [*frontier.failure, *middle]:
        policy = frontier.policy_at(float(budget))
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(frontier.objective_at(budget), rel=1e-9)
        failure = found.failure_probability if problem.discount is None else None
        failure = found.discounted_failure if failure is None else failure
        assert failure == pytest.approx(budget, abs=1e-12)
        assert len(policy.policies) <= 2
    if isinstance(problem, S3P) or problem.discount is not None:
        return
    for budget, price in zip(middle, frontier.price, strict=True):
        solution = solve(replace(problem, failure_budget=float(budget)))
        assert solution.failure_price == pytest.approx(price, rel=1e-9)


@each_problem
@pytest.mark.parametrize("points", [2, 3, None])
def test_bounds_are_true_however_early_tracing_stopped(problem, points):
    whole, part = trace_frontier(problem), trace_frontier(problem, point_limit=points)
    for budget in np.linspace(float(whole.failure[0]), 1.0, 17):
        low, high = part.bounds_at(float(budget))
        exact = whole.objective_at(float(budget))
        assert low <= exact * (1 + 1e-9)
        assert exact <= high * (1 + 1e-12)
        assert evaluate(part.policy_at(float(budget)), problem).objective == pytest.approx(high)
        if low < high * (1 - 1e-6) and budget not in part.failure:
            with pytest.raises(SolverError, match="not settled"):
                part.objective_at(float(budget))
        else:
            assert part.objective_at(float(budget)) == high == pytest.approx(exact, rel=1e-6)
        if points is None:
            assert low == pytest.approx(high, rel=1e-8)
    with pytest.raises(InfeasibleError):
        part.bounds_at(float(whole.failure[0]) - 1e-6)
    for failure, objective in zip(part.failure, part.objective, strict=True):
        assert part.objective_at(float(failure)) == objective
        low, high = part.bounds_at(float(failure))
        assert high == objective == pytest.approx(whole.objective_at(float(failure)), rel=1e-9)
        if failure > part.failure[0]:  # there no price says all
            assert low == pytest.approx(high, rel=1e-8)
    if points == 3:
        assert part.gap == max(part.below) > part.tolerance == whole.gap


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_frontiers_without_an_edge(criterion):
    frontier = trace_frontier(criterion(SURE, "s"))
    for budget in (0.0, 0.3, 1.0):
        assert frontier.objective_at(budget) == pytest.approx(2.0)
        assert frontier.bounds_at(budget) == pytest.approx((2, 2))
    with pytest.raises(ModelError):
        trace_frontier(criterion(SURE, "s"), gap=0.0)
    with pytest.raises(InfeasibleError):
        trace_frontier(S3P(ROADS, "d"))


@pytest.mark.parametrize("problem", [PROBLEMS[0], PROBLEMS[3]], ids=["MCMP", "S3P"])
def test_a_frontier_from_a_price_on_is_the_rest_of_the_whole(problem):
    whole = trace_frontier(problem)
    steepest = float(np.sqrt(whole.price[0] * whole.price[1]))  # between two kinks
    part = trace_frontier(problem, steepest_price=steepest)
    assert not part.complete
    assert part.failure == pytest.approx(whole.failure[1:], abs=1e-12)
    assert part.cost == pytest.approx(whole.cost[1:], rel=1e-12)
    with pytest.raises(ModelError, match="set a higher steepest_price"):
        part.objective_at(float(whole.failure[0]))


def test_tracing_stops_early_and_says_how_far_it_came():
    few = trace_frontier(PROBLEMS[0], point_limit=2)
    assert len(few.failure) == 2
    assert few.gap > 1e-9
    assert len(trace_frontier(PROBLEMS[0], time_limit=1e-9).failure) == 2
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ModelError, match="steepest_price"):
            trace_frontier(PROBLEMS[0], steepest_price=wrong)
    with pytest.raises(ModelError, match="failing is optimal"):
        trace_frontier(PROBLEMS[3], steepest_price=1e-3)


def test_a_frame_has_a_row_for_each_turning_point():
    pytest.importorskip("pandas")
    frontier = trace_frontier(PROBLEMS[3], point_limit=3)
    frame = frontier.to_frame()
    assert list(frame.columns) == ["failure", "goal", "cost", "objective", "price", "below"]
    assert (frame["cost"] / frame["goal"] == frame["objective"]).all()
    assert frame["price"].to_list()[:2] == frontier.price.tolist()
    assert frame["price"].isna().tolist() == frame["below"].isna().tolist() == [False, False, True]


@pytest.mark.slow
def test_two_pricing_calls_a_turning_point_and_closing_bounds_on_the_robot(robot):
    calls = []
    problem = MCMP(*robot)
    frontier = trace_frontier(problem, gap=1e-3, progress=lambda n, _: calls.append(n))
    assert frontier.pricing_calls <= 2 * len(frontier.failure) + 5
    assert calls[-1] == frontier.pricing_calls
    exact = solve(replace(problem, failure_budget=0.05)).objective
    assert exact * (1 - 1e-12) <= frontier.objective_at(0.05) <= exact * (1 + 2e-3)
    widths = []
    for points in (2, 4, 8, 16):
        part = trace_frontier(problem, gap=1e-6, point_limit=points)
        assert len(part.failure) == points
        assert part.gap > 1e-6
        low, high = part.bounds_at(0.05)
        assert low <= exact * (1 + 1e-9)
        assert exact <= high * (1 + 1e-12)
        widths.append(high - low)
    assert widths[-1] < 0.1 * widths[0]


def test_the_segment_with_most_below_it_is_split_first():
    """One state whose actions lie on a convex curve: what is below a segment is known."""
    failure = np.linspace(0.0, 0.9, 19)
    cost = 1.0 + (1.0 - failure) ** 6 * 40.0
    ways = enumerate(zip(failure, cost, strict=True))
    model = model_of({"s": {k: [(1.0 - f, "g", c), (f, "d", c)] for k, (f, c) in ways}})
    known = {0, 18}
    for points in range(3, 9):
        below = {}
        for i, j in pairwise(sorted(known)):
            line = np.interp(failure[i : j + 1], failure[[i, j]], cost[[i, j]])
            gaps = (line - cost[i : j + 1]) / cost[i]
            below[i + int(np.argmax(gaps))] = float(gaps.max())
        known.add(max(below, key=below.__getitem__))
        part = trace_frontier(MCMP(model, "s", give_up="dead_ends"), point_limit=points)
        assert part.failure == pytest.approx(failure[sorted(known)], abs=1e-12)


@pytest.mark.slow
def test_a_frontier_is_traced_once_however_often_its_process_is_refined(coarse_robot):
    frontier = trace_frontier(S3P(*coarse_robot, 0.3), point_limit=40)
    assert len(frontier.failure) == 40
    assert frontier.hidden == 0.0
    assert frontier.pricing_calls < 4 * 40


def test_a_proof_that_counts_success_is_kept_beside_one_that_counts_failing():
    """At one price, in either order: J + price * failure, and the same less the price."""
    for first in (False, True):
        frontier = trace_frontier(S3P(ROADS, "s"))
        points, price = frontier._points, float(frontier.objective[-1])
        column = points.columns[-1]
        proofs = {k: points.proof(price, column, slack=k) for k in (first, not first)}
        assert (proofs[False].failing, proofs[True].failing) == (price, 0.0)
        assert proofs[False].bound == pytest.approx(proofs[True].bound + price, rel=1e-12)
        assert points.proof(price, column, slack=first) is proofs[first]


# Frontiers over any limit: closed forms, optima at thirty bounds, refusals.


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
    with pytest.raises(ModelError, match="not a linear program"):
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
    with pytest.raises(ModelError, match="was traced only from"):
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
