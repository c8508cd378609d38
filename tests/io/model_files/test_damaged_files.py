"""A sample of `examples/checks/damaged_files.py`: damaged files are read, or refused by name."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

from examples.checks.damaged_files import MODEL, READ, REFUSED, TEXTS, damaged, verdict
from ssp_lp import ModelError
from ssp_lp.io import read_with_storm, write_umb


@pytest.mark.parametrize(
    "ending", ["json", "json.gz", "nested.json", "explicit.json", "prism", "jani", "umb"]
)
def test_damaged_files_are_read_or_refused_by_name(ending: str, tmp_path: Path) -> None:
    found = {
        number: verdict(ending, tmp_path / f"m.{ending}")
        for number, _ in damaged(ending, tmp_path, range(40))
    }
    assert set(found.values()) <= {READ, REFUSED}
    assert list(found.values()).count(REFUSED) > 20


MANY = 10**12
CLAIMS = [
    ("json", f'{{"format": "explicit-mdp-v1", "num_states": {MANY}, "choices": [[]]}}'),
    ("json", f'{{"format": "explicit-mdp-v1", "goal": [{MANY}], "choices": [[]]}}'),
    ("drn", f"@type: MDP\n@nr_states\n{MANY}\n@model\nstate 0 goal\n\taction 0\n\t\t0 : 1\n"),
    ("prism", f'mdp\nmodule m\n x : [0..{MANY}] init 0;\nendmodule\nlabel "goal" = x = 0;\n'),
]


@pytest.mark.parametrize(("ending", "text"), CLAIMS)
def test_a_claim_of_many_states_takes_no_memory(ending: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / f"m.{ending}"
    path.write_text(text, encoding="utf-8")
    assert verdict(ending, path) in (READ, REFUSED)


def packed(path: Path, parts: dict[str, bytes]) -> None:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in parts.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))


def parts_of(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        return {m.name: archive.extractfile(m).read() for m in archive if m.isfile()}


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [
        ("state-to-choices.bin", lambda c: c[:8] + b"\xff" * 8 + c[16:], "state-to-choices"),
        ("choice-to-branches.bin", lambda c: c[:-8] + b"\x01" * 8, "choice-to-branches"),
        ("actions/choices/values.bin", lambda c: b"\x09" + c[1:], "actions/choices/values"),
        ("actions/choices/string-mapping.bin", lambda c: b"\x01" + c[1:], "string-mapping"),
        ("actions/choices/strings.bin", lambda c: b"\xff" + c[1:], "Storm refuses it"),
        ("index.json", lambda c: c.replace(b'-actions": 4', b'-actions": 9999999999'), "mapping"),
        (
            "index.json",
            lambda c: c.replace(b'"#choices": 6', b'"#choices": []'),
            "state-to-choices",
        ),
        ("index.json", lambda c: b"[]", "index.json"),
    ],
)
def test_archives_that_would_end_storm_are_refused(
    name: str, damage: Callable[[bytes], bytes], words: str, tmp_path: Path
) -> None:
    """Packed soundly, so that only what they say is wrong."""
    pytest.importorskip("stormpy")
    write_umb(MODEL, tmp_path / "m.umb", start="depot")
    parts = parts_of(tmp_path / "m.umb")
    packed(tmp_path / "again.umb", parts)
    assert read_with_storm(tmp_path / "again.umb", goal="goal").model.n_states == MODEL.n_states
    parts[name] = damage(parts[name])
    packed(tmp_path / "again.umb", parts)
    with pytest.raises(ModelError, match=words):
        read_with_storm(tmp_path / "again.umb", goal="goal")


@pytest.mark.parametrize(
    ("found", "instead", "words"),
    [
        ('"type": "bool"', '"type": 0', "'done' has the type 0"),
        ('"type": "real", "value"', '"type": null, "value"', "'p' has the type null"),
        ('{"kind": "bounded", "base": "int"', '{"kind": "bounded", "base": []', "has the base"),
        ('"automata"', '"robots"', "lists its automata"),
        ("{", "", "no JSON"),
    ],
)
def test_jani_that_would_end_storm_is_refused(
    found: str, instead: str, words: str, tmp_path: Path
) -> None:
    pytest.importorskip("stormpy")
    path = tmp_path / "m.jani"
    path.write_text(TEXTS["jani"].replace(found, instead, 1), encoding="utf-8")
    with pytest.raises(ModelError, match=words):
        read_with_storm(path, goal="done")
