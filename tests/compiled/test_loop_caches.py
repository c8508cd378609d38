"""Each compiled loop is judged by its own cache, by what was passed over, and by the time left."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import ssp_lp
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.accelerator import NotCompiledError, accelerated, with_twin
from ssp_lp.compiled.deadline import until

pytest.importorskip("numba")

from ssp_lp.compiled import cores

SOURCES = Path(ssp_lp.__file__).parent
SECOND = accelerator._RATE


@pytest.fixture(name="loops")
def fresh_loops(monkeypatch, tmp_path):
    """A process that knows nothing of any loop, with an empty cache."""
    monkeypatch.delenv(accelerator.SWITCH, raising=False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    loops = accelerator._Loops()
    monkeypatch.setattr(accelerator, "_loops", loops)
    return loops


def put_in_cache(*names):
    """Index files of numba's, as of loops that are compiled."""
    folder = accelerator.cache_folders()[0]
    folder.mkdir(parents=True, exist_ok=True)
    version = f"py{sys.version_info[0]}{sys.version_info[1]}"
    for name in names:
        (folder / f"{name}-1.{version}.nbi").write_bytes(b"")


def test_every_loop_that_is_asked_for_exists_and_each_import_is_asked_for():
    """Names at the sites are those of functions; no loop runs that nobody judged."""
    defined = {
        f"{path.stem}.{name}"
        for path in (SOURCES / "compiled").glob("*.py")
        for name in re.findall(r"^def (\w+)", path.read_text(), re.MULTILINE)
    }
    modules = "backups|equations|graphs|layers|matrix_rows|policy_improvement"
    asked = set()
    for path in SOURCES.rglob("*.py"):
        asked |= set(re.findall(rf'"((?:{modules})\.\w+)"', path.read_text()))
    assert asked <= defined
    assert {name.partition(".")[0] for name in asked} == set(modules.split("|"))


