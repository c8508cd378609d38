"""Many problems at once: answers in order on the caller's models, whatever becomes of a worker."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest

import ssp_lp
from formulations import GUBS, MCMP, S3P, CostQuantile, MaxProb
from small_models import FIRST, TRIES
from ssp_lp import (
    SSP,
    InfeasibleError,
    Memory,
    ModelError,
    OutOfTimeError,
    Solution,
    SolverError,
    Status,
    answers,
    certify,
    evaluate,
    product,
    solve,
    solve_many,
    sweep,
    visits,
)
from ssp_lp.cargo import Models, Store, loaded

ROOT = Path(__file__).parents[2]
BUDGETS = [0.02, 0.001, 0.05, 0.08]


class AtOnce(Executor):
    """Whatever is given to it is done by the time it says so."""

    def __init__(self):
        self.sent = []

    def submit(self, function, *given):
        self.sent.append(given)
        future = Future()
        try:
            future.set_result(function(*given))
        except Exception as error:
            future.set_exception(error)
        return future


class Never(Executor):
    """Takes everything and does nothing."""

    def submit(self, function, *given):
        return Future()


class Elsewhere(AtOnce):
    """A machine that does not see the caller's files."""

    def submit(self, function, shipment, *rest):
        return super().submit(function, replace(shipment, path="/nowhere/models"), *rest)


class Frail(AtOnce):
    """A pool whose process dies of deadly problems, and with it whatever else it has in hand.

    It has two problems in hand, until one was deadly.
    """

    def __init__(self, deaths, most):
        super().__init__()
        self.deaths, self.most, self.in_hand = deaths, most, []

    def submit(self, function, *given):
        if not given:  # whether it could be started
            return super().submit(function)
        if self.in_hand is None:
            raise BrokenProcessPool("a process died")
        self.in_hand.append((Future(), function, given))
        waiting, future = self.in_hand, self.in_hand[-1][0]
        if len(waiting) == 2 or self.deaths:
            is_deadly = any(b"Deadly" in packed for _, _, (_, packed, _) in waiting)
            dies = is_deadly and len(self.deaths) < self.most
            self.deaths += ["died"] * dies
            self.in_hand = None if dies else []
            for one, answer, asked in waiting:
                if dies:
                    one.set_exception(BrokenProcessPool("a process died"))
                else:
                    one.set_result(answer(*asked))
        return future


