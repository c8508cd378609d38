"""Model files: round trips keep the optimum, texts read as they should, broken files are named."""

import gzip
import io
import json
import zipfile
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp

from cases import load_case
from checks import optima
from examples.checks.damaged_files import mutated
from formulations import MCMP
from small_models import FIRST, model_of
from ssp_lp import SSP, ModelError, solve
from ssp_lp.io import (
    from_matrices,
    load_model,
    read_drn,
    read_prism,
    save_model,
    write_drn,
    write_prism,
)


def _grid():
    """A robot in a corridor: tuples as states, two ends, labels with spaces."""

    def successors(cell):
        x, y = cell
        if cell == (1, 0):
            return {}
        moves = {(1, 0): (x + 1, y), (0, 1): (x, y + 1), (0, -1): (x, y - 1)}
        inside = {a: to for a, to in moves.items() if to[0] <= 3 and 0 <= to[1] <= 1}
        return {
            a: [(0.8, to, 0.1), (0.1, cell, 0.1), (0.1, (min(x + 1, 3), 0), 0.1)]
            for a, to in inside.items()
        }

    return SSP.from_successors(
        (0, 0),
        successors,
        {(3, 1)},
        state_labels={"the pit": lambda cell: cell == (1, 0), "edge": lambda cell: cell[1] == 1},
        treat_actionless_as_dead_ends=True,
    )


def _published(name, cost):
    case = load_case(name, cost)
    return SSP.from_transitions(case.floats(), case.goal, treat_actionless_as_dead_ends=True)


CASES = {
    "first": (FIRST, "depot", 0.05),
    "grid": (_grid(), (0, 0), 0.3),
    "river": (
        _published("gubs_river-alt1", "unit"),
        load_case("gubs_river-alt1", "unit").start,
        0.6,
    ),
    "robot": (_published("prism_robot_goal1", "unit"), 0, 0.75),
    "elevators": (_published("qcomp_elevators.a-3-3", "unit"), 0, 0.99),
    "triangle": (_published("qcomp_triangle-tireworld.9", "unit"), 0, 0.5),
}
each_case = pytest.mark.parametrize("name", sorted(CASES))


@each_case
@pytest.mark.parametrize("way", ["npz", "drn", "drn.gz", "prism"])
def test_a_round_trip_keeps_the_optimum(name, way, tmp_path):
    model, start, budget = CASES[name]
    path = tmp_path / f"model.{way}"
    if way == "npz":
        save_model(model, path)
        again, begin = load_model(path), start
    elif way == "prism":
        write_prism(model, path, start=start)
        found = read_prism(path, goal="goal")
        again, begin = found.model, found.start
    else:
        write_drn(model, path, start=start)
        found = read_drn(path, goal="goal", cost="cost")
        again, begin = found.model, found.start
    assert (path.with_name("model.drn.gz").exists()) == (way == "drn.gz")
    assert optima(again, begin, budget) == pytest.approx(
        optima(model, start, budget), rel=1e-12, abs=1e-12
    )


