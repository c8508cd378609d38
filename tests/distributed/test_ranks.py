"""Ranks give what one process finds; without PETSc this is skipped."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from ssp_lp import MissingDependencyError
from ssp_lp.distributed import PartitionedModel

HERE = Path(__file__).parent
MISSING = [name for name in ("petsc4py", "mpi4py") if find_spec(name) is None]
with_petsc = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
with_mpiexec = pytest.mark.skipif(shutil.which("mpiexec") is None, reason="there is no mpiexec")

SCRIPTS = [("on_drawn_problems.py", "40"), ("on_partitioned_models.py",), ("on_mistakes.py",)]


def ended(script: str, *arguments: str, ranks: int | None = None) -> CompletedProcess[str]:
    """A script that has ended, run by so many ranks of mpiexec; None: without it."""
    root = HERE.parent.parent
    places = [root, HERE.parent, HERE.parent / "support", HERE.parent / "support" / "problems"]
    settings = {
        "PYTHONPATH": os.pathsep.join(map(str, places)),
        "OMP_NUM_THREADS": "1",
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
        "OMPI_MCA_mpi_yield_when_idle": "1",
    }
    before = [] if ranks is None else ["mpiexec", "-n", str(ranks)]
    return subprocess.run(  # noqa: S603 (this very interpreter)
        [*before, sys.executable, str(HERE / script), *arguments],
        env=os.environ | settings,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def run(script: str, *arguments: str, ranks: int | None = None) -> str:
    """What a script prints that ends well."""
    found = ended(script, *arguments, ranks=ranks)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout


@with_petsc
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script[0])
def test_one_rank_needs_no_mpiexec(script: tuple[str, ...]) -> None:
    assert run(*script) == "1 ranks: well\n"


@with_petsc
@with_mpiexec
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script[0])
@pytest.mark.parametrize("ranks", [2, 3])
def test_every_rank_gets_what_one_process_finds(ranks: int, script: tuple[str, ...]) -> None:
    assert run(*script, ranks=ranks).strip() == f"{ranks} ranks: well"


@with_petsc
@with_mpiexec
def test_a_killed_rank_ends_the_run_and_another_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    script, checkpoint = "on_a_checkpoint.py", str(tmp_path / "search")
    killed = ended(script, checkpoint, "dies", ranks=2)
    assert killed.returncode != 0
    assert "on signal 9" in killed.stderr + killed.stdout or "KILLED" in killed.stderr
    assert any(Path(checkpoint).glob("*/policy.npz"))
    assert run(script, checkpoint, "resumes", ranks=2).strip() == "2 ranks: well"
    assert run(script, checkpoint, "resumes").strip() == "1 ranks: well"


@with_petsc
@with_mpiexec
def test_an_interrupt_and_an_error_on_one_rank_end_the_run(tmp_path: Path) -> None:
    interrupted = ended("on_a_checkpoint.py", str(tmp_path / "a"), "interrupted", ranks=2)
    assert interrupted.returncode != 0
    assert "KeyboardInterrupt" in interrupted.stderr + interrupted.stdout
    assert "nobody died" not in interrupted.stderr
    broken = ended("on_mistakes.py", "breaks", ranks=2)
    assert broken.returncode != 0
    assert "ZeroDivisionError: mine" in broken.stderr + broken.stdout


@with_petsc
@with_mpiexec
def test_a_policy_that_three_ranks_saved_is_read_by_two_and_by_one(tmp_path: Path) -> None:
    folder = str(tmp_path / "policy")
    for ranks, does in ((3, "saves"), (2, "reads"), (None, "reads")):
        words = run("on_a_checkpoint.py", folder, does, ranks=ranks)
        assert words.strip() == f"{ranks or 1} ranks: well"


@pytest.mark.skipif(not MISSING, reason="PETSc is installed")
def test_what_is_missing_is_named() -> None:
    with pytest.raises(MissingDependencyError, match=r"pip install '\.\[distributed\]'"):
        PartitionedModel.from_rows(lambda first, end: None, 3, [2])
