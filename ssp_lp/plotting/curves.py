"""Plots of curves and bars: frontiers, the bounds of a solve, distributions of the total cost.

The style of all plots is here, too: colours that can be distinguished with any colour vision, each
with a second distinguishing mark.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from ssp_lp.accumulated_cost.cost_law import CostLaw
from ssp_lp.analysis.what_if import WhatIf
from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.column import FailureRow
from ssp_lp.errors import ModelError, SolverError, optional_module
from ssp_lp.methods.frontier import Frontier
from ssp_lp.model.arguments import explained
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import Solution, as_solved

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, PALE = "#333333", "#777777"


class _Look(NamedTuple):
    """Style of a curve or a bar; styles differ in more than their colours."""

    colour: str
    line: str | tuple[int, tuple[int, ...]]
    marker: str
    hatch: str


LOOKS = (
    _Look("#0072B2", "-", "o", "////"),
    _Look("#D55E00", "--", "X", "\\\\\\\\"),
    _Look("#009E73", "-.", "^", "...."),
    _Look("#CC79A7", ":", "s", "xxxx"),
    _Look("#000000", (0, (5, 1, 1, 1, 1, 1)), "D", "||||"),
)
"""Okabe and Ito's colours, which people with any colour vision can distinguish."""


def axes_or_new(ax: Axes | None, width: float = 6.4, height: float = 4.2) -> Axes:
    """Return the given axes, or the axes of a new figure.

    Args:
        ax: axes of matplotlib; None: a new figure.
        width: width of the new figure, in inches.
        height: height of the new figure, in inches.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: the argument is no axes.
    """
    if ax is None:
        pyplot = optional_module("matplotlib.pyplot", "plot")
        ax = pyplot.subplots(figsize=(width, height), layout="constrained")[1]
    if not isinstance(ax, optional_module("matplotlib.axes", "plot").Axes):
        raise ModelError(f"ax must be axes of matplotlib, or None for a new figure, not {ax!r}")
    return cast("Axes", ax)


def dress_axes(ax: Axes, x: str, y: str) -> None:
    """Label both axes of a plot, draw a grid, and remove the lines above and on the right."""
    ax.set(xlabel=x, ylabel=y)
    ax.set_axisbelow(True)
    ax.grid(color="#e5e5e5", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)


_BAND = "the optimum lies in here"
_SAMPLES = 400  # budgets in all, divided among the segments


@explained
def plot_frontier(
    frontier: Frontier,
    budget: float | None = None,
    *,
    ax: Axes | None = None,
    label: str | None = None,
    look: int = 0,
    whole: bool = False,
) -> Axes:
    """Draw the least objective against the failure budget, or another limit.

    The line is the value of lotteries over neighbouring turning points. If tracing was cut short,
    the optimum lies in the hatched band between the line and the proved bound
    (:meth:`Frontier.bounds_at`); drawing the band takes up to two pricing calls for each turning
    point. In case S segments are not straight, since the objective is a ratio.

    Args:
        frontier: result of ``trace_frontier``.
        budget: a budget to mark, with the optimum and its tangent. The slope of the tangent is the
            derivative of the optimum by the budget (minus the failure price in case M). A turning
            point has two tangents. Where the optimum is known only up to bounds, the bounds are
            drawn instead.
        ax: where to draw; None: a new figure.
        label: label of the line; None: a label with the frontier's gap.
        look: style of the line, 0 .. 4, to distinguish several lines.
        whole: show the whole frontier; otherwise a new figure shows its bend and the budget.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        InfeasibleError: the budget is below the least failure.
        ModelError: the frontier was not traced down to the budget.

    Example:
        >>> from ssp_lp import MCMP, SSP, trace_frontier
        >>> model = SSP.from_transitions(
        ...     {"s": {"road": [(0.99, "g", 9.0), (0.01, "d", 5.0)],
        ...            "alley": [(0.9, "g", 4.0), (0.1, "d", 2.0)]}, "d": {}},
        ...     goal={"g"}, treat_actionless_as_dead_ends=True)
        >>> axes = trace_frontier(MCMP(model, "s")).plot(budget=0.05)
    """
    is_new, ax = ax is None, axes_or_new(ax)
    chosen, words = LOOKS[look % len(LOOKS)], "objective" if frontier.maximises else "least cost"
    _draw_frontier(ax, frontier, chosen, label or f"{words}, gap {frontier.gap:.1e}")
    if budget is not None:
        _mark_on_frontier(ax, frontier, budget, chosen)
    if is_new and not whole:
        _show_region(ax, frontier, budget)
    dress_axes(ax, frontier.axis, f"{words}{' given success' if frontier.ratio else ''}")
    ax.legend(frameon=False)
    return ax


