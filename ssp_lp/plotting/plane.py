"""Plots in the plane: a policy's decisions by cell, and episodes as paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ssp_lp.analysis.evaluation import pair_visits
from ssp_lp.analysis.simulation import simulate
from ssp_lp.arrays import FloatArray, segment_ids
from ssp_lp.errors import ModelError, check_whole, optional_module
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends, end_marks
from ssp_lp.plotting.curves import INK, LOOKS, axes_or_new, dress_axes
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy, Randomness, as_lottery, generator_of
from ssp_lp.problem import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Point = tuple[float, float]
"""(x, y), y upwards."""

Places = Mapping[Any, Point] | Callable[[Any], Point | None]
"""State or action -> point: a mapping, or a function that may return None."""


@explained
def row_major(rows: int, columns: int) -> Callable[[int], Point]:
    """Return the map to the plane of cells numbered row by row from the upper left corner, from 0.

    Args:
        rows: number of rows.
        columns: number of columns.

    Raises:
        ModelError: a number that is not a whole number >= 1.

    Example:
        >>> place = row_major(4, 4)  # FrozenLake-v1
        >>> place(0), place(7), place(15)
        ((0, 3), (3, 2), (3, 0))
    """
    check_whole("rows", rows)
    check_whole("columns", columns)

    @explained
    def place(number: int) -> Point:
        """Return the position of the cell with a number."""
        row, column = divmod(number, columns)
        return column, rows - 1 - row

    return place


def points_of(names: Iterable[Hashable], places: Places) -> FloatArray:
    """Return the points of states or actions in the plane; nan for those without, [names, 2].

    Raises:
        ModelError: a value that is not a point.
    """
    look_up = places.get if isinstance(places, Mapping) else places
    points = []
    for name in names:
        point = look_up(name)
        if point is not None and np.shape(point) != (2,):
            raise ModelError(f"{name!r} must lie at a point (x, y) or nowhere, not at {point!r}")
        points.append((np.nan, np.nan) if point is None else point)
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def cells_of(model: SSP, cells: Places) -> FloatArray:
    """Return the point of each state in the plane, [states, 2].

    Raises:
        ModelError: no state has a point, or a value is not a point.
    """
    points = points_of(model.states, cells)
    if np.isnan(points).all():
        raise ModelError(f"no state has a point: a state is, for instance, {model.states[0]!r}")
    return points


def size_of(points: FloatArray, walls: Iterable[Point]) -> tuple[float, float]:
    """Return the width and height in inches of a plane picture of these cells."""
    everything = np.vstack([points, np.array([*walls, (np.nan, np.nan)], dtype=np.float64)])
    extent = np.nanmax(everything, axis=0) - np.nanmin(everything, axis=0) + 2.0 * _MARGIN
    side = np.clip(_WIDEST / extent.max(), *_SIDES)
    width, height = (side * extent).tolist()
    return max(width, _NARROWEST), height + _LEGEND


_WIDEST, _NARROWEST, _LEGEND = 6.0, 3.2, 1.0  # inches: sides of a picture, size of a legend
_SIDES = 0.25, 0.55  # inches: of a cell, least and most


def draw_ground(ax: Axes, problem: Problem, points: FloatArray, walls: Iterable[Point]) -> None:
    """Draw walls, dead-ends, goals and the start as unit squares, and a frame around other cells.

    Args:
        ax: axes to draw on.
        problem: problem with the model and the start.
        points: points of the model's states, nan for those without, [states, 2].
        walls: middles of squares that are no states.
    """
    patches = optional_module("matplotlib.patches", "plot")
    free, dead, goals, begin = squares_of(problem, points)
    kinds = (
        (free, "", _FREE),
        (dead, "dead-end", _DEAD_END),
        (set(walls), "wall", _WALL),
        (goals, "goal", _GOAL),
        (begin, "start", _START),
    )
    for squares, words, style in kinds:
        side = _INNER if style is _START else 1.0
        for x, y in sorted(squares):
            corner = x - 0.5 * side, y - 0.5 * side
            ax.add_patch(patches.Rectangle(corner, side, side, zorder=2, label=words, **style))
            words = ""  # one of them is in the legend
    for x, y in goals:
        ax.plot([x], [y], "*", color=_GOAL["edgecolor"], markersize=9, zorder=2.5)
    everything = np.array([square for squares, _, _ in kinds for square in squares])
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)


def squares_of(
    problem: Problem, points: FloatArray
) -> tuple[set[Point], set[Point], set[Point], set[Point]]:
    """Return the middles of free cells, dead-ends, goals, and of cells where episodes may begin.

    If several states lie in a cell, it is a goal if one of them is, and a dead-end if all are.
    """
    model, goal = problem.model, problem.model.goal_mask
    dead, begin = dead_ends(model) & ~goal, problem.start_mass > 0.0
    goals, free = _distinct_cells(points[goal]), _distinct_cells(points[~dead & ~goal])
    lost = _distinct_cells(points[dead]) - free - goals
    return free - goals, lost, goals, _distinct_cells(points[begin])


def _distinct_cells(points: FloatArray) -> set[Point]:
    """Return the distinct points of cells in the plane."""
    return {(x, y) for x, y in points[~np.isnan(points).any(axis=1)].tolist()}


_INNER = 0.9  # side of the square of the start
_MARGIN = 0.55  # from the middle of a cell at the rim
_FREE = {"facecolor": "none", "edgecolor": "#d0d0d0", "linewidth": 0.5}
_DEAD_END = {"facecolor": "#f3d9c9", "edgecolor": "#D55E00", "hatch": "xxxx", "linewidth": 0.6}
_WALL = {"facecolor": "#595959", "edgecolor": "#595959", "linewidth": 0.0}
_GOAL = {"facecolor": "#d5efe6", "edgecolor": "#009E73", "linewidth": 1.8}
_START = {"facecolor": "none", "edgecolor": INK, "linewidth": 1.8}


_ENTRY = 1.1  # inches: width of an entry of a legend
_BELOW_TICKS = 0.12  # of the height: room for ticks and their label


def add_legend(ax: Axes) -> None:
    """Put a legend below the plot and its ticks."""
    if count := len(ax.get_legend_handles_labels()[0]):
        figure = ax.get_figure(root=True)
        width = 0.0 if figure is None else ax.get_position().width * figure.get_figwidth()
        rows = -(-count // max(int(width / _ENTRY), 2))
        below = _BELOW_TICKS if len(ax.get_xticks()) else 0.01
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -below), ncols=-(-count // rows),
                  frameon=False, fontsize=8, labelcolor=INK, handlelength=1.6,
                  columnspacing=1.2)  # fmt: skip


_SHADES = ("#ffffff", "#6baed6")  # light enough for dark arrows
_RARE = 0.02  # of a cell's visits: rarer actions have no arrow
_UNSEEN = 1e-6  # expected visits: a cell with fewer is drawn without
_LONGEST = 0.46  # of a cell's side, from its middle
_SHORTEST = 0.75  # of the longest: an arrow for a small share
_RING = 0.08  # radius of the mark of several actions
_SCALE = 1.0  # inches, of the scale of shades


class _Seen(NamedTuple):
    """Visits and decisions by cell."""

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
    """Plot a policy's decisions in the plane, cells shaded by expected visits.

    A cell with one action has one arrow. If there are several, by a lottery, by chance or by
    memory, the cell is marked by a ring, and each has an arrow from it, whose length grows with its
    share of the visits. An action without a direction is a dot; giving up is a cross. Walls,
    dead-ends and goals are drawn if they have a cell.

    Args:
        policy: any policy on the problem's model.
        problem: problem with the start.
        cells: the (x, y) of a state, the middle of a unit square; states at the same point are
            added up (such as those with different memories), and states without a point are
            omitted.
        moves: the (dx, dy) of an action.
        walls: middles of squares that are no states.
        most_visits: visits of the darkest shade; None: the most in the plot.
        ax: axes to draw on; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no state has a cell; the policy may wander for ever; it is for another model.

    Example:
        >>> from ssp_lp import MCMP, SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({0: {"east": [(0.9, 1, 1.0), (0.1, 0, 1.0)]}}, goal={1})
        >>> policy = DeterministicPolicy.from_actions(model, {0: "east"})
        >>> problem = MCMP(model, 0, failure_budget=0.1)
        >>> axes = plot_grid_policy(policy, problem, lambda state: (state, 0), {"east": (1, 0)})
    """
    seen, walls = _visits_on_grid(policy, problem, cells), list(walls)
    width, height = size_of(seen.points, walls)
    ax = axes_or_new(ax, width + _SCALE, height)
    most = float(seen.visits.max(initial=0.0)) if most_visits is None else most_visits
    _draw_scale([ax], _draw_visited_cells(ax, problem, seen, walls, moves, most))
    return ax


def _draw_visited_cells(
    ax: Axes, problem: Problem, seen: _Seen, walls: list[Point], moves: Places, most: float
) -> Any:
    """Draw a policy's cells in the plane with a legend; return the data of a scale of shades."""
    draw_ground(ax, problem, seen.points, walls)
    names = ("collections", "colors", "patches")
    collections, colors, patches = (optional_module(f"matplotlib.{name}", "plot") for name in names)
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
    _draw_decisions(ax, seen, points_of(problem.model.action_names, moves))
    add_legend(ax)
    return shades


