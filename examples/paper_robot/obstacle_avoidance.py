"""The paper's experiment: a robot that must reach a goal fast and may fail in 5 % of the runs.

Designs the paper's four policies, and the two that take the budget of 5 % exactly, for both costs
of a collision with the wall; runs each in the grid model and in the continuous world; prints the
paper's Tables 1 and 2 with ours beside them and saves the figures.

    python examples/paper_robot/obstacle_avoidance.py --output figures

Needs matplotlib (`pip install ssp-lp[plot]`). Takes about a minute.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from examples.paper_robot.figures import save_arena, save_frontier, save_trajectories
from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from examples.paper_robot.study import BUDGET, Trial, designs, try_out
from examples.paper_robot.tables import remarks, table_text
from formulations import MCMP, S3P
from ssp_lp import SSP, trace_frontier

WALL_COSTS = (1.0, 100.0)
POINTS = 16  # of a frontier
DRAWN = {
    "S max": "least failure, S",
    "M max": "least failure, M",
    "S mod": "failure budget 5 %, S, discount 0.999",
    "M mod": "failure budget 5 %, M, discount 0.999",
}
"""The designs of the paper's figures 2 to 5, in its order -> title."""


class Clock:
    """Prints progress lines with the seconds since the start."""

    def __init__(self) -> None:
        """Start the clock."""
        self._began = time.perf_counter()

    def say(self, words: str) -> None:
        """Print one progress line."""
        print(f"[{time.perf_counter() - self._began:6.1f} s] {words}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parse(arguments)
    clock = Clock()
    grid = RobotGrid(
        segments=options.segments,
        headings=options.headings,
        quadrature=options.quadrature,
        along_segment=options.along_segment,
    )
    trials: dict[float, list[Trial]] = {}
    for wall_cost in WALL_COSTS:
        priced = replace(grid, wall_cost=wall_cost)
        model = grid_model(priced)
        clock.say(f"{model}, wall cost {wall_cost:g}")
        trials[wall_cost] = _try_all(model, priced, options.episodes, options.seed, clock)
        if wall_cost == WALL_COSTS[0]:
            _save_figures(model, priced, trials[wall_cost], options.output, clock)
    tables = [table_text(cost, tried, options.episodes) for cost, tried in trials.items()]
    text = "\n\n".join([*tables, remarks(trials)])
    (options.output / "tables.txt").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}\n")
    clock.say(f"tables and figures are in {options.output}")


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100_000, help="episodes per policy")
    parser.add_argument("--quadrature", type=int, default=4, help="midpoints per dimension")
    parser.add_argument("--segments", type=int, default=20, help="cells along x, and along y")
    parser.add_argument("--headings", type=int, default=12, help="cells of the heading")
    parser.add_argument(
        "--along-segment",
        action="store_true",
        help="test collisions along the whole step, not at its end point only",
    )
    parser.add_argument("--output", type=Path, default=Path("robot_output"), help="folder")
    parser.add_argument("--seed", type=int, default=2024, help="seed of the simulations")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    return options


def _try_all(model: SSP, grid: RobotGrid, episodes: int, seed: int, clock: Clock) -> list[Trial]:
    trials = []
    for number, design in enumerate(designs(model, start_state(grid))):
        trial = try_out(design, grid, episodes, [seed, int(grid.wall_cost), number])
        trials.append(trial)
        clock.say(
            f"{design.name}: cost {trial.solution.objective:.4f}, "
            f"failure {trial.solution.failure_probability:.6f}, "
            f"solved in {trial.solution.seconds:.2f} s by {trial.solution.method}"
        )
    return trials


def _save_figures(
    model: SSP, grid: RobotGrid, trials: list[Trial], output: Path, clock: Clock
) -> None:
    save_arena(grid.arena, output / "arena.png")
    by_name = {trial.design.name: trial for trial in trials}
    for name, title in DRAWN.items():
        paths = by_name[name].trajectories
        file_name = f"trajectories_{name.replace(' ', '_').lower()}.png"
        save_trajectories(grid.arena, paths, f"{len(paths)} episodes: {title}", output / file_name)
    clock.say("trajectories drawn")
    start = start_state(grid)
    curves = {
        name: trace_frontier(criterion(model, start), point_limit=POINTS)
        for name, criterion in (("S", S3P), ("M", MCMP))
    }
    save_frontier(curves, BUDGET, "What a higher risk of failure buys", output / "frontier.png")
    clock.say("cost against failure drawn")


if __name__ == "__main__":
    main()
