"""A gallery: everything that `ssp_lp.plotting` draws, on one warehouse.

The robot of `key_and_door.py` goes straight to the door and may fail in 5 % of the runs. Saves
the frontier of cost against failure (traced to the end, and cut short), the members of its lottery,
what it does in all, simulated episodes, the bounds while it was solved, and the law of its cost.

    python examples/formulating/gallery.py --output gallery
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from examples.formulating.key_and_door import DIRECTIONS, WALLS, found, place, warehouse
from formulations import MCMP, S3P
from ssp_lp import solve, success_costs, trace_frontier
from ssp_lp.plotting import (
    BoundsRecord,
    plot_bounds,
    plot_cost_law,
    plot_episodes,
    plot_grid_policy,
    plot_lottery,
)

BUDGET = 0.05


def pictures() -> Iterator[tuple[str, Axes]]:
    """Each picture by its name; the axes are in a figure of their own."""
    model, start = warehouse(), found("S")
    problem = MCMP(model, start, failure_budget=BUDGET)
    solution = solve(problem)
    for name, points in (("frontier", None), ("frontier_cut_short", 4)):
        axes = trace_frontier(problem, point_limit=points).plot(BUDGET)
        axes.set(xlim=(-0.005, 0.25), ylim=(7.0, 16.0))  # beyond, failing at once is best
        yield name, axes
    yield "lottery", plot_lottery(solution.policy, problem, place, DIRECTIONS, walls=WALLS)[0]
    yield "policy", plot_grid_policy(solution.policy, problem, place, DIRECTIONS, walls=WALLS)
    yield "episodes", plot_episodes(solution.policy, problem, place, walls=WALLS, rng=1)
    record = BoundsRecord()
    ratio = solve(S3P(model, start, failure_budget=BUDGET), progress=record)
    yield "bounds", plot_bounds(record, ratio)
    yield "cost_law", plot_cost_law(success_costs(ratio.policy, ratio.problem), level=0.9)


def main(arguments: Sequence[str] | None = None) -> None:
    """Save every picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("gallery"), help="folder")
    folder = parser.parse_args(arguments).output
    folder.mkdir(parents=True, exist_ok=True)
    for name, axes in pictures():
        axes.get_figure(root=True).savefig(folder / f"{name}.png", dpi=150)
        print(f"{folder / name}.png")


if __name__ == "__main__":
    main()
