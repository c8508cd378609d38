"""Storm on our policies: what it says of their chains, and its schedulers written and read."""

import json

import numpy as np
import pytest
import stormpy

from cases import published
from formulations import MCMP, S3P
from small_models import AWKWARD, FIRST, model_of
from ssp_lp import GIVE_UP, SSP, DeterministicPolicy, ModelError, StochasticPolicy, evaluate, solve
from ssp_lp.io import induced_chain, to_stormpy, write_scheduler
from storm_values import value


def checked(policy, start):
    """Failure and expected cost of a policy, as Storm finds them on its chain."""
    found = induced_chain(policy, start)
    chain = to_stormpy(found.model, start=found.start)
    return 1.0 - value(chain, 'Pmin=? [F "goal"]'), value(chain, 'R{"cost"}max=? [C]')


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("kind", ["policy", "randomised_policy"])
@pytest.mark.parametrize(("model", "start"), [(FIRST, "depot"), (AWKWARD, ("s", 1))])
def test_storm_finds_what_we_say_of_a_policy(criterion, kind, model, start):
    problem = criterion(model, start, failure_budget=0.3)
    policy = getattr(solve(problem), kind)
    told = evaluate(policy, MCMP(model, start, failure_budget=0.3, charge_failing_step=False))
    failure, cost = checked(policy, start)
    assert failure == pytest.approx(told.failure_probability, abs=1e-8)
    assert cost == pytest.approx(told.expected_cost, abs=1e-8)


def test_a_chain_ends_where_failure_is_certain():
    """Waiting for ever costs without end, but the policy had failed before."""
    model = model_of(
        {
            "s": {"go": [(0.5, "g", 3.0), (0.5, "t", 1.0)]},
            "t": {"wait": [(1.0, "t", 1.0)], "back": [(1.0, "s", 1.0)]},
        }
    )
    policy = DeterministicPolicy.from_actions(model, {"s": "go", "t": "wait"})
    told = evaluate(policy, MCMP(model, "s", failure_budget=0.5, charge_failing_step=False))
    assert checked(policy, "s") == (0.5, pytest.approx(told.expected_cost))
    assert told.expected_cost == pytest.approx(2.0)


def test_a_start_may_be_drawn():
    model, _ = published("prism_robot_goal1", "time")
    first = {0: 0.25, 1: 0.75}
    solution = solve(MCMP(model, first, failure_budget=0.6))
    failure, _ = checked(solution.policy, first)
    assert failure == pytest.approx(solution.failure_probability, abs=1e-8)


def scheduler(policy, start, tmp_path):
    write_scheduler(policy, tmp_path / "s.json", start=start)
    return json.loads((tmp_path / "s.json").read_text(encoding="utf-8"))


def test_a_scheduler_is_written_as_storm_writes_it(tmp_path):
    """Storm's own scheduler, made a policy of ours, comes out as it came in."""
    model, start = published("prism_robot_goal1", "time")
    theirs = to_stormpy(model, start=start)
    asked = stormpy.parse_properties('Pmax=? [F "goal"]')[0]
    found = stormpy.model_checking(theirs, asked, extract_scheduler=True).get_scheduler()
    decision = np.full(model.n_states, -2)
    for state in np.flatnonzero(np.diff(model.pair_offsets)).tolist():
        taken = found.get_choice(state).get_deterministic_choice()
        decision[state] = model.pair_offsets[state] + taken
    policy = DeterministicPolicy(model, decision)
    assert scheduler(policy, start, tmp_path) == json.loads(found.to_json_str(theirs))


def applied(entries, theirs):
    """Storm's chain of a scheduler without memory that chooses one action in each state."""
    asked = stormpy.parse_properties('Pmax=? [F "goal"]')[0]
    whole = stormpy.model_checking(theirs, asked, extract_scheduler=True).get_scheduler()
    firsts = theirs.nondeterministic_choice_indices
    for entry in entries:
        if entry["c"] != "undefined":
            (choice,) = entry["c"]
            local = choice["index"] - firsts[entry["s"]]
            whole.set_choice(stormpy.models.SchedulerChoice[float](local), entry["s"])
    return theirs.apply_scheduler(whole)


@pytest.mark.parametrize("name", ["alley", "road"])
def test_a_scheduler_applied_by_storm_fails_and_costs_as_ours(name, tmp_path):
    policy = DeterministicPolicy.from_actions(FIRST, {"depot": name})
    told = evaluate(policy, MCMP(FIRST, "depot", failure_budget=0.3, charge_failing_step=False))
    chain = applied(scheduler(policy, "depot", tmp_path), to_stormpy(FIRST, start="depot"))
    assert 1.0 - value(chain, 'P=? [F "goal"]') == pytest.approx(told.failure_probability)
    assert value(chain, 'R{"cost"}=? [C]') == pytest.approx(told.expected_cost)


