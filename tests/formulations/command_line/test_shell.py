"""The command line as a shell runs it: its own process, pipes, signals, and its examples."""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from test_command_line import ROADS

from cases import FOLDER, expected
from formulations import MCMP
from formulations.command_line import main
from formulations.command_line.arguments import VERBS
from ssp_lp import solve
from ssp_lp.io import from_gymnasium

gymnasium = pytest.importorskip("gymnasium")

SSP_LP = f"{shlex.quote(sys.executable)} -m ssp_lp"
ROOT = Path(__file__).parents[3]
EVERY = [line.strip() for verb in VERBS.values() for line in verb.examples.splitlines()]


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of a shell in a folder, ``ssp-lp`` being the command."""
    line = "set -o pipefail\n" + command.replace("ssp-lp ", f"{SSP_LP} ")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(  # noqa: S603
        ["/bin/bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("shell")
    (where / "roads.json").write_text(json.dumps(ROADS), encoding="utf-8")
    return where


def test_help_comes_at_once_and_without_the_library(folder: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = shell("ssp-lp --help", folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    assert "exit codes" in done.stdout
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.5
    look = "import sys, ssp_lp.formulations.command_line; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", look], cwd=ROOT).returncode == 0  # noqa: S603


def test_a_published_case_through_its_own_process(folder: Path) -> None:
    case = next(c for c in expected()["cases"] if c["model"] == "prism_robot_goal1")
    path = FOLDER / "models" / "prism_robot_goal1.json.gz"
    done = shell(
        f"ssp-lp solve {path} --cost time --failure-budget 0.5 --give-up anywhere "
        "--no-charge-failing-step --json",
        folder,
    )
    assert (done.returncode, done.stderr) == (0, "")
    told = json.loads(done.stdout)
    assert told["objective"] == pytest.approx(case["min_cost_s.t._P>=1-eps"]["0.5"], rel=1e-9)


@pytest.mark.slow
def test_an_environment_through_a_pipe(folder: Path) -> None:
    done = shell("ssp-lp convert gym:FrozenLake-v1 - | ssp-lp solve - --failure-budget .3 --json",
                 folder)  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    world = from_gymnasium(gymnasium.make("FrozenLake-v1"))
    own = solve(MCMP(world.model, world.start, failure_budget=0.3))
    assert json.loads(done.stdout)["objective"] == pytest.approx(own.objective, rel=1e-12)


@pytest.mark.slow
def test_a_reader_that_goes_away_is_no_error(folder: Path) -> None:
    done = shell("ssp-lp convert gym:FrozenLake8x8-v1 - | head -c 10", folder)
    assert (done.returncode, done.stderr) == (141, "")
    assert len(done.stdout) == 10


@pytest.mark.parametrize("line", [line for line in EVERY if "|" not in line])
def test_the_examples_of_the_help_run(
    folder: Path, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    _, *words = shlex.split(line.partition(" > ")[0])
    assert main(words) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out or "convert" in line or " --csv " in line


def test_an_interrupt_is_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("ssp_lp.formulations.command_line._run_command", interrupted)
    assert main(["info", "roads.json"]) == 130


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith("ssp-lp 0.")
