"""UMB archives: read as the format says, written so that Storm reads them, broken ones named."""

import gzip
import io
import json
import tarfile

import numpy as np
import pytest

from formulations import MaxProb
from refusing import refused
from small_models import FIRST
from ssp_lp import solve
from ssp_lp.io import read_umb, write_umb

DOUBLE, RATIONAL = {"type": "double", "size": 64}, {"type": "rational", "size": 128}
SYSTEM = {
    "time": "discrete", "#players": 1, "#states": 3, "#initial-states": 1, "#choices": 4,
    "#choice-actions": 2, "#branches": 5, "#branch-actions": 0, "#observations": 0,
    "branch-probability-type": DOUBLE,
}  # fmt: skip
AP = {"applies-to": ["states"], "type": {"type": "bool", "size": 1}}
UNSIGNED = {"name": "x", "type": {"type": "uint", "size": 3}, "offset": -2}
VARIABLES = [
    UNSIGNED,
    {"padding": 2},
    {"name": "b", "type": {"type": "bool", "size": 1}},
    {"name": "k", "type": {"type": "int", "size": 10}},
]
INDEX = {
    "format-version": 1,
    "format-revision": 0,
    "transition-system": SYSTEM,
    "annotations": {
        "aps": {"g": AP, "p": {**AP, "alias": "the pit"}},
        "rewards": {
            "time": {"applies-to": ["states", "choices", "branches"], "type": DOUBLE},
            "toll": {"applies-to": ["choices"], "type": RATIONAL},
        },
    },
    "valuations": {"states": {"unique": True, "classes": [{"variables": VARIABLES}]}},
}
TOLLS = [(1, 3), (0, 1), (7, 2), (0, 5)]
# x + 2 in three bits, two of padding, b in one bit, k in ten bits
VALUATIONS = [0 | 0 << 5 | 1 << 6, 3 | 1 << 5 | (1024 - 1) << 6, 7 | 1 << 5 | 511 << 6]
FILES = {
    "state-to-choices.bin": np.array([0, 2, 3, 4], "<u8"),
    "state-is-initial.bin": np.array([1], "<u8"),
    "choice-to-branches.bin": np.array([0, 2, 3, 4, 5], "<u8"),
    "branch-to-target.bin": np.array([1, 2, 0, 1, 2], "<u8"),
    "branch-to-probability.bin": np.array([0.25, 0.75, 1.0, 1.0, 1.0], "<f8"),
    "actions/choices/values.bin": np.array([1, 0, 0, 0], "<u4"),
    "actions/choices/string-mapping.bin": np.array([0, 0, 3], "<u8"),
    "actions/choices/strings.bin": np.frombuffer("gö".encode(), "u1"),
    "annotations/aps/g/states/values.bin": np.array([0b010], "<u8"),
    "annotations/aps/p/states/values.bin": np.array([0b100], "<u8"),
    "annotations/rewards/time/states/values.bin": np.array([0.1, 0.0, 0.0], "<f8"),
    "annotations/rewards/time/choices/values.bin": np.array([0.2, 1.0, 0.0, 0.0], "<f8"),
    "annotations/rewards/time/branches/values.bin": np.array([0.0, 0.3, 0.0, 0.0, 0.0], "<f8"),
    "annotations/rewards/toll/choices/values.bin": np.array(TOLLS, "<i8"),
    "valuations/states/valuations.bin": np.array(VALUATIONS, "<u2"),
}
"""By hand from the specification: state 0 goes to the goal, 1, or the pit, 2, or stays."""


def archive(path, files=None, index=INDEX, mode="w"):
    with tarfile.open(path, mode) as made:
        every = {} if index is None else {"index.json": json.dumps(index).encode()}
        for name, values in {**every, **(FILES if files is None else files)}.items():
            data = values if isinstance(values, bytes) else values.tobytes()
            member = tarfile.TarInfo(name)
            member.size = len(data)
            made.addfile(member, io.BytesIO(data))
    return path


@pytest.mark.parametrize("mode", ["w", "w:gz", "w:xz"])
def test_an_archive_is_read_as_the_format_says(mode, tmp_path):
    found = read_umb(archive(tmp_path / "m.umb", mode=mode), goal="g", cost="time")
    model = found.model
    assert model.states == [(-2, False, 1), (1, True, -1), (5, True, 511)]
    assert found.start == (-2, False, 1)
    assert [model.action_of(k) for k in range(2)] == ["gö", "1"]
    assert model.successors[:3].tolist() == [1, 2, 0]
    assert model.probabilities[:3].tolist() == [0.25, 0.75, 1.0]
    assert model.costs[:3].tolist() == [0.3, 0.6, 1.1]  # in decimals
    assert model.named_costs["toll"][:3].tolist() == [1 / 3, 1 / 3, 0.0]
    assert model.state_labels["the pit"].tolist() == [2]
    assert solve(MaxProb(model, found.start)).objective == pytest.approx(0.25)


