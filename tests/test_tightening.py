"""Budgets that hold over boxes, beside all policies, all corners and linear programs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from ssp_lp import (
    MCMP,
    S3P,
    SSP,
    Boxes,
    FinitePenalty,
    InfeasibleError,
    MaxProb,
    ModelError,
    evaluate,
    solve,
    tighten,
    visits,
)
from tests.support.boxes import corners_of, drawn_boxes, policies_of, stopping_policies


def least_mean(cost, failure, budget):
    """Least mean cost of a lottery whose mean failure is within a budget."""
    found = linprog(cost, A_ub=[failure], b_ub=[budget], A_eq=np.ones((1, len(cost))), b_eq=[1.0])
    return found.fun


@pytest.mark.parametrize("how", ["anywhere", "attention", "charged"])
@pytest.mark.parametrize("seed", range(12))
def test_no_lottery_over_worst_values_is_better_and_no_bound_is_above_any(seed, how):
    rng = np.random.default_rng(seed)
    boxes = drawn_boxes(rng, n_states=2, even=how == "charged", most_actions=2 + seed % 2)
    model = boxes.model
    given = {"give_up": "anywhere" if how == "anywhere" else "attention"}
    stated = {**given, "charge_failing_step": how == "charged"}
    least = 1.0 - solve(MaxProb(model, "a", box=boxes)).objective
    problem = MCMP(model, "a", failure_budget=least + 0.3 * rng.random() * (1.0 - least), **stated)
    best = best_of_all(boxes, problem, how)
    found = tighten(problem, boxes)
    assert found.objective >= best - 1e-9
    assert found.lower_bound <= best + 1e-9
    # one nature for all policies: no lottery does better against all of its corners
    corners = [*corners_of(boxes, range(model.n_pairs))] if model.n_pairs <= 4 else []
    for corner in corners[:200]:
        own = solve(replace(problem, model=corner))
        assert own.objective <= found.objective + 1e-9
        assert found.failure_probability <= problem.failure_budget + 1e-12
        real = evaluate(replace_model(found.policy, corner), replace(problem, model=corner))
        assert real.objective <= found.objective + 1e-9
        assert real.failure_probability <= found.failure_probability + 1e-9
    for price in (1.0, 4.0, 20.0):
        robust = solve(FinitePenalty(model, "a", price, box=boxes, **stated)).objective
        assert robust - price * problem.failure_budget <= best + 1e-8


@pytest.mark.parametrize("seed", [86, 152, 315, 549, 683, 687])
def test_plans_priced_at_one_nature_are_not_the_best_for_two(seed):
    """Draws in which the best plans at one nature for cost and failure were up to 58 % worse."""
    rng, how = np.random.default_rng(1000 + seed), ["anywhere", "attention", "charged"][seed % 3]
    small = seed % 5 > 0
    boxes = drawn_boxes(
        rng,
        n_states=2 if small else 3,
        zeros=seed % 4 == 0,
        even=how == "charged",
        most_actions=2 + seed % 2 * small,
    )
    stated = {
        "give_up": "anywhere" if how == "anywhere" else "attention",
        "charge_failing_step": how == "charged",
    }
    least = 1.0 - solve(MaxProb(boxes.model, "a", box=boxes)).objective
    budget = least + 0.3 * rng.random() * (1.0 - least)
    problem = MCMP(boxes.model, "a", failure_budget=budget, **stated)
    best = best_of_all(boxes, problem, how)
    assert tighten(problem, boxes).objective == pytest.approx(best, rel=1e-9)


def best_of_all(boxes, problem, how):
    """The least mean cost of a lottery over all plans, each at its own worst values."""
    every = (
        policies_of(boxes.model, may_give_up=True)
        if how == "anywhere"
        else stopping_policies(boxes.model)
    )
    figures = [evaluate(policy, problem, box=boxes) for policy in every]
    cost = np.array([one.objective for one in figures])
    failure = np.array([one.failure_probability for one in figures])
    kept = np.isfinite(cost)
    return least_mean(cost[kept], failure[kept], problem.failure_budget)


def test_states_that_nature_never_leaves_are_avoided():
    """Through the bog a run may never end, at a cost: the lottery mixes the other ways."""
    ways = {
        "fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        "safe": [(1.0, "home", 3.0)],
        "short": [(0.9, "home", 0.5), (0.1, "bog", 0.5)],
    }
    bog = {"try": [(0.5, "home", 1.0), (0.5, "bog", 1.0)]}
    model = SSP.from_transitions(
        {"road": ways, "bog": bog, "ditch": {}}, {"home"}, dead_ends={"ditch"}
    )
    low = np.array([0.8, 0.0, 1.0, 0.8, 0.0, 0.0, 0.0])
    boxes = Boxes(model, low, [1.0, 0.2, 1.0, 1.0, 0.2, 1.0, 1.0])
    found = tighten(MCMP(model, "road", failure_budget=0.05), boxes)
    assert found.objective == pytest.approx(0.25 * 1.0 + 0.75 * 3.0)
    assert found.failure_probability == pytest.approx(0.05)
    assert found.lower_bound <= found.objective
    dear = FinitePenalty(model, "road", 100.0, box=boxes)
    assert solve(dear).objective == pytest.approx(3.0)
    refused = MCMP(model, "bog", failure_budget=0.5)
    with pytest.raises(ModelError, match="state 'bog': the boxes allow probabilities with which"):
        tighten(refused, boxes)
    narrow = {**ways, "safe": [(0.5, "home", 3.0), (0.5, "ditch", 3.0)]}
    model = SSP.from_transitions(
        {"road": narrow, "bog": bog, "ditch": {}}, {"home"}, dead_ends={"ditch"}
    )
    some = np.array([0.8, 0.0, 0.3, 0.3, 0.8, 0.0, 0.0, 0.0])
    boxes = Boxes(model, some, [1.0, 0.2, 0.7, 0.7, 1.0, 0.2, 1.0, 1.0])
    with pytest.raises(
        InfeasibleError, match="every policy of finite worst cost fails with probab"
    ):
        tighten(MCMP(model, "road", failure_budget=0.1), boxes)
    free = {"try": [(0.5, "home", 0.0), (0.5, "bog", 0.0)]}
    model = SSP.from_transitions(
        {"road": ways, "bog": free, "ditch": {}}, {"home"}, dead_ends={"ditch"}
    )
    boxes = Boxes(model, low, [1.0, 0.2, 1.0, 1.0, 0.2, 1.0, 1.0])
    with pytest.raises(ModelError, match="a run never ends"):
        tighten(MCMP(model, "road", failure_budget=0.1), boxes)


def replace_model(lottery, model):
    """The same lottery on a model with other probabilities."""
    members = tuple(replace(member, model=model) for member in lottery.policies)
    return replace(lottery, policies=members)


ROAD = SSP.from_transitions(
    {
        "road": {
            "fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
            "safe": [(1.0, "home", 3.0)],
        },
        "ditch": {},
    },
    goal={"home"},
    dead_ends={"ditch"},
)
BOXES = Boxes(ROAD, low=[0.8, 0.0, 1.0], high=[1.0, 0.2, 1.0])


def test_closed_forms():
    found = tighten(MCMP(ROAD, "road", failure_budget=0.05), BOXES)
    assert found.objective == pytest.approx(0.25 * 1.0 + 0.75 * 3.0)
    assert found.failure_price == pytest.approx(2.0 / 0.2)
    assert found.failure_probability == pytest.approx(0.05)
    assert found.gap <= 1e-9
    assert evaluate(found.policy, MCMP(ROAD, "road", failure_budget=0.05)).failure_probability == (
        pytest.approx(0.025)
    )
    narrow = Boxes(ROAD, ROAD.probabilities, ROAD.probabilities)
    problem = MCMP(ROAD, "road", failure_budget=0.05)
    assert tighten(problem, narrow).objective == pytest.approx(solve(problem).objective)
    assert "lower bound 2.5" in repr(found)


def test_a_budget_of_the_least_failure_is_feasible_up_to_rounding():
    ditch = {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)]}, "ditch": {}}
    only = SSP.from_transitions(ditch, goal={"home"}, dead_ends={"ditch"})
    boxes = Boxes(only, [0.5, 0.0], [1.0, 0.3])
    found = tighten(MCMP(only, "road", failure_budget=0.3 - 5e-11), boxes)
    assert found.objective == found.lower_bound == pytest.approx(1.0)
    assert found.failure_probability == pytest.approx(0.3)


def test_plans_decide_in_states_that_nature_turns_into_dead_ends():
    model = SSP.from_transitions(
        {
            "road": {
                "fast": [(0.5, "home", 1.0), (0.5, "swamp", 1.0)],
                "safe": [(1.0, "home", 3.0)],
            },
            "swamp": {"wade": [(0.5, "home", 1.0), (0.5, "ditch", 1.0)]},
            "ditch": {},
        },
        goal={"home"},
        dead_ends={"ditch"},
    )
    boxes = Boxes(model, [0.5, 0.5, 1.0, 0.0, 0.0], [0.5, 0.5, 1.0, 1.0, 1.0])
    found = tighten(MCMP(model, "road", failure_budget=0.4), boxes)
    assert found.objective == pytest.approx(0.8 * 1.5 + 0.2 * 3.0)
    assert found.failure_probability == pytest.approx(0.4)
    assert found.gap <= 1e-8


def test_the_model_itself_may_lie_outside_the_boxes():
    """At its own probabilities no plan satisfies the budget; in the boxes walking does."""
    ways = {
        "go": [(0.5, "home", 1.0), (0.5, "ditch", 1.0)],
        "walk": [(0.6, "home", 3.0), (0.4, "ditch", 3.0)],
    }
    model = SSP.from_transitions({"road": ways, "ditch": {}}, {"home"}, dead_ends={"ditch"})
    boxes = Boxes(model, low=[0.7, 0.0, 0.9, 0.0], high=[1.0, 0.3, 1.0, 0.1])
    plan = tighten(MCMP(model, "road", failure_budget=0.2), boxes)
    assert plan.objective == pytest.approx(2.0)  # half of the runs go: 0.5 * 0.3 + 0.5 * 0.1 = 0.2
    assert plan.lower_bound == pytest.approx(2.0)


def test_what_is_not_supported_is_refused_by_name():
    only = SSP.from_transitions(
        {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)]}, "ditch": {}},
        goal={"home"},
        dead_ends={"ditch"},
    )
    with pytest.raises(InfeasibleError, match="at some probabilities in the boxes") as error:
        tighten(MCMP(only, "road", failure_budget=0.1), Boxes(only, [0.5, 0.0], [1.0, 0.3]))
    assert error.value.least_failure == pytest.approx(0.3)
    problem = MCMP(ROAD, "road", failure_budget=0.05)
    for other in (
        MCMP(ROAD, "road", failure_budget=None),
        MCMP(ROAD, "road", reach_fraction=0.9),
        FinitePenalty(ROAD, "road", 3.0),
    ):
        with pytest.raises(ModelError, match="takes MCMP with a failure budget"):
            tighten(other, BOXES)
    with pytest.raises(ModelError, match="cost given success"):
        tighten(S3P(ROAD, "road", failure_budget=0.05), BOXES)
    with pytest.raises(ModelError, match="constraints"):
        tighten(replace(problem, constraints={"few": visits("road") <= 2.0}), BOXES)
    with pytest.raises(ModelError, match="tolerance must lie strictly between 0 and 1"):
        tighten(problem, BOXES, tolerance=-1.0)
    with pytest.raises(ModelError, match="must be Boxes"):
        tighten(problem, 0.1)
    trap = SSP.from_transitions(
        {"road": {"try": [(0.5, "home", 1.0), (0.5, "road", 1.0)]}}, goal={"home"}
    )
    boxes = Boxes(trap, [0.0, 0.0], [1.0, 1.0])
    with pytest.raises(ModelError, match="a run never ends"):
        tighten(MCMP(trap, "road", failure_budget=1.0), boxes)