def _show_region(ax: Axes, frontier: Frontier, budget: float | None) -> None:
    """Set the limits of the axes so that they show the frontier's bend and the budget."""
    first, last = frontier.region
    if budget is not None:
        beyond = first + 1.5 * (budget - first)
        last = max(last, min(beyond, float(frontier.spent[-1])))
    ends = [high for _, high in map(frontier.bounds_at, (first, last))]
    for (low, high), show in (((first, last), ax.set_xlim), (sorted(ends), ax.set_ylim)):
        if high > low:
            margin = 0.05 * (high - low)
            show(low - margin, high + margin)


def _draw_frontier(ax: Axes, frontier: Frontier, look: _Look, label: str) -> None:
    """Draw a frontier, its turning points, and the band between its bounds."""
    spent, (budgets, low, high) = frontier.spent, bounds_along(frontier)
    attained, size = low if frontier.maximises else high, 2.5 if len(spent) > 40 else 5
    ax.plot(budgets, attained, color=look.colour, linestyle=look.line, linewidth=2, label=label)
    ax.plot(spent, frontier.objective, look.marker, color=look.colour, markersize=size)
    least = max(2e-3 * np.ptp(high), frontier.tolerance * high.max())  # height of a visible band
    if (high - low).max() > least:
        band = None if _BAND in ax.get_legend_handles_labels()[1] else _BAND
        ax.fill_between(budgets, low, high, facecolor="none", edgecolor=look.colour,
                        hatch=look.hatch, linewidth=0.6, label=band)  # fmt: skip


