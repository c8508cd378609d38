"""Time against model size: a panel per group of instances, a line per solver.

Colours are Okabe and Ito's, one per kind of solver; a marker says which solver of its kind.
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from comparison_instances import parse_instance
from comparison_results import Outcome, SolverRun

_COLUMNS, _NUMPY, _LP, _HIGHS, _STORM, _OTHER = (
    "#0072B2", "#56B4E9", "#E69F00", "#D55E00", "#009E73", "#CC79A7",
)  # fmt: skip
STYLES = {
    "columns": (_COLUMNS, "o"),
    "columns-numpy": (_NUMPY, "s"),
    "lp-simplex": (_LP, "^"),
    "lp-ipx": (_LP, "v"),
    "lp-clarabel": (_LP, "<"),
    "lp-cvxpy": (_LP, ">"),
    "highs-ipx": (_HIGHS, "D"),
    "highs-hipo": (_HIGHS, "P"),
    "highs-pdlp": (_HIGHS, "X"),
    "highs-hipdlp": (_HIGHS, "d"),
    "storm": (_STORM, "p"),
    "storm-sound": (_STORM, "h"),
    "storm-1e-9": (_STORM, "*"),
}
"""Solver -> colour, marker."""

_FALLBACK = (_OTHER, "8")
_INK = "#333333"


def save_plot(runs: Sequence[SolverRun], path: Path) -> None:
    """Draw the runs that have a time or ran out of it; nothing is saved without any."""
    drawn = [run for run in runs if run.transitions and _height(run) is not None]
    groups = list(dict.fromkeys(parse_instance(run.instance).group for run in drawn))
    if not groups:
        return
    figure = Figure(figsize=(1.9 + 3.6 * len(groups), 4.6), layout="constrained")
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        members = [run for run in drawn if parse_instance(run.instance).group == group]
        _draw_group(axes, members)
        family, case = group.split(maxsplit=1)
        axes.set_title(f"{family}, case {case}", loc="left", fontsize=10)
        axes.set_xlabel("transitions of the model")
    panels[0].set_ylabel("seconds to solve the ready model")
    figure.suptitle("Time to solve against model size", x=0.01, ha="left", color=_INK)
    _add_legend(figure, drawn)
    figure.savefig(path, dpi=160)


def _draw_group(axes: Axes, runs: Sequence[SolverRun]) -> None:
    for solver in dict.fromkeys(run.solver for run in runs):
        own = sorted(
            (run for run in runs if run.solver == solver), key=lambda run: run.transitions or 0
        )
        colour, marker = STYLES.get(solver, _FALLBACK)
        thick = solver == "columns"
        axes.plot(
            [run.transitions for run in own],
            [_height(run) for run in own],
            color=colour,
            linewidth=2.2 if thick else 1.2,
            zorder=3 if thick else 2,
        )
        for run in own:
            late = run.outcome is Outcome.TIME_OUT
            axes.plot(
                [run.transitions],
                [_height(run)],
                marker,
                color=colour,
                markerfacecolor="white" if late else colour,
                markersize=7,
                zorder=4,
            )
    axes.set(xscale="log", yscale="log")
    axes.margins(x=0.12)
    axes.grid(color="#e5e5e5", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _height(run: SolverRun) -> float | None:
    if run.outcome is Outcome.TIME_OUT:
        return run.time_limit
    return run.seconds if run.outcome is Outcome.SOLVED else None


def _add_legend(figure: Figure, runs: Sequence[SolverRun]) -> None:
    found = {run.solver for run in runs}
    names = [*(name for name in STYLES if name in found), *sorted(found - set(STYLES))]
    handles = []
    for name in names:
        colour, marker = STYLES.get(name, _FALLBACK)
        handles.append(Line2D([], [], color=colour, marker=marker, label=name))
    if any(run.outcome is Outcome.TIME_OUT for run in runs):
        hollow = {"color": _INK, "markerfacecolor": "white", "linestyle": ""}
        handles.append(Line2D([], [], marker="o", label="not done at the limit", **hollow))
    figure.legend(handles=handles, loc="outside right center", frameon=False)
