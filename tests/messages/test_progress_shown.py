"""What is told of long work: nothing unless asked, else each phase and how far it has come."""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import replace

import pytest

from formulations import MCMP, S3P, compare_criteria
from small_models import FIRST
from ssp_lp import (
    SSP,
    InfeasibleError,
    ModelError,
    certify,
    cross_check,
    progress_shown,
    secondary_cost,
    simulate,
    solve,
    trace_frontier,
)
from terminal import Terminal

PROBLEM = MCMP(FIRST, "depot", 0.05, horizon=3)


def line(states: int) -> SSP:
    """A model that is explored: a walk of so many states."""
    return SSP.from_successors(0, lambda k: {"go": [(1.0, k + 1, 1.0)]}, {states - 1})


def test_nothing_is_told_unless_asked(capfd: pytest.CaptureFixture[str]) -> None:
    policy = solve(PROBLEM).policy
    simulate(policy, PROBLEM, seed=0, episodes=10)
    trace_frontier(PROBLEM)
    compare_criteria(FIRST, "depot")
    line(10)
    assert capfd.readouterr() == ("", "")


def test_verbose_tells_each_phase(capsys: pytest.CaptureFixture[str]) -> None:
    solution = solve(PROBLEM, verbose=True)
    assert solution.objective == solve(PROBLEM).objective
    told = capsys.readouterr().err
    phases = [row.split()[2] for row in told.splitlines()]
    assert phases[-3:] == ["compiling", "search", "proof"]
    assert "\r" not in told  # in a file or a pipe nothing can be overwritten
    assert "columns: 3 pricing calls, objective 6.66666667" in told

    trace_frontier(PROBLEM, verbose=True)
    simulate(solution.policy, PROBLEM, seed=0, episodes=10, verbose=True)
    certify(solution, verbose=True)
    cross_check(replace(PROBLEM, discount=0.99, horizon=None), verbose=True)
    compare_criteria(FIRST, "depot", failure_budgets=(), penalties=(), verbose=True)
    with progress_shown(), progress_shown():
        line(7)
    told = capsys.readouterr().err
    for part in (
        "2 turning points",
        "SimulationReport(epi",
        "1 of 7: MaxProb",
        "7 states foun",
        "Certificate(verdict acc",
        "3 of 3: game, ",
        "3 methods agree",
    ):
        assert told.count(part) == 1


def test_a_horizon_is_built_once(capsys: pytest.CaptureFixture[str]) -> None:
    problem = S3P(FIRST, "depot", 0.05, horizon=4)
    for built in (1, 0):
        solve(problem, verbose=True)
        assert capsys.readouterr().err.count("building") == built


def test_a_terminal_shows_how_far_work_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10_000))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress_shown():
        line(30_001)
    told = sys.stderr.getvalue()
    under_way, done = told.rsplit("\r", 1)
    assert "20000 states found" in under_way or "20001 states found" in under_way
    assert done.endswith("30001 states found\n")
    assert max(map(len, told.replace("\r", "\n").split("\n"))) <= 100
    with progress_shown():
        logging.getLogger("ssp_lp.building").debug("1 of 4", extra={"share": 0.25})
    assert "building    [#####---------------] 1 of 4" in sys.stderr.getvalue()
    with progress_shown():
        logging.getLogger("ssp_lp.search").debug("under way")
    assert sys.stderr.getvalue().endswith(" \r")  # and leaves nothing behind


def test_it_ends_where_it_should(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("ssp_lp")
    before = logger.level, list(logger.handlers), logger.propagate
    with pytest.raises(InfeasibleError):
        solve(MCMP(FIRST, "depot", 0.001), verbose=True)
    assert (logger.level, list(logger.handlers), logger.propagate) == before
    capsys.readouterr()
    solve(PROBLEM)
    with progress_shown(False):
        solve(PROBLEM)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("limited", [False, True])
def test_logging_has_the_same(caplog: pytest.LogCaptureFixture, limited: bool) -> None:
    fuel = {"fuel": secondary_cost({"depot": {"alley": 1.0}}) <= 0.3} if limited else {}
    calls: list[tuple[int, float, float]] = []
    with caplog.at_level(logging.DEBUG, "ssp_lp"):
        problem = MCMP(FIRST, "depot", 0.08, constraints=fuel, horizon=3)
        solution = solve(problem, progress=lambda *told: calls.append(told))
    told = [(r.name, r.levelname) for r in caplog.records]
    names = [name for name, level in told if level == "INFO"]
    assert names[0] == "ssp_lp.building"
    assert {"ssp_lp.compiling", "ssp_lp.search", "ssp_lp.proof"} <= set(names)
    assert told.count(("ssp_lp.search", "DEBUG")) == len(calls) >= 1
    assert calls[-1][0] <= solution.run.pricing_calls


def test_what_cannot_be_called_is_told() -> None:
    with pytest.raises(ModelError, match="verbose=True to show how far"):
        solve(PROBLEM, progress=True)  # type: ignore[arg-type]
