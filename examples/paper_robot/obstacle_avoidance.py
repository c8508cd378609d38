"""The paper's experiment: a robot that must reach a goal fast and may fail in 5 % of the runs.

The paper does not say how transition probabilities are computed and collisions detected. For two
readings of it, and for both costs of a collision with the wall, the script designs the paper's four
policies and further ones; runs each in the grid model and in the continuous world; prints the
paper's Tables 1 and 2 with ours below them; and draws runs of the first reading.

    python examples/paper_robot/obstacle_avoidance.py --output figures

Needs matplotlib (`pip install '.[plot]'`). Takes about a minute.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from examples.paper_robot.figures import save_arena, save_frontier, save_trajectories
from examples.paper_robot.grid import RobotGrid
from examples.paper_robot.robot import grid_model, start_state
from examples.paper_robot.study import (
    BUDGET,
    COMPARED,
    IN_BETWEEN,
    READINGS,
    Reading,
    Trial,
    run_in_world,
    try_out,
)
from examples.paper_robot.tables import comparison_text, remarks, table_text
from ssp_lp import MCMP, S3P, trace_frontier

WALL_COSTS = (1.0, 100.0)
POINTS = 16  # of a frontier
DRAWN = {
    "S max": "at the least failure probability:\nleast expected cost given success",
    "M max": "at the least failure probability:\nleast expected cost until the goal or failure",
    "S mod": "at a failure budget of 5 %:\nleast expected cost given success",
    "M mod": "at a failure budget of 5 %:\nleast expected cost until the goal or failure",
}
"""The designs of the paper's figures 2 to 5, in its order -> what is drawn."""


class Clock:
    """Printer of progress lines with the seconds since the start."""

    def __init__(self) -> None:
        """Start the clock."""
        self._began = time.perf_counter()

    def say(self, words: str) -> None:
        """Print one progress line."""
        print(f"[{time.perf_counter() - self._began:6.1f} s] {words}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options, clock = _parse(arguments), Clock()
    trials = {
        wall_cost: {
            reading.name: _try_all(reading, wall_cost, options, clock)
            for reading in (*READINGS, IN_BETWEEN)
        }
        for wall_cost in WALL_COSTS
    }
    cheap, dear = trials.values()
    touching = {
        reading.name: run_in_world(
            (trial := cheap[reading.name][COMPARED]).ready,
            trial.problem,
            replace(_grid_of(reading, options), points_on_the_way=None),
            options.episodes,
            np.random.default_rng([options.seed, 2]),
        )
        for reading in (*READINGS, IN_BETWEEN)
    }
    clock.say("runs in which any touch is a collision")
    _save_figures(cheap[READINGS[0].name], _grid_of(READINGS[0], options), options.output)
    clock.say("figures drawn")
    texts = [table_text(cost, tried, options.episodes) for cost, tried in trials.items()]
    texts += [say(cheap, dear, touching) for say in (comparison_text, remarks)]
    text = "\n\n".join(texts)
    (options.output / "tables.txt").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}\n")
    clock.say(f"tables and figures are in {options.output}")


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100_000, help="episodes per policy")
    parser.add_argument("--segments", type=int, default=20, help="cells along x, and along y")
    parser.add_argument("--headings", type=int, default=12, help="cells of the heading")
    parser.add_argument("--output", type=Path, default=Path("robot_output"), help="folder")
    parser.add_argument("--seed", type=int, default=2024, help="seed of the simulations")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    return options


def _grid_of(reading: Reading, options: argparse.Namespace) -> RobotGrid:
    return replace(reading.grid, segments=options.segments, headings=options.headings)


def _try_all(
    reading: Reading, wall_cost: float, options: argparse.Namespace, clock: Clock
) -> dict[str, Trial]:
    grid = replace(_grid_of(reading, options), wall_cost=wall_cost)
    model = grid_model(grid)
    clock.say(f"{reading.name}, wall cost {wall_cost:g}: {model}")
    trials = {}
    for number, design in enumerate(reading.designs):
        seed = [options.seed, int(wall_cost), number]
        trial = trials[design.name] = try_out(design, model, grid, options.episodes, seed)
        evaluation = trial.evaluation
        clock.say(
            f"{design.name}: cost given success {evaluation.conditional_cost:.4f}, "
            f"failure {evaluation.failure_probability:.6f}, solved in {trial.seconds:.2f} s"
        )
    return trials


def _save_figures(trials: Mapping[str, Trial], grid: RobotGrid, output: Path) -> None:
    save_arena(grid.arena, output / "arena.png")
    for name, words in DRAWN.items():
        paths = trials[name].trajectories
        file_name = f"trajectories_{name.replace(' ', '_').lower()}.png"
        save_trajectories(grid.arena, paths, f"{len(paths)} episodes {words}", output / file_name)
    model, start = trials["S max"].problem.model, start_state(grid)
    curves = {
        name: trace_frontier(criterion(model, start), point_limit=POINTS)
        for name, criterion in (("S", S3P), ("M", MCMP))
    }
    save_frontier(
        curves, BUDGET, "Least expected cost against the failure budget", output / "frontier.png"
    )


if __name__ == "__main__":
    main()