@each_case
def test_an_archive_is_the_same_model(name, tmp_path):
    model, _, _ = CASES[name]
    save_model(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert list(again.states) == list(model.states)
    assert [type(s) for s in again.states] == [type(s) for s in model.states]
    assert [again.action_of(k) for k in range(again.n_pairs)] == [
        model.action_of(k) for k in range(model.n_pairs)
    ]
    for field in ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs"):
        assert np.array_equal(getattr(again, field), getattr(model, field))
    assert np.array_equal(again.goal_mask, model.goal_mask)
    assert {k: list(v) for k, v in again.state_labels.items()} == {
        k: list(v) for k, v in model.state_labels.items()
    }


def test_an_archive_keeps_fractions_and_odd_names(tmp_path):
    third = Fraction(1, 3)
    model = model_of(
        {("é", 1.5): {1: [(0.5, "g", third), (0.5, (0, (True, "x")), 2)]}, (0, (True, "x")): {}}
    )
    save_model(model, tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    assert again.exact_costs == {float(third): third}
    assert again.states == [("é", 1.5), (0, (True, "x")), "g"]


def test_an_archive_of_arrays_keeps_what_is_left_out(tmp_path):
    arrays = {"pair_offsets": [0, 1, 1], "outcome_offsets": [0, 2], "successors": [0, 1]}
    model = SSP.from_arrays(**arrays, probabilities=[0.5, 0.5], costs=1.0, goal_states=[1])
    save_model(model, tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    assert again.states == range(2)
    assert again.action_names == range(1)
    assert again.costs.strides == (0,)


@pytest.mark.parametrize("name", [frozenset({1}), (1, b"x"), 2j])
def test_a_name_that_cannot_be_kept_is_named(name, tmp_path):
    model = SSP.from_transitions({name: {"a": [(1.0, "g", 1)]}}, goal={"g"})
    with pytest.raises(ModelError, match=r"the label .* cannot be written"):
        save_model(model, tmp_path / "m.npz")


def changed(path, **arrays):
    """The archive with other arrays, or without some."""
    with np.load(path, allow_pickle=False) as found:
        kept = {**found, **arrays}
    other = path.with_name("changed.npz")
    np.savez_compressed(other, **{name: a for name, a in kept.items() if a is not None})
    return other


def with_texts(path, **entries):
    with np.load(path, allow_pickle=False) as found:
        texts = json.loads(found["header"].tobytes()) | entries
    return changed(path, header=np.frombuffer(json.dumps(texts).encode(), dtype=np.uint8))


def test_archives_that_are_none_are_refused_by_name(tmp_path):
    path = tmp_path / "m.npz"
    save_model(FIRST, path)
    with pytest.raises(ModelError, match="costs is missing"):
        load_model(changed(path, costs=None))
    with pytest.raises(ModelError, match=r"version 2, .* install a newer"):
        load_model(with_texts(path, version=2))
    with pytest.raises(ModelError, match="no ssp-lp model file"):
        load_model(with_texts(path, format="something else"))
    with pytest.raises(ModelError, match="another type"):
        load_model(changed(path, costs=np.array([{}], dtype=object)))
    with pytest.raises(ModelError, match="another type"):
        load_model(changed(path, successors=np.zeros((2, 2), dtype=np.int32)))
    with pytest.raises(ModelError, match="probabilities must have length"):
        load_model(changed(path, probabilities=np.ones(1)))
    with pytest.raises(ModelError, match="names of states"):
        load_model(with_texts(path, states=["depot"]))
    with pytest.raises(ModelError, match="no fraction"):
        load_model(with_texts(path, exact_costs=[[0.5, "1e999999999"]]))
    path.write_bytes(b"no archive")
    with pytest.raises(ModelError, match="no ssp-lp model file"):
        load_model(path)


def test_an_array_cannot_claim_more_than_is_there(tmp_path):
    path = tmp_path / "m.npz"
    save_model(FIRST, path)
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    )
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "n.npz", "w") as new:
        for name in old.namelist():
            new.writestr(name, head.getvalue() if name == "costs.npy" else old.read(name))
    with pytest.raises(ModelError, match="costs has another type or size"):
        load_model(tmp_path / "n.npz")


DRN = """// Exported by storm
@type: MDP
@value_type: double
@parameters

@reward_models
time "coins"
@nr_states
4
@nr_choices
5
@model
state 0 [0.1, 5] init "a place"
\taction go [0.2, 1]
\t\t1 : 0.5
\t\t2: 1/4
\t\t3 :0.25
\taction go [1, 1]
\t\t0 : 1
state 1 [3,3] done
\taction __NOLABEL__ [0, 0]
\t\t0 : 1
state 2 [1, 0] deadlock dead_end
\taction 0
\t\t2 : 1
// between
state 3
\taction 0 [1e1, 7]
\t\t1 : 1
"""


def drn(tmp_path, text):
    path = tmp_path / "hand.drn"
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


def test_a_drn_text_reads_as_it_should(tmp_path):
    found = read_drn(drn(tmp_path, DRN), goal="done", cost="time")
    model = found.model
    assert found.start == 0
    assert [model.action_of(k) for k in range(model.n_pairs)] == ["go", "go#2", "0"]
    assert model.pair_offsets.tolist() == [0, 2, 2, 2, 3]  # done, and a deadlock
    assert model.successors.tolist() == [1, 2, 3, 0, 1]
    assert model.probabilities.tolist() == [0.5, 0.25, 0.25, 1.0, 1.0]
    assert model.costs.tolist() == [0.3, 0.3, 0.3, 1.1, 10.0]  # in decimals
    assert {name: at.tolist() for name, at in model.state_labels.items()} == {"a place": [0]}
    crlf = read_drn(drn(tmp_path, DRN.replace("\n", "\r\n")), goal="done", cost="coins").model
    assert crlf.costs.tolist() == [6.0, 6.0, 6.0, 6.0, 7.0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("@type: MDP", "@type: POMDP", "line 2: models of type 'POMDP'"),
        ("@type: MDP\n", "", "@type and @nr_states must come"),
        ("@type: MDP", "@tpye: MDP", "line 2: '@tpye' is no section"),
        ("double", "double-interval", "line 3: values of type"),
        ("@parameters\n", "@parameters\np", "line 5: a model with parameters"),
        ("@model", "@nr_states\n4\n@model", "@nr_states is there twice"),
        ("\n4\n", "\n1000000000000000\n", "the header says 1000000000000000 states"),
        ("\n4\n", "\n-4\n", "is no number"),
        ("\n4\n", "\n3\n", "there is no state 3"),
        ("\n5\n@model", "\n6\n@model", "and 6 choices"),
        ("1 : 0.5", "1 : 0.6", "action 'go' of state 0: probabilities sum to 1.1"),
        ("1 : 0.5", "1 : half", "line 15: 'half' is no number"),
        ("1 : 0.5", "1 : 1/0", "line 15: '1/0' is no number"),
        ("1 : 0.5", "1 : [0.4, 0.5]", "line 15: a transition is written"),
        ("1 : 0.5", "1 0.5 :", "line 15: a transition is written"),
        ("1 : 0.5", "1_0 : 0.5", "line 15: '1_0' is no whole number"),
        ("1 : 0.5", "99999999999999999999 : 0.5", "line 15: .* is no whole number"),
        ("[0.2, 1]", "[0.2]", "line 14: 1 rewards for 2"),
        ("[0.2, 1]", "[-1, 1]", "action 'go' of state 0 has a negative cost"),
        ("[0.2, 1]", "[nan, 1]", "action 'go' of state 0 has a cost that is NaN"),
        ("state 2", "state 7", "line 23: state 2 should come here"),
        ('"a place"', '"a place', "no partner"),
        ("state 1 [3,3] done", "state 1 !3 done", "exit rates"),
        ("// between", "between", "line 26: neither a state"),
        ("\taction 0\n", "", "line 24: it stands before"),
        ("\t\t0 : 1\nstate 1", "state 1", "action 'go#2' of state 0 has no outcomes"),
        ("@model", "@modle", "is no section"),
    ],
)
def test_an_error_in_a_drn_text_names_its_line(old, new, message, tmp_path):
    assert old in DRN
    with pytest.raises(ModelError, match=message):
        read_drn(drn(tmp_path, DRN.replace(old, new, 1)), goal="done", cost="time")


