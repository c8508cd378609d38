"""Robust optima against an enumeration of policies and of the corners of the boxes."""

from dataclasses import replace

import numpy as np
import pytest

from ssp_lp import (
    MCMP,
    SSP,
    Boxes,
    DeterministicPolicy,
    FinitePenalty,
    InfeasibleError,
    MaxProb,
    MinCost,
    ModelError,
    certify,
    evaluate,
    simulate,
    solve,
    tighten,
    visits,
)
from tests.support.boxes import corners_of, drawn_boxes, policies_of, stopping_policies


def worst_objective(policy, problem, boxes):
    """Worst objective of a policy over the corners of its pairs."""
    used = policy.decision[policy.decision >= 0].tolist()
    return max(
        (evaluate(replace(policy, model=m), replace(problem, model=m)).objective
         for m in corners_of(boxes, used)),
        key=lambda value: -value if problem.aim == "greatest_goal" else value,
    )  # fmt: skip


@pytest.mark.parametrize("zeros", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_the_robust_optimum_is_the_best_of_all_policies_at_their_worst_corners(seed, zeros):
    boxes = drawn_boxes(np.random.default_rng(seed), zeros=zeros, n_states=2 + seed % 2)
    model = boxes.model
    for problem in (MaxProb(model, "a"), FinitePenalty(model, "a", 6.0), MinCost(model, "a")):
        may_give_up = isinstance(problem, FinitePenalty)
        values = [
            evaluate(policy, problem, box=boxes).objective
            if zeros
            else worst_objective(policy, problem, boxes)
            for policy in policies_of(model, may_give_up=may_give_up)
        ]
        best = max(values) if isinstance(problem, MaxProb) else min(values)
        asked = replace(problem, box=boxes)
        if best == np.inf:
            with pytest.raises(InfeasibleError, match="all probabilities in the boxes") as error:
                solve(asked)
            greatest = solve(MaxProb(model, "a", box=boxes)).objective
            assert error.value.least_failure == pytest.approx(1.0 - greatest)
            continue
        solution = solve(asked)
        assert solution.objective == pytest.approx(best, rel=1e-8, abs=1e-10)
        assert solution.gap <= 1e-9
        worst = evaluate(solution.policy, problem, box=boxes)
        assert worst.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
        own = evaluate(solution.policy, solution.problem)
        assert own.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("charged", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_failing_at_attention_states_is_robust_too(seed, charged):
    rng = np.random.default_rng(300 + seed)
    boxes = drawn_boxes(rng, n_states=2 + seed % 2, even=True)
    given = {"give_up": "attention", "charge_failing_step": charged}
    problem = FinitePenalty(boxes.model, "a", 5.0, **given)
    best = min(
        evaluate(policy, problem, box=boxes).objective for policy in stopping_policies(boxes.model)
    )
    solution = solve(replace(problem, box=boxes))
    assert solution.objective == pytest.approx(best, rel=1e-8, abs=1e-10)
    assert solution.gap <= 1e-9


def test_the_bound_counts_costs_where_nature_alone_makes_a_dead_end():
    model = SSP.from_transitions(
        {
            "road": {"go": [(0.2, "home", 2.0), (0.2, "ditch", 2.0), (0.6, "road", 2.0)]},
            "ditch": {},
        },
        goal={"home"},
        dead_ends={"ditch"},
    )
    boxes = Boxes(model, [0.0, 0.1, 0.0], [1.0, 1.0, 0.8])
    solution = solve(FinitePenalty(model, "road", 5.0, give_up="attention", box=boxes))
    assert solution.objective == pytest.approx(2.0 / 0.2 + 5.0)
    assert solution.gap <= 1e-8
    assert certify(solution).accepted
    inside = solution.problem.model.probabilities
    assert (boxes.low <= inside).all()
    assert (inside <= boxes.high).all()


@pytest.mark.parametrize("first", ["push", "tow"])
def test_an_action_that_nature_can_repeat_for_ever_is_avoided(first):
    ways = {"push": [(0.5, "home", 1.0), (0.5, "mud", 1.0)], "tow": [(1.0, "home", 4.0)]}
    actions = {name: ways[name] for name in sorted(ways, reverse=first == "tow")}
    model = SSP.from_transitions({"mud": actions}, goal={"home"})
    sure = model.probabilities == 1.0
    boxes = Boxes(model, sure.astype(float), np.ones(3))
    problem = FinitePenalty(model, "mud", 9.0, give_up="attention", box=boxes)
    assert solve(problem).objective == pytest.approx(4.0)
    assert tighten(MCMP(model, "mud", failure_budget=0.0), boxes).objective == pytest.approx(4.0)


def test_a_free_action_that_nature_can_repeat_for_ever_fails_at_worst():
    ways = {"tow": [(1.0, "home", 9.0)], "wait": [(0.5, "home", 0.0), (0.5, "mud", 0.0)]}
    model = SSP.from_transitions({"mud": ways}, goal={"home"})
    boxes = Boxes(model, [1.0, 0.0, 0.0], np.ones(3))
    problem = FinitePenalty(model, "mud", 4.0, give_up="attention")
    solution = solve(replace(problem, box=boxes))
    assert solution.policy.action("mud") == "wait"
    assert solution.objective == pytest.approx(4.0)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("seed", range(12))
def test_larger_problems_close_their_gap(seed):
    rng = np.random.default_rng(100 + seed)
    boxes = drawn_boxes(rng, zeros=bool(seed % 2), n_states=6, most_actions=3)
    for problem in (
        MaxProb(boxes.model, "a", box=boxes),
        FinitePenalty(boxes.model, "a", 9.0, box=boxes),
    ):
        solution = solve(problem)
        assert solution.gap <= 1e-9
        free = solve(replace(problem, box=None))
        better = free.objective - solution.objective
        assert better >= -1e-9 if isinstance(problem, MaxProb) else better <= 1e-9


ROAD = SSP.from_transitions(
    {
        "road": {
            "fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
            "safe": [(0.5, "home", 3.0), (0.5, "road", 1.0)],
            "wait": [(1.0, "road", 0.0)],
        },
        "ditch": {},
    },
    goal={"home"},
    dead_ends={"ditch"},
)
LOW, HIGH = [0.7, 0.0, 0.25, 0.5, 1.0], [1.0, 0.3, 0.5, 0.75, 1.0]


def test_closed_forms():
    boxes = Boxes(ROAD, LOW, HIGH)
    cost = 1.5 / 0.25  # safe: 3 with 1/4, 1 with 3/4 a try
    surely = solve(MinCost(ROAD, "road", box=boxes))
    assert surely.objective == pytest.approx(cost)
    assert surely.policy.action("road") == "safe"
    priced = solve(FinitePenalty(ROAD, "road", 10.0, box=boxes))
    assert priced.objective == pytest.approx(1.0 + 0.3 * 10.0)
    assert priced.failure_probability == pytest.approx(0.3)
    assert solve(MaxProb(ROAD, "road", box=boxes)).objective == pytest.approx(1.0)
    free = Boxes(ROAD, [0.7, 0.0, 0.0, 0.0, 1.0], [1.0, 0.3, 1.0, 1.0, 1.0])
    assert solve(MaxProb(ROAD, "road", box=free)).objective == pytest.approx(0.7)
    with pytest.raises(InfeasibleError, match="road") as error:
        solve(MinCost(ROAD, "road", box=free))
    assert error.value.least_failure == pytest.approx(0.3)


def test_the_solution_is_that_of_an_ordinary_problem_at_the_worst_probabilities():
    boxes = Boxes(ROAD, LOW, HIGH)
    solution = solve(FinitePenalty(ROAD, "road", 10.0, box=boxes))
    at_worst = solution.problem
    assert at_worst.box is None
    assert (boxes.low - 1e-15 <= at_worst.model.probabilities).all()
    assert (at_worst.model.probabilities <= boxes.high + 1e-15).all()
    assert certify(solution).accepted
    assert "at the worst probabilities" in str(solution.summary())
    runs = simulate(solution.policy, at_worst, episodes=2_000, seed=0)
    assert runs.failure_probability.value == pytest.approx(0.3, abs=0.05)


def test_boxes_without_width_change_nothing():
    p = ROAD.probabilities
    boxes = Boxes(ROAD, p, p)
    for problem in (MaxProb(ROAD, "road"), MinCost(ROAD, "road"), FinitePenalty(ROAD, "road", 3.0)):
        robust = solve(replace(problem, box=boxes))
        assert robust.objective == pytest.approx(solve(problem).objective)


def test_the_time_limit_is_kept_as_without_boxes():
    problem = MaxProb(ROAD, "road", box=Boxes(ROAD, LOW, HIGH))
    assert solve(problem, time_limit=9).run.time_limit == 9
    with pytest.raises(ModelError, match="time_limit"):
        solve(problem, time_limit=-1)


def test_wrong_questions_are_refused_by_name():
    boxes = Boxes(ROAD, LOW, HIGH)
    with pytest.raises(ModelError, match="another model"):
        MaxProb(SSP.from_transitions({"road": {"go": [(1.0, "b", 1.0)]}}, {"b"}), "road", box=boxes)
    own = SSP.from_transitions({"a": {"go": [(1.0, "home", 1.0)]}}, {"home"})
    for here, name in (("b", "go"), ("a", "run")):
        other = SSP.from_transitions({here: {name: [(1.0, "home", 1.0)]}}, {"home"})
        with pytest.raises(ModelError, match="another model"):
            MaxProb(other, here, box=Boxes(own, [1.0], [1.0]))
    with pytest.raises(ModelError, match="must be Boxes"):
        MaxProb(ROAD, "road", box=0.1)
    with pytest.raises(ModelError, match="constraints"):
        MaxProb(ROAD, "road", box=boxes, constraints={"few": visits("road") <= 2.0})
    with pytest.raises(ModelError, match="a horizon"):
        MinCost(ROAD, "road", box=boxes, horizon=4)
    with pytest.raises(ModelError, match="does not support give_up='dead_ends'"):
        FinitePenalty(ROAD, "road", 3.0, give_up="dead_ends", box=boxes)
    with pytest.raises(ModelError, match="use charge_failing_step=False"):
        FinitePenalty(ROAD, "road", 3.0, charge_failing_step=True, box=boxes)
    with pytest.raises(ModelError, match="box"):
        MCMP(ROAD, "road", 0.1, box=boxes)
    problem = MaxProb(ROAD, "road", box=boxes)
    policy = DeterministicPolicy.from_actions(ROAD, {"road": "fast"})
    assert evaluate(policy, problem, box=boxes).goal_probability == pytest.approx(0.7)
    with pytest.raises(ModelError, match="one choice of probabilities"):
        evaluate(policy, problem)
    for ask in (problem.compile, problem.program):
        with pytest.raises(ModelError, match="boxes"):
            ask()
