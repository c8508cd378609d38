"""Storm on our policies: what it says of their chains, and its schedulers written and read."""

import json

import numpy as np
import pytest
import stormpy

from cases import published
from formulations import MCMP, S3P
from refusing import refused
from small_models import AWKWARD, FIRST, model_of
from ssp_lp import GIVE_UP, SSP, DeterministicPolicy, StochasticPolicy, evaluate, solve
from ssp_lp.io import induced_chain, to_stormpy, write_scheduler
from storm_values import value

ROBOT = published("prism_robot_goal1", "time")[0]
each_model = pytest.mark.parametrize(
    ("model", "start"), [(FIRST, "depot"), (AWKWARD, ("s", 1))], ids=["first", "awkward"]
)


def checked(policy, start):
    """Failure and expected cost of a policy, as Storm finds them on its chain."""
    found = induced_chain(policy, start)
    chain = to_stormpy(found.model, start=found.start)
    return 1.0 - value(chain, 'Pmin=? [F "goal"]'), value(chain, 'R{"cost"}max=? [C]')


def judged(policy, start):
    """The same by our own evaluation."""
    problem = MCMP(policy.model, start, failure_budget=0.3, charge_failing_step=False)
    told = evaluate(policy, problem)
    return told.failure_probability, told.expected_cost


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("kind", ["policy", "randomised_policy"])
@each_model
def test_storm_finds_what_we_say_of_a_policy(criterion, kind, model, start):
    policy = getattr(solve(criterion(model, start, failure_budget=0.3)), kind)
    assert checked(policy, start) == pytest.approx(judged(policy, start), abs=1e-8)


def test_a_chain_ends_where_failure_is_certain():
    """Waiting for ever costs without end, but the policy had failed before."""
    moves = {"wait": [(1.0, "t", 1.0)], "back": [(1.0, "s", 1.0)]}
    model = model_of({"s": {"go": [(0.5, "g", 3.0), (0.5, "t", 1.0)]}, "t": moves})
    policy = DeterministicPolicy.from_actions(model, {"s": "go", "t": "wait"})
    assert checked(policy, "s") == judged(policy, "s") == (0.5, pytest.approx(2.0))


def test_a_start_may_be_drawn():
    start = {0: 0.25, 1: 0.75}
    solution = solve(MCMP(ROBOT, start, failure_budget=0.6))
    failure, _ = checked(solution.policy, start)
    assert failure == pytest.approx(solution.failure_probability, abs=1e-8)


def scheduler(policy, start, tmp_path):
    write_scheduler(policy, tmp_path / "s.json", start=start)
    return json.loads((tmp_path / "s.json").read_text(encoding="utf-8"))


def test_a_scheduler_is_written_as_storm_writes_it(tmp_path):
    """Storm's own scheduler, made a policy of ours, comes out as it came in."""
    model, theirs = ROBOT, to_stormpy(ROBOT, start=0)
    asked = stormpy.parse_properties('Pmax=? [F "goal"]')[0]
    found = stormpy.model_checking(theirs, asked, extract_scheduler=True).get_scheduler()
    decision = np.full(model.n_states, -2)
    for state in np.flatnonzero(np.diff(model.pair_offsets)).tolist():
        taken = found.get_choice(state).get_deterministic_choice()
        decision[state] = model.pair_offsets[state] + taken
    policy = DeterministicPolicy(model, decision)
    assert scheduler(policy, 0, tmp_path) == json.loads(found.to_json_str(theirs))


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


@pytest.mark.parametrize(
    ("criterion", "model", "start", "budget"),
    [
        (S3P, FIRST, "depot", 0.3),
        (S3P, AWKWARD, ("s", 1), 0.3),
        (S3P, ROBOT, 0, 0.75),
        (MCMP, ROBOT, 0, 0.75),
    ],
    ids=["first", "awkward", "robot", "robot that by chance gives up"],
)
def test_a_scheduler_with_memory_says_what_the_policy_does(
    criterion, model, start, budget, tmp_path
):
    """Giving up is an action that avoids the goal; costs are then paid on."""
    solution = solve(criterion(model, start, failure_budget=budget))
    policy = solution.randomised_policy
    entries = scheduler(policy, start, tmp_path)
    if criterion is S3P and model is ROBOT:
        assert {tuple(sorted(entry)) for entry in entries} == {("c", "m", "s")}
    gave_up = evaluate(policy, solution.problem).ends["gave_up"]
    assert (gave_up > 0.0) or criterion is S3P
    parts = slice(1) if gave_up else slice(2)
    found = followed(entries, to_stormpy(model, start=start))
    assert found[parts] == pytest.approx(judged(policy, start)[parts], abs=1e-12)


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
    policy = solve(S3P(ROBOT, 0, failure_budget=0.75)).randomised_policy
    entries = scheduler(policy, 0, tmp_path)
    (known, *_), (mine, *_) = json.loads(own.to_json_str(theirs)), entries
    assert sorted(mine) == sorted(known)
    assert sorted(mine["c"][0]) == sorted(known["c"][0])
    assert sorted(mine["c"][0]["memory-updates"][0]) == ["m'", "s'"]


def test_what_a_scheduler_cannot_say_is_named(tmp_path):
    def refuse(words, policy, start):
        refused(words, scheduler, policy, start, tmp_path)

    lottery = solve(MCMP(FIRST, "depot", failure_budget=0.05)).policy
    refuse(r"solution\.randomised_policy", lottery, "depot")
    quits = DeterministicPolicy.from_actions(FIRST, {"depot": GIVE_UP})
    refuse("gives up in state 'depot'", quits, "depot")
    moves = {"wait": [(1.0, "stop", 1.0)], "ride": [(1.0, "g", 1.0)]}
    bus = SSP.from_transitions({"stop": moves}, goal={"g"})
    chances = {"wait": 0.25, "ride": 0.5, GIVE_UP: 0.25}
    undecided = StochasticPolicy.from_actions(bus, {"stop": chances})
    refuse("every action that it does not take otherwise", undecided, "stop")
    assert checked(quits, "depot") == (1.0, 0.0)
    stays = DeterministicPolicy.from_actions(AWKWARD, {("s", 1): "é b", "t": GIVE_UP})
    entries = scheduler(stays, ("s", 1), tmp_path)
    assert followed(entries, to_stormpy(AWKWARD, start=("s", 1)))[0] == 1.0
