"""Model files: archives and texts read as they should, broken ones are named; matrices."""

import io
import json
import tarfile
import tracemalloc
import zipfile
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp

from checks import optima
from formulations import MCMP
from random_models import drawn_model
from refusing import refused
from small_models import AWKWARD, FIRST, model_of
from ssp_lp import SSP, SSPError, solve
from ssp_lp.io import (
    archives,
    fingerprint,
    from_matrices,
    load_model,
    read_any,
    read_drn,
    save_model,
    write_drn,
)
from tests.campaigns.damaged_files import GOALS, READ, REFUSED, damaged, verdict

ARRAYS = ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs", "goal_mask")
LEFT_OUT = SSP.from_arrays(
    pair_offsets=[0, 1, 1], outcome_offsets=[0, 2], successors=[0, 1], probabilities=[0.5, 0.5],
    costs=1.0, goal_states=[1],
)  # fmt: skip
ODD = {("é", 1.5): {1: [(0.5, "g", Fraction(1, 3)), (0.5, (0, (True, "x")), 2)]}}
ODD[0, (True, "x")] = {}


@pytest.mark.parametrize("model", [FIRST, AWKWARD, model_of(ODD), LEFT_OUT])
def test_an_archive_is_the_same_model(model, tmp_path):
    save_model(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert again.states == model.states
    assert list(map(type, again.states)) == list(map(type, model.states))
    pairs = range(model.n_pairs)
    assert list(map(again.action_of, pairs)) == list(map(model.action_of, pairs))
    for field in ARRAYS:
        assert np.array_equal(getattr(again, field), getattr(model, field))
        assert getattr(again, field).strides == getattr(model, field).strides
    labels = ({k: list(v) for k, v in one.state_labels.items()} for one in (again, model))
    assert next(labels) == next(labels)
    assert again.exact_costs == model.exact_costs
    assert type(again.action_names) is type(model.action_names)


@pytest.mark.parametrize("name", [frozenset({1}), (1, b"x"), 2j])
def test_a_name_that_cannot_be_kept_is_named(name, tmp_path):
    model = SSP.from_transitions({name: {"a": [(1.0, "g", 1)]}}, goal={"g"})
    refused(r"the label .* cannot be written", save_model, model, tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("texts", "arrays", "message"),
    [
        ({}, {"costs": None}, "costs is missing"),
        ({"version": 2}, {}, r"version 2, .* install a newer"),
        ({"format": "something else"}, {}, "not an ssp-lp model file"),
        ({}, {"costs": np.array([{}], dtype=object)}, "another type"),
        ({}, {"successors": np.zeros((2, 2), dtype=np.int32)}, "another type"),
        ({}, {"probabilities": np.ones(1)}, "probabilities must have length"),
        ({"states": ["depot"]}, {}, "one name for each state"),
        ({"exact_costs": [[0.5, "1e999999999"]]}, {}, "not a fraction"),
    ],
)
def test_archives_that_are_none_are_refused_by_name(texts, arrays, message, tmp_path):
    path = tmp_path / "m.npz"
    save_model(FIRST, path)
    with np.load(path) as found:
        header = json.dumps(json.loads(found["header"].tobytes()) | texts).encode()
        kept = {**found, "header": np.frombuffer(header, dtype=np.uint8), **arrays}
    np.savez(path, **{name: array for name, array in kept.items() if array is not None})
    refused(message, load_model, path)


def test_an_array_cannot_claim_more_than_is_there(tmp_path):
    (tmp_path / "none.npz").write_bytes(b"no archive")
    refused("not an ssp-lp model file", load_model, tmp_path / "none.npz")
    save_model(FIRST, tmp_path / "m.npz")
    head, claim = io.BytesIO(), {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    np.lib.format.write_array_header_1_0(head, claim)
    with zipfile.ZipFile(tmp_path / "m.npz") as old, zipfile.ZipFile(tmp_path / "n", "w") as new:
        for name in old.namelist():
            new.writestr(name, head.getvalue() if name == "costs.npy" else old.read(name))
    refused("costs has another type or size", load_model, tmp_path / "n")


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


def drn(tmp_path, text=DRN):
    path = tmp_path / "hand.drn"
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


def test_a_drn_text_reads_as_it_should(tmp_path):
    found = read_drn(drn(tmp_path), goal="done", cost="time")
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
        ("@type: MDP", "@tpye: MDP", "line 2: '@tpye' is not a known section"),
        ("double", "double-interval", "line 3: values of type"),
        ("@parameters\n", "@parameters\np", "line 5: a model with parameters"),
        ("@model", "@nr_states\n4\n@model", "@nr_states occurs twice"),
        ("\n4\n", "\n1000000000000000\n", "the header says 1000000000000000 states"),
        ("\n4\n", "\n-4\n", "is not a number"),
        ("\n4\n", "\n3\n", "there is no state 3"),
        ("\n5\n@model", "\n6\n@model", "and 6 choices"),
        ("1 : 0.5", "1 : 0.6", "action 'go' of state 0: probabilities sum to 1.1"),
        ("1 : 0.5", "1 : half", "line 15: 'half' is not a number"),
        ("1 : 0.5", "1 : 1/0", "line 15: '1/0' is not a number"),
        ("1 : 0.5", "1 : [0.4, 0.5]", "line 15: a transition must be"),
        ("1 : 0.5", "1 0.5 :", "line 15: a transition must be"),
        ("1 : 0.5", "1_0 : 0.5", "line 15: '1_0' is not a whole number"),
        ("1 : 0.5", "99999999999999999999 : 0.5", "line 15: .* is not a whole number"),
        ("[0.2, 1]", "[0.2]", "line 14: 1 rewards for 2"),
        ("[0.2, 1]", "[-1, 1]", "action 'go' of state 0 has a negative cost"),
        ("[0.2, 1]", "[nan, 1]", "action 'go' of state 0 has a cost that is NaN"),
        ("state 2", "state 7", "line 23: expected state 2"),
        ('"a place"', '"a place', "quotation mark is missing"),
        ("state 1 [3,3] done", "state 1 !3 done", "exit rates"),
        ("// between", "between", "line 26: neither a state"),
        ("\taction 0\n", "", "line 24: a transition must follow"),
        ("\t\t0 : 1\nstate 1", "state 1", "action 'go#2' of state 0 has no outcomes"),
        ("@model", "@modle", "is not a known section"),
        (DRN[DRN.index("@model") :], "", "the file ends before @model"),
    ],
)
def test_an_error_in_a_drn_text_names_its_line(old, new, message, tmp_path):
    assert old in DRN
    refused(message, read_drn, drn(tmp_path, DRN.replace(old, new, 1)), goal="done", cost="time")


