"""The comparison in a few lines: geometric means against each peer, and the worst rows."""

import math
from collections.abc import Iterator, Sequence

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.reporting.results import Outcome, SolverRun, reference_runs

_WORST = 5  # rows shown
_OWN = ("columns", "lp-", "value iteration", "deterministic")  # methods of this library


def summary_text(runs: Sequence[SolverRun]) -> str:
    """Return our seconds over each peer's as geometric means by case, then the worst rows.

    A peer that ran out of time counts with its limit. A wrong answer of a peer counts as it is and
    is named; a peer that failed or ran out of memory is counted as unanswered, not as slow.
    """
    ratios = sorted(_ratios(runs), key=lambda found: -found[0])
    if not ratios:
        return ""
    groups: dict[tuple[str, str], list[float]] = {}
    for ratio, run in ratios:
        groups.setdefault((run.solver, parse_instance(run.instance).case), []).append(ratio)
    lines = ["Seconds of columns over those of each peer"]
    for (solver, case), found in sorted(groups.items()):
        mean = math.exp(math.fsum(map(math.log, found)) / len(found))
        lines.append(
            f"{solver:<16} case {case}: geometric mean {mean:.2g}, worst {max(found):.2g}"
            f" ({len(found)} instances{_unanswered(runs, solver, case)})"
        )
    lines.append("The worst rows of all")
    lines += [
        f"{run.instance:<22} {run.solver:<16} {ratio:.2g} times its {_told(run)} s"
        + (f", whose answer is {run.note.split(';')[0]}" if run.outcome is Outcome.WRONG else "")
        for ratio, run in ratios[:_WORST]
    ]
    return "\n".join(lines)


def _ratios(runs: Sequence[SolverRun]) -> Iterator[tuple[float, SolverRun]]:
    """Return our seconds over a peer's, for each run that has an answer or ran out of time."""
    reference = reference_runs(runs)
    for run in runs:
        ours = reference.get(run.instance)
        if ours is None or run.solver.startswith(_OWN):
            continue
        theirs = run.time_limit if run.outcome is Outcome.TIME_OUT else run.seconds
        counted = run.outcome in (Outcome.SOLVED, Outcome.WRONG, Outcome.TIME_OUT)
        if counted and theirs and ours.seconds:
            yield ours.seconds / theirs, run


def _told(run: SolverRun) -> str:
    """Return the seconds of a run in words; its limit if it ran out of time."""
    if run.outcome is Outcome.TIME_OUT:
        return f"limit of {run.time_limit:.3g}"
    return f"{run.seconds or math.nan:.3g}"


def _unanswered(runs: Sequence[SolverRun], solver: str, case: str) -> str:
    """Return the numbers of a peer's missing and wrong answers in words; empty if none."""
    own = [r for r in runs if r.solver == solver and parse_instance(r.instance).case == case]
    counts = {
        "out of time": Outcome.TIME_OUT,
        "wrong": Outcome.WRONG,
        "failed": Outcome.FAILED,
        "out of memory": Outcome.OUT_OF_MEMORY,
    }
    return "".join(
        f", {number} {words}"
        for words, outcome in counts.items()
        if (number := sum(run.outcome is outcome for run in own))
    )
