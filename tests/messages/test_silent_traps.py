"""What is misspelled, missing or silently assumed is named before it changes an answer."""

import pickle
import warnings

import pytest

from formulations import MCMP, S3P, CVaR, MaxProb
from refusing import refused
from small_models import ROUTES
from ssp_lp import (
    SSP,
    MixedPolicy,
    ModelWarning,
    arrival_cost,
    cross_check,
    evaluate,
    expected_cost,
    goal_probability,
    secondary_cost,
    simulate,
    solve,
    trace_frontier,
    visits,
)

DEPOT = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends={"wreck"})
PROBLEM = MCMP(DEPOT, "depot", failure_budget=0.05)
MISSPELLED = {**ROUTES, "alley": [(0.90, "hoem", 4.0), (0.10, "wreck", 2.0)]}
COLUMNS = [
    ("depot", action, to, chance, cost)
    for action, outcomes in MISSPELLED.items()
    for chance, to, cost in outcomes
]
TABLE = dict(
    zip(
        ("state", "action", "successor", "probability", "cost"),
        map(list, zip(*COLUMNS, strict=True)),
        strict=True,
    )
)


@pytest.mark.parametrize("dead_ends", [{"wreck"}, ["wreck"], lambda state: state == "wreck"])
def test_listed_dead_ends_are_the_only_ones(dead_ends):
    model = SSP.from_transitions({"depot": ROUTES}, goal={"home"}, dead_ends=dead_ends)
    assert solve(MCMP(model, "depot", failure_budget=0.05)).objective == pytest.approx(20 / 3)
    words = "'hoem', where action 'alley' of state 'depot' leads.*did you mean 'home'"
    options = {"goal": {"home"}, "dead_ends": dead_ends}
    refused(words, SSP.from_transitions, {"depot": MISSPELLED}, **options)
    refused(words, SSP.from_frame, TABLE, **options)
    refused(words, SSP.from_successors, "depot", {"depot": MISSPELLED, "wreck": {}, "hoem": {},
            "home": {}}.__getitem__, **options)  # fmt: skip


def test_dead_ends_of_arrays_are_given_by_labels():
    arrays = {
        "pair_offsets": [0, 1, 1, 1],
        "outcome_offsets": [0, 2],
        "successors": [1, 2],
        "probabilities": [0.5, 0.5],
        "costs": 1.0,
        "goal_states": [1],
    }
    assert SSP.from_arrays(**arrays, dead_ends=[2]).n_states == 3
    named = arrays | {"states": ["a", "home", "wreck"]}
    assert SSP.from_arrays(**named, dead_ends={"wreck"}).n_states == 3
    refused("state 'wreck', where .* neither a goal nor", SSP.from_arrays, **named, dead_ends=())
    refused("did you mean 'wreck'", SSP.from_arrays, **named, dead_ends={"wrek"})


def test_a_dead_end_may_have_actions_but_no_way_to_the_goal():
    trap = {"stay": [(1.0, "trap", 1.0)]}
    model = {"a": {"go": [(0.5, "g", 1.0), (0.5, "trap", 1.0)]}, "trap": trap}
    assert SSP.from_transitions(model, goal={"g"}, dead_ends={"trap"}).n_pairs == 2
    for wrong in ("a", "g"):
        words = f"'{wrong}' is listed in dead_ends, but the goal is reached from it"
        refused(words, SSP.from_transitions, model, goal={"g"}, dead_ends={"trap", wrong})


@pytest.mark.parametrize("wrong", ["hoem", "homee", "hume", "ohme"])
def test_an_unlisted_state_that_resembles_another_is_warned_of(wrong):
    model = {"depot": {"go": [(0.9, wrong, 1.0), (0.1, "home", 1.0)]}}
    with pytest.warns(ModelWarning, match=f"'{wrong}' has no actions.*did you mean 'home'"):
        SSP.from_transitions(model, goal={"home"}, treat_actionless_as_dead_ends=True)


