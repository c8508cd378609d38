"""Policies on a grid: where they lead, what they do there, the members of a lottery beside it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ssp_lp.analysis.visits import pair_visits
from ssp_lp.arrays import FloatArray, segment_ids
from ssp_lp.errors import optional_module
from ssp_lp.model.arguments import explained
from ssp_lp.plotting.cells import (
    Places,
    Point,
    add_legend,
    cells_of,
    draw_ground,
    points_of,
    size_of,
)
from ssp_lp.plotting.style import INK, axes_or_new
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHADES = ("#ffffff", "#6baed6")  # light enough for dark arrows
_RARE = 0.02  # of a cell's visits: an action that is taken less often has no arrow
_UNSEEN = 1e-6  # expected visits: a cell with fewer has none at all
_LONGEST = 0.46  # of a cell's side, from its middle
_SHORTEST = 0.75  # of the longest: an arrow for a small share
_RING = 0.08  # radius of what marks several actions
_SCALE = 1.0  # inches, of the scale of shades


class _Seen(NamedTuple):
    """What is seen in the cells."""

    points: FloatArray  # [states, 2]
    middles: FloatArray  # [cells, 2]
    visits: FloatArray  # [cells]
    shares: FloatArray  # [cells, actions and giving up] of the visits


@explained
def plot_grid_policy(
    policy: Policy | MixedPolicy,
    problem: Problem,
    cells: Places,
    moves: Places,
    *,
    walls: Iterable[Point] = (),
    most_visits: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw what a policy does in the cells that it visits, shaded by its expected visits.

    A cell with one action has one arrow. Where there are several, by a lottery, by chance or by
    what is remembered, the cell is marked by a ring, and each has an arrow from it, the longer
    the greater its share of the visits. An action without a direction is a dot; giving up is a
    cross. Walls, dead-ends and goals are drawn as far as they have a cell.

    Args:
        policy: any policy on the problem's model.
        problem: says the start.
        cells: the (x, y) of a state, the middle of a unit square; states at the same one are
            added up, and states without one (another memory, say) are left out.
        moves: the (dx, dy) that an action aims at.
        walls: middles of squares that are no states.
        most_visits: what the darkest shade stands for; None: the most in the picture.
        ax: where to draw; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no state has a cell; the policy may wander for ever; it is for another model.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> from formulations import MCMP
        >>> model = SSP.from_transitions({0: {"east": [(0.9, 1, 1.0), (0.1, 0, 1.0)]}}, goal={1})
        >>> policy = DeterministicPolicy.from_actions(model, {0: "east"})
        >>> problem = MCMP(model, 0, failure_budget=0.1)
        >>> axes = plot_grid_policy(policy, problem, lambda state: (state, 0), {"east": (1, 0)})
    """
    seen, walls = _seen_on_grid(policy, problem, cells), list(walls)
    width, height = size_of(seen.points, walls)
    ax = axes_or_new(ax, width + _SCALE, height)
    most = float(seen.visits.max(initial=0.0)) if most_visits is None else most_visits
    legend = draw_ground(ax, problem, seen.points, walls)
    _draw_scale([ax], _draw_visits(ax, seen, most))
    legend += _draw_decisions(ax, seen, points_of(problem.model.action_names, moves))
    add_legend(ax, legend)
    return ax


@explained
def plot_lottery(
    policy: MixedPolicy,
    problem: Problem,
    cells: Places,
    moves: Places,
    *,
    walls: Iterable[Point] = (),
) -> list[Axes]:
    """Draw the members of a lottery side by side in a new figure, on one scale of shades.

    Args:
        policy: a lottery; each picture's title says its member's share.
        problem: says the start.
        cells: as for :func:`plot_grid_policy`.
        moves: likewise.
        walls: likewise.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: as for :func:`plot_grid_policy`.
    """
    pyplot, count = optional_module("matplotlib.pyplot", "plot"), len(policy.policies)
    members, walls = (
        [_seen_on_grid(member, problem, cells) for member in policy.policies],
        list(walls),
    )
    width, height = size_of(members[0].points, walls)
    size = (count * width + _SCALE, height)
    axes = pyplot.subplots(1, count, figsize=size, squeeze=False, layout="constrained")[1][0]
    most = max(float(seen.visits.max(initial=0.0)) for seen in members)
    directions = points_of(problem.model.action_names, moves)
    for ax, seen, weight in zip(axes, members, policy.weights.tolist(), strict=True):
        legend = draw_ground(ax, problem, seen.points, walls)
        shades = _draw_visits(ax, seen, most)
        add_legend(ax, legend + _draw_decisions(ax, seen, directions))
        ax.set_title(f"with probability {weight:.4g}", fontsize=10)
    _draw_scale(list(axes), shades)
    return list(axes)


