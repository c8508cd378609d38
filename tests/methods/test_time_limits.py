"""A time limit and Ctrl-C: the best answer so far, its bound, and why the call ended."""

import _thread
import os
import signal
import sys
import threading
import time

import pytest

from examples.solver_comparison.instances.models import random_model
from formulations import (
    EGUBS,
    GUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from ssp_lp import (
    Game,
    OutOfTimeError,
    SSPError,
    Status,
    certify,
    solve,
    trace_frontier,
    visits,
)
from ssp_lp.compiled import deadline
from written_models import written

COARSE = 1e-3  # gap of a frontier of a few points
criteria = pytest.mark.parametrize("criterion", [MCMP, S3P])
methods = pytest.mark.parametrize("method", ["columns", "game", "deterministic"])


def interrupting(after):
    """A progress report at whose k-th call somebody presses Ctrl-C."""
    calls = iter(range(10**9))

    def progress(*_):
        if next(calls) >= after:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("after", [0, 2])
@methods
@criteria
def test_ctrl_c_hands_back_the_best_answer_so_far(coarse_robot, criterion, method, after):
    discount, budget = (0.99, 0.6) if method == "game" else (None, 0.3)
    problem = criterion(*coarse_robot, failure_budget=budget, discount=discount)
    best = solve(problem)
    solution = solve(problem, method, progress=interrupting(after), tolerance=1e-9)
    assert solution.lower_bound <= solution.objective + 1e-12
    assert solution.lower_bound <= best.objective * (1.0 + 1e-9)
    if method != "deterministic":
        assert best.lower_bound <= solution.objective * (1.0 + 1e-9)
    assert solution.budget_used <= budget + 1e-12
    assert (solution.status is Status.OPTIMAL) == (solution.gap <= 1e-9)
    assert solution.status in (Status.OPTIMAL, Status.INTERRUPTED)
    if solution.status is Status.INTERRUPTED:
        assert "interrupted" in solution.summary()
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.lower_bound <= best.objective * (1.0 + 1e-9)


def test_ctrl_c_comes_through_where_nothing_was_asked_for_so_far():
    timer = threading.Timer(0.05, _thread.interrupt_main)
    timer.start()
    try:
        problem = MCMP(random_model(20_000), 0, failure_budget=0.05)
        found = solve(problem, tolerance=1e-12)
        assert found.status in (Status.OPTIMAL, Status.INTERRUPTED, Status.TOLERANCE_MISSED)
        assert found.lower_bound <= found.objective
    except KeyboardInterrupt:  # before there was a policy, or while the model was drawn
        pass
    finally:
        timer.cancel()


@pytest.fixture
def ctrl_c():
    """Ctrl-C is heard, also where the suite was begun in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.skipif(sys.platform == "win32", reason="no process sends itself this signal there")
def test_a_signal_in_the_middle_of_a_long_loop_is_ctrl_c(robot):
    """It comes a moment after the second pricing call, in whatever runs then, or by the third."""
    signals = []

    def progress(calls, *_):
        if calls >= 2 and not signals:
            signals.append(threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)))
            signals[0].start()
        elif signals:
            signals[0].join()  # on a busy machine it may be late

    problem = S3P(*robot, failure_budget=0.05)
    solution = solve(problem, progress=progress, tolerance=1e-15)
    assert solution.status is Status.INTERRUPTED
    assert "interrupted" in solution.summary()
    assert solution.budget_used <= 0.05 + 1e-12
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.lower_bound <= solve(problem).objective * (1.0 + 1e-9)


@pytest.fixture(name="hasty")
def no_grace(monkeypatch):
    """Loops end at the deadline itself, however small the model."""
    monkeypatch.setattr(deadline, "_GRACE", 0.0)
    monkeypatch.setattr(deadline, "_CLOSING", 0.0)
    monkeypatch.setattr(deadline, "_LEAST", 0.0)


@pytest.mark.usefixtures("hasty")
@criteria
@methods
def test_no_policy_in_time_is_a_named_error(coarse_robot, criterion, method):
    discount = 0.99 if method == "game" else None
    problem = criterion(*coarse_robot, failure_budget=0.6, discount=discount)
    with pytest.raises(OutOfTimeError, match="allow more time"):
        solve(problem, method, time_limit=0.0)
    with pytest.raises(OutOfTimeError, match="allow more time"):
        trace_frontier(problem, time_limit=0.0)


@criteria
def test_before_the_search_has_a_policy_the_safest_one_comes_back(
    coarse_robot, criterion, monkeypatch
):
    """Without grace no price is solved for; what is left over is enough for the least failure."""
    monkeypatch.setattr(deadline, "_GRACE", 0.0)
    monkeypatch.setattr(deadline, "_CLOSING", 60.0)
    problem = criterion(*coarse_robot, failure_budget=0.3)
    best, solution = solve(problem), solve(problem, time_limit=0.0)
    assert solution.status in (Status.TIME_LIMIT, Status.OPTIMAL)
    assert solution.failure_probability <= 0.3 + 1e-12
    assert best.lower_bound <= solution.objective * (1.0 + 1e-9)
    assert solution.lower_bound <= best.objective * (1.0 + 1e-9)
    assert certify(solution).accepted


@criteria
def test_an_interrupted_frontier_keeps_its_points(coarse_robot, criterion):
    problem = criterion(*coarse_robot, failure_budget=0.3)
    whole = trace_frontier(problem, gap=COARSE)
    assert whole.status is Status.OPTIMAL
    assert not whole.open_segments
    for after in (0, 3, 6):
        check_part(trace_frontier(problem, gap=COARSE, progress=interrupting(after)), whole)


def check_part(part, whole):
    """What was traced until it was interrupted, against the whole."""
    assert part.status is Status.INTERRUPTED
    assert part.open_segments
    assert "open: interrupted" in repr(part)
    for budget in part.failure.tolist():
        low, high = part.bounds_at(budget)
        assert low <= whole.objective_at(budget) * (1.0 + 1e-9)
        assert whole.objective_at(budget) <= high * (1.0 + COARSE)
    for number in range(len(part.price)):
        middle = 0.5 * float(part.failure[number] + part.failure[number + 1])
        depth = part.bounds_at(middle)[1] - whole.objective_at(middle)
        share = (1.0 - middle) if part.ratio else 1.0
        assert depth * share <= part.gap * float(part.cost[number]) * (1.0 + 1e-9)
        if number not in part.open_segments:
            assert depth * share <= COARSE * float(part.cost[number])


def test_limits_on_other_quantities_are_kept_by_what_comes_back(coarse_robot):
    limits, calls = {"o": visits("obstacle") <= 0.25}, []
    limited = MCMP(*coarse_robot, failure_budget=0.3, constraints=limits)
    best = solve(limited, progress=lambda call, *_: calls.append(call))
    part = solve(limited, progress=interrupting(len(calls) - 2))
    assert part.status is Status.INTERRUPTED
    assert part.lower_bound <= best.objective * (1.0 + 1e-9)
    assert best.lower_bound <= part.objective * (1.0 + 1e-9)
    assert certify(part).accepted


def test_a_tolerance_that_is_missed_is_no_interruption(coarse_robot):
    capped = S3P(*coarse_robot, failure_budget=0.3, cost_cap=4.0)
    assert solve(capped).status is Status.TOLERANCE_MISSED


FERRY = """
    s go: 0.9 t 1, 0.1 d 1
    s safe: t DEAR
    t go: 0.6 g 1, 0.3 s 1, 0.1 d 1
    t safe: 0.7 g DEAR, 0.3 s 2
    t wait: t 0
    d sink: d 0
"""
SEEN, TIGHT = {"seen": visits("t") <= 1.35}, {"failure_budget": 0.1}
ASKED = [
    (None, lambda m: MCMP(m, "s", **TIGHT)),
    ("lp", lambda m: MCMP(m, "s", **TIGHT)),
    ("deterministic", lambda m: MCMP(m, "s", **TIGHT)),
    ("game", lambda m: MCMP(m, "s", failure_budget=0.5, discount=0.9)),
    (None, lambda m: MCMP(m, "s", failure_budget=None)),
    (None, lambda m: MCMP(m, "s", constraints=SEEN, **TIGHT)),
    ("lp", lambda m: MCMP(m, "s", constraints=SEEN, **TIGHT)),
    (None, lambda m: MCMP(m, "s", horizon=10, **TIGHT)),
    (None, lambda m: S3P(m, "s", **TIGHT)),
    ("lp", lambda m: S3P(m, "s", **TIGHT)),
    ("deterministic", lambda m: S3P(m, "s", **TIGHT)),
    (Game(tail=4), lambda m: S3P(m, "s", failure_budget=0.5, discount=0.9)),
    (None, lambda m: S3P(m, "s", failure_budget=None)),
    (None, lambda m: S3P(m, "s", constraints=SEEN, **TIGHT)),
    (None, lambda m: MaxProb(m, "s")),
    (None, lambda m: MaxProb(m, "s", constraints=SEEN)),
    (None, lambda m: MinProb(m, "s")),
    (None, lambda m: GUBS(m, "s", lambda cost: 0.9**cost, goal_bonus=1.0)),
    (None, lambda m: EGUBS(m, "s", risk_factor=-0.1, goal_bonus=1.0)),
    (None, lambda m: CVaR(m, "s", 0.9, **TIGHT)),
    (None, lambda m: CostQuantile(m, "s", 0.5, **TIGHT)),
    (None, lambda m: CostQuantile(m, "s", 0.5, constraints=SEEN, **TIGHT)),
    (None, lambda m: AlphaMCMP(m, "s", 0.9)),
    (None, lambda m: FinitePenalty(m, "s", 10.0)),
    (None, lambda m: ConstrainedCost(m, "s")),
    (None, lambda m: CostBoundedReach(m, "s", 6.0)),
    (None, lambda m: CostBudgetedMaxProb(m, "s", 4.0)),
    (None, lambda m: LeastQuantity(m, "s", visits("t"))),
    (None, lambda m: ISSPUDE(m, "s")),
    (None, lambda m: MinCost(m, "s")),
]


@pytest.mark.slow
@pytest.mark.parametrize(("tick", "looks"), [(0.05, range(0, 60, 7)), (1.0, range(0, 36, 5))])
@pytest.mark.parametrize("dear", ["3", str(2**0.5)])
def test_nothing_but_its_own_errors_leaves_the_library(monkeypatch, dear, tick, looks):
    """The clock moves on by a tick at each look, so that the time ends at every look in turn."""

    def at_most(looks, call):
        """A call whose time ends at some look."""
        now = iter(range(10**9))
        monkeypatch.setattr(time, "perf_counter", lambda: tick * next(now))
        try:
            return call(tick * looks)
        except SSPError as error:
            return error
        finally:
            monkeypatch.undo()

    def model():
        return written(FERRY.replace("DEAR", dear))

    for method, problem in ASKED:
        for k in looks:
            answer = at_most(k, lambda t, p=problem, m=method: solve(p(model()), m, time_limit=t))
            if not isinstance(answer, SSPError) and answer.status is Status.OPTIMAL:
                break
    answer = solve(MCMP(model(), "s", **TIGHT))
    for k in looks:
        at_most(k, lambda t: certify(answer, time_limit=t))
        at_most(k, lambda t: trace_frontier(MCMP(model(), "s", **TIGHT), time_limit=t))