def test_files_that_are_absent_have_their_defaults(tmp_path):
    """A Markov chain: a choice in each state, a branch to each choice, unnamed actions."""
    names = ("state-is-initial.bin", "annotations/aps/g/states/values.bin")
    files = {name: FILES[name] for name in names}
    files["branch-to-target.bin"] = np.array([2, 1, 1], "<u8")
    files["branch-to-probability.bin"] = np.ones(3)
    index = {key: INDEX[key] for key in ("format-version", "transition-system")}
    index["transition-system"] = SYSTEM | {"#players": 0, "#choices": 3, "#branches": 3}
    index["annotations"] = {"aps": {"g": AP}}
    found = read_umb(archive(tmp_path / "m.umb", files, index), goal="g")
    assert found.model.states == range(3)
    assert solve(MaxProb(found.model, found.start)).objective == 1.0
    assert set(found.model.costs) == {1.0}


def test_what_a_variable_of_another_kind_names_is_numbered(tmp_path):
    optional = [{**UNSIGNED, "is-optional": True}, *VARIABLES[1:]]
    index = {**INDEX, "valuations": {"states": {"classes": [{"variables": optional}]}}}
    found = read_umb(archive(tmp_path / "m.umb", index=index), goal="g", cost="time")
    assert found.model.states == range(3)


def changed_system(**changes):
    return {**INDEX, "transition-system": SYSTEM | changes}


@pytest.mark.parametrize(
    ("index", "files", "message"),
    [
        (None, {}, "index.json is not JSON"),
        ({**INDEX, "format-version": 2}, {}, "not of version 1"),
        ({"format-version": 1}, {}, "'transition-system', of type dict"),
        (changed_system(time="stochastic"), {}, "only MDPs and DTMCs"),
        (changed_system(**{"#players": 2}), {}, "only MDPs and DTMCs"),
        (changed_system(**{"#observations": 2}), {}, "observations"),
        (changed_system(**{"#states": 10**12}), {}, "says 1000000000000 states, the files have 3"),
        (changed_system(**{"branch-probability-type": None}), {}, "branch-probability-type"),
        (
            changed_system(**{"branch-probability-type": {"type": "double-interval"}}), {},
            "'double-interval' with 0 bits",
        ),
        (INDEX, {"state-to-choices.bin": np.array([0, 2, 4], "<u8")}, "states, the files have 2"),
        (INDEX, {"state-to-choices.bin": np.array([0, 5, 3, 4], "<u8")}, "must not decrease"),
        (INDEX, {"choice-to-branches.bin": np.array([0, 9], "<u8")}, "from 0 to 5"),
        (INDEX, {"branch-to-target.bin": np.array([9, 2, 0, 1, 2], "<u8")}, "no state 9"),
        (INDEX, {"branch-to-probability.bin": b"1"}, "has 1 bytes, not 40"),
        (INDEX, {"actions/choices/values.bin": np.array([2, 0, 0, 0], "<u4")}, "code 2, but"),
        (INDEX, {"actions/choices/strings.bin": b"\xff\xff\xff"}, "is no UMB archive"),
        (INDEX, {"valuations/states/valuations.bin": b"123"}, "too short"),
        (
            INDEX,
            {"annotations/rewards/toll/choices/values.bin": np.zeros(8, "<i8")},
            "denominator of 0",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_an_archive_is_named(index, files, message, tmp_path):
    path = archive(tmp_path / "m.umb", FILES | files, index)
    assert "m.umb" in refused(message, read_umb, path, goal="g", cost="time")


def test_an_archive_that_is_none_is_named(tmp_path):
    (tmp_path / "m.umb").write_bytes(gzip.compress(b"no archive"))
    refused("m.umb is no UMB archive", read_umb, tmp_path / "m.umb", goal="g")
    refused("No such file", read_umb, tmp_path / "none", goal="g", error=FileNotFoundError)


def test_an_archive_is_written_alike_each_time(tmp_path):
    for name in ("a.umb", "b.umb"):
        write_umb(FIRST, tmp_path / name, start="depot")
    one, other = (gzip.decompress((tmp_path / name).read_bytes()) for name in ("a.umb", "b.umb"))
    assert one == other


def test_storm_and_the_library_read_the_same_archive(tmp_path):
    pytest.importorskip("stormpy")
    from storm_values import in_storm, value

    told = value(in_storm(archive(tmp_path / "m.umb")), 'Pmax=? [F "g"]')
    found = read_umb(tmp_path / "m.umb", goal="g", cost="toll")
    assert solve(MaxProb(found.model, found.start)).objective == pytest.approx(told)
