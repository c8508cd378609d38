"""The comparison as a part of a Markdown page: seconds of each solver, and the worst rows."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from examples.solver_comparison.measuring.machine import machine_text
from examples.solver_comparison.reporting.results import REFERENCE, Outcome, SolverRun
from examples.solver_comparison.reporting.summary import summary_text

BEGIN, END = "<!-- comparison -->", "<!-- comparison ends -->"


def page_text(machine: dict[str, Any], runs: Sequence[SolverRun]) -> str:
    """Return the machine, a table of seconds (the least in bold), and the summary.

    Solvers that are not installed, and those that ran on no instance, have no column.
    """
    ran = [r for r in runs if r.outcome not in (Outcome.NOT_INSTALLED, Outcome.SKIPPED)]
    solvers = list(dict.fromkeys(run.solver for run in ran))
    cells = {(run.instance, run.solver): run for run in ran}
    lines = [machine_text(machine), "", _row("instance", "outcomes", *solvers)]
    lines.append(_row(*["---"] * (2 + len(solvers))))
    for name in dict.fromkeys(run.instance for run in ran):
        row = [cells.get((name, solver)) for solver in solvers]
        least = min((run.seconds for run in row if run and _is_answer(run)), default=None)
        sizes = [run.transitions for run in row if run and run.transitions is not None]
        size = f"{sizes[0]:,}" if sizes else ""
        lines.append(_row(name, size, *(_cell(run, least) for run in row)))
    summary = summary_text(runs).replace(REFERENCE, "this library")
    return "\n".join([*lines, *(["", "```text", summary, "```"] if summary else [])])


def put_on_page(page: Path, text: str) -> None:
    """Replace the text between the two marks of a page.

    Raises:
        ValueError: the page has no such marks.
    """
    whole = page.read_text(encoding="utf-8")
    before, begun, rest = whole.partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not (begun and ended):
        raise ValueError(f"{page} has no part between {BEGIN} and {END}")
    page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def _is_answer(run: SolverRun) -> bool:
    return run.outcome is Outcome.SOLVED and run.seconds is not None


def _cell(run: SolverRun | None, least: float | None) -> str:
    """Return a run's seconds in two digits, or why there are none."""
    if run is None:
        return ""
    if run.outcome is Outcome.TIME_OUT:
        return f"> {run.time_limit:g}"
    if run.outcome is not Outcome.SOLVED or run.seconds is None:
        return run.outcome.value
    text = f"{run.seconds:.2g}"
    return f"**{text}**" if run.seconds == least else text


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
