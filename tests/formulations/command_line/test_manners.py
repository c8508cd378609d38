"""What a shell is told: names and numbers as people write them, short errors, tables, progress."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from formulations.command_line import main
from formulations.command_line.arguments import CRITERIA, argument_parser
from ssp_lp.options import progress_shown

ROADS = {
    "depot": {
        "alley": [[0.90, "home", 4.0], [0.10, "wreck", 2.0]],
        "road": [[0.99, "home", 9.0], [0.01, "wreck", 5.0]],
    },
    "wreck": {},
}


@pytest.fixture
def asked(tmp_path: Path) -> list[str]:
    path = tmp_path / "roads.json"
    path.write_text(json.dumps(ROADS), encoding="utf-8")
    return [str(path), "--goal", "home", "--start", "depot"]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_criterion_by_its_class_or_its_page(criterion: str, asked: list[str]) -> None:
    parser = argument_parser()
    for name in (
        criterion,
        criterion.upper(),
        criterion.replace("-", ""),
        criterion.replace("-", "_"),
    ):
        told = parser.parse_args(["solve", *asked, "--criterion", name])
        assert told.criterion == criterion


def test_percentages(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    command = ["solve", *asked, "--json", "--criterion", "S3P", "--limit", "failure <= 9%"]
    assert main([*command, "--failure-budget", "5%"]) == 0
    assert json.loads(capsys.readouterr().out)["failure_probability"] == pytest.approx(0.05)
    assert main([*command, "--failure-budget", "20%"]) == 0
    assert json.loads(capsys.readouterr().out)["failure_probability"] == pytest.approx(0.09)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "COMMAND"),
        (["sovle"], "'sovle'"),
        (["solve"], "MODEL"),
        (["solve", "x.json", "--criterion", "mcpm"], "'mcpm'"),
        (["solve", "x.json", "--failure-budget", "5%%"], "'5%%' is no number"),
        (["solve", "x.json", "--failure-budget", "%"], "'%' is no number"),
        (["solve", "x.json", "--quiet", "--verbose"], "not allowed with"),
        (["compare", "x.json", "--json", "--csv"], "not allowed with"),
        (["solve", "x.json", "--gaol", "home"], "--gaol"),
    ],
)
def test_errors_are_one_line(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert complaint in told
    assert told.count("\n") == 1
    assert "--help" in told


@pytest.mark.parametrize("method", ["lp", "deterministic"])
def test_solvers_print_nothing_beside_the_answer(asked: list[str], method: str) -> None:
    """HiGHS would name itself on standard output, which only another process sees."""
    words = ["solve", *asked, "--method", method, "--failure-budget", "0.05", "--json"]
    command = [sys.executable, "-m", "formulations.command_line", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    assert json.loads(done.stdout)["objective"] >= 6.6


def test_tables_go_into_files(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("frontier", "compare"):
        path = tmp_path / f"{command}.csv"
        assert main([command, *asked, "--csv", str(path)]) == 0
        assert capsys.readouterr().out == ""
        assert main([command, *asked, "--csv"]) == 0
        printed = capsys.readouterr().out
        assert printed == path.read_text(encoding="utf-8")
        rows = list(csv.DictReader(io.StringIO(printed)))
        assert {"failure", "failure_probability"} & rows[0].keys()
        assert min(float(row["objective"]) for row in rows if row["objective"]) < 4.0


def test_shells_complete(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    for shell in ("bash", "zsh", "tcsh"):
        with pytest.raises(SystemExit) as ended:
            main(["--print-completion", shell])
        assert ended.value.code == 0
        told = capsys.readouterr().out
        assert "--failure-budget" in told or "failure-budget" in told


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_is_told_what_takes_long(
    asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = _Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("ssp_lp.options._PATIENCE", 0.0)
    for words in (["--quiet"], []):
        assert not terminal.getvalue()
        assert main(["solve", *asked, *words]) == 0
    assert "compiling" in terminal.getvalue()
    assert "\n" not in terminal.getvalue()
    assert terminal.getvalue().rpartition("\r")[2] == ""  # nothing is left
    assert not terminal.getvalue().rpartition("\r")[0].rpartition("\r")[2].strip()


def test_a_line_that_does_not_last_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    import logging

    terminal = _Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    began, now = time.perf_counter(), [0.0]
    monkeypatch.setattr("ssp_lp.options.time.perf_counter", lambda: began + now[0])
    with progress_shown(lasting=False):
        logging.getLogger("ssp_lp.search").info("soon done")
        assert not terminal.getvalue()
        now[0] = 2.0
        logging.getLogger("ssp_lp.search").info("still at it")
        assert "still at it" in terminal.getvalue()
