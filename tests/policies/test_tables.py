"""Policies print what they do, and solutions explain the actions of a state."""

import json

import numpy as np
import pytest

from formulations import MCMP, S3P, CVaR, MaxProb
from refusing import refused
from small_models import ROUTES
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    MixedPolicy,
    StochasticPolicy,
    TimedPolicy,
    evaluate,
    secondary_cost,
    solve,
)
from ssp_lp.policies.policy import Policy

DEPOT = SSP.from_transitions(
    {"depot": ROUTES, "wreck": {}}, goal={"home"}, treat_actionless_as_dead_ends=True
)
LOTTERY = solve(MCMP(DEPOT, "depot", failure_budget=0.05))
CORRIDOR = SSP.from_transitions(
    {k: {"on": [(1.0, k + 1, 1.0)], "back": [(1.0, max(k - 1, 0), 2.0)]} for k in range(400)},
    goal={400},
)


def test_a_lottery_prints_a_table_for_each_member_under_its_weight():
    assert str(LOTTERY.policy).splitlines() == [
        "lottery over 2 policies, drawn once at the start",
        "with probability 0.5556:",
        "  state  action  probability",
        "  depot  road              1",
        "with probability 0.4444:",
        "  state  action  probability",
        "  depot  alley             1",
    ]
    page = LOTTERY.policy._repr_html_()
    assert page.count("<table>") == 2
    assert "with probability 0.4444" in page


def test_long_tables_are_cut_and_say_so():
    policy = DeterministicPolicy.from_actions(CORRIDOR, dict.fromkeys(range(400), "on"))
    lines = str(policy).splitlines()
    assert len(lines) == 22
    assert lines[-1] == "and 380 more"
    assert len(policy.table()) == 400
    many = MixedPolicy((policy,) * 8, np.full(8, 1 / 8))
    assert str(many).splitlines()[-1] == "and 3 more policies"


def test_the_table_of_a_solution_has_what_the_plan_comes_to_nearest_first():
    plan = solve(MCMP(CORRIDOR, 397, failure_budget=0.0))
    rows = plan.policy_table()
    assert [(row.state, row.action) for row in rows] == [(397, "on"), (398, "on"), (399, "on")]
    aware = solve(S3P(DEPOT, "depot", failure_budget=0.05)).policy_table()
    assert [(row.member, row.state, row.memory) for row in aware] == [
        (0, "depot", 0.0),
        (1, "depot", 0.0),
    ]
    assert "cost paid" in str(aware)


def test_a_table_of_a_memory_says_where_runs_come():
    """Case S prints all costs, with a note; the solution's own table has those that runs pay."""
    solution = solve(S3P(DEPOT, "depot", 0.05))
    note = "runs need not reach all of these: solution.policy_table()"
    assert str(solution.policy).count(note) == 1
    assert note in solution.policy._repr_html_()
    assert [row.memory for row in solution.policy_table()] == [0.0, 0.0]
    assert note not in str(solution.policy_table()) + str(LOTTERY.policy)


def test_giving_up_is_called_give_up_in_every_table():
    policy = StochasticPolicy.from_actions(DEPOT, {"depot": {"road": 0.25, GIVE_UP: 0.75}})
    assert {row.action for row in policy.table()} == {"road", "give up"}
    assert "give up" in str(policy)
    assert json.dumps([row.action for row in policy.table()]) == '["road", "give up"]'
    frame = policy.to_frame()
    assert "give up" in frame.to_csv()
    assert "Decision" not in frame.to_csv() + frame.to_json()
    read_back = {row.action: row.probability for row in policy.table()}
    again = StochasticPolicy.from_actions(
        DEPOT, {"depot": {str(a): p for a, p in read_back.items()}}
    )
    assert list(again.pair) == list(policy.pair)


def test_a_model_may_have_an_action_called_give_up():
    model = SSP.from_transitions({"a": {"give up": [(1.0, "b", 1.0)]}}, goal={"b"})
    assert DeterministicPolicy.from_actions(model, {"a": "give up"}).decision.tolist() == [0, -2]
    assert DeterministicPolicy.from_actions(model, {"a": GIVE_UP}).decision.tolist() == [-1, -2]


