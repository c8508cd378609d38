"""Time against model size: a panel per group of instances, a line per solver.

Colours are Okabe and Ito's, one per kind of solver; the marker distinguishes solvers of a kind.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.reporting.results import REFERENCE, Outcome, SolverRun

_COLUMNS, _NUMPY, _LP, _HIGHS, _STORM, _OTHER = (
    "#0072B2", "#56B4E9", "#E69F00", "#D55E00", "#009E73", "#CC79A7",
)  # fmt: skip
STYLES = {
    "columns": (_COLUMNS, "o"),
    "columns-numpy": (_NUMPY, "s"),
    "lp-simplex": (_LP, "^"),
    "lp-ipx": (_LP, "v"),
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
_ASIDE = 0.07  # decades between hollow markers


def save_plot(runs: Sequence[SolverRun], path: Path) -> None:
    """Draw the runs with a time or a time-out; save nothing if there are none."""
    drawn = [run for run in runs if run.transitions and _height(run) is not None]
    groups = list(dict.fromkeys(parse_instance(run.instance).group for run in drawn))
    if not groups:
        return
    figure = Figure(figsize=(1.9 + 3.6 * len(groups), 4.6), layout="constrained")
    panels = figure.subplots(1, len(groups), sharex=True, sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        members = [run for run in drawn if parse_instance(run.instance).group == group]
        _draw_limit(axes, members)
        for solver in dict.fromkeys(run.solver for run in members):
            _draw_solver(axes, [run for run in members if run.solver == solver], members)
        _dress(axes, group)
    sizes = [math.log10(run.transitions) for run in drawn if run.transitions]
    panels[0].set_xlim(10.0 ** math.floor(min(sizes)), 10.0 ** math.ceil(max(sizes)))
    panels[0].set_ylabel("seconds to solve the ready model")
    figure.suptitle("Time to solve against model size", x=0.01, ha="left", color=_INK)
    _add_legend(figure, drawn)
    figure.savefig(path, dpi=160)


def _dress(axes: Axes, group: str) -> None:
    family, case = group.split(maxsplit=1)
    axes.set_title(f"{family}, case {case}", loc="left", fontsize=10)
    axes.set_xlabel("transitions of the model")
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e5e5e5", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_limit(axes: Axes, runs: Sequence[SolverRun]) -> None:
    late = [run.time_limit for run in runs if run.outcome is Outcome.TIME_OUT]
    if late:
        axes.axhline(max(late), color="#999999", linewidth=0.8, linestyle=":", zorder=1)


def _draw_solver(axes: Axes, own: Sequence[SolverRun], members: Sequence[SolverRun]) -> None:
    """Draw a solver's line, dashed to a hollow marker where the time ran out."""
    colour, marker = STYLES.get(own[0].solver, _FALLBACK)
    points = [
        (_place(run, members), _height(run), run.outcome is Outcome.TIME_OUT)
        for run in sorted(own, key=lambda run: run.transitions or 0)
    ]
    thick = own[0].solver == REFERENCE
    for (x, y, _), (next_x, next_y, late) in pairwise(points):
        axes.plot(
            [x, next_x],
            [y, next_y],
            color=colour,
            linewidth=2.2 if thick else 1.2,
            linestyle="--" if late else "-",
            zorder=3 if thick else 2,
        )
    for x, y, late in points:
        face = "white" if late else colour
        axes.plot([x], [y], marker, color=colour, markerfacecolor=face, markersize=7, zorder=4)


def _place(run: SolverRun, members: Sequence[SolverRun]) -> float:
    """Return the model's size, shifted so that several time-outs of an instance are visible."""
    size = float(run.transitions or 1)
    if run.outcome is not Outcome.TIME_OUT:
        return size
    late = [m.solver for m in members if m.instance == run.instance and m.outcome is run.outcome]
    return size * 10 ** (_ASIDE * (late.index(run.solver) - (len(late) - 1) / 2))


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