def test_a_drn_cost_must_be_chosen(tmp_path):
    path = drn(tmp_path, DRN)
    with pytest.raises(ModelError, match=r"choose one of the reward models.*'time', 'coins'"):
        read_drn(path, goal="done")
    with pytest.raises(ModelError, match="no reward model 'fuel'"):
        read_drn(path, goal="done", cost="fuel")
    with pytest.raises(ModelError, match="no state has the label 'home'; labels: 'a place'"):
        read_drn(path, goal="home", cost="time")
    kept = read_drn(drn(tmp_path, DRN.replace("deadlock ", "")), goal="done", cost="time").model
    assert kept.pair_offsets.tolist() == [0, 2, 2, 3, 4]  # a loop that is no deadlock stays
    unnamed = DRN.replace('time "coins"', "").replace(", 5]", "]").replace(", 1]", "]")
    unnamed = unnamed.replace("[3,3]", "[]").replace(", 0]", "]").replace(", 7]", "]")
    for cost in (None, ""):
        costs = read_drn(drn(tmp_path, unnamed), goal="done", cost=cost).model.costs
        assert costs.tolist() == [0.3, 0.3, 0.3, 1.1, 10.0]
    unnamed = unnamed.replace("action go", "action __NOLABEL__")
    actions = read_drn(drn(tmp_path, unnamed), goal="done").model.action_names
    assert list(actions) == ["0", "1"]
    bare = (
        "@type: DTMC\n@nr_states\n2\n@model\nstate 0\naction 0\n1 : 1\nstate 1 g\naction 0\n1 : 1"
    )
    found = read_drn(drn(tmp_path, bare), goal="g")
    assert found.model.costs.tolist() == [1.0]
    with pytest.raises(ModelError, match="0 initial states"):
        _ = found.start


