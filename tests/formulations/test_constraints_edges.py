"""Constraints at their edges: ends, equalities, rare goals, refusals, and what a measure keeps."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from formulations import (
    GUBS,
    MCMP,
    S3P,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
)
from small_models import deciding, each_meaning, each_method, model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    certify,
    end_probability,
    evaluate,
    expected_cost,
    failure_probability,
    goal_probability,
    secondary_cost,
    simulate,
    solve,
    visits,
)
from tests.support.compiled import Switch

WALL = {"wall": ["wall"]}


def alone(policy) -> MixedPolicy:
    return MixedPolicy((policy,), np.ones(1))


HUT = model_of(
    {
        "a": {"go": [(1.0, "b", 1.0)], "quit": [(1.0, "hut", 2.0)]},
        "hut": {
            "sleep": [(1.0, "hut", 1.0)],
            "on": [(1.0, "wall", 3.0)],
            "back": [(1.0, "g", 50.0)],
        },
        "b": {"x": [(1.0, "g", 1.0)]},
        "wall": {},
    },
    labels=WALL,
)
"""The wall lies behind a hut: whoever is on the way there has given the goal up."""


def test_an_end_that_is_asked_for_is_reached_after_failing() -> None:
    """4/5 go for 2; 1/5 or more give up, charged a step of 2, and walk to the wall for nothing."""
    problem = MCMP(HUT, "a", 1.0, constraints={"w": end_probability("wall") >= 0.2})
    solution = solve(problem)
    assert solution.objective == pytest.approx(2.0, rel=1e-12)
    assert certify(solution).gap < 1e-9
    program = problem.program()
    for measure in (program.solve(), program.to_cvxpy().solve(solver="CLARABEL")):
        assert measure.objective == pytest.approx(2.0, rel=1e-6)
        for policy in (measure.mixed_policy(), measure.randomised_policy()):
            found = evaluate(policy, problem)
            assert found.objective == pytest.approx(2.0, rel=1e-6)
            assert found.secondary_costs["w"] >= 0.2 - 1e-6


def test_where_failing_is_forbidden_no_end_is_bought() -> None:
    risky = [(0.5, "g", 5.0), (0.5, "wall", 5.0)]
    model = deciding("a", WALL, ok=[(1.0, "g", 5.0)], risky=risky)
    problem = MinCost(model, "a", constraints={"w": end_probability("goal", "wall") >= 0.5})
    bad = DeterministicPolicy.from_actions(model, {"a": "risky"})
    assert evaluate(bad, problem).objective == np.inf
    assert not certify(replace(solve(problem), policy=alone(bad))).accepted


def wall_of(chance: float) -> SSP:
    """Three ways to the goal; two of them end at the wall, rarely."""
    go = [(chance, "wall", 1.0), (0.6, "g", 2.0), (0.4 - chance, "pit", 1.0)]
    slow = [(2 * chance, "wall", 5.0), (1 - 2 * chance, "g", 4.0)]
    return deciding("a", WALL, go=go, slow=slow, z=[(1.0, "g", 9.0)])


@pytest.mark.parametrize(("chance", "asked"), [(2.3e-4, 3.75e-4), (1.2e-4, 1.33e-4)])
def test_equalities_of_rare_ends(chance: float, asked: float) -> None:
    """Costs given success between those of the lower and the upper bound alone; tight."""
    wall, model = end_probability("wall"), wall_of(chance)
    both = solve(S3P(model, "a", failure_budget=0.3, constraints={"w": wall == asked}))
    assert both.gap < 1e-9
    assert both.secondary_costs["w"] == pytest.approx(asked, rel=1e-9)
    one_sided = [
        solve(S3P(model, "a", failure_budget=0.3, constraints={"w": constraint})).objective
        for constraint in (wall <= asked, wall >= asked)
    ]
    assert both.objective == pytest.approx(max(one_sided), rel=1e-9)


def test_an_equality_of_the_worth_of_arriving() -> None:
    wall = end_probability("wall") == 0.001823
    problem = CostBoundedReach(wall_of(0.00156), "a", 3, 0.3, constraints={"w": wall})
    solution = solve(problem)
    assert solution.gap < 1e-9
    assert certify(solution).accepted


@each_method
def test_a_goal_probability_that_is_fixed(method: str) -> None:
    rare, asked = 4e-5, 4.4e-5
    go = [(rare, "g", 1.0), (1 - rare, "wall", 2.0)]
    model = deciding("a", go=go, slow=[(2 * rare, "g", 5.0), (1 - 2 * rare, "wall", 1.0)])
    found = [
        solve(FinitePenalty(model, "a", 3.0, constraints={"g": constraint}), method).objective
        for constraint in (goal_probability() == asked, goal_probability() >= asked)
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.parametrize(("rare", "late"), [(1e-7, 5e-10), (1e-9, 1e-8)])
def test_bounds_of_rare_goals_are_bounds(rare: float, late: float) -> None:
    """A slightly worse policy is not certified as the best."""
    lost = (1 - rare, "wall", 2.0)
    worse = [(rare * (1 - late), "g", 1.0), (rare * late, "g", 2.0), lost]
    model = deciding("a", go=[(rare, "g", 1.0), lost], worse=worse)
    fuel = {"c": secondary_cost({"a": {"go": 3.0}}) <= 5.0}
    solution = solve(S3P(model, "a", failure_budget=1.0, constraints=fuel))
    assert solution.objective == pytest.approx(1.0, rel=1e-12)
    worse = DeterministicPolicy.from_actions(model, {"a": "worse"})
    assert certify(replace(solution, policy=alone(worse))).lower_bound <= 1.0


def lucky(first: dict, wall: Any, *, may_go: bool = True) -> dict[str, Any]:
    """Only to lose and to go hit the wall with 0.2; to win is free, and does so with 0.1."""
    actions = {"lose": [(1.0, "b", 0.0)], "win": [(1.0, "g", 0.0)]}
    go = {"go": [(0.8, "g", 3.0), (0.2, "wall", 1.0)]} if may_go else {}
    lost = {"on": [(0.2, "wall", 0.0), (0.8, "ditch", 0.0)]}
    model = model_of({"s": first, "a": actions | go, "b": lost})
    asked = {"failure_budget": 1.0, "constraints": {"wall": wall}}
    return {"model": model, "start": {"s": 0.5, "b": 0.5}, **asked}


WALLS = (end_probability("wall") == 0.2, end_probability("wall") >= 0.2)
GIVEN_SUCCESS = [S3P, partial(CVaR, level=0.3), partial(CostQuantile, level=0.3)]


@each_method
@pytest.mark.parametrize("criterion", GIVEN_SUCCESS)
def test_the_room_for_rounding_of_a_limit_buys_no_success(criterion, method: str) -> None:
    step = {"on": [(1.0, "a", 0.0)]}
    for wall in WALLS:
        solution = solve(criterion(**lucky(step, wall)), method)
        assert solution.objective == pytest.approx(3.0, rel=1e-9)
        assert solution.goal_probability == pytest.approx(0.4, rel=1e-9)
        with pytest.raises(InfeasibleError, match="no cost given success exists"):
            solve(criterion(**lucky(step, wall, may_go=False)), method)
        free = criterion(**lucky(step, wall) | {"constraints": {}})
        assert solve(free, method).objective == 0.0


@pytest.mark.parametrize("wall", WALLS, ids=["equal", "at least"])
def test_nor_is_success_bought_where_totals_are_rounded(wall) -> None:
    roots = {"on": [(1.0, "a", 2.0**0.5)], "far": [(1.0, "a", 3.0**0.5)]}
    solution = solve(S3P(**lucky(roots, wall), cost_levels=1))
    assert solution.objective == pytest.approx(3.0 + 2.0**0.5, rel=1e-9)
    assert solution.goal_probability == pytest.approx(0.4, rel=1e-9)


def test_to_stay_for_ever_must_be_free_in_everything() -> None:
    """A loop free in the cost but counted as visits is no place to give up."""
    go = [(0.5, "g", 1.0), (0.5, "wall", 1.0)]
    model = deciding("a", wait=[(1.0, "a", 0.0)], go=go)
    problem = MCMP(model, "a", 1.0, give_up="dead_ends", constraints={"v": visits("a") <= 1.0})
    assert solve(problem).objective == pytest.approx(1.0)
    with pytest.raises(ModelError, match="gives up"):
        evaluate(DeterministicPolicy.from_actions(model, {"a": GIVE_UP}), problem)


LOOP = deciding("a", go=[(0.5, "g", 1.0), (0.5, "a", 1.0)], w=[(1.0, "a", 0.0)])


@each_method
def test_limits_under_which_nothing_succeeds(method: str) -> None:
    with pytest.raises(InfeasibleError):
        solve(S3P(LOOP, "a", 1.0, constraints={"c": expected_cost() <= 0.0}), method)
    problem = S3P(LOOP, "a", failure_budget=1.0, constraints={"v": visits("a") <= 3.0})
    never = DeterministicPolicy.from_actions(LOOP, {"a": GIVE_UP})
    assert not certify(replace(solve(problem, method), policy=alone(never))).accepted


@each_method
def test_no_failure_at_all(method: str) -> None:
    bad = [(0.4, "wall", 0.0), (0.6, "b", 2.0)]
    model = deciding("b", ok=[(1 / 3, "b", 1.0), (2 / 3, "g", 2.0)], bad=bad)
    start = {"b": 0.5, "g": 0.5}
    problem = S3P(model, start, 1.0, constraints={"r": failure_probability() == 0.0})
    assert solve(problem, method).objective == pytest.approx(1.25, rel=1e-9)
    assert problem.program().solve().objective == pytest.approx(1.25, rel=1e-9)


def test_terms_that_count_the_same_are_added_up_and_may_come_to_nothing() -> None:
    twice = 2.0 * visits("a") - visits("a")
    solution = solve(MCMP(LOOP, "a", 1.0, constraints={"v": twice <= 1.5}))
    assert solution.secondary_costs["v"] <= 1.5 + 1e-9
    assert solve(MCMP(LOOP, "a", 1.0, constraints={"v": visits("a") - visits("a") <= 0.0}))
    with pytest.raises(InfeasibleError) as caught:
        solve(MaxProb(LOOP, "a", constraints={"k": 0.0 * goal_probability() <= -1.0}))
    assert caught.value.conflicting_rows == ("k",)


def test_the_greatest_probability_may_be_nothing() -> None:
    model = deciding("a", x=[(1 / 3, "g", 1.0), (2 / 3, "wall", 1.0)], q=[(1.0, "wall", 1.0)])
    solution = solve(MaxProb(model, "a", constraints={"g": goal_probability() <= 0.0}))
    assert (solution.objective, solution.gap, solution.note) == (0.0, 0.0, "")


def test_what_is_refused_when_it_is_stated() -> None:
    for wrong, told in (
        ({"v": visits("a") >= 1.0}, "from below"),
        ({"v": visits("nowhere") <= 1.0}, "nowhere"),
        ({"v": end_probability("a") <= 1.0}, "no episode ends"),
        ({"failure": goal_probability() >= 0.5}, "names the failure budget"),
        ({"v": 3.0}, "quantity"),
    ):
        with pytest.raises(ModelError, match=told):
            MCMP(LOOP, "a", 1.0, constraints=wrong)
    without_name: Any = visits("a") <= 1.0
    with pytest.raises(ModelError, match=r"constraints must be \{name: quantity <= bound\}"):
        MCMP(LOOP, "a", 1.0, constraints=without_name)
    with pytest.raises(ModelError, match="no truth value"):
        assert 0.1 <= goal_probability() <= 0.5
    with pytest.raises(ModelError, match="finite numbers"):
        assert goal_probability() <= float("nan")


def test_the_least_of_the_cost_is_the_least_cost() -> None:
    """Its own expected cost as the quantity gives the criterion of the cost."""
    for budget in (0.0, 0.05, None):
        plain = MCMP(HUT, "a", budget, charge_failing_step=False)
        own = LeastQuantity(HUT, "a", expected_cost(), budget)
        assert solve(own).objective == pytest.approx(solve(plain).objective, rel=1e-12)


TANK = deciding("x", go=[(1.0, "g", 1.0)], stay=[(1.0, "x", 1.0)])
FUEL = {"x": {"go": 1.0}}


@each_meaning
@each_method
def test_what_uses_none_of_the_quantity_may_go_on_for_ever(method: str, give_up: str) -> None:
    """Half go for fuel 1; the others stay, which costs something, but no fuel."""
    problem = LeastQuantity(TANK, "x", secondary_cost(FUEL), 0.5, give_up=give_up)
    solution = solve(problem, method)
    assert (solution.objective, solution.lower_bound) == pytest.approx((0.5, 0.5), rel=1e-12)
    assert certify(solution).accepted
    assert problem.program().solve().objective == pytest.approx(0.5, rel=1e-9)
    staying = DeterministicPolicy.from_actions(TANK, {"x": "stay"})
    found = evaluate(staying, problem)
    assert found.objective == 0.0
    forever = np.inf if give_up == "dead_ends" else 0.0
    assert found.expected_cost == forever
    report = simulate(solution.policy, problem, episodes=100, seed=np.random.default_rng(1))
    assert report.expected_cost.value == np.inf if forever else report.expected_cost.value < 1.0


def test_to_pay_for_ever_is_no_way_to_fail_where_that_is_limited() -> None:
    """The same where the cost is limited, or is the quantity itself."""
    for quantity, limits in (
        (secondary_cost(FUEL), {"cost": expected_cost() <= 5.0}),
        (secondary_cost(FUEL) + 0.1 * expected_cost(), {}),
    ):
        problem = LeastQuantity(TANK, "x", quantity, 0.5, give_up="dead_ends", constraints=limits)
        assert solve(problem).failure_probability == 0.0
        with pytest.raises(ModelError, match="gives up"):
            evaluate(DeterministicPolicy.from_actions(TANK, {"x": GIVE_UP}), problem)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("limits", [{}, {"c": expected_cost() <= 3.0}])
@pytest.mark.parametrize("horizon", [None, 3])
def test_a_start_where_nothing_is_left_to_decide(
    horizon: int | None, limits: dict, fast: bool, accelerate: Switch
) -> None:
    """By compiled loops and by numpy; within a horizon no state is left that one may act in."""
    accelerate(fast)
    start = {"g": 0.5, "d": 0.5}
    beside = {"constraints": limits, "horizon": horizon}
    for cost in (1.0, 2.0**0.5):
        model = model_of({"x": {"go": [(1.0, "g", cost)]}, "d": {}})
        for problem, value in (
            (S3P(model, start, 0.6, **beside), 0.0),
            (CostBoundedReach(model, start, 2, **beside), 0.5),
            (CVaR(model, start, 0.5, 0.6, **beside), 0.0),
            (CostQuantile(model, start, 0.5, 0.6, **beside), 0.0),
            (GUBS(model, start, lambda total: 1.0 / (1.0 + total), 0.5, **beside), 0.75),
        ):
            solution = solve(problem)
            assert solution.objective == value
            assert (certify(solution).accepted, certify(solution).gap) == (True, 0.0)


WAITING = deciding(
    "x",
    cheap=[(0.6, "g", 1.0), (0.4, "d", 1.0)],
    dear=[(0.9, "g", 3.0), (0.1, "d", 3.0)],
    wait=[(1.0, "x", 1.0)],
)


@each_method
def test_who_begins_at_an_end_is_counted_there(method: str) -> None:
    """A quarter begin at the goal, a quarter lost: of the others half go cheaply, half dearly."""
    start, limits = {"x": 0.5, "g": 0.25, "d": 0.25}, {"g": goal_probability() >= 0.625}
    for problem, value in (
        (S3P(WAITING, start, 1.0, constraints=limits), 0.5 * (0.3 * 1 + 0.45 * 3) / 0.625),
        (MCMP(WAITING, start, 1.0, constraints=limits), 0.5 * (0.5 * 1 + 0.5 * 3)),
    ):
        solution = solve(problem, method)
        assert solution.objective == pytest.approx(value, rel=1e-9)
        assert solution.secondary_costs["g"] == pytest.approx(0.625, rel=1e-9)
        assert certify(solution).gap < 1e-9
        program = problem.program()
        measure = program.solve()
        assert measure.objective == pytest.approx(value, rel=1e-9)
        coefficients, constant = program.expression(goal_probability())
        assert coefficients @ measure.visits + constant == pytest.approx(0.625, rel=1e-9)


def test_the_least_goal_mass_follows_from_all_rows() -> None:
    """0.483 cheap and 0.233 dear use up the fuel and reach the goal with 1/2; the others stop."""
    limits = {
        "goal": goal_probability() >= 0.5,
        "fuel": secondary_cost({"x": {"cheap": 2.0, "dear": 1.0}}) <= 1.2,
    }
    for problem, value in (
        (S3P(WAITING, "x", 1.0, constraints=limits), 1.84),
        (CVaR(WAITING, "x", 0.5, 1.0, constraints=limits), 2.68),
        (CostQuantile(WAITING, "x", 0.5, 1.0, constraints=limits), 1.0),
        (CostQuantile(WAITING, "x", 0.7, 1.0, constraints=limits), 3.0),
    ):
        solution = solve(problem)
        certificate = certify(solution)
        assert solution.objective == pytest.approx(value, rel=1e-12)
        assert solution.lower_bound == pytest.approx(value, rel=1e-9)
        assert certificate.accepted
        assert certificate.lower_bound == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("most", [1e-1, 1e-4, 1e-8])
def test_limits_that_nearly_forbid_to_move(most: float) -> None:
    """Whoever goes at all goes cheaply, however few they may be."""
    limits = {"fuel": secondary_cost({"x": {"cheap": 2.0, "dear": 1.0}}) <= most}
    for more in ({}, {"d": end_probability("d") <= most / 20.0}):
        for problem in (
            S3P(WAITING, "x", 1.0, constraints=limits | more),
            CVaR(WAITING, "x", 0.5, 1.0, constraints=limits | more),
        ):
            solution = solve(problem)
            assert solution.objective == pytest.approx(1.0, rel=1e-12)
            assert max(solution.gap, certify(solution).gap) < 1e-9


@each_meaning
def test_where_a_run_without_budget_may_stop(give_up: str) -> None:
    """Every run costs 2 in the mean unless it may stop anywhere: at a 1, at b 1/2 * 2.

    Of the other model half may quit, for nothing, or by a step to the ditch that costs 1/7.
    """
    ladder = model_of(
        {
            "a": {"go": [(0.5, "g", 1.0), (0.5, "b", 1.0)]},
            "b": {"go": [(0.5, "g", 2.0), (0.5, "d", 2.0)]},
            "d": {},
        }
    )
    for budget, value in ((0.0, 0.0), (0.5, 0.25), (1.5, 0.625), (2.0, 0.75)):
        problem = CostBudgetedMaxProb(ladder, "a", budget, give_up)
        if give_up != "anywhere" and budget < 2.0:
            with pytest.raises(InfeasibleError, match="at least 2"):
                solve(problem)
        else:
            assert solve(problem).objective == pytest.approx(value, rel=1e-12)
    model = deciding("x", go=[(0.6, "g", 1.0), (0.4, "d", 1.0)], quit=[(1.0, "d", 1 / 7)])
    problem = CostBudgetedMaxProb(model, "x", 0.5, give_up)
    value = 0.25 if give_up == "dead_ends" else 0.3
    assert solve(problem).objective == pytest.approx(value)


ROADS = model_of(
    {
        "x": {
            "road": [(0.9, "g", 2.0), (0.1, "pit", 1.0)],
            "way": [(1.0, "t", 1.0)],
            "wait": [(1.0, "x", 1.0)],
        },
        "t": {"on": [(0.95, "g", 1.0), (0.05, "pit", 1.0)]},
        "pit": {},
    },
    labels={"pit": ["pit"]},
)


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        ({"a": end_probability("pit") <= -0.05}, {"a"}),
        ({"a": goal_probability() >= 1.04}, {"a"}),
        ({"a": 0.1 * visits("t") - 0.025 <= -0.03}, {"a"}),
        ({"a": end_probability("pit") <= 0.0, "b": end_probability("pit") >= 0.05}, {"a", "b"}),
        ({"a": goal_probability() >= 0.6, "b": failure_probability() >= 0.5}, {"a", "b"}),
        ({"a": failure_probability() <= 0.04}, {"a"}),
        ({"a": secondary_cost({"x": {"road": 1.0}}) <= -1e-9}, {"a"}),
        ({"a": goal_probability() == 0.5, "b": goal_probability() == 0.6}, {"a", "b, at least"}),
    ],
)
@each_method
def test_plain_contradictions_are_named(method: str, limits: dict, named: set[str]) -> None:
    """Beside a limit that is kept; no solver's rounding has a say."""
    every = {"kept": visits("t") <= 3.0, **limits}
    for problem in (
        MaxProb(ROADS, "x", constraints=every),
        MCMP(ROADS, "x", 1.0, constraints=every),
        MCMP(ROADS, "x", 1.0, 0.99, constraints=every),
        S3P(ROADS, "x", 1.0, constraints=every),
        CVaR(ROADS, "x", 0.5, 1.0, constraints=every),
        CostBoundedReach(ROADS, "x", 2, constraints=every),
        LeastQuantity(ROADS, "x", visits("t"), constraints=every, horizon=4),
    ):
        with pytest.raises(InfeasibleError, match=r"at (least|most) \S+ under every") as caught:
            solve(problem, method)
        assert set(caught.value.conflicting_rows) == named