@explained
def plot_lottery(
    policy: MixedPolicy,
    problem: Problem,
    cells: Places,
    moves: Places,
    *,
    walls: Iterable[Point] = (),
) -> list[Axes]:
    """Plot the members of a lottery in the plane side by side, on one scale of shades.

    Args:
        policy: a lottery; each plot's title has its member's share.
        problem: problem with the start.
        cells: as in :func:`plot_grid_policy`.
        moves: as in :func:`plot_grid_policy`.
        walls: as in :func:`plot_grid_policy`.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: as in :func:`plot_grid_policy`.
    """
    pyplot, count = optional_module("matplotlib.pyplot", "plot"), len(policy.policies)
    members, walls = [_visits_on_grid(one, problem, cells) for one in policy.policies], list(walls)
    width, height = size_of(members[0].points, walls)
    size = (count * width + _SCALE, height)
    axes = pyplot.subplots(1, count, figsize=size, squeeze=False, layout="constrained")[1][0]
    most = max(float(seen.visits.max(initial=0.0)) for seen in members)
    for ax, seen, weight in zip(axes, members, policy.weights.tolist(), strict=True):
        shades = _draw_visited_cells(ax, problem, seen, walls, moves, most)
        ax.set_title(f"with probability {weight:.4g}", fontsize=10)
    _draw_scale(list(axes), shades)
    return list(axes)