def followed(entries, theirs):
    """Failure and cost of a scheduler with memory, as its file says and by Storm's own rows."""
    rule = {(entry["s"], entry.get("m", 0)): entry["c"] for entry in entries}
    position = {key: k for k, key in enumerate(sorted(rule))}
    matrix, rewards = theirs.transition_matrix, theirs.reward_models["cost"].state_action_rewards
    n = len(position)
    move, cost, goal = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for (state, memory), choices in rule.items():
        here = position[state, memory]
        if "goal" in theirs.get_labels_of_state(state):
            goal[here] = 1.0
            continue
        if choices == "undefined" or "deadlock" in theirs.get_labels_of_state(state):
            continue
        for choice in choices:
            after = {u["s'"]: u["m'"] for u in choice.get("memory-updates", ())}
            cost[here] += choice["prob"] * rewards[choice["index"]]
            for entry in matrix.get_row(choice["index"]):
                there = position[entry.column, after.get(entry.column, 0)]
                move[here, there] += choice["prob"] * entry.value
    first = position[theirs.initial_states[0], 0]
    reached, paid = goal.copy(), np.zeros(n)
    for _ in range(5000):
        reached, paid = goal + move @ reached, cost + move @ paid
    return 1.0 - reached[first], paid[first]


@pytest.mark.parametrize(("model", "start"), [(FIRST, "depot"), (AWKWARD, ("s", 1))])
def test_a_scheduler_with_memory_says_what_the_policy_does(model, start, tmp_path):
    solution = solve(S3P(model, start, failure_budget=0.3))
    policy = solution.randomised_policy
    told = evaluate(policy, MCMP(model, start, failure_budget=0.3, charge_failing_step=False))
    entries = scheduler(policy, start, tmp_path)
    failure, cost = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(told.failure_probability, abs=1e-12)
    if not told.ends["gave_up"]:
        assert cost == pytest.approx(told.expected_cost, abs=1e-12)


def test_the_robots_memory_of_costs_is_a_scheduler(tmp_path):
    model, start = published("prism_robot_goal1", "time")
    solution = solve(S3P(model, start, failure_budget=0.75))
    told = solution.evaluation
    entries = scheduler(solution.randomised_policy, start, tmp_path)
    assert {tuple(sorted(entry)) for entry in entries} == {("c", "m", "s")}
    failure, _ = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(told.failure_probability, abs=1e-9)


def test_giving_up_is_an_action_that_avoids_the_goal(tmp_path):
    """A policy that by chance gives up or goes on from its start."""
    model, start = published("prism_robot_goal1", "time")
    solution = solve(MCMP(model, start, failure_budget=0.75))
    assert solution.evaluation.ends["gave_up"] > 0.0
    entries = scheduler(solution.randomised_policy, start, tmp_path)
    failure, _ = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(solution.failure_probability, abs=1e-12)


def test_memory_stands_in_a_scheduler_as_storm_writes_it(tmp_path):
    """The fields of an entry are those of a scheduler with memory that Storm made."""
    ring = "mdp\nmodule m\n s : [0..1];\n [a] true -> 0.5:(s'=0)+0.5:(s'=1);\nendmodule\n"
    (tmp_path / "ring.prism").write_text(ring, encoding="utf-8")
    program = stormpy.parse_prism_program(str(tmp_path / "ring.prism"))
    asked = stormpy.parse_properties("Pmax=? [(F s=0) & (F s=1)]", program)
    options = stormpy.BuilderOptions(asked, program)
    options.set_build_choice_labels()
    theirs = stormpy.build_model(program, options=options)
    own = stormpy.model_checking(theirs, asked[0], extract_scheduler=True).get_scheduler()
    assert not own.memoryless
    model, start = published("prism_robot_goal1", "time")
    entries = scheduler(
        solve(S3P(model, start, failure_budget=0.75)).randomised_policy, start, tmp_path
    )
    (known, *_), (mine, *_) = json.loads(own.to_json_str(theirs)), entries
    assert sorted(mine) == sorted(known)
    assert sorted(mine["c"][0]) == sorted(known["c"][0])
    assert sorted(mine["c"][0]["memory-updates"][0]) == ["m'", "s'"]


def test_what_a_scheduler_cannot_say_is_named(tmp_path):
    lottery = solve(MCMP(FIRST, "depot", failure_budget=0.05)).policy
    with pytest.raises(ModelError, match=r"solution\.randomised_policy"):
        scheduler(lottery, "depot", tmp_path)
    quits = DeterministicPolicy.from_actions(FIRST, {"depot": GIVE_UP})
    with pytest.raises(ModelError, match="gives up in state 'depot'"):
        scheduler(quits, "depot", tmp_path)
    bus = SSP.from_transitions(
        {"stop": {"wait": [(1.0, "stop", 1.0)], "ride": [(1.0, "g", 1.0)]}}, goal={"g"}
    )
    chances = {"wait": 0.25, "ride": 0.5, GIVE_UP: 0.25}
    undecided = StochasticPolicy.from_actions(bus, {"stop": chances})
    with pytest.raises(ModelError, match="every action that it does not take otherwise"):
        scheduler(undecided, "stop", tmp_path)
    failure, cost = checked(quits, "depot")
    assert (failure, cost) == (1.0, 0.0)
    stays = DeterministicPolicy.from_actions(AWKWARD, {("s", 1): "é b", "t": GIVE_UP})
    entries = scheduler(stays, ("s", 1), tmp_path)
    assert followed(entries, to_stormpy(AWKWARD, start=("s", 1)))[0] == 1.0