def test_the_action_of_a_state():
    plan = solve(MaxProb(DEPOT, "depot")).policy
    assert plan.action("depot") == "road"
    assert plan.action("home") is None
    assert plan.action("wreck") is None
    quits = DeterministicPolicy.from_actions(DEPOT, {"depot": GIVE_UP})
    assert quits.action("depot") is GIVE_UP
    agreeing = MixedPolicy((plan.policies[0], plan.policies[0]), np.array([0.5, 0.5]))
    assert agreeing.action("depot") == "road"


def test_an_action_that_depends_on_more_than_the_state_is_refused_with_the_remedy():
    refused(r"drawn \(road or alley\).*policy\.start\(seed=0\)", LOTTERY.policy.action, "depot")
    aware = solve(S3P(DEPOT, "depot", failure_budget=0.05)).policy
    refused(r"depends on the cost paid.*start\(seed=0\)", aware.action, "depot")
    stage = DeterministicPolicy.from_actions(DEPOT, {"depot": "road"})
    refused("depends on the memory", TimedPolicy((stage, stage)).action, "depot")
    silent = DeterministicPolicy.from_actions(DEPOT, {})
    refused(r"no decision in state 'depot'.*policy_everywhere", silent.action, "depot")
    refused("depto", LOTTERY.policy.action, "depto")


class Counting(DeterministicPolicy):
    """A policy of a class whose memory is not known."""

    memory_size = None


def test_a_policy_of_unknown_memory_prints_in_one_line():
    policy = Counting(DEPOT, np.array([0, -2, -2]))
    assert isinstance(policy, Policy)
    assert str(policy) == repr(policy)
    refused("the memory of a Counting cannot be listed", policy.table)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("discount", [None, 0.95])
def test_values_are_what_an_action_and_the_best_after_it_come_to(criterion, discount):
    """Against the evaluation of policies that take each action first."""
    fuel = {"depot": {"alley": 2.0, "road": 1.0}}
    problem = criterion(
        DEPOT,
        "depot",
        failure_budget=0.5,
        discount=discount,
        constraints={"fuel": secondary_cost(fuel) <= 1.3},
    )
    solution = solve(problem)
    explained = solution.explain("depot")
    assert explained.quantities[0] == "cost"
    weights = dict(zip(explained.quantities, explained.weights, strict=True))
    assert weights["fuel"] == pytest.approx(solution.prices["fuel"])
    for action in explained.actions:
        amounts = dict(zip(explained.quantities, action.amounts, strict=True))
        measured = evaluate(
            DeterministicPolicy.from_actions(DEPOT, {"depot": action.action}), problem
        )
        assert amounts["fuel"] == pytest.approx(measured.secondary_costs["fuel"])
        assert amounts["failure"] == pytest.approx(measured.limited_failure)
        goal = 1.0 if criterion is MCMP else 1.0 - measured.limited_failure
        assert amounts["cost"] == pytest.approx(measured.objective * goal)
        assert action.value == pytest.approx(sum(weights[k] * amounts[k] for k in amounts))
        place = "depot", action.action, explained.cost_paid
        assert action.value == pytest.approx(solution.values.at(*place))
        assert action.excess == pytest.approx(solution.values.advantage(*place))
    assert sum(action.share for action in explained.actions) == pytest.approx(1.0)


def test_an_action_of_a_longer_way_is_worse_by_its_reduced_cost():
    """One step back and two on: 2 + 1 more."""
    explained = solve(MCMP(CORRIDOR, 100, failure_budget=0.1)).explain(200)
    on, back, quits = explained.actions
    assert (on.action, on.value, on.excess) == ("on", 200.0, 0.0)
    assert (back.action, back.value, back.excess) == ("back", 203.0, 3.0)
    assert quits.action is GIVE_UP
    assert "200: value = cost" in str(explained)


def test_what_cannot_be_explained_is_said():
    refused("has no decision in 'home': it is a goal", LOTTERY.explain, "home")
    aware = solve(S3P(DEPOT, "depot", failure_budget=0.05))
    refused(r"at cost 77: ask for 'depot' at cost 0", aware.explain, "depot", 77)
    refused("not a linear program", solve(CVaR(DEPOT, "depot", 0.9)).explain, "depot")