def _visits_on_grid(policy: Policy | MixedPolicy, problem: Problem, cells: Places) -> _Seen:
    """Return the visits and decisions of a policy in the plane, by cell."""
    model, points = problem.model, cells_of(problem.model, cells)
    pairs, gave_up = pair_visits(as_lottery(policy), problem)
    placed = ~np.isnan(points).any(axis=1)
    middles, inverse = np.unique(points[placed], axis=0, return_inverse=True)
    cell = np.full(model.n_states, len(middles))  # the last: nowhere
    cell[placed] = inverse.reshape(-1)
    flows = np.zeros((len(middles) + 1, len(model.action_names) + 1))
    np.add.at(flows, (cell[segment_ids(model.pair_offsets)], model.pair_action), pairs)
    np.add.at(flows[:, -1], cell, gave_up)
    visits = flows[:-1].sum(axis=1)
    visits[visits < _UNSEEN] = 0.0
    shares = np.divide(
        flows[:-1], visits[:, None], where=visits[:, None] > 0.0, out=flows[:-1] * 0.0
    )
    return _Seen(points, middles, visits, shares)


def _draw_scale(axes: list[Axes], shades: Any) -> None:
    """Draw the scale of the plane's shades."""
    axes[0].figure.colorbar(shades, ax=axes, label="expected visits", shrink=0.7, pad=0.02)