def test_a_loop_is_compiled_once_its_twin_took_as_long(loops):
    """A second of numpy, however many passes that are; another loop is not compiled with it."""
    passes = [accelerated(SECOND // 10, "backups.back_up") for _ in range(12)]
    assert passes == sorted(passes)
    assert passes.index(True) in (8, 9, 10)
    assert not accelerated(SECOND // 10, "backups.back_up_safely")
    assert loops.running == {"backups.back_up"}


def test_numba_is_loaded_for_cached_loops_by_what_was_passed_over(loops, monkeypatch):
    """Not by the length of one loop; and not where the time left is shorter than that takes."""
    put_in_cache("backups.back_up")
    monkeypatch.setattr(accelerator._load, "cache_info", lambda: type("", (), {"currsize": 0}))
    passes = [accelerated(SECOND // 20, "backups.back_up") for _ in range(14)]
    assert passes.index(True) in (11, 12)
    loops.running.clear()
    for seconds, loads in ((1.0, False), (10.0, True)):
        with until(time.perf_counter() + seconds):
            assert accelerated(SECOND, "backups.back_up") is loads


def test_nothing_is_compiled_in_a_short_call(loops):
    """Numba cannot be interrupted: a call of a second that compiled would end late."""
    for seconds, compiles in ((1.0, False), (19.0, False), (100.0, True)):
        with until(time.perf_counter() + seconds):
            assert accelerated(10 * SECOND, "graphs._close_component") is compiles
    assert accelerated(1, "graphs._close_component")


def test_earlier_processes_count(loops, tmp_path):
    """Scripts of a short solve come to compiled loops; the record grows with each of them."""
    runs = 1
    while not accelerator._Loops().runs_compiled("layers.sweep_layers", SECOND // 10):
        runs += 1
    assert 20 < runs < 60
    record = next(tmp_path.rglob(accelerator._RECORD))
    assert json.loads(record.read_text()) == {
        "layers.sweep_layers": pytest.approx(runs * SECOND // 10)
    }
    assert [path.name for path in record.parent.iterdir()] == [accelerator._RECORD]
    assert not loops.running


@pytest.mark.parametrize(
    "damage", [b"", b"\xff\x00", b"[1, 2]", b'{"a": "b"}', b'{"a": -1e999}', b'{"a": null}']
)
def test_a_damaged_record_is_empty(loops, damage):
    folder = accelerator.cache_folders()[0]
    folder.mkdir(parents=True)
    (folder / accelerator._RECORD).write_bytes(damage)
    assert not loops.runs_compiled("backups.back_up", SECOND // 2)
    assert loops.runs_compiled("backups.back_up", SECOND // 2)
    assert json.loads((folder / accelerator._RECORD).read_text())["backups.back_up"] == SECOND


def test_without_a_folder_to_write_in_a_process_counts_alone(loops, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert not loops.runs_compiled("backups.back_up", SECOND // 2)
    assert loops.runs_compiled("backups.back_up", SECOND // 2)


def test_a_loop_for_other_types_is_not_compiled_before_it_is_due(loops):
    """The cache holds the loop, but not for these types: numpy goes on, until it is worth it."""
    loops.running.add("test_loop_caches.doubled")

    def doubled(x):
        x += x

    doubled.__module__ = f"{cores.__package__}.test_loop_caches"
    doubled.__qualname__ = "doubled"
    loop = cores.compiled_loop(doubled)

    @with_twin
    def double(x):
        if not accelerated(SECOND // 4, "test_loop_caches.doubled"):
            return "numpy", x + x
        loop(x)
        return "compiled", x

    ways = [double(np.ones(3)) for _ in range(6)]
    assert [way for way, _ in ways] == ["numpy"] * 3 + ["compiled"] * 3
    assert all((x == 2.0).all() for _, x in ways)
    with until(time.perf_counter() + 1.0):
        assert double(np.ones(3, dtype=np.float32))[0] == "numpy"
        assert double(np.ones(3))[0] == "numpy"  # until there is time
    assert double(np.ones(3))[0] == "compiled"


def test_a_function_without_a_twin_is_compiled_after_all(loops):
    calls = []

    @with_twin
    def only(name):
        calls.append(name)
        if accelerator._frames.depth:
            raise NotCompiledError(name)
        return accelerator.may_compile(name)

    assert only("test.loop")
    assert len(calls) == 3
    assert not loops.running


@pytest.mark.slow
def test_damaged_files_of_numba_are_compiled_anew(tmp_path):
    """The index cut short, and the code cut short, each met by a process of its own."""
    code = (
        "import os, sys, numpy as np\n"
        "os.environ['SSP_LP_ACCELERATOR'] = 'numba'\n"
        "from ssp_lp.compiled.matrix_rows import place_layers as loop\n"
        "x = np.zeros(1, dtype=np.int64)\n"
        "loop(np.zeros((1, 1), np.int64), np.zeros(1, np.uint32), x, x, x, np.zeros((1, 1), int))\n"
        "print(sum(loop.stats.cache_hits.values()))\n"
    )

    def hits():
        run = subprocess.run(  # noqa: S603
            [sys.executable, "-c", code],
            capture_output=True, text=True, timeout=300,
            env={"NUMBA_CACHE_DIR": str(tmp_path), "PATH": "", "PYTHONPATH": str(SOURCES.parent)},
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        return int(run.stdout)

    assert hits() == 0
    for ending in ("nbi", "nbc"):
        (path,) = tmp_path.rglob(f"*.{ending}")
        path.write_bytes(path.read_bytes()[:20])
        assert hits() == 0
    assert hits() == 1


def test_the_index_of_an_older_source_does_not_count(loops):
    put_in_cache("backups.back_up", "graphs._close_component", "no_module.loop")
    (index,) = accelerator.cache_folders()[0].glob("graphs._close_component*")
    os.utime(index, (0, 0))
    assert accelerator.cached_loops() == {"backups.back_up"}
    assert not loops.cached
