"""Solvers of large programs end with the call's time, whatever they hear of it themselves."""

import subprocess
import sys
import threading
import time

import highspy
import numpy as np
import pytest

from examples.solver_comparison.instances.families import layered
from formulations import MCMP, S3P
from ssp_lp import LinearProgramming, OutOfTimeError, SolverError, Status, solve
from ssp_lp.compiled.deadline import until
from ssp_lp.linear_programming import backends

MODEL = layered(8, 6, seed=2)
PROBLEM = MCMP(MODEL, 0, failure_budget=0.1)


@pytest.fixture(autouse=True)
def beside(monkeypatch):
    """Every program is as good as large: it is solved in a process beside this one."""
    monkeypatch.setattr(backends, "_LARGE", 0)


@pytest.mark.parametrize("backend", ["highs-ipx", "cvxpy"])
def test_a_process_beside_this_one_says_the_same(backend, monkeypatch):
    with_process = solve(PROBLEM, LinearProgramming(backend))
    monkeypatch.setattr(backends, "_LARGE", np.inf)
    assert with_process.objective == solve(PROBLEM, LinearProgramming(backend)).objective
    assert backend in with_process.run.program


def test_what_a_backend_raises_there_is_raised_here():
    with pytest.raises(SolverError, match="no-such-solver"):
        backends.run_backend(PROBLEM.program().linear, "no-such-solver", np.inf)


def test_a_solver_that_hears_nothing_is_ended(monkeypatch):
    monkeypatch.setattr(backends, "_SERVED", "import time; time.sleep(60)")
    program, began = PROBLEM.program(), time.perf_counter()
    with pytest.raises(OutOfTimeError), until(began + 0.2):
        backends.run_backend(program.linear, "cvxpy", np.inf)
    assert time.perf_counter() - began < 20.0
    with pytest.raises(OutOfTimeError, match="the time limit ended before there was an answer"):
        program.solve("cvxpy", time_limit=0.1)


_ASKS_AND_DIES = f"""
import subprocess, sys, time
subprocess.Popen([sys.executable, "-c", {backends._SERVED!r}], stdin=sys.stdin)
time.sleep(0.5)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process keeps its parent's number there")
def test_a_process_beside_one_that_was_killed_ends_by_itself():
    """It waits for a program that never comes; what it would write to is closed when it ends."""
    with subprocess.Popen(  # noqa: S603 (this very interpreter)
        [sys.executable, "-c", _ASKS_AND_DIES], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as asker:
        ended = threading.Thread(target=asker.stdout.read, daemon=True)
        ended.start()
        ended.join(timeout=30.0)
        by_itself = not ended.is_alive()
        asker.stdin.close()
        assert by_itself


def test_no_second_backend_is_asked_past_the_deadline(monkeypatch):
    """The first one is ended; an answer of case M, or that of least failure, comes back."""
    asked, run = [], backends.run_backend

    def listening(program, backend, *rest):
        asked.append(backend)
        return run(program, backend, *rest)

    monkeypatch.setattr(backends, "_SERVED", "import time; time.sleep(60)")
    monkeypatch.setattr(backends, "run_backend", listening)
    problem = S3P(MODEL, 0, failure_budget=0.1)
    solution = solve(problem, LinearProgramming("highs-ipx"), time_limit=0.5)
    assert asked == ["highs-ipx"]
    assert solution.status in (Status.TIME_LIMIT, Status.OPTIMAL)
    assert solution.failure_probability <= 0.1 + 1e-12


def test_ctrl_c_ends_highs_and_leaves_the_policy_of_least_failure(monkeypatch):
    """It is cancelled where it runs; the policy found before it, and its bound, come back."""
    ended = []

    def pressed(self, *_):
        monkeypatch.setattr(highspy.Highs, "wait", wait)
        raise KeyboardInterrupt

    def cancel(self):
        ended.append(self)
        return stop(self)

    wait, stop = highspy.Highs.wait, highspy.Highs.cancelSolve
    monkeypatch.setattr(backends, "_LARGE", np.inf)
    monkeypatch.setattr(highspy.Highs, "wait", pressed)
    monkeypatch.setattr(highspy.Highs, "cancelSolve", cancel)
    stopped, best = solve(PROBLEM, LinearProgramming("highs-ipx")), solve(PROBLEM)
    assert len(ended) == 1
    assert not ended[0].is_solver_running()
    assert stopped.status in (Status.INTERRUPTED, Status.OPTIMAL)
    assert stopped.failure_probability <= PROBLEM.failure_budget + 1e-12
    assert stopped.lower_bound <= best.objective <= stopped.objective * (1.0 + 1e-12)