def _draw_decisions(ax: Axes, seen: _Seen, directions: FloatArray) -> None:
    """Draw decisions in the plane: arrows, dots, crosses and rings."""
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
    for where, marker, face, words in marks:
        if where.any():
            ax.plot(*seen.middles[where].T, marker, markersize=4, zorder=5, markerfacecolor=face,
                    markeredgecolor=INK, label=words)  # fmt: skip


_SPREAD = 0.3  # of a cell's side: greatest offset of a path from its middle


@explained
def plot_paths(
    paths: Sequence[Any], ends: Sequence[str], *, order: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """Plot paths in the plane; each end of a path has its colour, line and marker.

    The first kind of end is drawn palely and beneath the others, so that the exceptions stand out.

    Args:
        paths: an array [points, 2 or more] each; the first two columns are x and y.
        ends: end of each path, as words for the legend, [paths].
        order: the ends in an order, so that they look the same in several plots; others follow by
            their number of paths.
        ax: axes to draw on; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: a path is no such array, or has no end.
    """
    drawn = [np.asarray(path, dtype=np.float64) for path in paths]
    if len(drawn) != len(ends):
        raise ModelError(f"{len(drawn)} paths need as many ends, not {len(ends)}")
    if not all(path.size == 0 or (path.ndim == 2 and path.shape[1] >= 2) for path in drawn):
        raise ModelError("a path must be an array [points, 2 or more]")
    is_new, ax = ax is None, axes_or_new(ax, 5.6, 5.6)
    if is_new:
        dress_axes(ax, "x", "y")
    counts = Counter(ends)
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
            ax.plot([], [], marker=look.marker, label=f"{counts[end]} {end}", **style)
    add_legend(ax)
    return ax


@explained
def plot_episodes(
    policy: Policy | MixedPolicy,
    problem: Problem,
    cells: Places,
    *,
    episodes: int = 50,
    seed: Randomness = 0,
    walls: Iterable[Point] = (),
    ax: Axes | None = None,
) -> Axes:
    """Plot simulated episodes in the plane over walls, dead-ends and goals.

    Each path has a small offset from the middles of the cells, so that none hides the others.
    States without a cell are left out of a path.

    Args:
        policy: any policy on the problem's model.
        problem: problem with the start.
        cells: the (x, y) of a state, the middle of a unit square.
        episodes: number of episodes.
        seed: a number or a generator, for the episodes and the offsets.
        walls: middles of squares that are no states.
        ax: axes to draw on; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no state has a cell, or the policy is for another model.
    """
    model, source, walls = problem.model, generator_of(seed), list(walls)
    points, marks = cells_of(model, cells), end_marks(model)
    ax = axes_or_new(ax, *size_of(points, walls))
    played = simulate(policy, problem, episodes=episodes, seed=source, record=episodes).paths
    aside = source.uniform(-_SPREAD, _SPREAD, (episodes, 2))
    fails = (f"fail: {name}" for name in (*model.state_labels, "dead-end"))
    words = ["reach the goal", *fails]
    ends = [words[m] if (m := marks[int(p[-1])]) >= 0 else "give up or go on" for p in played]
    placed = np.asarray(~np.isnan(points).any(axis=1))  # states without a point are left out
    paths = [points[p[placed[p]]] + shift for p, shift in zip(played, aside, strict=True)]
    draw_ground(ax, problem, points, walls)
    return plot_paths(paths, ends, order=words, ax=ax)
