"""How the bounds on the optimum close in while a problem is solved."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model.arguments import explained
from ssp_lp.plotting.style import LOOKS, Look, axes_or_new, dress_axes
from ssp_lp.problem import Problem, by_rows
from ssp_lp.processes.failure_semantics import Aim

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass
class BoundsRecord:
    """What ``solve`` reports while it runs: hand it over as ``progress=BoundsRecord()``. Grows."""

    began: float = field(default_factory=time.perf_counter)
    seconds: list[float] = field(default_factory=list)  # [reports] since then
    prices: list[float] = field(default_factory=list)  # [reports] of failure
    objectives: list[float] = field(default_factory=list)  # [reports] of the best policy so far

    def __call__(self, calls: int, price: float, objective: float) -> None:
        """Keep one report."""
        self.seconds.append(time.perf_counter() - self.began)
        self.prices.append(price)
        self.objectives.append(objective)


@explained
def plot_bounds(record: BoundsRecord, solution: Any, *, ax: Axes | None = None) -> Axes:
    """Draw the upper and the lower bound on the optimum against seconds.

    The upper bound is the objective of the best policy known by then; the lower one is what the
    pricing calls made by then prove, each worked out once more at its price (and where accumulated
    costs are capped, with the cap that a linear program would have); at the end, both as in
    the solution. With limits beside the failure budget, and where no cost is minimised within a
    budget, only the last lower bound is known.

    Args:
        record: that ``solve`` reported to.
        solution: the ``Solution`` that this call handed back.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: a quantile or another measure of the law of costs, which is a search over
            problems: what they report bounds none of it.

    Example:
        >>> from ssp_lp import SSP, solve
        >>> from formulations import MCMP
        >>> model = SSP.from_transitions({"s": {"go": [(0.5, "g", 1.0), (0.5, "s", 1.0)]}}, {"g"})
        >>> record = BoundsRecord()
        >>> axes = plot_bounds(record, solve(MCMP(model, "s", 0.1), progress=record))
    """
    if not hasattr(solution, "lower_bound"):
        raise ModelError(f"plot_bounds takes a solution after its record, not {in_short(solution)}")
    if solution.problem.semantics.measure is not None:
        name = type(solution.problem).__name__
        raise ModelError(f"{name} is solved as a search over problems: nothing to draw but its end")
    ax = axes_or_new(ax)
    upper = np.minimum.accumulate([*record.objectives, solution.objective])
    lower = np.maximum.accumulate([*_proved_bounds(record, solution.problem), solution.lower_bound])
    seconds = np.maximum.accumulate([*record.seconds, solution.seconds])
    _draw_bound(ax, seconds, upper, LOOKS[0], "best policy")
    _draw_bound(ax, seconds, lower, LOOKS[1], "proved bound")
    both = np.isfinite(lower) & np.isfinite(upper)
    ax.fill_between(seconds, lower, upper, where=both.tolist(), step="post", facecolor="none",
                    edgecolor="#bbbbbb", hatch="....", linewidth=0.0)  # fmt: skip
    ax.set_xlim(left=0.0)
    dress_axes(ax, "seconds", "bounds on the objective")
    ax.legend(frameon=False)
    return ax


def _draw_bound(ax: Axes, seconds: FloatArray, values: FloatArray, look: Look, words: str) -> None:
    """Draw one of the bounds as steps over the seconds."""
    known = np.isfinite(values)
    ax.step(seconds[known], values[known], where="post", color=look.colour, linestyle=look.line,
            marker=look.marker, markersize=5, label=f"{words}: {values[-1]:.8g}")  # fmt: skip


def _proved_bounds(record: BoundsRecord, problem: Problem) -> FloatArray:
    """The lower bound that each report's price proves; -inf where none is known, [reports]."""
    budget, semantics = problem.failure_budget, problem.semantics
    if budget is None or by_rows(problem) or semantics.aim is not Aim.LEAST_COST:
        return np.full(len(record.prices), -np.inf)
    pricing, row = problem.compile().for_program().pricing(), FailureRow(budget, problem.ratio)
    best, proved = replace(pricing.first(), totals=None), []  # else its own values are taken
    for price, objective in zip(record.prices, record.objectives, strict=True):
        slack = problem.ratio and price <= objective
        proved.append(row.lower_bound(pricing.prove(price, best, slack=slack)))
    return np.array(proved)
