"""Where the states of a model lie in the plane, and the ground that policies and paths cross."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError, check_whole, optional_module
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.plotting.style import INK
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import start_distribution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Point = tuple[float, float]
"""(x, y), y upwards."""

Places = Mapping[Any, Point] | Callable[[Any], Point | None]
"""State or action -> a point, or none: a mapping without the key, or a function that says None."""


def row_major(rows: int, columns: int) -> Callable[[int], Point]:
    """The middles of cells that are numbered row by row from the upper left corner, from 0.

    Args:
        rows: how many there are.
        columns: likewise.

    Raises:
        ModelError: one of them is no whole number >= 1.

    Example:
        >>> place = row_major(4, 4)  # FrozenLake-v1
        >>> place(0), place(7), place(15)
        ((0, 3), (3, 2), (3, 0))
    """
    check_whole("rows", rows)
    check_whole("columns", columns)

    @explained
    def place(number: int) -> Point:
        """Where the cell of a number lies."""
        row, column = divmod(number, columns)
        return column, rows - 1 - row

    return place


def points_of(names: Iterable[Hashable], places: Places) -> FloatArray:
    """The points in the picture's cells of states or actions; nan where there is none, [names, 2].

    Raises:
        ModelError: what is given for one is no point.
    """
    look_up = places.get if isinstance(places, Mapping) else places
    found = []
    for name in names:
        point = look_up(name)
        if point is not None and np.shape(point) != (2,):
            raise ModelError(f"{name!r} must lie at a point (x, y) or nowhere, not at {point!r}")
        found.append((np.nan, np.nan) if point is None else point)
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def cells_of(model: SSP, cells: Places) -> FloatArray:
    """The point of each state, [states, 2].

    Raises:
        ModelError: no state has a point, or what is given for one is no point.
    """
    found = points_of(model.states, cells)
    if np.isnan(found).all():
        raise ModelError(f"no state has a point: they are such as {model.states[0]!r}")
    return found


def size_of(points: FloatArray, walls: Iterable[Point]) -> tuple[float, float]:
    """Width and height in inches of a picture of these cells."""
    everything = np.vstack([points, np.array([*walls, (np.nan, np.nan)], dtype=np.float64)])
    extent = np.nanmax(everything, axis=0) - np.nanmin(everything, axis=0) + 2.0 * _MARGIN
    side = np.clip(_WIDEST / extent.max(), *_SIDES)
    width, height = (side * extent).tolist()
    return max(width, _NARROWEST), height + _LEGEND


_WIDEST, _NARROWEST, _LEGEND = 6.0, 3.2, 1.0  # inches: a picture's sides, what a legend takes
_SIDES = 0.25, 0.55  # inches: of a cell, least and most


def draw_ground(
    ax: Axes, problem: Problem, points: FloatArray, walls: Iterable[Point]
) -> list[Any]:
    """Draw walls, dead-ends, goals and the start as unit squares, and a frame around other cells.

    Where several states lie in a cell, it is a goal if one of them is, and a dead-end if all are.

    Args:
        ax: where to draw.
        problem: says the model and the start.
        points: of the model's states, nan where there is none, [states, 2].
        walls: middles of squares that are no states.

    Returns:
        Entries of a legend.
    """
    patches, model = optional_module("matplotlib.patches", "plot"), problem.model
    dead, goal = dead_ends(model) & ~model.goal_mask, model.goal_mask
    goals, free = _distinct_cells(points[goal]), _distinct_cells(points[~dead & ~goal])
    kinds = (
        (free - goals, "", _FREE),
        (_distinct_cells(points[dead]) - free - goals, "dead-end", _DEAD_END),
        (set(walls), "wall", _WALL),
        (goals, "goal", _GOAL),
        (_distinct_cells(points[start_distribution(model, problem.start) > 0.0]), "start", _START),
    )
    legend = []
    for squares, words, style in kinds:
        side = _INNER if style is _START else 1.0
        for x, y in sorted(squares):
            corner = x - 0.5 * side, y - 0.5 * side
            ax.add_patch(patches.Rectangle(corner, side, side, zorder=2, **style))
        if words and squares:
            legend.append(patches.Patch(label=words, **style))
    for x, y in goals:
        ax.plot([x], [y], "*", color=_GOAL["edgecolor"], markersize=9, zorder=2.5)
    everything = np.array([square for squares, _, _ in kinds for square in squares])
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    return legend


def _distinct_cells(points: FloatArray) -> set[Point]:
    """The points of cells that are somewhere, each once."""
    return {(x, y) for x, y in points[~np.isnan(points).any(axis=1)].tolist()}


_INNER = 0.9  # side of the square that marks the start
_MARGIN = 0.55  # from the middle of a cell at the rim
_FREE = {"facecolor": "none", "edgecolor": "#d0d0d0", "linewidth": 0.5}
_DEAD_END = {"facecolor": "#f3d9c9", "edgecolor": "#D55E00", "hatch": "xxxx", "linewidth": 0.6}
_WALL = {"facecolor": "#595959", "edgecolor": "#595959", "linewidth": 0.0}
_GOAL = {"facecolor": "#d5efe6", "edgecolor": "#009E73", "linewidth": 1.8}
_START = {"facecolor": "none", "edgecolor": INK, "linewidth": 1.8}


_ENTRY = 1.1  # inches: width of an entry of a legend
_BELOW_TICKS = 0.12  # of the height: room for ticks and their label


def add_legend(ax: Axes, legend: list[Any]) -> None:
    """Put a legend below the picture of cells and its ticks, where it hides nothing."""
    if legend:
        figure = ax.get_figure(root=True)
        width = 0.0 if figure is None else ax.get_position().width * figure.get_figwidth()
        rows = -(-len(legend) // max(int(width / _ENTRY), 2))
        below = _BELOW_TICKS if len(ax.get_xticks()) else 0.01
        ax.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -below),
                  ncols=-(-len(legend) // rows), frameon=False, fontsize=8, labelcolor=INK,
                  handlelength=1.6, columnspacing=1.2)  # fmt: skip
