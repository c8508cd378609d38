"""Worst cases over boxes against an enumeration of the corners of every box."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ssp_lp import (
    MCMP,
    S3P,
    SSP,
    Boxes,
    DeterministicPolicy,
    FinitePenalty,
    MaxProb,
    MinCost,
    MixedPolicy,
    ModelError,
    StochasticPolicy,
    evaluate,
    visits,
)
from tests.support.boxes import corners_of, drawn_boxes

LABELLED = {"pit": ["pit"]}


def first_actions(model, rng):
    """A policy that takes a random action in every state."""
    pairs = [int(rng.integers(a, b)) if b > a else -1 for a, b in pairwise(model.pair_offsets)]
    return DeterministicPolicy(model, np.array(pairs))


@pytest.mark.parametrize("seed", range(8))
def test_worst_cases_are_those_of_the_worst_corners(seed):
    """Interior models approach their corners, where the goal is not lost by a probability of 0."""
    rng = np.random.default_rng(seed)
    boxes = drawn_boxes(rng, labels=LABELLED, most_actions=1 + seed % 2)
    policy = first_actions(boxes.model, rng)
    problems = [
        MCMP(boxes.model, "a", 1.0, give_up="dead_ends", charge_failing_step=False),
        FinitePenalty(boxes.model, "a", 7.0),
        MaxProb(boxes.model, "a"),
    ]
    if seed % 2 == 0:  # else the charge of failing depends on pairs that the policy does not take
        problems.append(MCMP(boxes.model, "a", 1.0))
    used = policy.decision[policy.decision >= 0].tolist()
    models = [*corners_of(boxes, used)]
    for problem in problems:
        worst = evaluate(policy, problem, box=boxes)
        assert worst.is_exact
        own = [evaluate(replace(policy, model=m), replace(problem, model=m)) for m in models]
        greatest = {
            "failure_probability": max(e.failure_probability for e in own),
            "expected_cost": max(e.expected_cost for e in own),
        }
        objective = [e.objective for e in own]
        greatest["objective"] = (
            min(objective) if problem.semantics.aim == "greatest_goal" else max(objective)
        )
        for name, value in greatest.items():
            assert getattr(worst, name) == pytest.approx(value, rel=1e-8, abs=1e-10), name
        for name in ("pit", "dead_end", "gave_up", "wandering"):
            assert worst.ends[name] == pytest.approx(max(e.ends[name] for e in own), abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_where_outcomes_may_be_ruled_out_the_inside_of_the_boxes_approaches_the_worst_case(seed):
    """At a corner the goal may be lost, and failing is declared at once; beside it never."""
    rng = np.random.default_rng(1000 + seed)
    boxes = drawn_boxes(rng, zeros=True, labels=LABELLED, most_actions=1)
    policy = first_actions(boxes.model, rng)
    models = [*corners_of(boxes, range(boxes.model.n_pairs))]
    far = MCMP(boxes.model, "a", 1.0, give_up="dead_ends", charge_failing_step=False)
    for problem in (far, FinitePenalty(boxes.model, "a", 7.0)):
        worst = evaluate(policy, problem, box=boxes)
        at_corners, beside = [], []
        for m in models:
            at_corners.append(evaluate(replace(policy, model=m), replace(problem, model=m)))
            mixed = (1.0 - 1e-6) * m.probabilities + 1e-6 * boxes.model.probabilities
            near = replace(m, probabilities=mixed)
            beside.append(evaluate(replace(policy, model=near), replace(problem, model=near)))
        failure = max(e.failure_probability for e in at_corners)
        assert worst.failure_probability == pytest.approx(failure, abs=1e-9)
        cost = max(e.expected_cost for e in beside)
        if worst.expected_cost == np.inf:
            assert cost > 1e4
        else:
            assert cost == pytest.approx(worst.expected_cost, rel=1e-3, abs=1e-3)
        either = max(e.objective for e in [*beside, *at_corners])
        if problem is far:
            assert worst.objective == worst.expected_cost
        elif worst.objective < np.inf:
            assert either == pytest.approx(worst.objective, rel=1e-3, abs=1e-3)


def test_mixed_policies_have_bounds_and_randomised_ones_are_exact():
    rng = np.random.default_rng(7)
    boxes = drawn_boxes(rng, labels=LABELLED)
    problem = MaxProb(boxes.model, "a")
    members = first_actions(boxes.model, rng), first_actions(boxes.model, rng)
    each = [evaluate(one, problem, box=boxes) for one in members]
    lottery = evaluate(MixedPolicy(members, np.array([0.3, 0.7])), problem, box=boxes)
    assert not lottery.is_exact
    mean = 0.3 * each[0].failure_probability + 0.7 * each[1].failure_probability
    assert lottery.failure_probability == pytest.approx(mean)
    assert "bounds" in str(lottery)
    model, names = boxes.model, range(boxes.model.n_states)
    acts = {
        model.states[k]: {
            model.action_of(pair): 1.0 / len(model.pairs_of(k)) for pair in model.pairs_of(k)
        }
        for k in names
        if len(model.pairs_of(k))
    }
    drawn = StochasticPolicy.from_actions(model, acts)
    worst = evaluate(drawn, problem, box=boxes)
    assert worst.is_exact
    own = [
        evaluate(StochasticPolicy.from_actions(m, acts), replace(problem, model=m))
        for m in corners_of(boxes, range(model.n_pairs))
    ]
    assert worst.failure_probability == pytest.approx(max(e.failure_probability for e in own))


def test_failing_forbidden_costs_infinity_where_the_boxes_allow_it():
    moves = {
        "go": [(0.9, "home", 1.0), (0.1, "pit", 1.0)],
        "wait": [(0.5, "a", 1.0), (0.5, "home", 1.0)],
    }
    model = SSP.from_transitions({"a": moves, "pit": {}}, {"home"}, dead_ends={"pit"})
    boxes = Boxes(model, [0.5, 0.0, 0.2, 0.2], [1.0, 0.5, 0.8, 0.8])
    problem = MinCost(model, "a")
    wait, go = (DeterministicPolicy.from_actions(model, {"a": name}) for name in ("wait", "go"))
    worst = evaluate(wait, problem, box=boxes)
    assert worst.expected_cost == pytest.approx(5.0)
    assert worst.failure_probability == 0.0
    assert evaluate(go, problem, box=boxes).objective == np.inf


def test_a_worst_case_of_boxes_without_width_is_the_evaluation():
    boxes = drawn_boxes(np.random.default_rng(3))
    p = boxes.model.probabilities
    narrow, policy = Boxes(boxes.model, p, p), first_actions(boxes.model, np.random.default_rng(3))
    problem = FinitePenalty(boxes.model, "a", 5.0)
    worst, own = evaluate(policy, problem, box=narrow), evaluate(policy, problem)
    assert worst.objective == pytest.approx(own.objective)
    assert worst.expected_cost == pytest.approx(own.expected_cost)
    assert sum(worst.ends.values()) == pytest.approx(own.failure_probability)


def test_measures_without_a_worst_case_are_refused_by_name():
    boxes = drawn_boxes(np.random.default_rng(4))
    model, policy = boxes.model, first_actions(boxes.model, np.random.default_rng(4))
    worst = evaluate(policy, MaxProb(model, "a"), box=boxes)
    assert "need not occur together" in str(worst)
    with pytest.raises(ModelError, match="may be far above it"):
        _ = worst.conditional_cost
    for problem, words in (
        (S3P(model, "a", 1.0), "given success"),
        (MCMP(model, "a", 1.0, horizon=3), "a horizon"),
        (MCMP(model, "a", 1.0, discount=0.9), "a discount"),
        (MCMP(model, "a", 1.0, constraints={"few": visits("a") <= 2.0}), "constraints"),
        (MaxProb(drawn_boxes(np.random.default_rng(5)).model, "a"), "another model"),
    ):
        with pytest.raises(ModelError, match=words):
            evaluate(policy, problem, box=boxes)