PRISM = {
    "tra": "5 6 8\n3 0 4 1 b\n0 0 1 0.5 a\n0 0 2 0.5 a\n0 1 3 1\n1 0 1 1\n2 0 2 0.9\n2 0 1 0.1\n"
    "4 0 4 1\n",
    "lab": '0="init" 1="deadlock" 2="done" 3="odd one"\n0: 0 3\n1: 2\n4: 1\n',
    "sta": "(x,b)\n0:(0,true)\n1:(1,false)\n2:(2,true)\n3:(3,true)\n4:(-4,true)\n",
    "srew": '# Reward structure "energy"\n# State rewards\n5 2\n0 0.1\n2 2\n',
    "trew": '# Reward structure "energy"\n# Transition rewards\n5 6 2\n0 0 1 0.2\n3 0 4 7\n',
}


def prism(tmp_path, **changes):
    for ending, text in (PRISM | changes).items():
        if text is not None:
            (tmp_path / f"hand.{ending}").write_text(text, encoding="utf-8", newline="\n")
    return tmp_path / "hand"


def test_prism_texts_read_as_they_should(tmp_path):
    found = read_prism(prism(tmp_path), goal="done", cost="energy")
    model = found.model
    assert model.states == [(0, True), (1, False), (2, True), (3, True), (-4, True)]
    assert found.start == (0, True)
    assert [model.action_of(k) for k in range(model.n_pairs)] == ["a", "1", "0", "b"]
    assert model.successors.tolist() == [1, 2, 3, 2, 1, 4]
    assert model.probabilities.tolist() == [0.5, 0.5, 1.0, 0.9, 0.1, 1.0]
    assert model.costs.tolist() == [0.3, 0.1, 0.1, 2.0, 2.0, 7.0]
    assert model.state_labels["odd one"].tolist() == [0]
    packed = tmp_path / "hand.tra"
    (tmp_path / "hand.tra.gz").write_bytes(gzip.compress(packed.read_bytes()))
    packed.unlink()
    assert read_prism(tmp_path / "hand.tra.gz", goal="done").model.n_outcomes == 6


def test_a_prism_structure_is_chosen_by_name(tmp_path):
    base = prism(tmp_path, srew=None, trew=None, sta=None, srew1=None)
    assert set(read_prism(base, goal="done").model.costs) == {1.0}
    (tmp_path / "hand1.srew").write_text('# Reward structure "time"\n5 1\n0 3\n')
    (tmp_path / "hand2.trew").write_text('# Reward structure "coins"\n5 6 1\n3 0 4 7\n')
    with pytest.raises(ModelError, match=r"choose one .* 'time', 'coins'"):
        read_prism(base, goal="done")
    assert read_prism(base, goal="done", cost="time").model.costs.tolist() == [3, 3, 3, 0, 0, 0]
    assert read_prism(base, goal="done", cost="coins").model.costs.tolist() == [0, 0, 0, 0, 0, 7]


def test_a_markov_chain_of_prism(tmp_path):
    texts = {"tra": "3 4\n0 1 0.5\n0 2 0.5\n1 1 1\n2 2 1\n", "sta": None}
    rewards = {"srew": "3 1\n0 2\n", "trew": "3 1\n0 2 5\n"}
    labels = '0="init" 1="done"\n1: 1\n'
    found = read_prism(prism(tmp_path, **texts, **rewards, lab=labels), goal="done")
    assert found.model.costs.tolist() == [2.0, 7.0, 0.0]


