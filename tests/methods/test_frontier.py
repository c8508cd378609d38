"""The frontier: convex, exact at every budget, and tangent to the prices."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import InfeasibleError, ModelError, SolverError, evaluate, solve, trace_frontier
from written_models import written

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
    with pytest.raises(ModelError, match="steeper"):
        part.objective_at(float(whole.failure[0]))


def test_tracing_stops_early_and_says_how_far_it_came():
    few = trace_frontier(PROBLEMS[0], point_limit=2)
    assert len(few.failure) == 2
    assert few.gap > 1e-9
    assert len(trace_frontier(PROBLEMS[0], time_limit=1e-9).failure) == 2
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ModelError, match="steepest_price"):
            trace_frontier(PROBLEMS[0], steepest_price=wrong)
    with pytest.raises(ModelError, match="best to fail"):
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
