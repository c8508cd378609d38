"""Dead-ends are listed in every format of a model, by states or by labels of theirs."""

import json

import numpy as np
import pytest

from formulations.command_line import main
from refusing import refused
from ssp_lp import SSP, Axis, ContinuousModel, Grid, discretise
from ssp_lp.io import from_gymnasium, from_matrices, read_any, read_drn, read_umb, write_any

ROUTES = {
    "alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)],
    "road": [(0.9, "home", 9.0), (0.1, "lost", 5.0)],
}
MODEL = SSP.from_transitions(
    {"depot": ROUTES}, goal={"home"}, dead_ends={"wreck", "lost"},
    state_labels={"crash": {"wreck"}},
)  # fmt: skip


@pytest.mark.parametrize("ending", [".json", ".drn", ".umb", ".npz"])
def test_dead_ends_of_files_are_listed_by_states_or_labels(tmp_path, ending, capsys):
    path = tmp_path / f"model{ending}"
    write_any(MODEL, path, start="depot")
    goal = {".json": "home", ".npz": []}.get(ending, "goal")
    states = read_any(path, goal).model.states
    wreck, lost = (states[MODEL.index_of(name)] for name in ("wreck", "lost"))
    ends = {wreck, lost}
    for listed in (ends, ["crash", lost], [str(lost), "crash"], ends.__contains__):
        assert read_any(path, goal, dead_ends=listed).model.n_states == 4
    for listed in ("crash", ["crash"], {wreck}):
        refused("where .* neither a goal nor a dead-end", read_any, path, goal, dead_ends=listed)
    refused("'crahs' .*did you mean 'crash'", read_any, path, goal, dead_ends=["crahs"])

    # the same at the command line
    words = ["info", str(path), *(["--goal", goal] if goal else []), "--dead-ends", "crash"]
    assert main(words) == 2
    assert "neither a goal nor a dead-end" in capsys.readouterr().err
    assert main([*words, str(lost)]) == 0


def test_the_deadlocks_of_a_file_are_a_label_as_well(tmp_path):
    for ending, read in ((".drn", read_drn), (".umb", read_umb)):
        path = tmp_path / f"model{ending}"
        write_any(MODEL, path, start="depot")
        found = read(path, goal="goal", dead_ends="deadlock").model
        assert found.n_states == 4
        assert "deadlock" not in found.state_labels


def test_a_json_file_lists_its_dead_ends(tmp_path):
    table = {"goal": ["home"], "dead_ends": ["wreck"], "transitions": {"depot": ROUTES}}
    path = tmp_path / "roads.json"
    path.write_text(json.dumps(table))
    refused("'lost', where action 'road' of state 'depot' leads", read_any, path, [])
    assert read_any(path, [], dead_ends=["wreck", "lost"]).model.n_states == 4
    path.write_text(json.dumps(table | {"dead_ends": "wreck"}))
    refused("'dead_ends' must be a list of states", read_any, path, [])


def test_a_json_file_is_written_with_its_dead_ends(tmp_path):
    path = tmp_path / "roads.json"
    write_any(MODEL, path, start="depot")
    table = json.loads(path.read_text())
    assert table["dead_ends"] == ["wreck", "lost"]
    assert read_any(path, []).model.states == MODEL.states
    table["transitions"]["depot"]["road"][0][1] = "hoem"
    path.write_text(json.dumps(table))
    refused("'hoem', where .* did you mean 'home'", read_any, path, [])

    # with another goal the states that are listed may be no dead-ends
    write_any(MODEL, path, start="depot")
    assert read_any(path, "wreck").model.goal_mask.sum() == 1
    none = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, goal={"b"}, dead_ends=())
    write_any(none, path)
    table = json.loads(path.read_text())
    assert table["dead_ends"] == []
    table["transitions"]["a"]["go"] = [[0.5, "b", 1.0], [0.5, "c", 1.0]]
    path.write_text(json.dumps(table))
    refused("'c', where action 'go' of state 'a' leads", read_any, path, [])


def test_dead_ends_of_matrices_and_of_worlds():
    go = np.array([[0.0, 0.5, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    options = {"goal": {1}, "costs": [1.0, 0.0, 0.0], "state_labels": {"pit": {2}}}
    assert from_matrices([go], **options, dead_ends="pit").n_states == 3
    refused("state 2, where", from_matrices, [go], **options, dead_ends=set())
    world = ContinuousModel(
        Grid([Axis(0.0, 1.0, cells=2)]), actions=["go"], dead_ends={"over": 0.0}, outside="over",
        step=lambda point, action, noise: ((point[0] + 1.0,), 1.0, np.where(point[0] < 0.5, 1, 0)),
    )  # fmt: skip
    assert discretise(world).with_dead_ends("over").n_states == 4


def test_ends_of_an_environment_are_listed_as_states_or_by_a_predicate():
    gym = pytest.importorskip("gymnasium")
    lake = gym.make("FrozenLake-v1")
    holes = {5, 7, 11, 12}
    for listed in (holes, lambda state: state in holes):
        assert from_gymnasium(lake, goal={15}, dead_ends=listed, horizon=None).model.n_states == 16
    refused("state 12, where", from_gymnasium, lake, dead_ends=holes - {12})
    refused("14 is listed in dead_ends, but", from_gymnasium, lake, dead_ends={*holes, 14})
    refused("'15' is not a state.*did you mean 15", from_gymnasium, lake, goal={"15"})
    refused("dead_ends: 99 is not a state", from_gymnasium, lake, dead_ends={99})
    assert main(["info", "gym:FrozenLake-v1", "--horizon", "none", "--dead-ends", "5"]) == 2
