"""Errors name what was probably meant."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from formulations import MCMP, AlphaMCMP, compare_criteria
from small_models import model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    Memory,
    ModelError,
    cross_check,
    end_probability,
    evaluate,
    product,
    secondary_cost,
    simulate,
    solve,
    success_costs,
    trace_frontier,
    visits,
)
from ssp_lp.policies.policy import generator_of

ROAD: dict[Any, Any] = {
    "depot": {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)]},
    "wreck": {},
    (1, 2): {"alley": [(1.0, "home", 1.0)], "road": [(1.0, "home", 1.0)]},
    7: {"alley": [(1.0, "home", 1.0)]},
}
MODEL = model_of(ROAD, "home", labels={"crash": ["wreck"]})
PROBLEM = MCMP(MODEL, "depot", 0.2)
SOLUTION = solve(PROBLEM)


@pytest.mark.parametrize(
    ("asked", "meant"),
    [("deopt", "'depot'"), ("Depot", "'depot'"), ("7", "7"), ("(1,2)", "(1, 2)"), ([1, 2], "(1")],
)
def test_an_unknown_state_has_a_nearest(asked: Any, meant: str) -> None:
    with pytest.raises(ModelError) as caught:
        MODEL.index_of(asked)
    assert f"did you mean {meant}" in str(caught.value)


def test_nothing_near_is_not_guessed() -> None:
    with pytest.raises(ModelError) as caught:
        MODEL.index_of("zzz")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(ModelError, match=r"states are 0 \.\. 1"):
        numbered().index_of(5)


def test_looking_for_the_nearest_is_bounded() -> None:
    n = 300_000
    names = [f"state number {k}" for k in range(n)]
    model = SSP.from_arrays(
        pair_offsets=np.minimum(np.arange(n + 1), n - 1),
        outcome_offsets=np.arange(n),
        successors=np.arange(1, n),
        probabilities=np.ones(n - 1),
        costs=1.0,
        goal_states=[n - 1],
        states=names,
    )
    model.index_of("state number 1")
    began = time.perf_counter()
    with pytest.raises(ModelError, match="did you mean 'state number"):
        model.index_of("state numer 1")
    assert time.perf_counter() - began < 10.0


def test_an_unknown_action_has_a_nearest_or_a_list() -> None:
    with pytest.raises(ModelError, match="did you mean 'alley'"):
        DeterministicPolicy.from_actions(MODEL, {"depot": "aley"})
    with pytest.raises(ModelError, match="it has 'alley', 'road'"):
        DeterministicPolicy.from_actions(MODEL, {(1, 2): "fly"})
    with pytest.raises(ModelError, match="it has none"):
        DeterministicPolicy.from_actions(MODEL, {"wreck": "fly"})
    with pytest.raises(ModelError, match="did you mean 'alley'"):
        limited(secondary_cost({"depot": {"Alley": 1.0}}) <= 1.0)


def limited(limit: Any) -> MCMP:
    return MCMP(MODEL, "depot", constraints={"limit": limit})


def test_unknown_labels_and_ends_have_a_nearest() -> None:
    with pytest.raises(ModelError, match="did you mean 'crash'"):
        limited(visits("crahs") <= 1.0)
    with pytest.raises(ModelError, match="did you mean 'dead_end'"):
        limited(end_probability("dead end") <= 1.0)


def test_a_stranger_among_the_successors_has_a_nearest() -> None:
    with pytest.raises(ModelError, match="did you mean 'home'"):
        SSP.from_transitions({"depot": {"go": [(1.0, "hoem", 1.0)]}}, goal={"home"})


def test_percentages_are_recognised() -> None:
    with pytest.raises(ModelError, match=r"did you mean 0\.05\?"):
        MCMP(MODEL, "depot", failure_budget=5)
    with pytest.raises(ModelError, match=r"did you mean 0\.9\?"):
        AlphaMCMP(MODEL, "depot", 90)
    with pytest.raises(ModelError) as caught:
        MCMP(MODEL, "depot", failure_budget=-0.2)
    assert "did you mean" not in str(caught.value)


def test_rewards_are_recognised() -> None:
    with pytest.raises(ModelError, match=r"state 'a' has a negative cost.*costs=-rewards"):
        SSP.from_transitions({"a": {"go": [(1.0, "b", -1.0)]}}, goal={"b"})


def numbered(probabilities: Any = (0.5, 0.5), **options: Any) -> SSP:
    return SSP.from_arrays(
        pair_offsets=[0, 1, 1],
        outcome_offsets=[0, 2],
        successors=[0, 1],
        probabilities=probabilities,
        costs=1.0,
        goal_states=[1],
        **options,
    )


def test_single_precision_is_divided_out_where_asked() -> None:
    single = np.array([1 / 3, 2 / 3 - 1e-7], dtype=np.float32)
    with pytest.raises(ModelError, match="normalise=True"):
        numbered(single)
    assert numbered(single, normalise=True).probabilities.sum() == pytest.approx(1.0, abs=1e-15)
    table = {"a": {"go": [(1 / 3, "a", 1.0), (0.666667, "g", 1.0)]}}
    with pytest.raises(ModelError, match="normalise=True"):
        SSP.from_transitions(table, goal={"g"})
    for model in (
        SSP.from_transitions(table, goal={"g"}, normalise=True),
        SSP.from_successors("a", table.__getitem__, {"g"}, normalise=True),
    ):
        assert model.probabilities.sum() == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("normalise", [False, True])
def test_what_is_no_rounding_stays_an_error(normalise: bool) -> None:
    with pytest.raises(ModelError, match=r"sum to 0\.9, not to 1$"):
        numbered([0.4, 0.5], normalise=normalise)


def test_a_model_is_no_problem_and_a_solution_no_policy() -> None:
    policy = SOLUTION.policy
    with pytest.raises(ModelError, match=r"solve takes a problem, such as MCMP\(model"):
        solve(MODEL)  # type: ignore[arg-type]
    for question in (trace_frontier, cross_check):
        with pytest.raises(ModelError, match="takes a problem"):
            question(MODEL)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="MCMP takes an SSP first"):
        MCMP("depot", MODEL)  # type: ignore[arg-type]
    for verb in (evaluate, success_costs):
        with pytest.raises(ModelError, match=r"takes a policy: pass solution\.policy"):
            verb(SOLUTION, PROBLEM)  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="takes a problem"):
            verb(policy, MODEL)  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="takes a policy, such as"):
            verb({"depot": "alley"}, PROBLEM)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=r"pass solution\.policy"):
        simulate(SOLUTION, PROBLEM, seed=0)  # type: ignore[arg-type]


def test_a_policy_of_a_product_is_recognised() -> None:
    task = product(MODEL, Memory(start=0, update=lambda kept, *step: kept))
    plan = solve(MCMP(task, task.start("depot"), 0.2))
    with pytest.raises(ModelError, match="on_original"):
        evaluate(plan.policy, PROBLEM)


def test_a_seed_is_a_generator() -> None:
    by_seed = simulate(SOLUTION.policy, PROBLEM, seed=3, episodes=500)
    by_generator = simulate(SOLUTION.policy, PROBLEM, seed=np.random.default_rng(3), episodes=500)
    assert by_seed.ends == by_generator.ends
    assert SOLUTION.policy.start(0).action("depot") == "alley"
    given = np.random.default_rng(1)
    assert generator_of(given) is given
    for wrong in (-1, 0.5, "0", True, None):
        with pytest.raises(ModelError, match="seed must be a number such as 0"):
            generator_of(wrong)  # type: ignore[arg-type]


def test_values_by_name_have_a_nearest_name() -> None:
    problem = MCMP(MODEL, "depot", 0.2, constraints={"fuel": secondary_cost({}) <= 1.0})
    solution = solve(problem)
    report = simulate(solution.policy, problem, seed=0, episodes=5)
    for values, slip, meant in (
        (solution.prices, "feul", "'fuel'"),
        (solution.secondary_costs, "Fuel", "'fuel'"),
        (solution.evaluation.ends, "crahs", "'crash'"),
        (report.ends, "unfinishd", "'unfinished'"),
        (problem.program().solve().duals, "failur", "'failure'"),
        (problem.program().solve().activity, "fule", "'fuel'"),
        (compare_criteria(MODEL, "depot", penalties=()), "MaxProp", "'MaxProb'"),
    ):
        with pytest.raises(KeyError, match=f"did you mean {meant}"):
            values[slip]
    with pytest.raises(KeyError, match=r"there are 'f(ailure|uel)'"):
        solution.prices["zzz"]
    assert solution.prices.get("zzz") is None


def test_a_goal_that_no_action_leads_to_may_be_misspelt() -> None:
    table = {"depot": {"road": [(1.0, "home", 1.0)]}}
    with pytest.raises(ModelError, match="no action leads to the goal 'Home'; did you mean 'home'"):
        SSP.from_transitions(table, goal={"Home"}, treat_actionless_as_dead_ends=True)
    far = SSP.from_transitions({**table, "home": {"stay": [(1.0, "home", 1.0)]}}, goal={"moon"})
    assert far.goal_mask.sum() == 1  # nothing reads like it: out of reach


def test_successors_that_are_not_listed_are_dead_ends_where_these_need_no_actions() -> None:
    table = {"depot": {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)]}}
    model = SSP.from_transitions(table, goal={"home"}, treat_actionless_as_dead_ends=True)
    assert solve(MCMP(model, "depot", 0.1)).objective == pytest.approx(3.8, rel=1e-12)
    with pytest.raises(ModelError, match="'wreck', which is neither a state of the model nor a"):
        SSP.from_transitions(table, goal={"home"})


def test_a_label_of_goals_is_a_way_to_end_and_one_of_places_on_the_way_is_none() -> None:
    table = {
        "depot": {
            "alley": [(0.5, "home", 1.0), (0.4, "inn", 1.0), (0.1, "wreck", 1.0)],
            "road": [(1.0, "home", 3.0)],
        },
        "wreck": {},
    }
    labels = {"cosy": ["inn"], "begun": ["depot"]}
    model = SSP.from_transitions(
        table, goal={"home", "inn"}, state_labels=labels, treat_actionless_as_dead_ends=True
    )
    few = {"few": end_probability("cosy") <= 0.1}
    assert solve(MCMP(model, "depot", 1.0, constraints=few)).objective == pytest.approx(2.5)
    with pytest.raises(
        ModelError, match="no episode ends in a state labelled 'begun': take visits"
    ):
        solve(MCMP(model, "depot", 1.0, constraints={"few": end_probability("begun") <= 0.1}))


def test_a_budget_that_is_spent_by_giving_up_is_told_of() -> None:
    table = {"depot": {"road": [(1.0, "home", 3.0)], "wait": [(1.0, "depot", 1.0)]}}
    model = SSP.from_transitions(table, goal={"home"})
    assert "give_up='dead_ends' forbids it" in solve(MCMP(model, "depot", 0.2)).summary()
    assert "giving up" not in solve(MCMP(model, "depot", 0.2, give_up="dead_ends")).summary()