def in_archive(path, kind, text):
    """Write texts as files of an archive in a folder."""
    members = {"folder/model.drn": text} if isinstance(text, str) else text
    if kind == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        return
    with tarfile.open(path, f"w:{kind}") as archive:
        folder = tarfile.TarInfo("folder")
        folder.type = tarfile.DIRTYPE
        archive.addfile(folder)
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content.encode())
            archive.addfile(member, io.BytesIO(content.encode()))


@pytest.mark.parametrize("kind", ["gz", "xz", "", "zip"])
def test_a_packed_drn_is_read_as_storm_packs_it(kind, tmp_path):
    path, known = tmp_path / "m.drn.gz", read_drn(drn(tmp_path), goal="done", cost="time").model
    in_archive(path, kind, DRN)
    found = read_drn(path, goal="done", cost="time").model
    assert all(np.array_equal(getattr(found, name), getattr(known, name)) for name in ARRAYS)
    for members in ({}, {"a.drn": DRN, "b.drn": DRN}):
        in_archive(path, kind, members)
        refused("m.drn.gz: an archive must contain one readable file", read_drn, path, goal="done")
    in_archive(path, kind, DRN)
    content = path.read_bytes().rstrip(b"\0")
    path.write_bytes(content[: len(content) // 2])
    refused(r"m\.drn\.gz", read_drn, path, goal="done", cost="time")


@pytest.mark.parametrize("ending", ["drn", "drn.gz", "drn.xz"])
def test_storm_reads_the_drn_that_is_written(ending, tmp_path):
    stormpy = pytest.importorskip("stormpy")
    path = tmp_path / f"m.{ending}"
    write_drn(FIRST, path, start="depot")
    theirs, ours = stormpy.build_model_from_drn(str(path)), read_drn(path, goal="goal").model
    assert theirs.nr_states == ours.n_states + 2  # two that only pay
    assert optima(ours, 0, 0.05) == pytest.approx(optima(FIRST, "depot", 0.05), rel=1e-12)


def test_a_reward_model_without_a_name_beside_others_in_drn(tmp_path):
    """Storm puts a blank behind each name, also where the name is empty."""
    for line, names in {
        " coins ": ["", "coins"],
        "time  ": ["time", ""],
        "time coins ": [],
    }.items():
        path = drn(tmp_path, DRN.replace('time "coins"', line))
        paid_by_each = [0.3, 0.3, 0.3, 1.1, 10.0], [6, 6, 6, 6, 7]
        costs = dict(zip(names or ["time", "coins"], paid_by_each, strict=True))
        for name, paid in costs.items():
            model = read_drn(path, goal="done", cost=name).model
            assert model.costs.tolist() == paid
            assert {n: c.tolist() for n, c in model.named_costs.items()} == costs


def test_lines_of_drn_may_be_spaced_and_commented(tmp_path):
    model = drawn_model(3, 60)[0]
    write_drn(model, path := tmp_path / "m.drn", start="s0")
    text = path.read_text(encoding="utf-8")
    head, body = text.split("@model\n")
    spaced = head + "@model\n" + "\n".join(line + " \n" for line in body.splitlines())
    for written in (text, spaced, spaced + "// end"):
        found = read_drn(drn(tmp_path, written), goal="goal").model
        assert optima(found, 0, 0.5) == pytest.approx(optima(model, "s0", 0.5), rel=1e-12)
        assert list(found.action_names) == list(map(str, model.action_names))
        wrong = written.replace("state 40", "state 41", 1)
        line = wrong[: wrong.index("state 41")].count("\n") + 1
        refused(rf"line {line}: expected state 40", read_drn, drn(tmp_path, wrong), goal="goal")


def test_what_storm_writes_is_read(tmp_path):
    stormpy = pytest.importorskip("stormpy")
    program, path = tmp_path / "m.prism", tmp_path / "m.drn"
    program.write_text(
        "mdp\nmodule m\n x : [0..9];\n [] x<9 -> 1/3:(x'=x+1)+2/3:true;\nendmodule\n"
        'rewards "time"\n true : 1;\nendrewards\nrewards\n x=2 : 0.5;\nendrewards\n'
        'label "end" = x=9;\n',
        encoding="utf-8",
    )
    options = stormpy.BuilderOptions()
    for name in ("all_labels", "all_reward_models", "state_valuations", "choice_labels"):
        getattr(options, f"set_build_{name}")()
    model = stormpy.build_model(stormpy.parse_prism_program(str(program)), options=options)
    stormpy.io.export_to_drn(model, str(path))
    assert "//[" in path.read_text(encoding="utf-8")
    found = read_drn(path, goal="end", cost="")
    assert set(found.model.named_costs) == {"time", ""}
    assert solve(MCMP(found.model, found.start, 0.0)).objective == pytest.approx(1.5)


def test_a_drn_cost_must_be_chosen(tmp_path):
    path = drn(tmp_path)
    refused(r"choose one of the reward models.*'time', 'coins'", read_drn, path, goal="done")
    refused("no reward model 'fuel'", read_drn, path, goal="done", cost="fuel")
    nowhere = "no state has the label 'home'; labels: 'a place'"
    refused(nowhere, read_drn, path, goal="home", cost="time")
    kept = read_drn(drn(tmp_path, DRN.replace("deadlock ", "")), goal="done", cost="time").model
    assert kept.pair_offsets.tolist() == [0, 2, 2, 3, 4]  # a loop that is no deadlock stays
    unnamed = DRN.replace('time "coins"', "").replace("[3,3]", "[]").replace(", 5]", "]")
    unnamed = unnamed.replace(", 0]", "]").replace(", 1]", "]").replace(", 7]", "]")
    for cost in (None, ""):
        costs = read_drn(drn(tmp_path, unnamed), goal="done", cost=cost).model.costs
        assert costs.tolist() == [0.3, 0.3, 0.3, 1.1, 10.0]
    unnamed = drn(tmp_path, unnamed.replace("action go", "action __NOLABEL__"))
    assert list(read_drn(unnamed, goal="done").model.action_names) == ["0", "1"]
    states = "state 0\naction 0\n1 : 1\nstate 1 g\naction 0\n1 : 1"
    found = read_drn(drn(tmp_path, f"@type: DTMC\n@nr_states\n2\n@model\n{states}"), goal="g")
    assert found.model.costs.tolist() == [1.0]
    refused("0 initial states", lambda: found.start)


def drn_text(model, start, path):
    write_drn(model, path, start=start)
    return path.read_text(encoding="utf-8")


def test_outcomes_of_several_costs_keep_their_totals(tmp_path):
    model = model_of(
        {
            "s": {"a": [(0.25, "g", 0.1), (0.25, "g", 0.3), (0.5, "t", 0.3)]},
            "t": {"a": [(0.5, "g", 0.3), (0.5, "d", 0.3)], "b": [(1.0, "s", 0), (0.0, "d", 9)]},
            "d": {},
        }
    )
    text = drn_text(model, "s", tmp_path / "m.drn")
    assert text.count("paying") == 2  # 0.2 before g, and before t
    assert "[0.2]" in text
    assert "999" not in text  # no 0.19999999999999998
    found = read_drn(tmp_path / "m.drn", goal="goal").model  # the reader takes them out again
    assert (found.n_states, set(found.costs)) == (model.n_states, {0.0, 0.1, 0.3})
    assert not found.state_labels
    assert optima(found, 0, 0.5) == pytest.approx(optima(model, "s", 0.5), rel=1e-12)
    assert drn_text(found, 0, tmp_path / "n.drn") == text


def test_what_cannot_be_exported_is_named(tmp_path):
    path = tmp_path / "m.drn"
    refused("'nowhere' is not a state", write_drn, FIRST, path, start="nowhere")
    for label in ("init", "deadlock", 'a"b', "a//b", ""):
        model = SSP.from_transitions({0: {0: [(1.0, 1, 1)]}}, {1}, state_labels={label: [0]})
        refused("cannot be written", write_drn, model, path, start=0)
    assert not list(tmp_path.iterdir())


def test_what_is_paid_until_a_failure_survives_a_round_trip(tmp_path):
    """A step that fails is paid in full, though its file pays in two steps."""
    text = drn_text(FIRST, "depot", tmp_path / "m.drn")
    found = read_drn(tmp_path / "m.drn", goal="goal").model
    dear, told = (
        solve(MCMP(model, start, failure_budget=0.05, charge_failing_step=False)).objective
        for model, start in ((found, 0), (FIRST, "depot"))
    )
    assert dear == pytest.approx(told, rel=1e-15)
    assert "action pay [2.0]" in text  # and a negative payment is not hidden by the sum
    (tmp_path / "m.drn").write_text(text.replace("pay [2.0]", "pay [-2.0]"), encoding="utf-8")
    words = "action 'pay' of state 3 has a negative cost"
    refused(words, read_drn, tmp_path / "m.drn", goal="goal")


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


@pytest.mark.filterwarnings("ignore::ssp_lp.ModelWarning")
@pytest.mark.parametrize(
    "ending",
    ["json", "json.gz", "nested.json", "explicit.json", "prism", "drn", "drn.gz", "npz", "umb"],
)
def test_damaged_files_are_read_or_refused_by_name(ending, tmp_path):
    """A sample of `tests/campaigns/damaged_files.py`."""
    path, texts = tmp_path / f"m.{ending}", []
    for _ in damaged(ending, tmp_path, range(100)):
        try:
            read_any(path, GOALS.get(ending, ("goal",)))
        except SSPError as error:
            texts.append(str(error))
    assert len(texts) > 40
    assert "json" in ending or all("m." in text for text in texts)


MANY = 10**12


@pytest.mark.parametrize(
    ("ending", "text"),
    [
        ("json", f'{{"format": "explicit-mdp-v1", "num_states": {MANY}, "choices": [[]]}}'),
        ("json", f'{{"format": "explicit-mdp-v1", "goal": [{MANY}], "choices": [[]]}}'),
        ("drn", f"@type: MDP\n@nr_states\n{MANY}\n@model\nstate 0 goal\n\taction 0\n\t\t0 : 1\n"),
        ("prism", f'mdp\nmodule m\n x : [0..{MANY}] init 0;\nendmodule\nlabel "goal" = x = 0;\n'),
    ],
)
def test_a_claim_of_many_states_takes_no_memory(ending, text, tmp_path):
    path = tmp_path / f"m.{ending}"
    path.write_text(text, encoding="utf-8")
    assert verdict(ending, path) in (READ, REFUSED)


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
        ({"goal": [0], "costs": [1, 1], "transitions": [np.ones((2, 3))]}, "square"),
    ],
)
def test_matrices_that_do_not_fit_are_named(options, message):
    refused(message, from_matrices, **({"transitions": MATRICES} | options))


def test_members_of_an_archive_that_are_not_known_are_not_unpacked(tmp_path, monkeypatch):
    """An archive of a megabyte may hold a gigabyte: only what a model has is unpacked."""
    save_model(FIRST, tmp_path / "m.npz")
    claim = {"descr": "|u1", "fortran_order": False, "shape": (64 << 20,)}
    with (
        zipfile.ZipFile(tmp_path / "m.npz", "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("more.npy", "w") as member,
    ):
        np.lib.format.write_array_header_1_0(member, claim)
        for _ in range(64):
            member.write(bytes(1 << 20))
    tracemalloc.start()
    assert fingerprint(load_model(tmp_path / "m.npz")) == fingerprint(FIRST)
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()
    monkeypatch.setattr(archives, "_LARGEST_HEADER", 100)
    refused("its header has .* bytes, more than 100", load_model, tmp_path / "m.npz")
