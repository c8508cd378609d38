"""Episodes as paths in the plane, told apart by how they end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.analysis.simulation import simulate
from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError, optional_module
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph.reachability import end_marks
from ssp_lp.plotting.cells import Places, Point, add_legend, cells_of, draw_ground, size_of
from ssp_lp.plotting.style import INK, LOOKS, axes_or_new
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.policies.randomness import Randomness, generator_of
from ssp_lp.problem import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SPREAD = 0.3  # of a cell's side: how far from its middle a path may be moved


@explained
def plot_paths(
    paths: Sequence[Any],
    ends: Sequence[str],
    *,
    order: Sequence[str] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw paths in the plane; each way to end has its colour, line and marker.

    The first way is drawn palely and beneath the others, so that the exceptions stand out.

    Args:
        paths: an array [points, 2 or more] each; the first two columns are x and y.
        ends: how each path ends, in words for the legend, [paths].
        order: the ways to end, so that they look the same in several pictures; those that are not
            listed follow by how many paths end so.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: a path is no such array, or has no end.
    """
    drawn = [np.asarray(path, dtype=np.float64) for path in paths]
    if len(drawn) != len(ends):
        raise ModelError(f"{len(drawn)} paths cannot have {len(ends)} ends")
    if not all(path.size == 0 or (path.ndim == 2 and path.shape[1] >= 2) for path in drawn):
        raise ModelError("a path must be an array [points, 2 or more]")
    ax = axes_or_new(ax, 5.6, 5.6)
    lines, legend, counts = optional_module("matplotlib.lines", "plot"), [], Counter(ends)
    ways = dict.fromkeys([*order, *(end for end, _ in counts.most_common())])
    for rank, end in enumerate(ways):
        look, usual = LOOKS[rank % len(LOOKS)], rank == 0
        style: dict[str, Any] = {"color": look.colour, "linestyle": look.line, "linewidth": 0.9}
        for path, own in zip(drawn, ends, strict=True):
            if own == end and len(path):
                x, y = path[:, :2].T
                ax.plot(x, y, alpha=0.45 if usual else 0.95, zorder=3 if usual else 4, **style)
                ax.plot(x[-1:], y[-1:], look.marker, color=look.colour, zorder=5,
                        markeredgecolor=look.colour if usual else INK,
                        markersize=4 if usual else 7)  # fmt: skip
        if counts[end]:
            entry = lines.Line2D([], [], marker=look.marker, label=f"{counts[end]} {end}", **style)
            legend.append(entry)
    add_legend(ax, legend)
    return ax


@explained
def plot_episodes(
    policy: Policy | MixedPolicy,
    problem: Problem,
    cells: Places,
    *,
    episodes: int = 50,
    rng: Randomness = 0,
    walls: Iterable[Point] = (),
    ax: Axes | None = None,
) -> Axes:
    """Simulate episodes in a model on a grid, and draw them over its walls, dead-ends and goals.

    Each path keeps its own small distance from the middles of the cells, so that none hides the
    others. States without a cell are left out of a path.

    Args:
        policy: any policy on the problem's model.
        problem: says the start.
        cells: the (x, y) of a state, the middle of a unit square.
        episodes: how many to draw.
        rng: a generator or a seed, of the episodes and of the distances.
        walls: middles of squares that are no states.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no state has a cell, or the policy is for another model.
    """
    model, source, walls = problem.model, generator_of(rng), list(walls)
    points, marks = cells_of(model, cells), end_marks(model)
    ax = axes_or_new(ax, *size_of(points, walls))
    played = simulate(policy, problem, episodes=episodes, rng=source, record=episodes).paths
    aside = source.uniform(-_SPREAD, _SPREAD, (episodes, 2))
    fails = (f"fail: {name}" for name in (*model.state_labels, "dead-end"))
    words = ["reach the goal", *fails]
    ends = [words[m] if (m := marks[int(p[-1])]) >= 0 else "give up or go on" for p in played]
    paths = [_placed_path(points[path], shift) for path, shift in zip(played, aside, strict=True)]
    ground = draw_ground(ax, problem, points, walls)
    plot_paths(paths, ends, order=words, ax=ax)
    drawn = ax.get_legend()
    add_legend(ax, ground + (list(drawn.legend_handles) if drawn else []))
    return ax


def _placed_path(path: FloatArray, shift: FloatArray) -> FloatArray:
    """A path without what lies nowhere, aside of the middles of the cells, [points, 2]."""
    return path[~np.isnan(path).any(axis=1)] + shift
