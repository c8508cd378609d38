"""The command line: what it prints, and how it ends."""

from __future__ import annotations

import json
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from formulations import MCMP, S3P
from formulations.command_line import main
from ssp_lp import SSP, ModelError, solve
from ssp_lp.io import save_model, write_drn, write_prism
from ssp_lp.io.reading import read_any

ROADS = {
    "depot": {
        "alley": [[0.90, "home", 4.0], [0.10, "wreck", 2.0]],
        "road": [[0.99, "home", 9.0], [0.01, "wreck", 5.0]],
    },
    "wreck": {},
    "ferry": {"wait": [[1, "ferry", 1]], "sail": [[1, "home", 2]]},
}


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    return written(tmp_path, ROADS)


def written(folder: Path, table: Any) -> Path:
    path = folder / "roads.json"
    path.write_text(table if isinstance(table, str) else json.dumps(table), encoding="utf-8")
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(one) for one in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_info_counts(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("info", roads, "--goal", "home")
    code, out, _ = run(capsys, *asked, "--start", "depot", "--json")
    assert code == 0
    assert json.loads(out) == {
        "states": 4,
        "pairs": 4,
        "outcomes": 6,
        "goals": 1,
        "dead-ends": 1,
        "attention states": 2,
        "least failure": pytest.approx(0.01),
    }
    code, out, _ = run(capsys, *asked)
    assert code == 0
    assert "dead-ends         1" in out
    assert "least failure" not in out


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_solve_says_what_the_library_says(
    roads: Path, capsys: pytest.CaptureFixture[str], criterion: Any
) -> None:
    own = solve(criterion(read_any(roads, ["home"]).model, "depot", 0.05))
    asked = ["solve", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.05]
    asked += ["--criterion", criterion.__name__.lower()]
    code, out, _ = run(capsys, *asked)
    assert code == 0
    assert out.splitlines()[:2] == own.summary().splitlines()[:2]
    code, out, _ = run(capsys, *asked, "--json")
    told = json.loads(out)
    assert code == 0
    assert told["objective"] == pytest.approx(own.objective)
    assert told["failure_probability"] == pytest.approx(0.05)
    assert sum(member["weight"] for member in told["policy"]) == pytest.approx(1.0)
    if criterion is MCMP:
        assert {member["actions"]["depot"] for member in told["policy"]} == {"alley", "road"}


def test_numbers_that_are_none_are_null(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("solve", roads, "--goal", "home", "--start", "wreck", "--criterion", "maxprob")
    code, out, _ = run(capsys, *asked, "--json")
    assert code == 0
    assert json.loads(out)["conditional_cost"] is None
    assert "NaN" not in out


def test_too_small_a_budget_ends_with_3(roads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("solve", roads, "--goal", "home", "--start", "depot", "--failure-budget", 0.001)
    code, out, err = run(capsys, *asked)
    assert (code, out) == (3, "")
    assert "0.01" in err


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (["--start", "deopt"], "did you mean 'depot'"),
        (["--start", "depot", "--failure-budget", "5"], "did you mean 0.05"),
        (["--start", "depot", "--criterion", "maxprob", "--failure-budget", ".1"], "takes no"),
        ([], "--start"),
    ],
)
def test_wrong_arguments_end_with_2(
    roads: Path, capsys: pytest.CaptureFixture[str], changed: list[str], complaint: str
) -> None:
    code, _, err = run(capsys, "solve", roads, "--goal", "home", *changed)
    assert code == 2
    assert complaint in err


def test_what_the_parser_refuses_ends_with_2(roads: Path) -> None:
    assert main(["solve", str(roads)]) == 2  # which states are goals is not said
    for wrong in (["fly"], [], ["solve", str(roads), "--criterion", "x"]):
        with pytest.raises(SystemExit) as caught:
            main(wrong)
        assert caught.value.code == 2


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("{", "is no JSON"),
        ([1], "must hold"),
        ({"a": [1]}, "state 'a' needs"),
        ({"a": {"go": [[1, "home"]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, ["home"], 1]]}}, "action 'go' of state 'a'"),
        ({"a": {"go": [[1, "hoem", 1]]}}, "did you mean 'hoem'"),
        ({"a": {"go": [[1, "home", "x"]]}}, "no number"),
        ({"a": {"go": [[1, "home", -1]]}}, "negative cost"),
        ('{"a": {"go": [[1, "home", 1]]}, "a": {}}', "'a' stands twice"),
    ],
)
def test_wrong_models_end_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: Any, complaint: str
) -> None:
    code, _, err = run(capsys, "info", written(tmp_path, table), "--goal", "home")
    assert code == 2
    assert complaint in err


def test_files_that_are_not_there_or_not_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "info", tmp_path / "none.json", "--goal", "g")[0] == 2
    with pytest.raises(ModelError, match=r"ends in none of \.json"):
        read_any(tmp_path / "roads.txt", ["g"])


def test_numbers_may_name_states(tmp_path: Path) -> None:
    model = read_any(written(tmp_path, {"0": {"go": [[1, 1, 2.5]]}}), ["1"]).model
    assert list(model.states) == ["0", "1"]


def test_the_entry_point_is_there() -> None:
    project = Path(__file__).parents[2] / "pyproject.toml"
    entry = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["scripts"]["ssp-lp"]
    module, _, name = entry.partition(":")
    assert getattr(import_module(module), name) is main


def test_other_formats_and_the_policy_in_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = SSP.from_transitions(
        {0: {"a": [(0.9, 1, 1.0), (0.1, 2, 1.0)], "b": [(1.0, 1, 3.0)]}, 1: {}, 2: {}},
        goal={1},
        treat_actionless_as_dead_ends=True,
    )
    write_drn(model, tmp_path / "m.drn", start=0)
    write_prism(model, tmp_path / "m", start=0)
    save_model(model, tmp_path / "m.npz")
    drn, prism, own = (str(tmp_path / f"m.{ending}") for ending in ("drn", "tra", "npz"))
    for arguments in (
        [drn, "--goal", "goal"],
        [prism, "--goal", "goal"],
        [own, "--start", "0"],
    ):
        assert main(["info", *arguments]) == 0
        assert "attention states" in capsys.readouterr().out
    policy = tmp_path / "policy.npz"
    chosen = ["solve", drn, "--goal", "goal", "--failure-budget", "0.05", "--json"]
    assert main([*chosen, "--policy-out", str(policy)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["objective"] == pytest.approx(0.5 * 1.0 + 0.5 * 3.0)
    assert policy.exists()
    assert main(["info", own, "--goal", "1"]) == 2
