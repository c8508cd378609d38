"""The law of the total cost: how likely each cost is on success, its quantile and its tail."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssp_lp.analysis.total_cost.cost_law import CostLaw
from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model.arguments import explained
from ssp_lp.plotting.style import INK, LOOKS, axes_or_new, dress_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BARS = 150
_PALE = "#b5d6ea"  # behind lines
_UNSEEN = 1e-3  # share of the successes that are costlier than what is drawn


@explained
def plot_cost_law(law: CostLaw, level: float = 0.9, *, ax: Axes | None = None) -> Axes:
    """Draw the law of the total cost given success, its quantile and the mean of its tail.

    A bar is the probability of one cost, or, where there are too many, of an interval of costs.
    The costliest share of ``1 - level`` is hatched: its mean is the conditional value at risk, and
    the bar at the quantile belongs to it in part. At most a thousandth of the successes costs more
    than the last bar.

    Args:
        law: from ``success_costs``.
        level: of the quantile and of the tail, in [0, 1).
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: the goal is never reached, a level out of range, or costs without a common unit.
    """
    if law.goal == 0.0:
        raise ModelError("the policy never reaches the goal: there is no law of costs to draw")
    ax = axes_or_new(ax)
    quantile, tail = law.quantile(level), law.tail_mean(level)
    costs, shares, width = _bars_of_law(law)
    body, rest = LOOKS[0], LOOKS[1]
    dearer = 1.0 - np.cumsum(shares)  # what is not drawn counts
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
    """Middles, probabilities given success, and the width of the bars."""
    costs, masses = law.all_but(_UNSEEN * law.goal)
    shares = masses / law.goal
    if len(costs) <= 1:
        return costs, shares, 1.0
    unit, span = float(np.diff(costs).min()), float(np.ptp(costs))
    if span <= _BARS * unit:
        return costs, shares, 0.85 * unit
    heights, edges = np.histogram(costs, _BARS, weights=shares)
    return 0.5 * (edges[1:] + edges[:-1]), heights, float(edges[1] - edges[0])
