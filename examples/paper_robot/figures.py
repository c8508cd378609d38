"""Pictures of the robot example: the arena, trajectories, and cost against failure."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from examples.paper_robot.arena import FloatArray
from examples.paper_robot.grid import START_BOX
from examples.paper_robot.robot import Arena, Box, Place
from ssp_lp import Frontier
from ssp_lp.plotting import plot_frontier, plot_paths

INK = "#333333"
ENDS = {
    Place.GOAL: "reached the goal",
    Place.OBSTACLE: "hit obstacle A or B",
    Place.WALL: "hit the wall",
    Place.FREE: "failed otherwise",
}
"""End of an episode -> words."""

CRITERIA = {
    "S": "S: expected cost given success",
    "M": "M: expected cost until the goal or failure",
}

_NUDGE = 1e-6  # distance (in steps) beyond a path's last point at which the place is tested


def save_arena(arena: Arena, path: Path) -> None:
    """Draw the arena with its start and goal (the paper's figure 1)."""
    figure, axes = _arena_axes(arena)
    middle = sum(START_BOX) / 2
    axes.arrow(middle, middle, 0.1, 0.0, width=0.004, color=INK, length_includes_head=True)
    axes.text(0.24, middle, "one step, 0.1", va="center", color=INK)
    _save(figure, path)


def save_trajectories(arena: Arena, paths: list[FloatArray], title: str, path: Path) -> None:
    """Draw episodes of the continuous world, coloured by their ends: paths [steps + 1, 3]."""
    figure, axes = _arena_axes(arena)
    ends = [ENDS[_end_of(arena, trajectory)] for trajectory in paths]
    plot_paths(paths, ends, order=list(ENDS.values()), ax=axes)
    axes.set_title(title, loc="left", fontsize=11)
    _save(figure, path)


def save_frontier(curves: dict[str, Frontier], budget: float, title: str, path: Path) -> None:
    """Draw the least cost against the failure budget: one curve per criterion, "S" and "M"."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    for look, (name, frontier) in enumerate(curves.items()):
        plot_frontier(frontier, budget, label=CRITERIA[name], look=look, ax=axes)
    axes.set(xlim=(0.0, 3 * budget), ylim=(11.0, 20.0), ylabel="least expected cost (steps)")
    axes.set_title(title, loc="left", fontsize=11)
    axes.legend(loc="upper right", frameon=False)
    _save(figure, path)


def _arena_axes(arena: Arena) -> tuple[Figure, Axes]:
    """Return axes with the arena drawn in them."""
    figure = Figure(figsize=(5.6, 6.0), layout="constrained")
    axes = figure.subplots()
    for name, box in zip("ABCDEFGH", arena.obstacles, strict=False):
        _draw_box(axes, box, name, face="#bdbdbd", edge="#555555")
    _draw_box(axes, arena.goal, "", face="#cfe8dc", edge="#009E73")
    _write(axes, (arena.goal.left + arena.goal.right) / 2, arena.goal.top + 0.025, "goal")
    low, high = START_BOX
    _draw_box(axes, Box(low, high, low, high), "", face="#f6e7b8", edge=INK)
    _write(axes, (low + high) / 2, low - 0.035, "start")
    axes.add_patch(Rectangle((0, 0), arena.side, arena.side, fill=False, edgecolor=INK, lw=2.0))
    margin = 0.11 * arena.side  # a step may end 0.1 beyond the wall
    axes.set(xlim=(-margin, arena.side + margin), ylim=(-margin, arena.side + margin))
    axes.set(xlabel="x", ylabel="y", aspect="equal")
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    return figure, axes


def _draw_box(axes: Axes, box: Box, name: str, *, face: str, edge: str) -> None:
    width, height = box.right - box.left, box.top - box.bottom
    axes.add_patch(
        Rectangle((box.left, box.bottom), width, height, facecolor=face, edgecolor=edge, lw=1.0)
    )
    _write(axes, box.left + width / 2, box.bottom + height / 2, name)


def _write(axes: Axes, x: float, y: float, words: str) -> None:
    """Write over whatever is drawn, with a pale rim that keeps it legible."""
    rim = withStroke(linewidth=3, foreground="white")
    axes.text(x, y, words, ha="center", va="center", color=INK, zorder=6, path_effects=[rim])


def _end_of(arena: Arena, trajectory: FloatArray) -> Place:
    """Return the place that a path ran into, just beyond its last point."""
    if len(trajectory) < 2:
        return Place.FREE
    last = trajectory[-1, :2]
    beyond = last + _NUDGE * (last - trajectory[-2, :2])
    return Place(int(arena.classify(np.array([beyond[0]]), np.array([beyond[1]]))[0]))


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=160, bbox_inches="tight")