@dataclass(frozen=True, eq=False)
class Deadly(MCMP):
    """A problem that kills the process that compiles it, unless a file says that it did."""

    marker: str = ""

    def compile(self):
        if self.marker and not Path(self.marker).exists():
            Path(self.marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().compile()


@dataclass(frozen=True, eq=False)
class Faulty(MCMP):
    """A problem whose class has a flaw."""

    def compile(self):
        return 1 / 0


class Unsendable:
    """A utility that holds what no other process can have."""

    def __init__(self):
        self.lock = threading.Lock()

    def __call__(self, cost):
        return np.exp(-cost)


def mixed_problems():
    """Of several criteria, models, products and horizons; the second is infeasible."""
    counting = product(TRIES, Memory(0, counted))
    return [
        *sweep(MCMP, FIRST, "depot", failure_budget=BUDGETS),
        *sweep(S3P, FIRST, "depot", failure_budget=BUDGETS[2:], horizon=[None, 1]),
        MaxProb(counting, ("door", 0), horizon=2),
        MaxProb(TRIES, "door"),
        CostQuantile(FIRST, "depot", 0.5, 0.05),
        MCMP(FIRST, "depot", 0.09, constraints={"few": visits("wreck") <= 0.04}),
    ]


def counted(tries, state, action, successor, cost):
    """A memory that counts to two."""
    return min(tries + 1, 2)


def check_answers(problems, answers):
    """Each is what ``solve`` says, on the caller's model."""
    assert len(answers) == len(problems)
    for problem, answer in zip(problems, answers, strict=True):
        if isinstance(answer, InfeasibleError):
            with pytest.raises(InfeasibleError) as caught:
                solve(problem)
            assert str(answer) == str(caught.value)
            assert answer.least_failure == caught.value.least_failure
            continue
        known = solve(problem)
        assert isinstance(answer, Solution)
        assert answer.objective == pytest.approx(known.objective, rel=1e-12)
        assert answer.problem.model is answer.policy.model is problem.model
        assert evaluate(answer.policy, problem).objective == pytest.approx(known.objective)


def test_answers_come_in_order_on_the_callers_models() -> None:
    problems = mixed_problems()
    for executor in (AtOnce(), Elsewhere()):
        answers = solve_many(problems, executor=executor)
        check_answers(problems, answers)
        assert set(answers.errors) == {1}
        assert np.flatnonzero(np.isnan(answers.objectives)).tolist() == [1]
    assert all(certify(answers[k]).accepted for k in (0, 5))


@pytest.mark.slow
def test_processes_answer_and_one_that_dies_is_replaced(tmp_path) -> None:
    problems = [*mixed_problems()[:7], Deadly(FIRST, "depot", 0.05, marker=str(tmp_path / "died"))]
    come = []
    answers = solve_many(
        problems, workers=2, progress=lambda place, answer: come.append((place, answer))
    )
    assert (tmp_path / "died").exists()
    check_answers(problems, answers)
    assert sorted(place for place, _ in come) == [*range(len(problems))]
    assert all(answers[place] is answer for place, answer in come)


@pytest.mark.parametrize("most", [1, 2, 3])
def test_a_problem_that_processes_die_of_is_asked_three_times(monkeypatch, most) -> None:
    """The others lose nothing by it: what was in hand with it is asked again alone."""
    deaths = []
    monkeypatch.setattr(answers._Pool, "_new_pool", lambda _: Frail(deaths, most))
    problems = sweep(MCMP, FIRST, "depot", failure_budget=np.linspace(0.01, 0.1, 7))
    problems.insert(2, Deadly(FIRST, "depot", 0.05))
    found = solve_many(problems, workers=1)
    assert len(deaths) == most
    if most < 3:
        check_answers(problems, found)
    else:
        assert set(found.errors) == {2}
        assert isinstance(found[2], SolverError)
        assert "3 processes died" in str(found[2])


def test_an_executor_of_ones_own_that_breaks_is_not_replaced() -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(SolverError, match="broke or was shut down"):
        solve_many([MCMP(FIRST, "depot", 0.05)], executor=pool)
    first, second = sweep(MCMP, FIRST, "depot", failure_budget=BUDGETS[2:])
    problems = [first, second, Deadly(FIRST, "depot", 0.05), first]
    found = solve_many(problems, executor=Frail([], 1))
    assert [isinstance(answer, Solution) for answer in found] == [True, True, False, False]
    assert "pass a new one" in str(found[3])


class Stillborn(Executor):
    """A pool whose first process dies while it starts: all that it was given fails."""

    def submit(self, function, *given):
        future = Future()
        future.set_exception(BrokenProcessPool("it died at once"))
        return future

    def shutdown(self, **_):
        """Nothing is to be ended."""


def test_processes_that_never_start_again_end_the_call_and_nobody_is_blamed(monkeypatch) -> None:
    deaths = []
    pools = chain([Frail(deaths, 1)], repeat(Stillborn()))
    monkeypatch.setattr(answers._Pool, "_new_pool", lambda _: next(pools))
    problems = sweep(MCMP, FIRST, "depot", failure_budget=np.linspace(0.01, 0.1, 7))
    problems.insert(4, Deadly(FIRST, "depot", 0.05))
    found = solve_many(problems, workers=1)
    assert [isinstance(answer, Solution) for answer in found] == [True] * 4 + [False] * 4
    assert all("die while they start" in str(error) for error in found.errors.values())


def test_processes_that_cannot_be_started_say_so(monkeypatch) -> None:
    monkeypatch.setattr(answers._Pool, "_new_pool", lambda _: Stillborn())
    with pytest.raises(SolverError, match="die while they start"):
        solve_many([MCMP(FIRST, "depot", 0.05)])


SCRIPT = """
import numpy as np
from formulations import GUBS
from ssp_lp import SSP, solve, solve_many

class Patient(GUBS):
    pass

def patience(cost):
    return np.exp(-cost / 4.0)

ways = {"a": {"fast": [(0.9, "g", 1.0), (0.1, "d", 1.0)], "slow": [(1.0, "g", 3.0)]}, "d": {}}
model = SSP.from_transitions(ways, goal={"g"}, treat_actionless_as_dead_ends=True)
asked = [Patient(model, "a", one, 1.0) for one in (patience, lambda cost: 1.0 / (1.0 + cost))]
for problem, answer in zip(asked, solve_many(asked, workers=2), strict=True):
    assert abs(answer.objective - solve(problem).objective) < 1e-9
    assert answer.problem.model is model and type(answer.problem) is Patient
print("all answered")
"""


@pytest.mark.slow
def test_functions_and_classes_of_a_script_go_along(tmp_path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT, encoding="utf-8")
    told = subprocess.run(  # noqa: S603
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )  # fmt: skip
    assert told.stdout == "all answered\n", told.stderr


def test_models_are_sent_once() -> None:
    """Whatever their size, problems take some hundred bytes and answers their own arrays."""
    n = 800
    line = SSP.from_arrays(
        pair_offsets=[*range(n), n - 1],
        outcome_offsets=range(n),
        successors=range(1, n),
        probabilities=np.ones(n - 1),
        costs=2.0,
        goal_states=[n - 1],
    )
    executor = AtOnce()
    problems = sweep(MCMP, line, [n - 2, n - 3], failure_budget=BUDGETS)
    assert all(problem.conditions == () and problem.start_mass.size == n for problem in problems)
    assert len(pickle.dumps(line)) > 20 * n
    found = solve_many(problems, executor=executor)
    assert found.objectives.tolist() == [2.0] * 4 + [4.0] * 4
    paths = {shipment.path for shipment, _, _ in executor.sent}
    assert len(paths) == 1
    assert not Path(*paths).exists()
    assert max(len(packed) for _, packed, _ in executor.sent) < 400
    assert all(answer.problem.model.costs is line.costs for answer in found)


def test_a_worker_maps_the_arrays_of_a_model(tmp_path) -> None:
    """They are the file's own bytes, aligned and read-only; one cost for all takes no room."""
    model, path = replace(FIRST, costs=np.broadcast_to(1.0, FIRST.n_outcomes)), tmp_path / "models"
    ours = Store()
    with path.open("wb") as file:
        ours.load([model], file)
    there = loaded(Models(str(path)))
    asked = there.unpack(ours.pack(MCMP(model, "depot", 0.05)))
    loaded.cache_clear()
    assert asked.model is not model
    assert asked.model.states == model.states
    for name, array in vars(model).items():
        if isinstance(array, np.ndarray):
            theirs = getattr(asked.model, name)
            assert np.array_equal(theirs, array), name
            assert theirs.strides == array.strides, name
            assert theirs.flags.aligned, name
            assert not theirs.flags.writeable, name
            assert not theirs.flags.owndata, name


def test_time_for_all_and_for_each() -> None:
    problems = sweep(MCMP, FIRST, "depot", failure_budget=BUDGETS)
    late = solve_many(problems, executor=AtOnce(), total_time_limit=0.0)
    assert all(isinstance(answer, OutOfTimeError) for answer in late)
    assert "total_time_limit" in str(late[0])
    soon = solve_many(problems, executor=AtOnce(), time_limit=50.0, total_time_limit=20.0)
    assert all(0.0 < soon[k].run.time_limit <= 20.0 for k in (0, 2, 3))
    assert solve_many(problems[:1], executor=AtOnce(), time_limit=50.0)[0].run.time_limit == 50.0


def test_who_does_not_answer_in_time_is_not_waited_for(monkeypatch) -> None:
    monkeypatch.setattr(answers, "_LATE", 0.0)
    found = solve_many([MaxProb(TRIES, "door")], executor=Never(), total_time_limit=0.01)
    assert isinstance(found[0], OutOfTimeError)


def test_an_interrupt_keeps_what_is_there() -> None:
    def stop(place: int, answer: object) -> None:
        if place == 1:
            raise KeyboardInterrupt

    problems = sweep(MCMP, FIRST, "depot", failure_budget=BUDGETS[::-1])
    found = solve_many(problems, executor=AtOnce(), progress=stop)
    assert [isinstance(answer, Solution) for answer in found] == [True, True, False, False]
    assert all(isinstance(found[k], OutOfTimeError) and "Ctrl-C" in str(found[k]) for k in (2, 3))
    assert found[0].status is Status.OPTIMAL


def test_errors_stand_in_their_places() -> None:
    problems = [
        MaxProb(TRIES, "door"),
        GUBS(FIRST, "depot", Unsendable(), 1.0),
        Faulty(FIRST, "depot", 0.05),
        MaxProb(FIRST, "depot"),
    ]
    found = solve_many(problems, executor=AtOnce())
    assert {k: type(error) for k, error in found.errors.items()} == {1: ModelError, 2: SolverError}
    assert "cannot be pickled" in str(found[1])
    assert "ZeroDivisionError: division by zero" in str(found[2])
    game = solve_many([problems[0]], "game", executor=AtOnce())
    assert isinstance(game[0], ModelError)


def test_a_sweep_is_every_combination() -> None:
    problems = sweep(S3P, FIRST, ["depot", "wreck"], np.array([0.1, 0.2]), horizon=range(1, 4))
    asked = [(p.start, p.failure_budget, p.horizon) for p in problems]
    assert asked == [
        (start, budget, steps)
        for start in ("depot", "wreck")
        for budget in (0.1, 0.2)
        for steps in (1, 2, 3)
    ]
    with pytest.raises(ModelError, match="failure_budget is empty"):
        sweep(MCMP, FIRST, "depot", failure_budget=[])
    with pytest.raises(ModelError, match="argument 2 is empty"):
        sweep(MCMP, FIRST, np.array([]))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"problems": MaxProb(TRIES, "door")}, "several problems: pass a list"),
        ({"problems": [TRIES]}, "takes a problem"),
        ({"problems": 3}, "problems must be a list"),
        ({"workers": 0}, "workers must be a whole number >= 1"),
        ({"workers": 2, "executor": AtOnce()}, "leave out workers, or executor"),
        ({"executor": 2}, "executor must be an Executor or None"),
        ({"method": "magic"}, "method must be one of"),
        ({"time_limit": "1"}, "time_limit must be a number of seconds"),
        ({"total_time_limit": -1.0}, "total_time_limit must be a number of seconds"),
        ({"tolerance": 2.0}, "tolerance must lie"),
        ({"progress": 1}, "progress must be a function"),
    ],
)
def test_wrong_arguments_are_named(given: dict[str, object], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        solve_many(**({"problems": [MaxProb(TRIES, "door")]} | given))


def test_answers_are_shown_and_put_in_a_table() -> None:
    frame = solve_many(mixed_problems(), executor=AtOnce()).to_frame()
    assert list(frame)[:5] == ["criterion", "model", "start", "failure_budget", "give_up"]
    assert frame["model"].tolist() == [0] * 8 + [1, 2, 0, 0]
    assert frame["failure_budget"].tolist()[:6] == [*BUDGETS, 0.05, 0.05]
    assert frame["failure_budget"].tolist()[10:] == [0.05, 0.09]
    assert frame["error"][0] == ""
    assert "at least 0.01" in frame["error"][1]
    assert frame["objective"][2] == pytest.approx(20 / 3)
    found = solve_many(sweep(MCMP, FIRST, "depot", BUDGETS * 6), executor=AtOnce())
    assert repr(found).startswith("Answers(24, 6 of them errors, ")
    lines = str(found).splitlines()
    assert lines[0].split() == [
        "criterion", "failure_budget", "objective", "failure", "price", "status",
    ]  # fmt: skip
    assert lines[2].split() == ["MCMP", "0.001", "-", "-", "-", "InfeasibleError"]
    assert lines[3].split() == ["MCMP", "0.05", "6.66667", "0.05", "57.3333", "optimal"]
    assert lines[21] == "and 4 more: to_frame() has all"
    assert lines[22].startswith("1: every policy fails")
    assert str(solve_many([])) == "no rows"


def test_what_is_told_on_the_way(capsys, caplog) -> None:
    problems = sweep(MCMP, FIRST, "depot", failure_budget=BUDGETS[2:])
    with caplog.at_level(logging.DEBUG, logger="ssp_lp.answers"):
        solve_many(problems, executor=AtOnce())
    own = [record for record in caplog.records if record.name == "ssp_lp.answers"]
    assert [getattr(record, "share", None) for record in own] == [None, 0.5, 1.0, None]
    assert capsys.readouterr().err == ""
    solve_many(problems, executor=ThreadPoolExecutor(1), verbose=True)
    told = capsys.readouterr().err
    assert all(part in told for part in ("2 problems of", "ThreadPoolExecutor", "Answers(2, "))
    assert ssp_lp.solve_many is solve_many
