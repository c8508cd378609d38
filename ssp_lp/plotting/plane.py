"""Plots in the plane: a policy's decisions by cell, and episodes as paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ssp_lp.analysis.evaluation import pair_visits
from ssp_lp.analysis.simulation import simulate
from ssp_lp.arrays import BoolArray, FloatArray, IntArray, segment_ids
from ssp_lp.errors import ModelError, check_whole, optional_module
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends, end_marks
from ssp_lp.plotting.curves import INK, LOOKS, axes_or_new, dress_axes
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy, Randomness, generator_of
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import start_distribution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Point = tuple[float, float]
"""(x, y), y upwards."""

Places = Mapping[Any, Point] | Callable[[Any], Point | None]
"""State or action -> point: a mapping, or a function that may return None."""


@explained
def row_major(rows: int, columns: int) -> Callable[[int], Point]:
    """Return a function from the number of a cell to its point in the plane.

    Cells are numbered from 0 row by row, beginning in the upper left corner.

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
    """Return the point of each state or action in the plane, nan for one without, [names, 2].

    Raises:
        ModelError: a value that is not a point.
    """
    look_up = places.get if isinstance(places, Mapping) else places
    points = []
    for name in names:
        point = look_up(name)
        if point is not None and np.shape(point) != (2,):
            raise ModelError(f"the point of {name!r} must be (x, y) or None, not {point!r}")
        points.append((np.nan, np.nan) if point is None else point)
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def cells_of(model: SSP, cells: Places) -> FloatArray:
    """Return the point of each state in the plane, [states, 2].

    Raises:
        ModelError: no state has a point, or a value is not a point.
    """
    points = points_of(model.states, cells)
    if np.isnan(points).all():
        raise ModelError(f"no state has a point: give points of states such as {model.states[0]!r}")
    return points


def with_point(points: FloatArray) -> BoolArray:
    """Return a mask of the states that have a point in the plane, [states]."""
    return np.asarray(~np.isnan(points).any(axis=1))


