"""The comparison as a table of text: a line per run."""

from collections.abc import Iterable, Sequence

from examples.solver_comparison.reporting.results import Outcome, SolverRun, reference_runs

_HEAD = (
    "instance", "states", "pairs", "transitions", "solver", "seconds", "x columns", "objective",
    "gap", "excess", "peak", "import s", "build s", "warm-up s", "note",
)  # fmt: skip
_LEFT = {"instance", "solver", "note"}
_NOTE_WIDTH = 90

LEGEND = """\
seconds    of one solve or peer call on the ready model, the least of up to {repeat} calls; beside
           it stand import, building the model in the solver's form, and a warm-up call where
           something compiles on first use
x columns  seconds over those of column generation (`columns`) on the same instance
gap        relative; certified for columns and lp-*; what their own duals leave for highs-*
excess     failure probability above the budget
peak       memory of the solver's own process, in GB\
"""


def table_text(runs: Sequence[SolverRun]) -> str:
    """Return the table of given runs."""
    reference = {name: run.seconds for name, run in reference_runs(runs).items()}
    rows = [_HEAD, *(_cells(run, reference.get(run.instance)) for run in runs)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
    lines = [_line(row, widths) for row in rows]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def run_line(run: SolverRun) -> str:
    """Return a run in one line, to be printed when it ends."""
    figures = f"{_seconds(run)} s" if run.outcome is Outcome.SOLVED else run.outcome.value
    return f"{run.instance:<22} {run.solver:<14} {figures:>12}  {_number(run.objective, '.9g')}"


def _line(cells: Sequence[str], widths: Iterable[int]) -> str:
    aligned = (
        cell.ljust(width) if head in _LEFT else cell.rjust(width)
        for head, cell, width in zip(_HEAD, cells, widths, strict=True)
    )
    return "  ".join(aligned).rstrip()


def _cells(run: SolverRun, reference: float | None) -> tuple[str, ...]:
    note = "" if run.outcome is Outcome.SOLVED else f"{run.outcome.value}: "
    return (
        run.instance,
        _number(run.states, ","),
        _number(run.pairs, ","),
        _number(run.transitions, ","),
        run.solver,
        _seconds(run),
        _ratio(run, reference),
        _number(run.objective, ".9g"),
        _number(run.gap, ".0e"),
        _number(run.excess, ".0e"),
        _number(run.peak_memory and run.peak_memory / 1e9, ".2f"),
        _number(run.import_seconds, ".2f"),
        _number(run.build_seconds, ".2f"),
        _number(run.warm_up_seconds, ".2f"),
        _shortened(f"{note}{run.note}".removesuffix(": ")),
    )


def _seconds(run: SolverRun) -> str:
    if run.outcome is Outcome.TIME_OUT:
        return f"> {run.time_limit:.0f}"
    return _number(run.seconds, ".3g" if (run.seconds or 0.0) < 1000.0 else ".0f")


def _ratio(run: SolverRun, reference: float | None) -> str:
    if reference is None:
        return "-"
    if run.outcome is Outcome.TIME_OUT:
        return f"> {run.time_limit / reference:.3g}"
    if run.outcome is not Outcome.SOLVED or run.seconds is None:
        return "-"
    return f"{run.seconds / reference:.3g}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _shortened(words: str) -> str:
    return words if len(words) <= _NOTE_WIDTH else words[: _NOTE_WIDTH - 3] + "..."