def _seen_on_grid(policy: Policy | MixedPolicy, problem: Problem, cells: Places) -> _Seen:
    """Add up visits and decisions by cell."""
    model, points = problem.model, cells_of(problem.model, cells)
    pairs, gave_up = pair_visits(as_lottery(policy), problem)
    known = ~np.isnan(points).any(axis=1)
    middles, inverse = np.unique(points[known], axis=0, return_inverse=True)
    cell = np.full(model.n_states, len(middles))  # the last: nowhere
    cell[known] = inverse.reshape(-1)
    flows = np.zeros((len(middles) + 1, len(model.action_names) + 1))
    np.add.at(flows, (cell[segment_ids(model.pair_offsets)], model.pair_action), pairs)
    np.add.at(flows[:, -1], cell, gave_up)
    visits = flows[:-1].sum(axis=1)
    visits[visits < _UNSEEN] = 0.0
    shares = np.divide(
        flows[:-1], visits[:, None], where=visits[:, None] > 0.0, out=flows[:-1] * 0.0
    )
    return _Seen(points, middles, visits, shares)


def _draw_visits(ax: Axes, seen: _Seen, most: float) -> Any:
    """Shade the cells by their visits; return what a scale of shades needs."""
    collections = optional_module("matplotlib.collections", "plot")
    colors = optional_module("matplotlib.colors", "plot")
    patches = optional_module("matplotlib.patches", "plot")
    some = seen.visits > 0.0
    corners = (seen.middles[some] - 0.5).tolist()
    shades = collections.PatchCollection(
        [patches.Rectangle(tuple(corner), 1.0, 1.0) for corner in corners],
        cmap=colors.LinearSegmentedColormap.from_list("visits", _SHADES),
        norm=colors.Normalize(0.0, max(most, _UNSEEN)),
        zorder=1,
    )
    shades.set_array(seen.visits[some])
    ax.add_collection(shades)
    return shades


def _draw_scale(axes: list[Axes], shades: Any) -> None:
    """Draw the scale of the grid's shades."""
    axes[0].figure.colorbar(shades, ax=axes, label="expected visits", shrink=0.7, pad=0.02)


def _draw_decisions(ax: Axes, seen: _Seen, directions: FloatArray) -> list[Any]:
    """Draw arrows, dots, crosses and rings; return entries of a legend."""
    lines = optional_module("matplotlib.lines", "plot")
    length = np.hypot(directions[:, 0], directions[:, 1])
    still = ~(length > 0.0)
    taken = seen.shares >= _RARE
    several = taken.sum(axis=1) > 1
    cell, action = np.nonzero(taken[:, :-1] & ~still)
    toward = directions[action] / length[action, None]
    share = np.where(several[cell], seen.shares[cell, action], 1.0)[:, None]
    reach = _LONGEST * (_SHORTEST + (1.0 - _SHORTEST) * share)
    begin = np.where(several[cell], _RING, -0.8 * _LONGEST)[:, None]
    tail, step = seen.middles[cell] + begin * toward, (reach - begin) * toward
    ax.quiver(*tail.T, *step.T, angles="xy", scale_units="xy", scale=1.0, units="xy", width=0.055,
              headwidth=4.5, headlength=4.5, headaxislength=4.0, color=INK, zorder=4)  # fmt: skip
    marks = (
        (taken[:, -1], "x", INK, "gives up"),
        (taken[:, :-1][:, still].any(axis=1), ".", INK, "stays"),
        (several, "o", "white", "by chance or memory"),
    )
    legend = []
    for where, marker, face, words in marks:
        style: dict[str, Any] = {"marker": marker, "markerfacecolor": face, "markeredgecolor": INK}
        if where.any():
            ax.plot(*seen.middles[where].T, linestyle="", markersize=4, zorder=5, **style)
            legend.append(lines.Line2D([], [], linestyle="", label=words, **style))
    return legend
