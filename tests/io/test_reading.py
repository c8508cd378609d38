"""Models of every format are read again, with their dead-ends."""

import json
from functools import cache

import numpy as np
import pytest

from cases import FOLDER, published
from checks import optima
from formulations import MaxProb
from formulations.command_line import main
from random_models import drawn_model
from refusing import refused
from small_models import ALONE, AWKWARD, FIRST, model_of
from ssp_lp import SSP, Axis, ContinuousModel, Grid, discretise, solve
from ssp_lp.io import (
    from_gymnasium,
    from_matrices,
    from_stormpy,
    read_any,
    read_drn,
    read_umb,
    write_any,
)
from storm_values import in_storm

# The one door by which models of every format come in and go out: the optimum survives.


PUBLISHED = ["gubs_river-alt1", "gubs_river4x4", "prism_robot_goal1", "qcomp_cdrive.3"]
PUBLISHED += ["qcomp_elevators.a-3-3", "qcomp_triangle-tireworld.9", "storm_compromise_x1"]
MODELS = {"first": (FIRST, "depot"), "awkward": (AWKWARD, ("s", 1)), "alone": (ALONE, "g")}
CELLS = {(0, True): {"on": [(0.75, (1, False), 2.0), (0.25, (2, True), 2.0)]}, (2, True): {}}
MODELS["cells"] = model_of(CELLS, (1, False)), (0, True)
MODELS |= {f"drawn {seed}": (drawn_model(seed, 12)[0], "s0") for seed in (0, 2)}
MODELS |= {name: published(name) for name in PUBLISHED}
ENDINGS = ["json", "drn", "npz", "umb"]
SAYS_ITSELF = ("npz", "json", "json.gz")


@cache
def kept(name):
    """A budget, and the optima within it."""
    model, start = MODELS[name]
    budget = 1.0 - 0.8 * solve(MaxProb(model, start)).objective
    return budget, pytest.approx(optima(model, start, budget), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "way"),
    [(name, way) for name in MODELS for way in ENDINGS]
    + [(name, f"{way}.gz") for name in ("first", "awkward") for way in ("json", "drn")]
    + [("first", "drn.xz")]
    + [(name, way) for name in ("first", "awkward", "alone") for way in ("storm.umb", "storm.drn")],
)
def test_whatever_is_written_is_read_again(name, way, tmp_path):
    model, start = MODELS[name]
    path = tmp_path / f"m.{way}"
    write_any(model, path, {start: 1.0} if way == "drn" else start)
    assert path.exists()
    if way.startswith("storm"):
        found = from_stormpy(in_storm(path), goal="goal", cost="cost")
    else:
        found = read_any(path, [] if way in SAYS_ITSELF else ["goal"])
    begin = start if way == "npz" else found.start
    budget, known = kept(name)
    assert optima(found.model, begin, budget) == known
    assert set(found.model.state_labels) - {"paying"} == set(model.state_labels)


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_model_is_read_as_stated(name):
    found = read_any(FOLDER / "models" / f"{name}.json.gz", [], "unit")
    budget, known = kept(name)
    assert optima(found.model, found.start, budget) == known


def test_what_a_format_does_not_have_is_refused(tmp_path):
    write_any(ALONE, tmp_path / "m.npz")
    write_any(ALONE, tmp_path / "m.drn", "g")
    words = r"m\.drn has no constants: leave constants out"
    refused(words, read_any, tmp_path / "m.drn", ["goal"], constants="N=3")
    refused(r"say in which state m\.umb begins", write_any, ALONE, tmp_path / "m.umb")
    refused(r"'m\.txt' must end in one of .*\.umb", write_any, ALONE, tmp_path / "m.txt", "g")
    drawn = {("s", 1): 0.5, "t": 0.5}
    refused("the file needs one start: name a state", write_any, AWKWARD, tmp_path / "m.drn", drawn)
    program = "dtmc\nconst int N;\nmodule m\n s : [0..N];\n [] s<N -> (s'=s+1);\nendmodule\n"
    (tmp_path / "m.pm").write_text(program, encoding="utf-8")
    found = read_any(tmp_path / "m.pm", ["s=N"], constants="N=3")
    assert (found.start, found.model.n_states) == ((0,), 4)


# Dead-ends are listed in every format of a model, by states or by labels of theirs.


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