def distinct_points(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct points of states, called cells, and the cell of each state.

    Returns:
        The points, [cells, 2], and the index of each state's cell, -1 without a point, [states].
    """
    known, cell = with_point(points), np.full(len(points), -1)
    middles, inverse = np.unique(points[known], axis=0, return_inverse=True)
    cell[known] = inverse.reshape(-1)
    return middles, cell


def size_of(points: FloatArray, walls: Iterable[Point]) -> tuple[float, float]:
    """Return width and height, in inches, of a plot that shows these points and walls."""
    everything = np.vstack([points, np.array([*walls, (np.nan, np.nan)], dtype=np.float64)])
    extent = np.nanmax(everything, axis=0) - np.nanmin(everything, axis=0) + 2.0 * _MARGIN
    side = np.clip(6.0 / extent.max(), 0.25, 0.55)  # of a cell, so that a picture fits on a page
    width, height = (side * extent).tolist()
    return max(width, 3.2), height + 1.0  # an inch for the legend


def draw_ground(ax: Axes, problem: Problem, points: FloatArray, walls: Iterable[Point]) -> None:
    """Draw walls, dead-ends, goals and the start as unit squares, other cells as thin frames.

    Args:
        ax: axes to draw on.
        problem: problem with the model and the start.
        points: points of the model's states, nan for those without, [states, 2].
        walls: middles of unit squares that are walls, not states.
    """
    patches, kinds = (
        optional_module("matplotlib.patches", "plot"),
        squares_of(problem, points, walls),
    )
    for kind, squares in kinds.items():
        side, words = 0.9 if kind == "start" else 1.0, "" if kind == "free" else kind
        for x, y in squares:
            corner, style = (x - 0.5 * side, y - 0.5 * side), _STYLES[kind]
            ax.add_patch(patches.Rectangle(corner, side, side, zorder=2, label=words, **style))
            words = ""  # the legend has one entry for each kind
            if kind == "goal":
                ax.plot([x], [y], "*", color=style["edgecolor"], markersize=9, zorder=2.5)
    everything = np.array([square for squares in kinds.values() for square in squares])
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)


def squares_of(
    problem: Problem, points: FloatArray, walls: Iterable[Point]
) -> dict[str, list[Point]]:
    """Return the middles of the unit squares of each kind: free, dead-end, wall, goal and start.

    If several states lie in a square, it is a goal if one of them is, and a dead-end if all are.
    """
    model, goal = problem.model, problem.model.goal_mask
    dead, begin = dead_ends(model) & ~goal, start_distribution(model, problem.start) > 0.0
    free, lost, goals, start = (
        set(map(tuple, points[kind & with_point(points)].tolist()))
        for kind in (~dead & ~goal, dead, goal, begin)
    )
    kinds = free - goals, lost - free - goals, set(map(tuple, walls)), goals, start
    return {kind: sorted(cells) for kind, cells in zip(_STYLES, kinds, strict=True)}


_MARGIN = 0.55  # from the middle of a cell at the rim
_STYLES = {
    "free": {"facecolor": "none", "edgecolor": "#d0d0d0", "linewidth": 0.5},
    "dead-end": {"facecolor": "#f3d9c9", "edgecolor": "#D55E00", "hatch": "xxxx", "linewidth": 0.6},
    "wall": {"facecolor": "#595959", "edgecolor": "#595959", "linewidth": 0.0},
    "goal": {"facecolor": "#d5efe6", "edgecolor": "#009E73", "linewidth": 1.8},
    "start": {"facecolor": "none", "edgecolor": INK, "linewidth": 1.8},
}
"""Styles of the squares of each kind of cell."""


def add_legend(ax: Axes) -> None:
    """Put a legend below the plot and its ticks."""
    if count := len(ax.get_legend_handles_labels()[0]):
        width = ax.bbox.width / ax.figure.dpi  # inches
        rows = -(-count // max(int(width / 1.1), 2))  # an entry takes about 1.1 inches
        below = 0.12 if len(ax.get_xticks()) else 0.01  # of the height: room for ticks
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -below), ncols=-(-count // rows),
                  frameon=False, fontsize=8, labelcolor=INK, handlelength=1.6,
                  columnspacing=1.2)  # fmt: skip


_UNSEEN = 1e-6  # expected visits: a cell with fewer is drawn without
_LONGEST = 0.46  # of a cell's side, from its middle


class _Seen(NamedTuple):
    """Expected visits of each cell, and the shares of the decisions in each cell."""

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
    """Plot a policy's decisions in the plane, with cells shaded by their expected visits.

    A cell in which one action is taken has one arrow. If several actions are taken in a cell,
    because the policy has a memory or draws at random, the cell has a ring and an arrow for each
    action; the length of an arrow grows with the action's share of the visits. An action without a
    direction is a dot; giving up is a cross. Walls, dead-ends and goals are drawn if they have a
    cell.

    Args:
        policy: any policy on the problem's model.
        problem: problem with the start.
        cells: the point (x, y) of each state, the middle of a unit square. Visits of states at the
            same point, such as those with different memories, are added up; states without a point
            are omitted.
        moves: the direction (dx, dy) of each action.
        walls: middles of unit squares that are walls, not states.
        most_visits: expected visits of the darkest shade; None: the most in the plot.
        ax: axes to draw on; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no state has a cell, the policy may wander for ever, or it is for another model.

    Example:
        >>> from ssp_lp import MCMP, SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({0: {"east": [(0.9, 1, 1.0), (0.1, 0, 1.0)]}}, goal={1})
        >>> policy = DeterministicPolicy.from_actions(model, {0: "east"})
        >>> problem = MCMP(model, 0, failure_budget=0.1)
        >>> axes = plot_grid_policy(policy, problem, lambda state: (state, 0), {"east": (1, 0)})
    """
    return _plot_policies([policy], problem, cells, moves, [*walls], most_visits, ax)[0]


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
        policy: a lottery; the title of each plot is the probability of its member.
        problem: problem with the start.
        cells: as in :func:`plot_grid_policy`.
        moves: as in :func:`plot_grid_policy`.
        walls: as in :func:`plot_grid_policy`.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: as in :func:`plot_grid_policy`.
    """
    axes = _plot_policies(policy.policies, problem, cells, moves, [*walls])
    for ax, weight in zip(axes, policy.weights.tolist(), strict=True):
        ax.set_title(f"with probability {weight:.4g}", fontsize=10)
    return axes


def _plot_policies(
    policies: Sequence[Policy | MixedPolicy],
    problem: Problem,
    cells: Places,
    moves: Places,
    walls: list[Point],
    most: float | None = None,
    ax: Axes | None = None,
) -> list[Axes]:
    """Plot policies in the plane side by side; the arguments are as in :func:`plot_grid_policy`."""
    names = ("pyplot", "collections", "colors", "patches")
    pyplot, collections, colors, patches = (
        optional_module(f"matplotlib.{name}", "plot") for name in names
    )
    points, directions = (
        cells_of(problem.model, cells),
        points_of(problem.model.action_names, moves),
    )
    drawn = [_visits_of_cells(policy, problem, points) for policy in policies]
    if ax is None:
        width, height = size_of(points, walls)
        size = (len(drawn) * width + 1.0, height)  # an inch for the scale of shades
        figure = pyplot.figure(figsize=size, layout="constrained")
        axes = list(figure.subplots(1, len(drawn), squeeze=False)[0])
    else:
        axes = [axes_or_new(ax)]
    most = max(seen.visits.max(initial=0.0) for seen in drawn) if most is None else most
    for ax, seen in zip(axes, drawn, strict=True):
        draw_ground(ax, problem, points, walls)
        visited = seen.visits > 0.0
        corners = (seen.middles[visited] - 0.5).tolist()
        shades = collections.PatchCollection(
            [patches.Rectangle(tuple(corner), 1.0, 1.0) for corner in corners],
            cmap=colors.LinearSegmentedColormap.from_list("visits", ["white", "#6baed6"]),
            norm=colors.Normalize(0.0, max(most, _UNSEEN)),
            zorder=1,
        )
        shades.set_array(seen.visits[visited])
        ax.add_collection(shades)
        _draw_decisions(ax, seen, directions)
        add_legend(ax)
    axes[0].figure.colorbar(shades, ax=axes, label="expected visits", shrink=0.7, pad=0.02)
    return axes


def _visits_of_cells(policy: Policy | MixedPolicy, problem: Problem, points: FloatArray) -> _Seen:
    """Return the expected visits of each cell by a policy, and the decisions taken there.

    ``points`` has the point of each state, [states, 2].
    """
    model, (middles, cell) = problem.model, distinct_points(points)
    pairs, gave_up = pair_visits(policy, problem)
    # the last row, which -1 stands for, collects the states without a point
    flows = np.zeros((len(middles) + 1, len(model.action_names) + 1))
    np.add.at(flows, (cell[segment_ids(model.pair_offsets)], model.pair_action), pairs)
    np.add.at(flows[:, -1], cell, gave_up)
    visits = flows[:-1].sum(axis=1)
    visits[visits < _UNSEEN] = 0.0
    shares = np.divide(
        flows[:-1], visits[:, None], where=visits[:, None] > 0.0, out=flows[:-1] * 0.0
    )
    return _Seen(middles, visits, shares)


def _draw_decisions(ax: Axes, seen: _Seen, directions: FloatArray) -> None:
    """Draw decisions in the plane: arrows, dots, crosses and rings."""
    length = np.hypot(directions[:, 0], directions[:, 1])
    still = ~(length > 0.0)
    taken = seen.shares >= 0.02  # rarer actions have no arrow
    several = taken.sum(axis=1) > 1
    cell, action = np.nonzero(taken[:, :-1] & ~still)
    toward = directions[action] / length[action, None]
    share = np.where(several[cell], seen.shares[cell, action], 1.0)[:, None]
    reach = _LONGEST * (0.75 + 0.25 * share)
    # arrows of several actions begin at the ring around their cell's middle
    begin = np.where(several[cell], 0.08, -0.8 * _LONGEST)[:, None]
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
    """Plot paths in the plane, in a style for each kind of end.

    The first kind of end is drawn palely and beneath the others, so that the exceptions stand out.

    Args:
        paths: an array [points, 2 or more] each; the first two columns are x and y.
        ends: end of each path, in the words of the legend, [paths].
        order: ends that come first, in this order, so that they have equal styles in several plots;
            the other ends follow by their number of paths.
        ax: axes to draw on; None: a new figure.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: a path is no such array, or has no end.
    """
    drawn = [np.asarray(path, dtype=np.float64) for path in paths]
    if len(drawn) != len(ends):
        raise ModelError(f"{len(drawn)} paths need {len(drawn)} ends, not {len(ends)}")
    if not all(path.size == 0 or (path.ndim == 2 and path.shape[1] >= 2) for path in drawn):
        raise ModelError("a path must be an array [points, coordinates], 2 coordinates or more")
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
        cells: the point (x, y) of each state, the middle of a unit square.
        episodes: number of episodes.
        seed: a number or a generator, for the episodes and the offsets.
        walls: middles of unit squares that are walls, not states.
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
    words = ["reach the goal", *fails, "give up or go on"]  # in the order of marks, then -1
    ends = [words[marks[path[-1]]] for path in played]
    placed = with_point(points)
    paths = [points[p[placed[p]]] + shift for p, shift in zip(played, aside, strict=True)]
    draw_ground(ax, problem, points, walls)
    return plot_paths(paths, ends, order=words, ax=ax)
