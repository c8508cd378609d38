"""The solver comparison: rows for all that can happen to a solver, and numbers that agree."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from examples.solver_comparison import compare_solvers
from examples.solver_comparison.instances.instance import (
    FULL_INSTANCES,
    QUICK_INSTANCES,
    Instance,
    parse_instance,
)
from examples.solver_comparison.instances.models import build
from examples.solver_comparison.measuring import worker
from examples.solver_comparison.measuring.memory import process_memory
from examples.solver_comparison.measuring.process import Limits, watch
from examples.solver_comparison.reporting.growth import growth_text
from examples.solver_comparison.reporting.page import BEGIN, END, page_text, put_on_page
from examples.solver_comparison.reporting.results import (
    Outcome,
    SolverRun,
    completed,
    judged,
    run_from_json,
    run_to_json,
)
from examples.solver_comparison.reporting.summary import summary_text
from examples.solver_comparison.reporting.table import table_text
from examples.solver_comparison.solvers.catalogue import (
    GAME,
    QUICK_SOLVERS,
    SOLVERS,
    Order,
    Solver,
    solver_names,
)
from refusing import refused

SMALL = "random-400-M"


def solved(solver, seconds, **more):
    entries = {"instance": SMALL, "solver": solver, "outcome": "solved", "time_limit": 60.0}
    return run_from_json({**entries, "seconds": seconds, "calls": 1, **more})


def order(solver="columns"):
    return Order(SMALL, solver, time_limit=9.0, repeat=1, tolerance=1e-9)


def worked(instance, solver, tmp_path):
    """All that a worker reports, by its last words on each, in this process."""
    asked = {"instance": instance, "solver": solver, "time_limit": 60.0, "repeat": 1}
    report = tmp_path / f"{instance}-{solver}"
    worker.main([json.dumps({**asked, "tolerance": 1e-9}), str(report)])
    told = {}
    for line in report.read_text(encoding="utf-8").splitlines():
        told |= json.loads(line)
    return told


def test_names_of_instances_are_read_back():
    names = [*QUICK_INSTANCES, *FULL_INSTANCES]
    assert [parse_instance(name).name for name in names] == names
    assert parse_instance("robot-20x12-S80").cost_cap == 80.0
    assert parse_instance("robot-20x12-M@0.999") == Instance("robot", (20, 12), "M", None, 0.999)
    for name in ("robot-20-M", "random-5x5-M", "maze-20-M", "robot-20x12-X"):
        refused("is no instance", parse_instance, name, error=ValueError)
    for name, warm_up in (("robot-80x36-S80", "robot-20x12-S80"), ("robot-6x6-M", "robot-6x6-M")):
        assert parse_instance(name).warm_up.name == warm_up


@pytest.mark.slow
def test_criteria_without_a_budget_are_compared_with_storm(tmp_path):
    def value(instance, solver):
        told = worked(instance, solver, tmp_path)
        assert told["outcome"] == Outcome.SOLVED, told
        return told["objective"]

    for instance in ("blocks-3-P", "blocks-3-C", "tandem-6-P"):
        ours, theirs = (value(instance, solver) for solver in ("columns", "storm"))
        assert ours == pytest.approx(theirs, rel=1e-5)
    assert value("tandem-6-C", "columns") is value("tandem-6-C", "storm") is None  # nobody is sure


@pytest.mark.slow
def test_an_instance_without_a_policy_is_told_as_such_by_all(tmp_path):
    """At a discount of 0.9 success after t steps counts 0.9^t only: no policy keeps to 0.05."""
    for solver in ("columns", "value iteration (game)", "storm", "storm-sound"):
        told = worked(f"{SMALL}@0.9", solver, tmp_path)
        assert told["outcome"] == Outcome.SOLVED, told
        assert told["objective"] is None
        assert "no policy satisfies the failure budget" in told["note"]


@pytest.mark.slow
def test_the_game_is_compared_where_there_is_a_discount(tmp_path):
    told = [worked(f"{SMALL}@0.999", name, tmp_path) for name in ("columns", GAME)]
    assert told[0]["objective"] == pytest.approx(told[1]["objective"], rel=1e-8)
    options = ["--instances", SMALL, "--solvers", GAME, "--output", str(tmp_path)]
    (run,) = compare_solvers.main(options)
    assert (run.outcome, run.note) == (Outcome.SKIPPED, "needs a discount")


@pytest.mark.parametrize(
    ("given", "instances", "solvers", "limit"),
    [
        ([], QUICK_INSTANCES, QUICK_SOLVERS, 5.0),
        (["--quick"], QUICK_INSTANCES, QUICK_SOLVERS, 5.0),
        (["--full"], FULL_INSTANCES, solver_names(), 60.0),
        (["--instances", SMALL], (SMALL,), solver_names(), 60.0),
    ],
)
def test_by_default_the_robot_and_published_domains_are_compared(
    tmp_path, given, instances, solvers, limit
):
    options = compare_solvers._parse([*given, "--output", str(tmp_path)])
    assert tuple(options.instances) == instances
    assert tuple(options.solvers) == solvers
    assert options.time_limit == limit
    assert GAME in solvers


@pytest.mark.slow
def test_solvers_agree_each_in_a_process_of_its_own(tmp_path):
    chosen = ["columns", "highs-ipx"]
    options = ["--solvers", *chosen, "--repeat", "2", "--output", str(tmp_path)]
    runs = compare_solvers.main(["--instances", SMALL, *options])
    assert [run.solver for run in runs] == chosen
    assert {run.outcome for run in runs} == {Outcome.SOLVED}
    assert runs[0].gap <= 1e-9
    assert runs[0].calls == 2
    for run in runs:
        assert run.objective == pytest.approx(runs[0].objective, rel=1e-6)
        assert run.excess <= 1e-9
        assert run.peak_memory >= (run.ready_memory or 0) > 0
    saved = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert [run_from_json(entry) for entry in saved["runs"]] == runs
    assert (tmp_path / "comparison.png").stat().st_size > 10_000


def test_a_solver_that_hangs_is_ended_with_all_it_started(tmp_path):
    mark = tmp_path / "grandchild"
    late = f"import time; time.sleep(2); open({str(mark)!r}, 'w')"
    hanging = (
        "import json, subprocess, sys\n"
        "open(sys.argv[1], 'a').write(json.dumps({'phase': 'solving', 'states': 7}) + '\\n')\n"
        f"subprocess.run([sys.executable, '-c', {late!r}])\n"
    )
    began = time.monotonic()
    limits = Limits(prepare_seconds=20.0, call_seconds=0.2)
    run = compare_solvers.run_solver(order(), limits, [sys.executable, "-c", hanging])
    assert time.monotonic() - began < 2.0
    assert run.outcome is Outcome.TIME_OUT
    assert run.states == 7  # what it had said is kept
    assert "> 0" in table_text([run])
    time.sleep(max(0.0, began + 2.6 - time.monotonic()))
    assert not mark.exists()


@pytest.mark.parametrize(
    ("code", "outcome", "note"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", Outcome.FAILED, "SIGSEGV"),
        ("raise SystemExit('out of luck')", Outcome.FAILED, "exit status 1: out of luck"),
        (
            "import os, sys; print('std::bad_alloc', file=sys.stderr, flush=True); os.abort()",
            Outcome.OUT_OF_MEMORY,
            "SIGABRT: std::bad_alloc",
        ),
    ],
    ids=["crash", "exit", "memory"],
)
def test_a_crash_is_a_row_with_its_reason(code, outcome, note):
    run = compare_solvers.run_solver(order(), Limits(9.0, 9.0), [sys.executable, "-c", code])
    assert (run.outcome, run.note) == (outcome, note)


@pytest.mark.skipif(process_memory(1) is None, reason="the memory of others cannot be read here")
def test_a_process_over_its_memory_is_ended():
    greedy = "x = bytearray(200_000_000)\nimport time; time.sleep(30)"
    ending = watch([sys.executable, "-c", greedy], Limits(9.0, 9.0, memory=100e6))
    assert ending.outcome is Outcome.OUT_OF_MEMORY


def test_what_is_not_installed_is_a_row(monkeypatch, tmp_path):
    assert all(solver.pip.startswith("pip install") for solver in SOLVERS)
    assert len({solver.name for solver in SOLVERS}) == len(SOLVERS)
    absent = Solver("absent", "nowhere", package="a_package_nobody_has", pip="pip install it")
    monkeypatch.setattr(worker, "solver_named", lambda name: absent)
    told = worked(SMALL, "absent", tmp_path)
    assert told == {"outcome": "not installed", "note": absent.pip, "phase": "done"}


@pytest.mark.slow
def test_an_error_in_a_solver_is_a_row():
    run = compare_solvers.run_solver(order("no-such-method"), Limits(60.0, 9.0))
    assert run.outcome is Outcome.FAILED
    assert run.note.startswith("ModelError: method must be one of")


def test_larger_instances_are_left_out_after_a_time_out(monkeypatch):
    asked = []

    def late(order, limits):
        asked.append(order.instance)
        return SolverRun(order.instance, order.solver, Outcome.TIME_OUT, limits.call_seconds)

    monkeypatch.setattr(compare_solvers, "run_solver", late)
    names = ["robot-20x12-M", "robot-40x24-M", "robot-40x24-S80"]
    options = compare_solvers._parse(["--instances", *names, "--solvers", "columns"])
    runs = list(compare_solvers.compare(options, Limits()))
    assert asked == ["robot-20x12-M", "robot-40x24-S80"]
    assert [run.outcome for run in runs] == ["time-out", "skipped", "time-out"]


def test_the_table_has_a_row_per_run_and_ratios():
    runs = [
        solved("columns", 0.5, objective=1.25, gap=1e-12),
        solved("storm", 2.0),
        SolverRun(SMALL, "lp-ipx", Outcome.TIME_OUT, 60.0),
        SolverRun(SMALL, "highs-hipo", Outcome.NOT_INSTALLED, 60.0, note="pip install hipo"),
    ]
    head, _, *rows = table_text(runs).splitlines()
    assert len(rows) == len(runs)
    assert "x columns" in head
    assert rows[1].split()[4:7] == ["storm", "2", "4"]
    assert "> 60" in rows[2]
    assert "> 120" in rows[2]
    assert rows[3].endswith("not installed: pip install hipo")


def test_rows_are_judged_completed_and_survive_json():
    near, far = 10.0 * (1 + 1e-5), 10.0 * (1 + 1e-3)
    runs = [solved("storm", 1.0, objective=far), solved("columns", 1.0, objective=10.0)]
    runs = judged([*runs, solved("lp-ipx", 1.0, objective=near)])
    assert [run.outcome for run in runs] == ["wrong", "solved", "solved"]
    assert runs[0].note == "off the certified value by 0.001"
    late = SolverRun(SMALL, "storm", Outcome.SKIPPED, 60.0)  # takes the sizes of the instance
    rows = completed([solved("columns", 1.0, states=3, pairs=4, transitions=5), late])
    assert (rows[1].states, rows[1].pairs, rows[1].transitions) == (3, 4, 5)
    run = solved("columns", 0.5, objective=1.25, gap=1e-12, backups=3, note="words")
    assert run_from_json(json.loads(json.dumps(run_to_json(run)))) == run


def test_growth_compares_a_refinement_with_the_one_before():
    def member(name, transitions, backups, seconds):
        sizes = {"instance": name, "transitions": transitions, "states": 10, "pairs": 50}
        return solved("columns", seconds, **sizes, backups=backups, products=50)

    runs = [member("robot-20x12-M", 1000, 10, 1.0), member("robot-40x24-M", 2000, 20, 3.0)]
    _, first, second = growth_text(runs).splitlines()
    assert first.split()[3] == "20"  # 10 sweeps and 50 products of a fifth of a sweep each
    assert second.split()[4] == "1.50"
    assert float(second.split()[5]) == pytest.approx(1e9 * 3.0 / (30 * 2000))
    assert growth_text([solved("columns", 1.0)]) == ""


def test_the_summary_gives_geometric_means_and_shows_the_worst_rows_first():
    ours = [solved("columns", 2.0), replace(solved("columns", 8.0), instance="blocks-3-M")]
    peer = [solved("storm", 1.0), replace(solved("storm", 1.0), instance="blocks-3-M")]
    late = replace(solved("highs-ipx", None), outcome=Outcome.TIME_OUT, time_limit=4.0)
    lines = summary_text([*ours, *peer, late, solved("lp-ipx", 9.0)]).splitlines()
    assert lines == [
        "Seconds of columns over those of each peer",
        "highs-ipx        case M: geometric mean 0.5, worst 0.5 (1 instances, 1 out of time)",
        "storm            case M: geometric mean 4, worst 8 (2 instances)",
        "The worst rows of all",
        "blocks-3-M             storm            8 times its 1 s",
        "random-400-M           storm            2 times its 1 s",
        "random-400-M           highs-ipx        0.5 times its limit of 4 s",
    ]
    assert summary_text(ours) == ""


def test_the_comparison_is_put_on_a_page_with_the_machine_and_the_worst_rows(tmp_path):
    runs = [
        solved("columns", 2.0, transitions=1_500),
        solved("storm", 1.0),
        SolverRun(SMALL, "highs-ipx", Outcome.TIME_OUT, 60.0),
        SolverRun(SMALL, "scikit-decide", Outcome.NOT_INSTALLED, 60.0),
    ]
    machine = {"cores": 2, "memory_gb": 24.0, "system": "Linux", "python": "3.11", "packages": {}}
    text = page_text(machine, runs)
    assert text.startswith("2 cores, 24 GB, Linux, Python 3.11")
    assert "| instance | outcomes | columns | storm | highs-ipx |" in text
    assert f"| {SMALL} | 1,500 | 2 | **1** | > 60 |" in text
    assert "storm            2 times its 1 s" in text
    page = tmp_path / "page.md"
    page.write_text(f"before {BEGIN} old {END} after")
    put_on_page(page, text)
    assert page.read_text() == f"before {BEGIN}\n\n{text}\n\n{END} after"
    page.write_text("nothing")
    refused("has no part between", put_on_page, page, text, error=ValueError)


def test_the_page_on_performance_takes_a_comparison():
    text = (Path(__file__).parents[2] / "docs" / "performance.md").read_text(encoding="utf-8")
    assert 0 < text.index(BEGIN) < text.index(END)


def test_published_domains_are_instances():
    for name, states in (("triangle-10-M", 590), ("navigation-20x20-P", 401)):
        assert build(parse_instance(name)).model.n_states == states