@pytest.mark.parametrize(
    ("ending", "text", "message"),
    [
        ("tra", "", "tra, line 0: the first line"),
        ("tra", "1000000000000000 6 8\n0 0 1 1\n", "states of the lines are not those"),
        ("tra", "2 1 1\n0 0 999999999999 1\n", "states of the lines"),
        ("tra", "5 6 8\n0 0 1\n", "tra, line 2: the line must have 4"),
        ("tra", "5 6 8\n0 x 1 1\n", "tra, line 2: 'x' is no whole number"),
        ("tra", "2 1 2\n0 0 1 1\n", "header says"),
        ("lab", "init\n", "lab, line 1"),
        ("lab", '0="init" 2="done"\n9: 2\n', "lab, line 2"),
        ("lab", '0="init" 2="done"\n1: 7\n', "there is no label 7"),
        ("sta", "(x)\n0:(1,2)\n", "sta, line 2"),
        ("sta", "(x)\n0:(1)\n", "state 1 is missing"),
        ("sta", "(x)\n0:(a)\n", "neither a whole number"),
        ("srew", "5 1\n9 2\n", "srew: the states are not the 5"),
        ("srew", "5 3\n1 2\n", "header says 3 rewards"),
        ("trew", "5 6 1\n0 0 4 1\n", "twice, or does not exist"),
        ("trew", "5 6 2\n0 0 1 1\n0 0 1 1\n", "twice, or does not exist"),
        ("trew", "5 6 1\n0 0 1 -1\n", "negative cost"),
    ],
)
def test_an_error_in_a_prism_text_names_its_file(ending, text, message, tmp_path):
    with pytest.raises(ModelError, match=message):
        read_prism(prism(tmp_path, **{ending: text}), goal="done")


def test_outcomes_of_several_costs_keep_their_totals(tmp_path):
    model = model_of(
        {
            "s": {"a": [(0.25, "g", 0.1), (0.25, "g", 0.3), (0.5, "t", 0.3)]},
            "t": {"a": [(0.5, "g", 0.3), (0.5, "d", 0.3)], "b": [(1.0, "s", 0), (0.0, "d", 9)]},
            "d": {},
        }
    )
    write_drn(model, tmp_path / "m.drn", start="s")
    found = read_drn(tmp_path / "m.drn", goal="goal")
    text = (tmp_path / "m.drn").read_text()
    assert text.count("paying") == 2  # 0.2 before g, and before t
    assert "[0.2]" in text
    assert "999" not in text  # no 0.19999999999999998
    # and the reader takes them out again
    assert found.model.n_states == model.n_states
    assert set(found.model.costs) == {0.0, 0.1, 0.3}
    assert not found.model.state_labels
    assert optima(found.model, 0, 0.5) == pytest.approx(optima(model, "s", 0.5), rel=1e-12)
    write_drn(found.model, tmp_path / "n.drn", start=0)
    assert (tmp_path / "n.drn").read_text() == (tmp_path / "m.drn").read_text()


def test_what_cannot_be_exported_is_named(tmp_path):
    with pytest.raises(ModelError, match="'nowhere' is not a state"):
        write_drn(FIRST, tmp_path / "m.drn", start="nowhere")
    with pytest.raises(ModelError, match="begin in one state"):
        write_drn(FIRST, tmp_path / "m.drn", start={"depot": 1.0})
    for label in ("init", "deadlock", 'a"b', "a//b", ""):
        model = SSP.from_transitions({0: {0: [(1.0, 1, 1)]}}, {1}, state_labels={label: [0]})
        with pytest.raises(ModelError, match="cannot be written"):
            write_drn(model, tmp_path / "m.drn", start=0)
    assert not list(tmp_path.iterdir())


def loads_or_is_refused(load, path, **options):
    """Whether nothing worse happens than an error that names the file."""
    try:
        load(path, **options)
    except ModelError as error:
        return str(path.parent / path.stem) in str(error)
    return True


@pytest.mark.parametrize("seed", range(100))
def test_damaged_files_load_or_are_refused(seed, tmp_path):
    rng = np.random.default_rng(seed)
    path = drn(tmp_path, DRN)
    path.write_bytes(mutated(path.read_bytes(), rng))
    assert loads_or_is_refused(read_drn, path, goal="done", cost="time")
    packed = gzip.compress(DRN.encode(), mtime=0)
    path.write_bytes(mutated(packed, rng))
    assert loads_or_is_refused(read_drn, path, goal="done", cost="time")
    base = prism(tmp_path)
    ending = str(rng.choice(sorted(PRISM)))
    broken = base.with_suffix(f".{ending}")
    broken.write_bytes(mutated(broken.read_bytes(), rng))
    assert loads_or_is_refused(read_prism, base, goal="done")
    save_model(FIRST, tmp_path / "m.npz")
    archive = (tmp_path / "m.npz").read_bytes()
    (tmp_path / "m.npz").write_bytes(mutated(archive, rng))
    assert loads_or_is_refused(load_model, tmp_path / "m.npz")


