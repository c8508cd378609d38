"""Storm's door: its programs and models read, ours given to it, and what it says of them."""

import json
import sys

import pytest
import stormpy

from cases import load_case
from formulations import MCMP, MaxProb
from refusing import refused
from ssp_lp import SSP, MissingDependencyError, secondary_cost, solve
from ssp_lp.io import from_stormpy, read_any, read_with_storm, write_umb
from ssp_lp.model.graph import dead_end_labels
from storm_values import in_storm, value
from tests.campaigns.damaged_files import JANI

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


GO = r"action 'go' of state \(False, 0\)"


def written(tmp_path, text, name="walker.prism"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def least(found, budget=0.0):
    return solve(MCMP(found.model, found.start, failure_budget=budget))


def test_dead_ends_of_a_program_are_listed_by_states_or_a_predicate(tmp_path):
    path, options = written(tmp_path, PROGRAM), {"goal": "done", "cost": "time"}
    broken = {(True, 0), (True, 1)}
    for listed in (broken, lambda state: state[0]):
        found = read_with_storm(path, **options, constants="N=2,p=0.25", dead_ends=listed)
        assert dead_end_labels(found.model) == broken
        write_umb(found.model, tmp_path / "walker.umb", start=found.start)
        storms = in_storm(tmp_path / "walker.umb")
        for numbers in ({found.model.index_of(state) for state in broken}, "deadlock"):
            same = from_stormpy(storms, goal="goal", cost="time", dead_ends=numbers)
            assert same.model.n_states == found.model.n_states
        refused("neither a goal nor a dead", from_stormpy, storms, goal="goal", cost="time",
                dead_ends=())  # fmt: skip
    told = r"state \(True, 1\), where .* neither a goal nor a dead-end"
    refused(told, read_with_storm, path, **options, constants="N=2,p=0.25", dead_ends={(True, 0)})
    whole = {"constants": "N=2,p=0.25", "dead_ends": {(False, 1), *broken}}
    refused(
        "listed in dead_ends, but the goal is reached", read_with_storm, path, **options, **whole
    )


def test_a_program_of_prism(tmp_path):
    path, constants = written(tmp_path, PROGRAM), {"N": 2, "p": 0.25}
    found = read_with_storm(path, goal="done", cost="time", constants="N=2,p=0.25")
    model = found.model
    assert found.start == (False, 0)  # broken, x
    assert set(model.states) == {(b, x) for b in (False, True) for x in (0, 1, 2)} - {(True, 2)}
    solution = least(found, 0.25)
    # walk or go at x = 0, then at x = 1 for 0.1 more: one of the two may be risked
    assert solution.failure_probability == pytest.approx(0.25)
    assert solution.objective == pytest.approx(min(3.0 + 1.1, 1.0 + 0.75 * 3.1))
    pair = int(model.pair_offsets[model.index_of((False, 1))])
    assert [model.action_of(k) for k in (pair, pair + 1)] == ["go", "walk"]
    assert model.costs[model.outcome_offsets[pair + 1]] == 3.1  # in decimals
    coins = read_with_storm(path, goal="done", cost="coins", constants=constants)
    assert least(coins).objective == 0.0


@pytest.mark.parametrize("goal", ["x = N - 1 & !broken", '!("deadlock" | x < 3)'])
def test_a_goal_may_be_a_condition(goal, tmp_path):
    path = written(tmp_path, PROGRAM)
    found = read_with_storm(path, goal=goal, cost="time", constants="N=4,p=0.1")
    assert least(found).objective == pytest.approx(3 * 3.0 + 0.1)
    assert all(not name.startswith("(") for name in found.model.state_labels)


@pytest.mark.parametrize(
    ("old", "new", "options", "message"),
    [
        ("", "", {"cost": None}, "choose one of the reward models .cost.: .*'coins', 'time'"),
        ("", "", {"cost": "fuel"}, "no reward model 'fuel'; choose .*'coins', 'time'"),
        ("", "", {"goal": "doen"}, r"goal 'doen' \(labels: 'done'\)"),
        ("", "", {"goal": '"doen"'}, "unknown label 'doen'"),
        ("", "", {"goal": "x=1;x=2"}, "one condition, not 2"),
        ("", "", {"goal": 'Pmax=? [F "done"]'}, "must be a condition on states"),
        ("", "", {"goal": "x = 99"}, "no state has the label 'x = 99'"),
        ("", "", {"constants": "N=2"}, "undefined constants: p; give .*constants"),
        ("", "", {"constants": None}, "undefined constants: N, p; give .*constants"),
        ("", "", {"constants": "N=2,p=2"}, "negative probabilities"),
        ("", "", {"constants": "N=2,p=0.1,q=1"}, "unknown undefined constant 'q'"),
        ("[walk] true : 3", "[walk] true : 2 - 3", {}, "action 'walk' of state .* negative cost"),
        ("mdp\n", "ctmc\n", {}, "is a CTMC: only MDPs and DTMCs"),
        ("mdp\n", "mpd\n", {}, "Storm rejects it"),
        ("x' = x + 1", "x' = x + y", {}, "Storm rejects it"),
        ("x + 1", "x + 1000", {}, rf"{GO}: a variable leaves its bounds"),
        ("1 - p : (x'", "0.9 - p : (x'", {}, rf"{GO}: probabilities sum to 0.9, not to 1"),
    ],
)
def test_what_is_wrong_with_a_program_is_named(old, new, options, message, tmp_path):
    path = written(tmp_path, PROGRAM.replace(old, new, 1) if old else PROGRAM)
    asked = {"goal": "done", "cost": "time", "constants": "N=2,p=0.1"} | options
    assert "walker.prism" in refused(message, read_with_storm, path, **asked)


TENTHS = """
mdp
module m
  s : [0..3] init 0;
  b : bool init false;
  [a] s = 0 -> P : (s' = 1) + 0.1 : (s' = 2) + 0.1 : (s' = 3) & (b' = true);
  [a] s = 1 -> (s' = 2);
  [b] s = 1 -> (s' = 3);
  [] s >= 2 -> true;
endmodule
label "done" = s = 2;
"""


@pytest.mark.parametrize("ending", ["prism", "jani"])
def test_decimals_that_sum_to_one_are_probabilities(tmp_path, ending):
    """As floats 0.8 + 0.1 + 0.1 is a little less than 1: rounding, up to 1e-9."""

    def read(probability, text=TENTHS):
        path = written(tmp_path, text.replace("P :", f"{probability} :"), "tenths.prism")
        if ending == "jani":
            program, _ = stormpy.parse_prism_program(str(path)).to_jani([])
            path = tmp_path / "tenths.jani"
            stormpy.io.export_jani_to_file(str(path), program)
        return read_with_storm(path, goal="done" if ending == "prism" else "s = 2").model

    model = read("0.8")
    assert model.probabilities[:3].tolist() == pytest.approx([0.8, 0.1, 0.1], abs=1e-15)
    assert read("0.8000000001").n_outcomes == model.n_outcomes
    refused(r"action 'a' of .*: probabilities sum to 1.00000001,", read, "0.80000001")
    # one bit more than two would hold: Storm by itself goes on from 0 again
    for update in ("(s' = s + 4)", "(s' = s - 1)"):
        wrong = TENTHS.replace("(s' = 1)", update)
        refused("a variable leaves its bounds", read, "0.8", wrong)


def test_a_markov_chain_and_a_partly_observed_model(tmp_path):
    chain = "dtmc\nmodule m\n s : [0..2];\n [] s=0 -> 0.5:(s'=1)+0.5:(s'=2);\nendmodule\n"
    found = read_with_storm(written(tmp_path, chain), goal="s=1")
    assert solve(MaxProb(found.model, found.start)).objective == 0.5
    assert found.model.n_pairs == 1  # states 1 and 2 are deadlocks
    hidden = "pomdp\nobservables s endobservables\n" + chain.removeprefix("dtmc\n")
    refused("is a POMDP", read_with_storm, written(tmp_path, hidden), goal="s=1")


def test_jani_rewards_of_edges_are_read_and_those_of_outcomes_refused(tmp_path):
    open_one = JANI.replace(', "value": 0.25', "")
    path = written(tmp_path, open_one, "walker.jani")
    found = read_with_storm(path, goal="done", cost="toll", constants="p=0.2")
    assert least(found).objective == pytest.approx(3 * 5.0 / 0.8)
    assert read_with_storm(path, goal="x = 3", constants={"p": 0.2}).model.n_states == 4
    toll = '{"exp": "p"}, "assignments": [{"ref": "toll", "value": 7}]'
    path = written(tmp_path, open_one.replace('{"exp": "p"}', toll), "walker.jani")
    refused("cannot represent", read_with_storm, path, goal="done", cost="toll", constants="p=0.2")


THREE = """mdp
module m
  x : [0..3] init 0;
  [fast] x < 3 -> 0.5 : (x' = x + 1) + 0.5 : true;
  [slow] x < 3 -> (x' = x + 1);
endmodule
rewards "time"
  [fast] true : 1;
  [slow] true : 3;
endrewards
rewards "fuel"
  [fast] true : 2;
endrewards
rewards "noise"
  [slow] true : 1;
endrewards
rewards "profit"
  [slow] true : x - 1;
endrewards
label "done" = x = 3;
"""


@pytest.mark.parametrize("ending", ["prism", "jani", "umb", "drn", " prism", " drn"])
def test_every_reward_is_kept_whichever_counts(ending, tmp_path):
    """Three steps, each at time 2 and fuel 4 by "fast", at time 3 and noise 1 by "slow"."""
    time = "" if ending[0] == " " else "time"  # a reward without a name
    text = THREE if time else THREE.replace('rewards "time"', "rewards")
    path = written(tmp_path, text, "three.prism")
    program = stormpy.parse_prism_program(str(path))
    storms = stormpy.build_model(program)
    if ending == "jani":
        stormpy.io.export_jani_to_file(str(path := tmp_path / "three.jani"), program.to_jani([])[0])
    elif ending == "umb":
        stormpy.io.export_to_umb(storms, str(path := tmp_path / "three.umb"))
    elif ending.strip() == "drn":
        stormpy.io.export_to_drn(storms, str(path := tmp_path / "three.drn"))
    cases = [(time, 6.0, "fuel", 6.0, 7.5), ("fuel", 0.0, "noise", 1.5, 6.0)]
    cases += [("noise", 0.0, "fuel", 6.0, 1.5)]
    for cost, least_cost, other, most, within in cases:
        found = read_any(path, "x = 3" if ending == "jani" else "done", cost)
        model = found.model
        assert set(model.named_costs) == {time, "fuel", "noise"}  # "profit" is negative at 0
        assert (model.n_states, model.n_pairs + 1) == (storms.nr_states, storms.nr_choices)
        assert least(found).objective == pytest.approx(least_cost)
        if cost:  # Storm cannot be asked about the one without a name beside others
            theirs = value(storms, f'R{{"{cost}"}}min=? [F "done"]')
            assert theirs == pytest.approx(least_cost, abs=1e-6)
        limits = {"other": secondary_cost(other) <= most}
        limited = MCMP(model, found.start, failure_budget=0.0, constraints=limits)
        assert solve(limited).objective == pytest.approx(within)


def jani(tmp_path, at_outcomes=(None, None), **defaults):
    """The walker with a reward "fuel" that is assigned at the outcomes of its one action."""
    document = json.loads(JANI)
    for name, default in {"fuel": 0, **defaults}.items():
        kind = {"type": "real", "transient": True, "initial-value": default}
        document["variables"].insert(1, {"name": name, **kind})
    (edge,) = document["automata"][0]["edges"]
    for destination, paid in zip(edge["destinations"], at_outcomes, strict=True):
        if paid is not None:
            destination.setdefault("assignments", []).append({"ref": "fuel", "value": paid})
    return written(tmp_path, json.dumps(document), "walker.jani")


def test_a_reward_that_storm_cannot_build_leaves_the_others(tmp_path):
    path = jani(tmp_path, (None, 7))  # fuel where the walker stays
    model = read_with_storm(path, goal="done", cost="toll").model
    assert list(model.named_costs) == ["toll"]
    assert model.states == [(0,), (1,), (2,), (3,)]
    assert "cannot represent" in refused(
        "Storm rejects", read_with_storm, path, goal="done", cost="fuel"
    )
    path = jani(tmp_path, (7, 7), base=1)  # a default of 1 is paid at each outcome
    refused("Storm rejects it", read_with_storm, path, goal="done", cost="base")
    for cost in ("toll", "fuel", "*"):
        model = read_with_storm(path, goal="done", cost=cost).model
        assert list(model.named_costs) == ["fuel", "toll"]
    assert set(model.named_costs["fuel"]) == {7.0}
    for options in ({"at_outcomes": (0, None)}, {"fuel": 1}):
        path = jani(tmp_path, **options)
        error = refused("Storm rejects it", read_with_storm, path, goal="done", cost="fuel")
        assert "cannot represent" not in error  # no cost differs between outcomes


def test_states_of_jani_have_the_names_of_their_locations(tmp_path):
    document = json.loads(JANI)
    (automaton,) = document["automata"]
    automaton["locations"].append({"name": "lost"})
    automaton["edges"][0]["destinations"][1]["location"] = "lost"
    path = written(tmp_path, json.dumps(document), "walker.jani")
    model = read_with_storm(path, goal="x = 3", cost="toll").model
    assert set(model.states) == {(k, "l") for k in range(4)} | {(k, "lost") for k in range(3)}


def rows_of(rows):
    builder = stormpy.datastructures.SparseMatrixBuilder[float](
        has_custom_row_grouping=True, row_groups=len(rows)
    )
    for row, entries in enumerate(rows):
        builder.new_row_group(row)
        for column, chance in entries.items():
            builder.add_next_value(row, column, chance)
    return builder.build()


def hand_made(**rewards):
    """Two states: one action to the goal or back."""
    labels = stormpy.models.StateLabeling(2)
    for label, state in (("init", 0), ("end", 1), ("the pit", 0)):
        labels.add_label(label)
        labels.add_label_to_state(label, state)
    parts = stormpy.models.SparseModelComponents[float](
        transition_matrix=rows_of([{0: 0.5, 1: 0.5}, {1: 1.0}]),
        state_labeling=labels,
        reward_models={"r": stormpy.models.SparseRewardModel[float](**rewards)},
    )
    return stormpy.models.SparseMdp[float](parts)


def test_rewards_of_states_actions_and_transitions_add_up():
    by_state = {"optional_state_reward_vector": [0.1, 5.0]}
    assert set(from_stormpy(hand_made(**by_state), goal="end").model.costs) == {0.1}
    all_three = hand_made(
        **by_state,
        optional_state_action_reward_vector=[0.2, 7.0],
        optional_transition_reward_matrix=rows_of([{0: 0.5, 1: 1.0}, {}]),
    )
    model = from_stormpy(all_three, goal='"end" & !"init"', cost="r").model
    assert model.costs.tolist() == [0.8, 1.3]
    assert list(model.state_labels) == ["end", "the pit"]
    negative = hand_made(optional_state_reward_vector=[-1.0, 0.0])
    words = "cost 'r': action 0 of state 0 has a negative cost"
    refused(words, from_stormpy, negative, goal="end")


def test_models_that_are_no_decision_processes_in_floats_are_refused(tmp_path):
    program = stormpy.parse_prism_program(str(written(tmp_path, PROGRAM)))
    with_p, _ = stormpy.instantiate_constants(program, "N=2")
    ready, _ = stormpy.instantiate_constants(program, "N=2,p=0.5")
    for words, model, goal in (
        ("are parameters: build it", stormpy.build_model[stormpy.RationalFunction](with_p), "done"),
        ("are fractions: build it", stormpy.build_model[stormpy.Rational](ready), "done"),
        ("is symbolic", stormpy.build_symbolic_model(ready), "done"),
        ("must be a model of stormpy, not dict", {}, "done"),
        ("no state has the label 'doen'", stormpy.build_model(ready), "doen"),
    ):
        refused(words, from_stormpy, model, goal=goal, cost="time")


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
def test_storm_agrees_on_published_models(name, cost, tmp_path):
    """The greatest goal probability, and the least cost where three tenths of it may be lost."""
    case = load_case(name, cost)
    choices = case.floats()
    whole = SSP.from_transitions(choices, case.goal, treat_actionless_as_dead_ends=True)
    # where the goal is out of reach an episode is over, while Storm would go on counting
    ended = choices | {state: {} for state in dead_end_labels(whole)}
    model = SSP.from_transitions(ended, case.goal, treat_actionless_as_dead_ends=True)
    write_umb(model, tmp_path / "m.umb", start=case.start)
    theirs = in_storm(tmp_path / "m.umb")
    best = solve(MaxProb(model, case.start)).objective
    assert value(theirs, 'Pmax=? [F "goal"]') == pytest.approx(best, abs=1e-6)
    wanted = 0.7 * best
    cheapest = value(theirs, f'multi(R{{"cost"}}min=? [C], P>={wanted!r} [F "goal"])')
    problem = MCMP(model, case.start, failure_budget=1.0 - wanted, give_up="dead_ends")
    assert cheapest == pytest.approx(solve(problem).objective, rel=1e-6, abs=1e-6)


def test_what_is_missing_is_named(monkeypatch, tmp_path):
    refused(
        "no.prism", read_with_storm, tmp_path / "no.prism", goal="done", error=FileNotFoundError
    )
    monkeypatch.setitem(sys.modules, "stormpy", None)
    missing = {"error": MissingDependencyError}
    words = r"pip install '\.\[storm\]'"
    refused(words, read_with_storm, written(tmp_path, PROGRAM), goal="done", **missing)
