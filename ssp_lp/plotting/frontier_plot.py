"""The frontier: least cost against the failure budget, and what is not known between its points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssp_lp.analysis.frontier import Frontier
from ssp_lp.arrays import FloatArray
from ssp_lp.errors import SolverError
from ssp_lp.model.arguments import explained
from ssp_lp.plotting.style import INK, LOOKS, PALE, Look, axes_or_new, dress_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAND = "the optimum lies in here"
_SAMPLES = 400  # budgets in all, shared out among the segments
_VISIBLE = 2e-3  # of the height: a band that is narrower is a line
_TANGENT = 0.4  # of the height: how far a tangent rises and falls
_FINEST = 1e-5  # gap: five digits are shown at most
_MANY = 40  # turning points, beyond which each has a small marker


@explained
def plot_frontier(
    frontier: Frontier,
    budget: float | None = None,
    *,
    ax: Axes | None = None,
    label: str | None = None,
    look: int = 0,
) -> Axes:
    """Draw the least objective against the failure budget.

    The line is what the lotteries over neighbouring turning points attain. Where tracing was cut
    short, the optimum lies in the hatched band below it, down to what is proved
    (:meth:`Frontier.bounds_at`, up to two pricing calls for each turning point). In case S a
    segment is no straight line: the objective is a ratio.

    Args:
        frontier: from ``trace_frontier``.
        budget: marked with its value, and with the tangent there, whose slope is that of the
            optimum in the budget: minus the failure price in case M; both tangents at a turning
            point. Where the frontier is not settled, with its bounds and without a tangent.
        ax: where to draw; None: a new figure.
        label: of the line; None: its gap.
        look: of the line, 0 .. 4, so that several can be told apart.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        InfeasibleError: the budget is below the least failure.
        ModelError: the frontier was not traced down to the budget.

    Example:
        >>> from ssp_lp import SSP, trace_frontier
        >>> from formulations import MCMP
        >>> model = SSP.from_transitions(
        ...     {"s": {"road": [(0.99, "g", 9.0), (0.01, "d", 5.0)],
        ...            "alley": [(0.9, "g", 4.0), (0.1, "d", 2.0)]}, "d": {}},
        ...     goal={"g"}, treat_actionless_as_dead_ends=True)
        >>> axes = trace_frontier(MCMP(model, "s")).plot(budget=0.05)
    """
    ax = axes_or_new(ax)
    chosen = LOOKS[look % len(LOOKS)]
    _draw_frontier(ax, frontier, chosen, label or f"least cost, gap {frontier.gap:.1e}")
    if budget is not None:
        _mark_on_frontier(ax, frontier, budget, chosen)
    dress_axes(ax, "failure budget", f"least cost{' given success' if frontier.ratio else ''}")
    ax.legend(frameon=False)
    return ax


def _draw_frontier(ax: Axes, frontier: Frontier, look: Look, label: str) -> None:
    """The frontier, its turning points, and the band where the optimum may lie below."""
    budgets = _sampled_frontier(frontier)
    low, high = np.array([frontier.bounds_at(float(b)) for b in budgets]).T
    many = len(frontier.failure) > _MANY
    ax.plot(budgets, high, color=look.colour, linestyle=look.line, linewidth=2, label=label)
    ax.plot(frontier.failure, frontier.objective, look.marker, color=look.colour,
            markersize=2.5 if many else 5)  # fmt: skip
    if (high - low).max() > max(_VISIBLE * np.ptp(high), frontier.tolerance * high.max()):
        band = None if _BAND in ax.get_legend_handles_labels()[1] else _BAND
        ax.fill_between(budgets, low, high, facecolor="none", edgecolor=look.colour,
                        hatch=look.hatch, linewidth=0.6, label=band)  # fmt: skip


def _sampled_frontier(frontier: Frontier) -> FloatArray:
    """Budgets along every segment."""
    failure = frontier.failure
    each = max(_SAMPLES // len(failure), 4)
    segments = zip(failure[:-1].tolist(), failure[1:].tolist(), strict=True)
    found = [failure, *(_budgets_between(begin, end, each) for begin, end in segments)]
    return np.unique(np.concatenate(found))


def _budgets_between(begin: float, end: float, count: int) -> FloatArray:
    """Budgets from one to another, dense on a linear and on a logarithmic axis."""
    even = np.linspace(begin, end, count)
    if begin == 0.0:
        return even
    return np.clip(np.union1d(even, np.geomspace(begin, end, count)), begin, end)


def _mark_on_frontier(ax: Axes, frontier: Frontier, budget: float, look: Look) -> None:
    """The budget with its value and its tangents, or with its bounds."""
    ax.axvline(budget, color=PALE, linewidth=0.8, linestyle=":", zorder=1)
    try:
        value = frontier.objective_at(budget)
    except SolverError:
        low, high = frontier.bounds_at(budget)
        ends = f"{low:.5g}", f"{high:.5g}"
        near = ends[0] == ends[1]
        told = f"{ends[1]}, to {high - low:.0e}" if near else f"{ends[0]} to {ends[1]}"
        ax.plot([budget, budget], [low, high], color=look.colour, linewidth=2, zorder=5)
        ax.plot([budget, budget], [low, high], "_", color=look.colour, markersize=14, zorder=5,
                markeredgewidth=2, label=f"budget {budget:g}: {told}")  # fmt: skip
        return
    ax.plot([budget], [value], "*", color=look.colour, markeredgecolor=INK, markersize=14, zorder=6,
            label=f"budget {budget:g}: {_as_far_as_sure(value, frontier):.5g}")  # fmt: skip
    prices = [price - (value if frontier.ratio else 0.0) for price in _prices_at(frontier, budget)]
    for price in prices:
        _draw_tangent(ax, frontier, (budget, value), price)
    if prices:
        told = " to ".join(f"{price:.4g}" for price in sorted(prices))
        ax.plot([], [], color=INK, linestyle="-.", linewidth=1,
                label=f"tangent{'s' * (len(prices) - 1)}: failure price {told}")  # fmt: skip


def _as_far_as_sure(value: float, frontier: Frontier) -> float:
    """A value rounded to the digits that the gap of its frontier leaves sure, two at least."""
    digits = max(-np.log10(max(frontier.gap, _FINEST)), 2.0)
    return float(f"{value:.{int(digits)}g}")


def _prices_at(frontier: Frontier, budget: float) -> list[float]:
    """Prices of the settled segments at a budget: one within a segment, up to two at its ends."""
    touching = (frontier.failure[:-1] <= budget) & (budget <= frontier.failure[1:])
    settled = frontier.below <= frontier.tolerance
    return [float(price) for price in frontier.price[touching & settled]]


def _draw_tangent(ax: Axes, frontier: Frontier, point: tuple[float, float], price: float) -> None:
    """The line through a point, as far as it stays beside the frontier."""
    budget, value = point
    slope = -price / (1.0 - budget) if frontier.ratio else -price
    height, failure = frontier.objective, frontier.failure
    room = _TANGENT * float(np.ptp(height)) / abs(slope) if slope else np.inf
    ends = max(budget - room, float(failure[0])), min(budget + room, float(failure[-1]))
    along = _budgets_between(*ends, _SAMPLES)
    ax.plot(
        along, value + slope * (along - budget), color=INK, linestyle="-.", linewidth=1.1, zorder=5
    )