def test_names_that_are_numbered_or_listed_are_not_warned_of():
    outcomes = [(0.25, "cell11", 1.0), (0.25, "cell12", 1.0), (0.5, "cell1", 1.0)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for model in (
            {"cell2": {"go": outcomes}},
            {"ward": {"go": [(0.5, "wards", 1.0), (0.5, "cell1", 1.0)]}, "wards": {}},
        ):
            SSP.from_transitions(model, goal={"cell1"}, treat_actionless_as_dead_ends=True)


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("budget", "failure_budget"),
        ("epsilon", "failure_budget"),
        ("gamma", "discount"),
        ("limits", "constraints"),
        ("giveup", "give_up"),
        ("charge_failing", "charge_failing_step"),
    ],
)
def test_a_misspelled_keyword_of_a_criterion_is_named_with_what_was_meant(word, meant):
    words = f"has no argument '{word}'; did you mean '{meant}'"
    refused(words, MCMP, DEPOT, "depot", **{word: 0.05})


def test_misspelled_keywords_of_functions():
    refused("did you mean 'method'", solve, PROBLEM, solver="lp")
    refused("did you mean 'time_limit'", solve, PROBLEM, timeout=3)
    refused("did you mean 'start'", S3P, DEPOT, initial_state="depot", failure_budget=0.1)
    refused("did you mean 'cost'", SSP.from_transitions, {}, goal={"a"}, reward="time")
    refused("did you mean 'costs'", SSP.from_arrays, rewards=[1.0])
    refused("did you mean 'seed'", simulate, solve(PROBLEM).policy, PROBLEM, rng=0)
    refused("its arguments: problem", cross_check, PROBLEM, colour=3)
    refused("did you mean 'time_limit'", evaluate, solve(PROBLEM).policy, PROBLEM, timeout=3)
    refused("did you mean 'point_limit'", trace_frontier, PROBLEM, points_limit=3)
    refused("CVaR has no argument 'alpha'; its arguments: model, start", CVaR, DEPOT, alpha=0.9)
    refused("did you mean 'policies'", MixedPolicy, policy=(), weights=())


def test_simulation_has_a_seed():
    policy = solve(PROBLEM).policy
    played, again = (simulate(policy, PROBLEM, episodes=50, **seed) for seed in ({}, {"seed": 0}))
    assert repr(played) == repr(again)


def test_strict_limits_and_functions_that_are_not_called_say_what_to_write():
    refused(r"write expected_cost\(\) <= 5", lambda: expected_cost() < 5)
    refused(r"write end_probability\('goal'\) >= 0.5", lambda: goal_probability() > 0.5)
    refused(
        r"expected_cost is a function: call it, such as expected_cost\(\)",
        lambda: expected_cost <= 5,
    )
    refused(r"visits is a function: call it, such as visits\(\.\.\.\)", lambda: visits <= 5)
    refused(r"such as expected_cost\(\)", lambda: 2.0 * expected_cost <= 5)
    for function in (expected_cost, visits, secondary_cost, arrival_cost):
        assert pickle.loads(pickle.dumps(function)) is function  # noqa: S301
    assert repr(expected_cost).startswith("expected_cost(")


def test_where_a_limited_cost_stops_to_count_is_a_choice_of_maxprob():
    """Declared failing at ``a`` saves what follows; counted to the dead-end it must be paid."""
    model = SSP.from_transitions(
        {
            "a": {"go": [(1.0, "b", 1.0)]},
            "b": {
                "risk": [(0.4, "two", 1.0), (0.6, "three", 1.0)],
                "stop": [(1.0, "two", 0.0)],
            },
        },
        goal={"three"},
        dead_ends={"two"},
    )
    limit = {"cost": expected_cost() <= 1.5}
    assert solve(MaxProb(model, "a", constraints=limit)).objective == pytest.approx(0.45)
    counted = MaxProb(model, "a", give_up="dead_ends", constraints=limit)
    assert solve(counted).objective == pytest.approx(0.3)
    refused("give_up", MaxProb, model, "a", give_up="never")
