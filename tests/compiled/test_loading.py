"""Ctrl-C while numba is loaded leaves a process that goes on solving."""

import subprocess
import sys
import textwrap

import pytest

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