def test_a_bound_may_be_wrong_by_rounding() -> None:
    """A probability of 1 and a bit in the last place is meant to be 1."""
    limits = {"sure": goal_probability() >= 1.0 + 2.0**-52, "none": end_probability("pit") <= 0.0}
    model = deciding("x", go=[(1.0, "g", 1.0)], no=[(1.0, "pit", 0.0)])
    assert solve(MCMP(model, "x", 1.0, constraints=limits)).objective == 1.0


def test_where_terms_cancel_a_limit_is_satisfied_to_the_rounding_of_the_terms():
    """2 (1 - y) - 0.4 y <= 0, where y is the share of what is risky: it is 5/6 and fails in 1/6."""
    sure, risky = {"cost": 0.0, "fuel": 2.0}, {"cost": 0.0, "fuel": 0.0}
    outcomes = {"sure": [(1.0, "g", sure)], "risky": [(0.8, "g", risky), (0.2, "wall", risky)]}
    model = SSP.from_transitions(
        {"s": outcomes}, goal={"g"}, dead_ends={"wall"}, state_labels=WALL, cost="cost"
    )
    kept = secondary_cost("fuel") + 0.5 * visits("s") - 2.0 * end_probability("wall") <= 0.5
    problem = FinitePenalty(model, "s", 6.0, give_up="dead_ends", constraints={"kept": kept})
    for method in ("columns", "lp"):
        solution = solve(problem, method)
        assert solution.objective == pytest.approx(1.0, rel=1e-12)
        assert certify(solution).accepted
