"""A gallery: everything that `ssp_lp.plotting` draws, on a warehouse and a channel.

The robot of `key_and_door.py` goes straight to the door and may fail in 5 % of the runs. Saves the
frontier of cost against failure (complete, and with few points), the members of the lottery, the
whole policy, simulated episodes, the distribution of the cost, and the bounds during the solution.
A boat may run aground in 5 % of the runs; its courses in the continuous world are saved as well.
These are the pictures of docs/gallery.md, which shows the lines that draw each.

    python examples/formulating/gallery.py --output docs/gallery
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from examples.formulating.key_and_door import DIRECTIONS, WALLS, found, place, warehouse
from ssp_lp import (
    MCMP,
    S3P,
    Axis,
    ContinuousModel,
    Distribution,
    Grid,
    Quadrature,
    WorldSimulator,
    discretise,
    simulate,
    solve,
    success_costs,
    trace_frontier,
)
from ssp_lp.plotting import (
    BoundsRecord,
    plot_bounds,
    plot_cost_law,
    plot_episodes,
    plot_grid_policy,
    plot_lottery,
    plot_paths,
)

BUDGET = 0.05
COLOURS = 256  # shades of a colour bar differ by at most 3 levels of 255, with 64 by up to 17
PLAIN = Image.Dither.NONE
SAND = "#e9dcc3"


def pictures() -> Iterator[tuple[str, Axes]]:
    """Yield each picture by its name, on the axes of its own figure."""
    model, start = warehouse(), found("S")
    problem = MCMP(model, start, failure_budget=BUDGET)
    solution = solve(problem)
    for name, points in (("frontier", None), ("frontier_cut_short", 4)):
        axes = trace_frontier(problem, point_limit=points).plot(BUDGET)
        axes.set(xlim=(-0.005, 0.25), ylim=(7.0, 16.0))  # beyond, failing at once is best
        yield name, axes
    yield "lottery", plot_lottery(solution.policy, problem, place, DIRECTIONS, walls=WALLS)[0]
    yield "policy", plot_grid_policy(solution.policy, problem, place, DIRECTIONS, walls=WALLS)
    yield "episodes", plot_episodes(solution.policy, problem, place, walls=WALLS, seed=1)
    given_success = S3P(model, start, failure_budget=BUDGET)
    law = success_costs(solve(given_success).policy, given_success)
    yield "cost_law", plot_cost_law(law, level=0.9)
    record = BoundsRecord()
    yield "bounds", plot_bounds(record, solve(given_success, progress=record))
    yield "paths", courses()


def courses() -> Axes:
    """Draw twenty courses of a boat in gusts, planned on cells and simulated in coordinates."""

    def sail(point, turn, noise):
        (x, y), (gust,) = point, noise
        x, y = x + 0.5, y + turn + gust
        end = np.where(abs(y) > 1.0, 2, np.where(x > 5.0, 1, 0))  # 0 goes on, 1 goal, 2 aground
        return (x, y), 1.0 + 5.0 * abs(turn), end

    sea = ContinuousModel(
        Grid([Axis(0.0, 5.0, cells=10), Axis(-1.0, 1.0, cells=40)]),
        actions=(-0.2, 0.0, 0.2),
        step=sail,
        noise=[Distribution.uniform(-0.3, 0.3)],
        dead_ends={"aground": 0.0},
    )
    start = sea.grid.cell_of((0.25, 0.0))
    channel = MCMP(discretise(sea, Quadrature(8)), start, failure_budget=BUDGET)
    boat = WorldSimulator(sea, start=(0.25, 0.0))
    report = simulate(
        solve(channel).policy, channel, episodes=20, seed=11, simulator=boat, record=20
    )
    ends = ["through" if path[-1, 0] > 5.0 else "aground" for path in report.paths]
    axes = plot_paths(report.paths, ends, order=["through", "aground"])
    for bank in ((1.0, 1.3), (-1.3, -1.0)):
        axes.axhspan(*bank, color=SAND, zorder=0)
    return axes


def main(arguments: Sequence[str] | None = None) -> None:
    """Save every picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("gallery"), help="folder")
    folder = parser.parse_args(arguments).output
    folder.mkdir(parents=True, exist_ok=True)
    for name, axes in pictures():
        save(axes, folder / f"{name}.png")
        print(f"{folder / name}.png")


def save(axes: Axes, path: Path) -> None:
    """Save a picture with a palette, to keep pages small."""
    drawn = BytesIO()
    axes.get_figure(root=True).savefig(drawn, dpi=150)
    Image.open(drawn).convert("RGB").quantize(COLOURS, dither=PLAIN).save(path, optimize=True)


if __name__ == "__main__":
    main()