def bounds_along(frontier: Frontier) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return budgets along a frontier, and the optimum's lower and upper bounds at each.

    The three arrays are [budgets]. All turning points are among the budgets.
    """
    spent = frontier.spent
    each = max(_SAMPLES // len(spent), 4)
    segments = zip(spent[:-1].tolist(), spent[1:].tolist(), strict=True)
    all_budgets = [spent, *(_budgets_between(begin, end, each) for begin, end in segments)]
    budgets = np.unique(np.concatenate(all_budgets))
    low, high = np.array([frontier.bounds_at(float(b)) for b in budgets]).T
    return budgets, low, high


def _budgets_between(begin: float, end: float, count: int) -> FloatArray:
    """Return budgets between two given ones, dense enough for linear and logarithmic axes."""
    even = np.linspace(begin, end, count)
    if begin == 0.0:
        return even
    return np.clip(np.union1d(even, np.geomspace(begin, end, count)), begin, end)


def _mark_on_frontier(ax: Axes, frontier: Frontier, budget: float, look: _Look) -> None:
    """Mark a budget with the optimum and its tangents, or with bounds if the optimum is unknown."""
    ax.axvline(budget, color=PALE, linewidth=0.8, linestyle=":", zorder=1)
    try:
        value = frontier.objective_at(budget)
    except SolverError:
        low, high = frontier.bounds_at(budget)
        interval = f"{low:.5g} to {high:.5g}"
        if f"{low:.5g}" == f"{high:.5g}":
            interval = f"{high:.5g}, to {high - low:.0e}"
        ax.plot([budget, budget], [low, high], "_-", color=look.colour, linewidth=2, markersize=14,
                zorder=5, markeredgewidth=2, label=f"budget {budget:g}: {interval}")  # fmt: skip
        return
    digits = max(-int(np.log10(max(frontier.gap, 1e-5))), 2)  # as many as the gap leaves certain
    certain = float(f"{value:.{digits}g}")
    ax.plot([budget], [value], "*", color=look.colour, markeredgecolor=INK, markersize=14, zorder=6,
            label=f"budget {budget:g}: {certain:.5g}")  # fmt: skip
    slopes = frontier.slopes_at(budget)
    for slope in slopes:  # a line through the point, as far as it stays close
        room = 0.4 * float(np.ptp(frontier.objective)) / abs(slope) if slope else np.inf
        first, last = frontier.spent[[0, -1]].tolist()
        along = _budgets_between(max(budget - room, first), min(budget + room, last), _SAMPLES)
        ax.plot(along, value + slope * (along - budget), color=INK, linestyle="-.", linewidth=1.1,
                zorder=5)  # fmt: skip
    if slopes:
        by_failure = frontier.ratio and frontier.over == "failure"
        prices = sorted(abs(slope) * (1.0 - budget if by_failure else 1.0) for slope in slopes)
        listed = " to ".join(f"{price:.4g}" for price in prices)
        words = f"tangent{'s' * (len(prices) - 1)}: {frontier.over} price {listed}"
        ax.plot([], [], color=INK, linestyle="-.", linewidth=1, label=words)


@dataclass
class BoundsRecord:
    """Record of the progress reports of ``solve(..., progress=record)``. Mutable."""

    began: float = field(default_factory=time.perf_counter)
    seconds: list[float] = field(default_factory=list)  # [reports] since then
    prices: list[float] = field(default_factory=list)  # [reports] of failure
    objectives: list[float] = field(default_factory=list)  # [reports] of the best policy so far

    def __call__(self, calls: int, price: float, objective: float) -> None:
        """Add a report of ``solve``."""
        self.seconds.append(time.perf_counter() - self.began)
        self.prices.append(price)
        self.objectives.append(objective)


@explained
def plot_bounds(record: BoundsRecord, solution: Solution, *, ax: Axes | None = None) -> Axes:
    """Plot the upper and lower bound of the optimum against seconds.

    The upper bound is the objective of the best policy so far. The lower bound is the greatest that
    the failure prices so far prove: for each price, one pricing problem is solved for the plot, on
    the process that the linear program would have, with its cap on the accumulated cost. The last
    point shows the bounds of the solution. Before that point a lower bound is drawn only if a cost
    is minimised within a failure budget, without other limits.

    Args:
        record: record of the reports of ``solve``.
        solution: solution of that call.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: the argument is no solution, or its criterion is a quantile or another function
            of the distribution of costs. ``solve`` searches for such an optimum by solving other
            problems, whose reports do not bound it.

    Example:
        >>> from ssp_lp import MCMP, SSP, solve
        >>> model = SSP.from_transitions({"s": {"go": [(0.5, "g", 1.0), (0.5, "s", 1.0)]}}, {"g"})
        >>> record = BoundsRecord()
        >>> axes = plot_bounds(record, solve(MCMP(model, "s", 0.1), progress=record))
    """
    as_solved(solution, "plot_bounds")
    if solution.problem.semantics.counts_law:
        name = type(solution.problem).__name__
        raise ModelError(f"{name} records no bounds during the search: read solution.gap instead")
    ax = axes_or_new(ax)
    upper = np.minimum.accumulate([*record.objectives, solution.objective])
    lower = np.maximum.accumulate([*_proved_bounds(record, solution.problem), solution.lower_bound])
    seconds = np.maximum.accumulate([*record.seconds, solution.seconds])
    curves = (upper, LOOKS[0], "best policy"), (lower, LOOKS[1], "proved bound")
    for values, look, words in curves:
        finite = np.isfinite(values)
        ax.step(seconds[finite], values[finite], where="post", color=look.colour,
                linestyle=look.line, marker=look.marker, markersize=5,
                label=f"{words}: {values[-1]:.8g}")  # fmt: skip
    both = np.isfinite(lower) & np.isfinite(upper)
    ax.fill_between(seconds, lower, upper, where=both.tolist(), step="post", facecolor="none",
                    edgecolor="#bbbbbb", hatch="....", linewidth=0.0)  # fmt: skip
    ax.set_xlim(left=float(seconds[0]))  # no bounds before the first report
    dress_axes(ax, "seconds", "bounds on the objective")
    ax.legend(frameon=False)
    return ax


def _proved_bounds(record: BoundsRecord, problem: Problem) -> FloatArray:
    """Return the lower bound that the price in each report proves; -inf: unknown, [reports]."""
    budget, semantics = problem.failure_budget, problem.semantics
    if budget is None or problem.several_rows or semantics.aim is not Aim.LEAST_COST:
        return np.full(len(record.prices), -np.inf)
    pricing, row = problem.compile().for_program().pricing(), FailureRow(budget, problem.ratio)
    best, proved = replace(pricing.first(), totals=None), []  # otherwise its own values are used
    for price, objective in zip(record.prices, record.objectives, strict=True):
        slack = problem.ratio and price <= objective
        proved.append(row.lower_bound(pricing.prove(price, best, slack=slack)))
    return np.array(proved)


_BARS = 150
_PALE = "#b5d6ea"  # behind lines
_UNSEEN = 1e-3  # share of the successes with greater costs than those drawn


@explained
def plot_cost_law(law: CostLaw, level: float = 0.9, *, ax: Axes | None = None) -> Axes:
    """Plot the distribution of the total cost given success, its quantile and tail mean.

    A bar is the probability of one cost or, if there are too many costs, of an interval of costs.
    The costliest share ``1 - level`` of the successes is hatched, so the bar at the quantile may be
    split. The mean of the hatched part is the conditional value at risk. At most a thousandth of
    the successes costs more than the last bar.

    Args:
        law: result of ``success_costs``.
        level: level of the quantile and of the tail, in [0, 1).
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: the goal is never reached, a level out of range, or costs without a common unit.
    """
    if law.goal == 0.0:
        raise ModelError("no costs to draw: the policy never reaches the goal")
    ax = axes_or_new(ax)
    quantile, tail = law.quantile(level), law.tail_mean(level)
    costs, shares, width = _bars_of_law(law)
    body, rest = LOOKS[0], LOOKS[1]
    dearer = 1.0 - np.cumsum(shares)  # costs that are not drawn count
    hatched = np.clip(1.0 - level - dearer, 0.0, shares)
    some, left = hatched > 0.0, shares - hatched
    ax.bar(costs[left > 0.0], left[left > 0.0], width, facecolor=_PALE, edgecolor=body.colour)
    ax.bar(costs[some], hatched[some], width, left[some], facecolor="white", edgecolor=rest.colour,
           hatch=rest.hatch, linewidth=0.6, label=f"costliest {1.0 - level:.3g}")  # fmt: skip
    marks = (
        (law.conditional_mean, "-", "mean"),
        (quantile, "--", f"{level:g} quantile"),
        (tail, "-.", "CVaR, mean of the costliest"),
    )
    for value, line, words in marks:
        ax.axvline(value, color=INK, linestyle=line, linewidth=1.3, label=f"{words}: {value:.5g}")
    dress_axes(ax, "total cost", "probability given success")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, frameon=False,
              title=f"goal reached with probability {law.goal:.4g}")  # fmt: skip
    return ax


def _bars_of_law(law: CostLaw) -> tuple[FloatArray, FloatArray, float]:
    """Return the bars of a cost distribution: their middles, their heights, and their width.

    A height is the probability of the bar's costs given success.
    """
    costs, masses = law.all_but(_UNSEEN * law.goal)
    shares = masses / law.goal
    if len(costs) <= 1:
        return costs, shares, 1.0
    unit, span = float(np.diff(costs).min()), float(np.ptp(costs))
    if span <= _BARS * unit:
        return costs, shares, 0.85 * unit
    heights, edges = np.histogram(costs, _BARS, weights=shares)
    return 0.5 * (edges[1:] + edges[:-1]), heights, float(edges[1] - edges[0])


@explained
def plot_tornado(
    effects: WhatIf, *, share: float = 0.1, most: int = 12, ax: Axes | None = None
) -> Axes:
    """Draw a bar for the effect of each number of a problem on the optimum, the longest on top.

    A bar shows by how much the optimum changes when the number falls or rises by a share of its
    size, computed from the derivative on each side. The size of a probability p is min(p, 1 - p).

    Args:
        effects: result of ``solution.what_if()``.
        share: share of its size by which each number changes.
        most: greatest number of bars.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no number moves the optimum.
    """
    drawn = [effect for effect in effects.effects if effect.weight > 0.0][:most][::-1]
    if not drawn:
        raise ModelError("no number moves the optimum: there is nothing to draw")
    ax = axes_or_new(ax, 7.2, 1.2 + 0.34 * len(drawn))
    places = np.arange(len(drawn))
    moves = share * np.array([effect.number.scale for effect in drawn])
    falls, rises = (
        ([e.left or 0.0 for e in drawn], -moves),
        ([e.right or 0.0 for e in drawn], moves),
    )
    for words, look, (slopes, move) in (("falls", LOOKS[0], falls), ("rises", LOOKS[1], rises)):
        ax.barh(places, np.array(slopes) * move, 0.62, facecolor="white", edgecolor=look.colour,
                hatch=look.hatch, label=f"it {words} by {share:.0%}")  # fmt: skip
    names = [f"{e.number.name} ({e.number.value:g})" if e.number.value is not None
             else e.number.name for e in drawn]  # fmt: skip
    ax.set_yticks(places, names)
    ax.axvline(0.0, color=INK, linewidth=1.0)
    dress_axes(ax, f"change of the optimum {effects.optimum.measure.objective:.6g}", "")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    return ax


@explained
def plot_parameter(solutions: Iterable[object], name: str, *, ax: Axes | None = None) -> Axes:
    """Draw the optimum as a function of a parameter of the model, with its slope at each point.

    The slopes are the derivatives of ``solution.what_if()``. If the left and the right slope
    differ, there is a kink. Errors among the answers, such as infeasible problems, are left out.

    Args:
        solutions: answers to one problem at several values of the parameter, such as
            ``solve_many(sweep(...))``.
        name: name of the parameter.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: fewer than two of the problems were solved and have the parameter.
    """
    solved = [one for one in solutions if isinstance(one, Solution)]
    solved = [one for one in solved if name in one.problem.model.parameters]
    if len(solved) < 2:
        raise ModelError(f"give solutions of two or more models with the parameter {name!r}")
    solved.sort(key=lambda one: one.problem.model.parameters[name].value)
    at = np.array([one.problem.model.parameters[name].value for one in solved])
    optima = np.array([one.objective for one in solved])
    ax, half = axes_or_new(ax), 0.4 * float(np.diff(at).min(initial=np.inf))
    for x, y, one in zip(at.tolist(), optima.tolist(), solved, strict=True):
        (effect,) = one.what_if(
            by=lambda number: name if number.name == f"parameter {name}" else None
        ).effects
        for slope, end in ((effect.left, -half), (effect.right, half)):
            if slope is not None:
                ax.plot([x, x + end], [y, y + slope * end], color=LOOKS[1].colour, linewidth=2.5)
    ax.plot(at, optima, color=LOOKS[0].colour, marker=LOOKS[0].marker, linestyle=":")
    dress_axes(ax, name, "optimum")
    return ax
