"""When loops are compiled, loaded and shared among cores."""

import json
import os
import re
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

import ssp_lp
from formulations import MCMP
from formulations.command_line import compiling, main
from small_models import FIRST
from ssp_lp import solve
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.accelerator import NotCompiledError, accelerated, with_twin
from ssp_lp.compiled.deadline import until

# Each compiled loop is judged by its own cache, by what was passed over, and by the time left.


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
            assert accelerated(10 * SECOND, "graphs.mark_leading") is compiles
    assert accelerated(1, "graphs.mark_leading")


def test_earlier_processes_count(loops, tmp_path):
    """Scripts of a short solve come to compiled loops; the record grows with each of them."""
    runs = 1
    while not accelerator._Loops().is_worth("layers.sweep_layers", SECOND // 10):
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
    assert not loops.is_worth("backups.back_up", SECOND // 2)
    assert loops.is_worth("backups.back_up", SECOND // 2)
    assert json.loads((folder / accelerator._RECORD).read_text())["backups.back_up"] == SECOND


def test_without_a_folder_to_write_in_a_process_counts_alone(loops, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert not loops.is_worth("backups.back_up", SECOND // 2)
    assert loops.is_worth("backups.back_up", SECOND // 2)


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
    put_in_cache("backups.back_up", "graphs.mark_leading", "no_module.loop")
    (index,) = accelerator.cache_folders()[0].glob("graphs.mark_leading*")
    os.utime(index, (0, 0))
    assert accelerator.cached_loops() == {"backups.back_up"}
    assert not loops.cached


def test_the_command_compiles_and_counts(monkeypatch, capsys):
    """What is compiled by then, and where; the environment is as before."""
    wish = os.environ.get(accelerator.SWITCH)
    wishes = []

    def problem():
        wishes.append((os.environ[accelerator.SWITCH], cores.many_entries.get() == 0))

    monkeypatch.setattr(compiling, "_problems", lambda: iter([problem]))
    assert main(["compile"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("loops compiled    0 in ")
    assert [line.split()[0] for line in printed] == ["loops", "loops", "cache"]
    assert wishes == [("numba", False), ("numba", True)]
    assert os.environ.get(accelerator.SWITCH) == wish


# Ctrl-C while numba is loaded leaves a process that goes on solving.


pytest.importorskip("numba")

INTERRUPTED = """
import os, signal, sys, threading

import ssp_lp.compiled.accelerator as accelerator
from formulations import MCMP
from ssp_lp import SSP, solve

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it

class AtModule:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:  # about to be loaded
            sys.meta_path.remove(self)
            print("interrupted in", name)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, AtModule())
os.environ[accelerator.SWITCH] = "numba"  # every loop runs compiled
model = SSP.from_transitions(
    {"x": {"go": [(0.5, "g", 1.0), (0.25, "d", 1.0), (0.25, "x", 2.0)],
           "safe": [(0.9, "g", 5.0), (0.1, "d", 1.0)]}, "d": {}},
    goal={"g"}, treat_actionless_as_dead_ends=True)
for attempt in range(3):
    try:
        if sys.argv[2] == "load":
            print("loaded", accelerator.has_accelerator())
        else:
            solution = solve(MCMP(model, "x", failure_budget=0.2))
            print("solved", round(solution.objective, 9), solution.status.name)
    except KeyboardInterrupt:
        print("ended by Ctrl-C")
import numba
assert numba.njit(lambda number: number + 1)(1) == 2
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

def count():
    print("counted", numba.njit(lambda number: number + 2)(1))

beside = threading.Thread(target=count)
beside.start()
beside.join()
"""


def told(*asked):
    code = textwrap.dedent(INTERRUPTED)
    command = [sys.executable, "-c", code, *asked]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300)  # noqa: S603
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("module", ["numba", "numba.np.arraymath"])
def test_loading_is_ended_before_ctrl_c_is_heard(module):
    """At the begin and where registries are filled; in the middle: the next test."""
    assert told(module, "load") == [
        f"interrupted in {module}",
        "ended by Ctrl-C",
        "loaded True",
        "loaded True",
        "counted 3",
    ]


@pytest.mark.slow
def test_a_solve_that_was_interrupted_while_numba_was_loaded_is_followed_by_others():
    lines = told("numba.core.typing", "solve")
    assert lines[0] == "interrupted in numba.core.typing"
    assert lines[2:] == [f"solved {117 / 35:.9f} OPTIMAL"] * 2 + ["counted 3"]


@pytest.mark.slow
def test_another_thread_loads_it_without_signals():
    code = (
        "import threading, ssp_lp.compiled.accelerator as a\n"
        "t = threading.Thread(target=lambda: print(a.has_accelerator()))\n"
        "t.start(); t.join()"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)  # noqa: S603
    assert run.stdout == "True\n", run.stderr


# An exception from outside that ends numba's compiler leaves a process that goes on in numpy.


numba = pytest.importorskip("numba")
codegen = pytest.importorskip("numba.core.codegen")


class AlarmError(Exception):
    """Such as pytest-timeout raises from the handler of a signal."""


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Every loop is worth compiling, and nothing has been given up."""
    monkeypatch.setenv(accelerator.SWITCH, "numba")
    monkeypatch.setattr(accelerator._loops, "is_given_up", False)
    assert accelerator.accelerated(1, "backups.back_up")


def loops():
    """A loop that calls another one, neither of them compiled yet."""
    inner = numba.njit(lambda number: number + 1.0)
    return numba.njit(lambda numbers: inner(numbers[0]))


@pytest.mark.parametrize("error", [AlarmError, KeyboardInterrupt])
@pytest.mark.parametrize("stage", ["finalize", "add_ir_module"])
def test_after_an_alarm_in_the_compiler_loops_run_in_numpy(monkeypatch, stage, error):
    def ring(*_):
        monkeypatch.delattr(codegen.CPUCodeLibrary, stage)
        raise error

    monkeypatch.setattr(codegen.CPUCodeLibrary, stage, ring)
    with pytest.raises(error):
        loops()(np.zeros(1))
    assert not accelerator.has_accelerator()
    assert not accelerator.accelerated(10**9, "backups.back_up")
    assert solve(MCMP(FIRST, "depot", failure_budget=0.05)).objective == pytest.approx(20 / 3)


def test_a_loop_compiled_while_an_error_is_handled_is_no_half_compiled_one():
    try:
        raise AlarmError
    except AlarmError:
        assert loops()(np.zeros(1)) == 1.0
    assert accelerator.accelerated(1, "backups.back_up")


def test_an_alarm_while_numba_is_loaded_leaves_numpy(monkeypatch):
    def ring(name):
        raise AlarmError(name)

    accelerator._load.cache_clear()
    with monkeypatch.context() as interrupted:
        interrupted.setattr(accelerator.importlib, "import_module", ring)
        with pytest.raises(AlarmError):
            accelerator.has_accelerator()
    assert not accelerator.has_accelerator()


# Which of its two versions a compiled loop runs in: on one core, or on all that are idle.


from ssp_lp.compiled.accelerator import SWITCH  # noqa: E402


@pytest.mark.parametrize(
    ("load", "others"), [(0.0, True), (0.9, True), (1.1, False), (50.0, False)]
)
def test_all_cores_are_woken_where_some_are_idle(load, others, monkeypatch):
    """Long loops alone, unless they are to be compiled; where no load is known, all."""

    def nothing(count):
        for _ in numba.prange(count):
            pass

    monkeypatch.setenv(SWITCH, "numba")
    loop = cores.one_or_all_cores(nothing)
    monkeypatch.setattr(os, "getloadavg", lambda: (os.cpu_count() + load, 0.0, 0.0), raising=False)
    many = cores.many_entries.get()
    single = loop(many - 1)
    with cores.on_all_cores():
        everywhere = loop(1)
    assert single is not everywhere
    assert loop(many) is (everywhere if others else single)
    monkeypatch.delattr(os, "getloadavg")
    assert loop(many) is everywhere
