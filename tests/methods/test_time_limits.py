"""Time limits and Ctrl-C: every long stretch of a call looks at the clock."""

import _thread
import os
import signal
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp

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
    SSP,
    Game,
    OutOfTimeError,
    Solution,
    SSPError,
    Status,
    certify,
    solve,
    trace_frontier,
    visits,
)
from ssp_lp.accumulated_cost import written_out
from ssp_lp.compiled import deadline
from ssp_lp.compiled.accelerator import SWITCH
from ssp_lp.compiled.deadline import Deadline
from ssp_lp.model import graph
from ssp_lp.model.product import unroll_steps
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.programs.occupation_program import rows_program
from written_models import written

# A time limit and Ctrl-C: the best answer so far, its bound, and why the call ended.


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


# Every long stretch of a call looks at the clock: assembly, products, searches on graphs.


class Counting(Deadline):
    """A deadline that is never met, and counts the looks at it."""

    def __init__(self):
        super().__init__(due=-np.inf)
        self.looks = 0

    def look(self):
        self.looks += 1


def corridor(cells):
    """Cells in a row, two speeds, of which the fast one falls more often."""
    return SSP.from_transitions(
        {
            k: {
                "slow": [(0.9, k + 1, 2.0), (0.1, k, 1.0)],
                "fast": [(0.85, k + 1, 1.0), (0.1, max(k - 1, 0), 1.0), (0.05, "pit", 1.0)],
            }
            for k in range(cells)
        }
        | {"pit": {}},
        goal={cells},
        treat_actionless_as_dead_ends=True,
    )


def test_the_program_is_assembled_in_pieces_and_is_what_it_says(monkeypatch):
    """A look for each hundred entries; the matrix of the definition, entry by entry."""
    monkeypatch.setattr(deadline, "_PIECE", 100)
    rng, n, pairs = np.random.default_rng(3), 40, 120
    steps = sp.csr_array(rng.random((pairs, n)) * (rng.random((pairs, n)) < 0.3) / n)
    offsets = np.arange(0, pairs + 1, 3)
    numbers = [rng.random(pairs) for _ in range(3)]
    process = ExplicitProcess(offsets, steps, np.full(n, 1 / n), *numbers)
    row = np.where(rng.random(pairs) < 0.5, 0.0, rng.random(pairs))
    with Counting() as counted:
        program = rows_program(process, {"fuel": (row, 0.4)}, ratio=True)
    assert counted.looks >= steps.nnz // 100
    balance = np.repeat(np.eye(n), 3, axis=1) - steps.toarray().T
    scale = np.append(-np.append(process.start, 0.4), 0.0)
    own = np.vstack([balance, row, process.goal])
    np.testing.assert_array_equal(program.matrix.toarray(), np.column_stack([own, scale]))


@pytest.mark.parametrize(
    "stretch",
    {
        "layers": lambda model: written_out.steps_of_layers(
            S3P(model, 0, failure_budget=0.9).compile().layer.base,
            lambda kinds: (np.add.outer(np.arange(9), kinds), None),
            10_000,
        ),
        "steps": lambda model: unroll_steps(model, 30, [0]),
        "reaching": lambda model: graph.reaching_states(model, model.goal_mask),
        "approach": lambda model: graph.nearer_pairs(model, None, ends=model.goal_mask),
        "pairs": lambda model: graph.pairs_into(model, model.goal_mask),
        "components": lambda model: graph.end_components(
            model, np.ones(model.n_pairs, dtype=np.bool_)
        ),
    }.items(),
    ids=lambda stretch: stretch[0],
)
def test_a_long_stretch_looks_at_the_clock(stretch, monkeypatch):
    monkeypatch.setenv(SWITCH, "none")
    with Counting() as counted:
        stretch[1](corridor(30))
    assert counted.looks > 0


PROBLEMS = {
    "program": (lambda m: S3P(m, 0, failure_budget=0.6), "lp"),
    "layers": (lambda m: S3P(m, 0, failure_budget=0.6), None),
    "limit": (lambda m: S3P(m, 0, failure_budget=0.6, constraints={"c": visits(1) <= 1.1}), "lp"),
    "horizon": (lambda m: MCMP(m, 0, failure_budget=0.6, horizon=20), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROBLEMS)
def test_whichever_look_finds_the_time_over_the_call_ends_by_name(kind, monkeypatch):
    """An answer within the budget, above its bound, or OutOfTimeError; never anything else."""
    monkeypatch.setenv(SWITCH, "none")
    make, method = PROBLEMS[kind]
    best, looks, over = solve(make(corridor(12)), method), [0], [10**9]
    began = time.perf_counter()

    def clock():
        """A clock that jumps beyond every limit at one of the looks."""
        looks[0] += 1
        return began + (1e6 if looks[0] > over[0] else 1.0)

    monkeypatch.setattr(deadline, "time", SimpleNamespace(perf_counter=clock))
    solve(make(corridor(12)), method, time_limit=1e5)
    total = looks[0]
    assert total > 10
    for over[0] in range(0, total, max(total // 6, 1)):
        looks[0] = 0
        try:
            answer = solve(make(corridor(12)), method, time_limit=1e5)
        except OutOfTimeError:
            continue
        assert isinstance(answer, Solution)
        assert answer.failure_probability <= 0.6 + 1e-9
        assert answer.lower_bound <= best.objective * (1.0 + 1e-9)
        assert best.lower_bound <= answer.objective * (1.0 + 1e-9)