MATRICES = np.array(
    [[[0.0, 0.9, 0.1], [0, 1, 0], [0, 0, 1]], [[0.0, 0.99, 0.01], [0, 1, 0], [0, 0, 0]]]
)


@pytest.mark.parametrize("sparse", [False, True])
def test_matrices_make_the_model(sparse):
    matrices = [sp.csr_matrix(m) for m in MATRICES] if sparse else MATRICES
    by_outcome = np.zeros((2, 3, 3))
    by_outcome[:, 0, 1], by_outcome[:, 0, 2] = [4, 9], [2, 5]
    costs = [sp.csr_array(m) for m in by_outcome] if sparse else by_outcome
    model = from_matrices(matrices, 1, costs=costs, actions=["alley", "road"])
    assert optima(model, 0, 0.05) == pytest.approx(optima(FIRST, "depot", 0.05), rel=1e-12)
    assert model.pair_offsets.tolist() == [0, 2, 2, 3]  # the wreck keeps its free loop
    by_pair = from_matrices(matrices, [1], rewards=[[-4, -9], [0, 0], [0, 0]])
    assert by_pair.costs.tolist() == [4.0, 4.0, 9.0, 9.0, 0.0]
    assert from_matrices(matrices, [1], costs=[3, 0, 0]).costs.tolist() == [3.0] * 4 + [0.0]
    barred = from_matrices(matrices, [1], rewards=[[-4, -np.inf], [0, 0], [0, 0]])
    assert barred.n_pairs == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": [1], "rewards": [[1, 0]] * 3}, "action 0 of state 0 has the reward 1"),
        ({"goal": [1], "costs": [[1, 0]] * 2}, r"shape \(2, 2\) do not fit"),
        ({"goal": [1]}, "either costs or rewards"),
        ({"goal": [7], "costs": [0, 0, 0]}, "indices of states, 0 .. 2"),
        ({"goal": [True], "costs": [0, 0, 0]}, "indices of states"),
        ({"goal": [1], "costs": [0, 0, 0], "actions": ["a"]}, "1 names for 2 actions"),
    ],
)
def test_matrices_that_do_not_fit_are_named(options, message):
    with pytest.raises(ModelError, match=message):
        from_matrices(MATRICES, **options)
    with pytest.raises(ModelError, match="square"):
        from_matrices([np.ones((2, 3))], [0], costs=[1, 1])


def test_what_is_paid_until_a_failure_survives_a_round_trip(tmp_path):
    """A step that fails is paid in full, though its file pays in two steps."""
    write_drn(FIRST, tmp_path / "m.drn", start="depot")
    found = read_drn(tmp_path / "m.drn", goal="goal")
    dear = MCMP(found.model, 0, failure_budget=0.05, charge_failing_step=False)
    told = MCMP(FIRST, "depot", failure_budget=0.05, charge_failing_step=False)
    assert solve(dear).objective == pytest.approx(solve(told).objective, rel=1e-15)


def test_a_state_that_merely_bears_the_name_is_kept(tmp_path):
    """A state labelled "paying" is the model's own if it may do anything but pay."""
    model = model_of(
        {
            "s": {"a": [(1.0, "till", 1.0)]},
            "till": {"pay": [(0.5, "g", 1.0), (0.5, "s", 1.0)]},
            "bar": {"wait": [(1.0, "g", 1.0)]},
        },
        labels={"paying": ["till", "bar"]},
    )
    write_drn(model, tmp_path / "m.drn", start="s")
    found = read_drn(tmp_path / "m.drn", goal="goal").model
    assert found.n_states == 4
    assert found.state_labels["paying"].tolist() == [1, 2]


def test_a_negative_payment_is_not_hidden_by_a_sum(tmp_path):
    write_drn(FIRST, tmp_path / "m.drn", start="depot")
    text = (tmp_path / "m.drn").read_text(encoding="utf-8")
    assert "action pay [2.0]" in text
    (tmp_path / "m.drn").write_text(text.replace("pay [2.0]", "pay [-2.0]"), encoding="utf-8")
    with pytest.raises(ModelError, match="action 'pay' of state 3 has a negative cost"):
        read_drn(tmp_path / "m.drn", goal="goal")
