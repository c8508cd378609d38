r"""This library's methods beside their peers: one run, one table.

Runs every solver on every instance, each in a process of its own, and prints the size of the
model, the seconds, the objective, the relative gap and the peak memory, then geometric means
against each peer and the worst rows; saves the rows as JSON and draws time against model size.

    python examples/solver_comparison/compare_solvers.py --quick
    python examples/solver_comparison/compare_solvers.py --full
    python examples/solver_comparison/compare_solvers.py --frontier
    python examples/solver_comparison/compare_solvers.py --structures --solvers columns storm
    python examples/solver_comparison/compare_solvers.py --instances robot-20x12-M \
        --solvers columns storm lp-ipx

Instances: robot-SEGMENTSxHEADINGS-CASE, random-STATES-CASE, published domains (triangle-30,
rectangle-60x60, navigation-60x60) and families (grid-300, ...). CASE is M or S, S80 with a cap on
accumulated cost, M@0.999 with a discount, which "value iteration (game)" needs; P is the greatest
goal probability, C the least cost of a sure goal. The largest robot is robot-160x72: 192 million
transitions, several GB.

`pip install '.[compare]'` brings the peers. What is not installed is a row that says so.
`--quick`, the default, takes about a minute: the paper's robot and published domains, a solver of
each kind; `--page docs/performance.md` puts its table on that page. `--full` takes about an hour,
mostly for solvers that reach the time limit; such a solver is not tried on larger instances of the
same kind.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from examples.solver_comparison.instances.instance import (
    FULL_INSTANCES,
    QUICK_INSTANCES,
    STRUCTURES,
    Instance,
    parse_instance,
)
from examples.solver_comparison.measuring.machine import describe_machine, machine_text
from examples.solver_comparison.measuring.memory import physical_memory
from examples.solver_comparison.measuring.process import Limits, python_command, watch
from examples.solver_comparison.reporting.growth import growth_text
from examples.solver_comparison.reporting.page import page_text, put_on_page
from examples.solver_comparison.reporting.results import (
    Outcome,
    SolverRun,
    completed,
    judged,
    run_from_json,
    run_to_json,
)
from examples.solver_comparison.reporting.summary import summary_text
from examples.solver_comparison.reporting.table import LEGEND, run_line, table_text
from examples.solver_comparison.solvers.catalogue import (
    QUICK_SOLVERS,
    Order,
    solver_named,
    solver_names,
)

_QUICK_LIMIT, _LONG_LIMIT = 5.0, 60.0  # seconds for one call, in a comparison of a minute or not
_LARGE = 1_000_000  # transitions from which a sweep is measured against the memory's bandwidth


def main(arguments: Sequence[str] | None = None) -> list[SolverRun]:
    """Compare from the command line; return the rows."""
    options = _parse(arguments)
    limits = Limits(options.prepare_limit, options.time_limit, options.memory_limit * 1e9)
    results: dict[str, Any] = {"machine": describe_machine(), "limits": asdict(limits)}
    print(machine_text(results["machine"]), flush=True)
    runs: list[SolverRun] = []
    for run in compare(options, limits):
        runs = judged(completed([*runs, run]))
        print(run_line(run), flush=True)
        results["runs"] = [run_to_json(r) for r in runs]
        _save(results, options)
    if runs:
        parts = table_text(runs), LEGEND.format(repeat=options.repeat), summary_text(runs)
        table = "\n\n".join(part for part in parts if part)
        text = f"{machine_text(results['machine'])}\n\n{table}\n"
        (options.output / "comparison.txt").write_text(text, encoding="utf-8")
        print(f"\n{table}")
        if options.page is not None:
            put_on_page(options.page, page_text(results["machine"], runs))
        _draw(runs, options.output)
    if growth := growth_text(runs):
        print(f"\nColumn generation from refinement to refinement\n{growth}")
    if options.bandwidth:
        results["bandwidth"] = _bandwidths(runs, limits)
    if options.frontier:
        results["frontier"] = _frontiers(options)
    _save(results, options)
    return runs


def compare(options: argparse.Namespace, limits: Limits) -> Iterator[SolverRun]:
    """Yield the run of each solver on each instance as it is done."""
    beaten: dict[tuple[str, str], Instance] = {}
    for instance in map(parse_instance, () if options.frontier else options.instances):
        for name in options.solvers:
            order = Order(
                instance.name, name, limits.call_seconds, options.repeat, options.tolerance
            )
            smaller = beaten.get((instance.group, name))
            if smaller is not None and smaller.size < instance.size and not options.try_all:
                yield _skipped(order, f"over the limit on {smaller.name}")
                continue
            if unfit := _unfit(name, instance):
                yield _skipped(order, unfit)
                continue
            run = run_solver(order, limits)
            if run.over_limit:
                beaten[instance.group, name] = instance
            yield run


def _unfit(name: str, instance: Instance) -> str:
    """Return the reason for which a solver does not run on an instance; empty if it runs."""
    solver = solver_named(name)
    if solver.discounted and instance.discount is None:
        return "needs a discount"
    return "" if instance.case in solver.cases else f"compared in cases {solver.cases} only"


def _skipped(order: Order, note: str) -> SolverRun:
    return SolverRun(order.instance, order.solver, Outcome.SKIPPED, order.time_limit, note=note)


def run_solver(order: Order, limits: Limits, command: Sequence[str] | None = None) -> SolverRun:
    """Run a solver in a separate process; `command` replaces the command that starts it."""
    if command is None:
        command = python_command("worker", json.dumps(asdict(order)))
    ending = watch(command, limits, solver_named(order.solver).environment)
    entries = {"peak_memory": ending.peak_memory, "outcome": Outcome.FAILED, **ending.entries}
    if ending.outcome is not None and "seconds" not in entries:
        entries["outcome"] = ending.outcome
    if ending.reason:
        entries["note"] = "; ".join(w for w in (ending.reason, entries.get("note", "")) if w)
    entries |= {"instance": order.instance, "solver": order.solver}
    return run_from_json({**entries, "time_limit": limits.call_seconds})


def _bandwidths(runs: Sequence[SolverRun], limits: Limits) -> list[dict[str, Any]]:
    """Measure a Bellman sweep on the large instances of case M that were compared."""
    large = [r.instance for r in runs if (r.transitions or 0) >= _LARGE]
    chosen = [n for n in dict.fromkeys(large) if parse_instance(n).case == "M"]
    measured = []
    for name in chosen:
        ending = watch(python_command("bandwidth", name), limits)
        measured.append({"instance": name, "reason": ending.reason, **ending.entries})
        if "sweep" not in ending.entries:
            print(f"\nBellman sweep on {name}: {ending.reason}")
            continue
        sweep, read = ending.entries["sweep"], ending.entries["read"]
        speed = sweep["gigabytes_per_second"]
        print(
            f"\nBellman sweep on {name}: {sweep['bytes_read'] / 1e9:.3g} GB in "
            f"{1e3 * sweep['seconds']:.3g} ms = {speed:.3g} GB/s; memory reads at "
            f"{read:.3g} GB/s: {speed / read:.0%}"
        )
    return measured


def _frontiers(options: argparse.Namespace) -> list[dict[str, Any]]:
    from examples.solver_comparison.instances.models import build
    from examples.solver_comparison.measuring.frontier import measure_frontier

    measured = []
    for name in options.instances:
        cost = measure_frontier(build(parse_instance(name)), options.tolerance)
        print(f"\n{cost.text}", flush=True)
        measured.append(asdict(cost))
    return measured


def _draw(runs: Sequence[SolverRun], output: Path) -> None:
    try:
        from examples.solver_comparison.reporting.plot import save_plot
    except ImportError:
        print("\nno plot: pip install matplotlib")
        return
    save_plot(runs, output / "comparison.png")


def _save(results: dict[str, Any], options: argparse.Namespace) -> None:
    name = "frontier.json" if options.frontier else "comparison.json"
    text = json.dumps(results, indent=1)
    (options.output / name).write_text(text + "\n", encoding="utf-8")


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = solver_names()
    add = parser.add_argument
    add("--instances", nargs="+", metavar="NAME", help="such as robot-20x12-M, robot-20x12-S80")
    add("--structures", action="store_true", help="one instance of each structure")
    add("--quick", action="store_true", help="the default: about a minute")
    add("--full", action="store_true", help="all solvers, and many instances: about an hour")
    add("--solvers", nargs="+", choices=known, metavar="NAME", help=", ".join(known))
    add("--time-limit", type=float, help="seconds for one call of a solver; default: 5, else 60")
    add("--prepare-limit", type=float, default=1800.0, help="seconds until its first call")
    half = physical_memory() / 2e9
    add("--memory-limit", type=float, default=half, help="GB; default: half of the machine's")
    add("--repeat", type=int, default=3, help="calls, where a call takes less than 5 s")
    add("--tolerance", type=float, default=1e-9, help="relative gap asked of this library")
    add("--try-all", action="store_true", help="also where a smaller instance was over the limit")
    add("--bandwidth", action=argparse.BooleanOptionalAction, default=True,
        help="measure a Bellman sweep against the memory's bandwidth")  # fmt: skip
    add("--frontier", action="store_true", help="trace the frontier of the instances instead")
    add("--page", type=Path, help="a Markdown page to put the table on, such as "
        "docs/performance.md")  # fmt: skip
    add("--output", type=Path, default=Path("comparison_output"), help="folder")
    options = parser.parse_args(arguments)
    _fill_in(options, known)
    try:
        options.instances = [parse_instance(name).name for name in options.instances]
    except ValueError as error:
        parser.error(str(error))
    if options.page is not None and not options.page.is_file():
        parser.error(f"there is no page {options.page}")
    options.output.mkdir(parents=True, exist_ok=True)
    return options


def _fill_in(options: argparse.Namespace, known: Sequence[str]) -> None:
    """Fill in missing options: a comparison of a minute, unless more was requested."""
    is_quick = not (options.full or options.instances or options.structures or options.frontier)
    if options.instances is None and options.structures:
        options.instances = list(STRUCTURES)
    if options.instances is None and options.frontier:
        options.instances = ["robot-20x12-M"]
    if options.instances is None:
        options.instances = list(QUICK_INSTANCES if is_quick else FULL_INSTANCES)
    if options.solvers is None:
        options.solvers = list(QUICK_SOLVERS if is_quick else known)
    if options.time_limit is None:
        options.time_limit = _QUICK_LIMIT if is_quick else _LONG_LIMIT


if __name__ == "__main__":
    main(sys.argv[1:])
