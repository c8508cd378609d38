"""Storm's door: its programs and models read, ours given to it, and what it says of them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stormpy

from cases import load_case, published
from checks import optima
from formulations import MCMP, S3P, MaxProb
from small_models import ALONE, AWKWARD, FIRST, model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    MissingDependencyError,
    ModelError,
    StochasticPolicy,
    evaluate,
    solve,
)
from ssp_lp.analysis.goal_probability import dead_end_labels
from ssp_lp.io import (
    from_stormpy,
    induced_chain,
    read_with_storm,
    to_stormpy,
    write_drn,
    write_scheduler,
    write_umb,
)

# "time" is paid by states and actions, "coins" by actions
PROGRAM = """mdp
const int N;
const double p;
module walker
    x : [0..N] init 0;
    broken : bool init false;
    [go] x < N & !broken -> 1 - p : (x' = x + 1) + p : (broken' = true);
    [walk] x < N & !broken -> (x' = x + 1);
    [] x = N -> true;
endmodule
rewards "time"
    [go] true : 1;
    [walk] true : 3;
    x = 1 : 0.1;
endrewards
rewards "coins"
    [go] true : 0.2;
endrewards
label "done" = x = N;
"""

JANI: dict[str, Any] = {
    "jani-version": 1,
    "name": "walker",
    "type": "mdp",
    "actions": [{"name": "go"}],
    "constants": [{"name": "p", "type": "real"}],
    "variables": [
        {
            "name": "x",
            "type": {"kind": "bounded", "base": "int", "lower-bound": 0, "upper-bound": 3},
            "initial-value": 0,
        },
        {"name": "toll", "type": "real", "transient": True, "initial-value": 0},
        {"name": "done", "type": "bool", "transient": True, "initial-value": False},
    ],
    "properties": [],
    "automata": [
        {
            "name": "a",
            "locations": [
                {
                    "name": "l",
                    "transient-values": [
                        {"ref": "done", "value": {"op": "=", "left": "x", "right": 3}}
                    ],
                }
            ],
            "initial-locations": ["l"],
            "edges": [
                {
                    "location": "l",
                    "action": "go",
                    "guard": {"exp": {"op": "<", "left": "x", "right": 3}},
                    "assignments": [{"ref": "toll", "value": 5}],
                    "destinations": [
                        {
                            "location": "l",
                            "probability": {"exp": {"op": "-", "left": 1, "right": "p"}},
                            "assignments": [
                                {"ref": "x", "value": {"op": "+", "left": "x", "right": 1}}
                            ],
                        },
                        {"location": "l", "probability": {"exp": "p"}},
                    ],
                }
            ],
        }
    ],
    "system": {
        "elements": [{"automaton": "a"}],
        "syncs": [{"synchronise": ["go"], "result": "go"}],
    },
}


def written(tmp_path: Path, text: str, name: str = "walker.prism") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def value(model: Any, formula: str) -> float:
    """What Storm says of the initial state, by methods that bound their error."""
    asked = stormpy.parse_properties(formula)[0]
    environment = stormpy.environments.sound()
    environment.modelchecker().multi().precision = stormpy.Rational("1/100000000")
    found = stormpy.model_checking(model, asked, environment=environment)
    return float(found.get_value(model.initial_states[0]))


def test_a_program_of_prism(tmp_path: Path) -> None:
    found = read_with_storm(
        written(tmp_path, PROGRAM), goal="done", cost="time", constants="N=2,p=0.25"
    )
    model = found.model
    assert found.start == (False, 0)  # broken, x
    assert set(model.states) == {(b, x) for b in (False, True) for x in (0, 1, 2)} - {(True, 2)}
    solution = solve(MCMP(model, found.start, failure_budget=0.25))
    # walk or go at x = 0, then at x = 1 for 0.1 more: one of the two may be risked
    assert solution.failure_probability == pytest.approx(0.25)
    assert solution.objective == pytest.approx(min(3.0 + 1.1, 1.0 + 0.75 * 3.1))
    pair = int(model.pair_offsets[model.index_of((False, 1))])
    assert [model.action_of(k) for k in (pair, pair + 1)] == ["go", "walk"]
    assert model.costs[model.outcome_offsets[pair + 1]] == 3.1  # in decimals
    named = read_with_storm(
        written(tmp_path, PROGRAM), goal="done", cost="coins", constants={"N": 2, "p": 0.25}
    )
    assert solve(MCMP(named.model, named.start, failure_budget=0.0)).objective == 0.0


def test_a_goal_may_be_a_condition(tmp_path: Path) -> None:
    path = written(tmp_path, PROGRAM)
    options = {"cost": "time", "constants": "N=4,p=0.1"}
    for goal in ("x = N - 1 & !broken", '!("deadlock" | x < 3)'):
        found = read_with_storm(path, goal=goal, **options)
        least = solve(MCMP(found.model, found.start, failure_budget=0.0)).objective
        assert least == pytest.approx(3 * 3.0 + 0.1)
        assert all(not name.startswith("(") for name in found.model.state_labels)


@pytest.mark.parametrize(
    ("old", "new", "options", "message"),
    [
        ("", "", {"cost": None}, "choose one of the reward models, cost=.*'coins', 'time'"),
        ("", "", {"cost": "fuel"}, "unknown reward model 'fuel'"),
        ("", "", {"goal": "doen"}, r"goal 'doen' \(labels: 'done'\)"),
        ("", "", {"goal": '"doen"'}, "unknown label 'doen'"),
        ("", "", {"goal": "x=1;x=2"}, "one condition, not 2"),
        ("", "", {"goal": 'Pmax=? [F "done"]'}, "must say of each state"),
        ("", "", {"goal": "x = 99"}, "no state has the label 'x = 99'"),
        ("", "", {"constants": "N=2"}, "undefined constants: p"),
        ("", "", {"constants": "N=2,p=2"}, "negative probabilities"),
        ("", "", {"constants": "N=2,p=0.1,q=1"}, "unknown undefined constant 'q'"),
        ("[walk] true : 3", "[walk] true : 2 - 3", {}, "action 'walk' of state .* negative cost"),
        ("mdp\n", "ctmc\n", {}, "is a CTMC: only MDPs and DTMCs"),
        ("mdp\n", "mpd\n", {}, "Storm refuses it"),
        ("x' = x + 1", "x' = x + y", {}, "Storm refuses it"),
        ("x' = x + 1", "x' = x + 1000", {}, "Storm refuses it"),
        ("1 - p : (x'", "0.9 - p : (x'", {}, "Storm refuses it"),
    ],
)
def test_what_is_wrong_with_a_program_is_named(
    old: str, new: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, PROGRAM.replace(old, new, 1) if old else PROGRAM)
    asked = {"goal": "done", "cost": "time", "constants": "N=2,p=0.1"} | options
    with pytest.raises(ModelError, match=message) as found:
        read_with_storm(path, **asked)
    assert "walker.prism" in str(found.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_with_storm(tmp_path / "no.prism", goal="done")


def test_a_markov_chain_and_a_partly_observed_model(tmp_path: Path) -> None:
    chain = "dtmc\nmodule m\n s : [0..2];\n [] s=0 -> 0.5:(s'=1)+0.5:(s'=2);\nendmodule\n"
    found = read_with_storm(written(tmp_path, chain), goal="s=1")
    assert solve(MaxProb(found.model, found.start)).objective == 0.5
    assert found.model.n_pairs == 1  # states 1 and 2 are deadlocks
    hidden = "pomdp\nobservables s endobservables\n" + chain.removeprefix("dtmc\n")
    with pytest.raises(ModelError, match="is a POMDP"):
        read_with_storm(written(tmp_path, hidden), goal="s=1")


def test_jani_rewards_of_edges_are_read_and_those_of_outcomes_refused(tmp_path: Path) -> None:
    path = written(tmp_path, json.dumps(JANI), "walker.jani")
    found = read_with_storm(path, goal="done", cost="toll", constants="p=0.2")
    least = solve(MCMP(found.model, found.start, failure_budget=0.0)).objective
    assert least == pytest.approx(3 * 5.0 / 0.8)
    assert read_with_storm(path, goal="x = 3", constants={"p": 0.2}).model.n_states == 4
    text = json.dumps(JANI).replace('{"exp": "p"}', '{"exp": "p"}, "assignments": '
                                    '[{"ref": "toll", "value": 7}]')  # fmt: skip
    with pytest.raises(ModelError, match="only average"):
        read_with_storm(
            written(tmp_path, text, "walker.jani"), goal="done", cost="toll", constants="p=0.2"
        )


def _transitions(rows: list[dict[int, float]], groups: list[int]) -> Any:
    builder = stormpy.datastructures.SparseMatrixBuilder[float](
        has_custom_row_grouping=True, row_groups=len(groups)
    )
    for row, entries in enumerate(rows):
        if row in groups:
            builder.new_row_group(row)
        for column, chance in entries.items():
            builder.add_next_value(row, column, chance)
    return builder.build()


def _hand_made(**rewards: Any) -> Any:
    """Two states: one action to the goal or back."""
    labels = stormpy.models.StateLabeling(2)
    for label, state in (("init", 0), ("end", 1), ("the pit", 0)):
        labels.add_label(label)
        labels.add_label_to_state(label, state)
    parts = stormpy.models.SparseModelComponents[float](
        transition_matrix=_transitions([{0: 0.5, 1: 0.5}, {1: 1.0}], [0, 1]),
        state_labeling=labels,
        reward_models={"r": stormpy.models.SparseRewardModel[float](**rewards)},
    )
    return stormpy.models.SparseMdp[float](parts)


def test_rewards_of_states_actions_and_transitions_add_up() -> None:
    by_state = _hand_made(optional_state_reward_vector=[0.1, 5.0])
    assert set(from_stormpy(by_state, goal="end").model.costs) == {0.1}
    paid = _transitions([{0: 0.5, 1: 1.0}, {}], [0, 1])
    all_three = _hand_made(
        optional_state_reward_vector=[0.1, 5.0],
        optional_state_action_reward_vector=[0.2, 7.0],
        optional_transition_reward_matrix=paid,
    )
    model = from_stormpy(all_three, goal='"end" & !"init"', cost="r").model
    assert model.costs.tolist() == [0.8, 1.3]
    assert list(model.state_labels) == ["end", "the pit"]
    with pytest.raises(ModelError, match="cost 'r': action 0 of state 0 has a negative cost"):
        from_stormpy(_hand_made(optional_state_reward_vector=[-1.0, 0.0]), goal="end")


def test_models_that_are_no_decision_processes_in_floats_are_refused(tmp_path: Path) -> None:
    program = stormpy.parse_prism_program(str(written(tmp_path, PROGRAM)))
    ready, _ = stormpy.instantiate_constants(program, "N=2")
    open_one = stormpy.build_model[stormpy.RationalFunction](ready)
    with pytest.raises(ModelError, match="has parameters for numbers"):
        from_stormpy(open_one, goal="done", cost="time")
    ready, _ = stormpy.instantiate_constants(program, "N=2,p=0.5")
    with pytest.raises(ModelError, match="has fractions for numbers"):
        from_stormpy(stormpy.build_model[stormpy.Rational](ready), goal="done", cost="time")
    with pytest.raises(ModelError, match="is symbolic"):
        from_stormpy(stormpy.build_symbolic_model(ready), goal="done", cost="time")
    with pytest.raises(ModelError, match="must be a model of stormpy, not dict"):
        from_stormpy({}, goal="done")
    with pytest.raises(ModelError, match="no state has the label 'doen'"):
        from_stormpy(stormpy.build_model(ready), goal="doen", cost="time")


@pytest.mark.parametrize("way", ["memory", "umb", "drn"])
@pytest.mark.parametrize(("model", "start"), [(FIRST, "depot"), (AWKWARD, ("s", 1)), (ALONE, "g")])
def test_a_round_trip_through_storm_keeps_the_optimum(
    way: str, model: SSP, start: str, tmp_path: Path
) -> None:
    if way == "memory":
        found = from_stormpy(to_stormpy(model, start=start), goal="goal")
    elif way == "umb":
        write_umb(model, tmp_path / "m.umb", start=start)
        found = read_with_storm(tmp_path / "m.umb", goal="goal")
    else:
        write_drn(model, tmp_path / "m.drn", start=start)
        theirs = stormpy.build_model_from_drn(str(tmp_path / "m.drn"))
        found = from_stormpy(theirs, goal="goal", cost="cost")
    assert optima(found.model, found.start, 0.3) == pytest.approx(
        optima(model, start, 0.3), rel=1e-12, abs=1e-12
    )
    assert set(found.model.state_labels) - {"paying"} == set(model.state_labels)


@pytest.mark.parametrize(
    ("name", "cost"),
    [
        ("prism_robot_goal1", "time"),
        ("gubs_river-alt1", "unit"),
        ("qcomp_cdrive.3", "unit"),
        ("storm_compromise_x1", "test"),
        ("prism_rewpoliter", "cost"),
    ],
)
def test_storm_agrees_on_published_models(name: str, cost: str) -> None:
    """The greatest goal probability, and the least cost where three tenths of it may be lost."""
    case = load_case(name, cost)
    choices = case.floats()
    whole = SSP.from_transitions(choices, case.goal, treat_actionless_as_dead_ends=True)
    # where the goal is out of reach an episode is over, while Storm would go on counting
    ended = choices | {state: {} for state in dead_end_labels(whole)}
    model = SSP.from_transitions(ended, case.goal, treat_actionless_as_dead_ends=True)
    theirs = to_stormpy(model, start=case.start)
    best = solve(MaxProb(model, case.start)).objective
    assert value(theirs, 'Pmax=? [F "goal"]') == pytest.approx(best, abs=1e-6)
    wanted = 0.7 * best
    least = value(theirs, f'multi(R{{"cost"}}min=? [C], P>={wanted!r} [F "goal"])')
    problem = MCMP(model, case.start, failure_budget=1.0 - wanted, give_up="dead_ends")
    assert least == pytest.approx(solve(problem).objective, rel=1e-6, abs=1e-6)


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "stormpy", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'ssp-lp\[storm\]'"):
        to_stormpy(FIRST, start="depot")
    with pytest.raises(MissingDependencyError):
        read_with_storm(written(tmp_path, PROGRAM), goal="done")


# schedulers


def checked(policy: Any, start: object) -> tuple[float, float]:
    """Failure and expected cost of a policy, as Storm finds them on its chain."""
    found = induced_chain(policy, start)
    chain = to_stormpy(found.model, start=found.start)
    return 1.0 - value(chain, 'Pmin=? [F "goal"]'), value(chain, 'R{"cost"}max=? [C]')


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("kind", ["policy", "randomised_policy"])
@pytest.mark.parametrize(("model", "start"), [(FIRST, "depot"), (AWKWARD, ("s", 1))])
def test_storm_finds_what_we_say_of_a_policy(
    criterion: Any, kind: str, model: SSP, start: str
) -> None:
    problem = criterion(model, start, failure_budget=0.3)
    policy = getattr(solve(problem), kind)
    told = evaluate(policy, MCMP(model, start, failure_budget=0.3, charge_failing_step=False))
    failure, cost = checked(policy, start)
    assert failure == pytest.approx(told.failure_probability, abs=1e-8)
    assert cost == pytest.approx(told.expected_cost, abs=1e-8)


def test_a_chain_ends_where_failure_is_certain() -> None:
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


def test_a_start_may_be_drawn() -> None:
    model, _ = published("prism_robot_goal1", "time")
    first = {0: 0.25, 1: 0.75}
    solution = solve(MCMP(model, first, failure_budget=0.6))
    failure, _ = checked(solution.policy, first)
    assert failure == pytest.approx(solution.failure_probability, abs=1e-8)


def scheduler(policy: Any, start: object, tmp_path: Path) -> list[dict[str, Any]]:
    write_scheduler(policy, tmp_path / "s.json", start=start)
    return json.loads((tmp_path / "s.json").read_text(encoding="utf-8"))


def test_a_scheduler_is_written_as_storm_writes_it(tmp_path: Path) -> None:
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


def applied(entries: list[dict[str, Any]], theirs: Any) -> Any:
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
def test_a_scheduler_applied_by_storm_fails_and_costs_as_ours(name: str, tmp_path: Path) -> None:
    policy = DeterministicPolicy.from_actions(FIRST, {"depot": name})
    told = evaluate(policy, MCMP(FIRST, "depot", failure_budget=0.3, charge_failing_step=False))
    chain = applied(scheduler(policy, "depot", tmp_path), to_stormpy(FIRST, start="depot"))
    assert 1.0 - value(chain, 'P=? [F "goal"]') == pytest.approx(told.failure_probability)
    assert value(chain, 'R{"cost"}=? [C]') == pytest.approx(told.expected_cost)


def followed(entries: list[dict[str, Any]], theirs: Any) -> tuple[float, float]:
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
def test_a_scheduler_with_memory_says_what_the_policy_does(
    model: SSP, start: str, tmp_path: Path
) -> None:
    solution = solve(S3P(model, start, failure_budget=0.3))
    policy = solution.randomised_policy
    told = evaluate(policy, MCMP(model, start, failure_budget=0.3, charge_failing_step=False))
    entries = scheduler(policy, start, tmp_path)
    failure, cost = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(told.failure_probability, abs=1e-12)
    if not told.ends["gave_up"]:
        assert cost == pytest.approx(told.expected_cost, abs=1e-12)


def test_the_robots_memory_of_costs_is_a_scheduler(tmp_path: Path) -> None:
    model, start = published("prism_robot_goal1", "time")
    solution = solve(S3P(model, start, failure_budget=0.75))
    told = solution.evaluation
    entries = scheduler(solution.randomised_policy, start, tmp_path)
    assert {tuple(sorted(entry)) for entry in entries} == {("c", "m", "s")}
    failure, _ = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(told.failure_probability, abs=1e-9)


def test_giving_up_is_an_action_that_avoids_the_goal(tmp_path: Path) -> None:
    """A policy that by chance gives up or goes on from its start."""
    model, start = published("prism_robot_goal1", "time")
    solution = solve(MCMP(model, start, failure_budget=0.75))
    assert solution.evaluation.ends["gave_up"] > 0.0
    entries = scheduler(solution.randomised_policy, start, tmp_path)
    failure, _ = followed(entries, to_stormpy(model, start=start))
    assert failure == pytest.approx(solution.failure_probability, abs=1e-12)


def test_memory_stands_in_a_scheduler_as_storm_writes_it(tmp_path: Path) -> None:
    """The fields of an entry are those of a scheduler with memory that Storm made."""
    ring = "mdp\nmodule m\n s : [0..1];\n [a] true -> 0.5:(s'=0)+0.5:(s'=1);\nendmodule\n"
    program = stormpy.parse_prism_program(str(written(tmp_path, ring)))
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


def test_what_a_scheduler_cannot_say_is_named(tmp_path: Path) -> None:
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
