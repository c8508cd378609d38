"""The paper's robot with realistic costs: the length of its way, and its turns.

A step stops at the first contact, so that its length is a real number, and a turn costs an amount
per radian: the totals have no common unit. Solves S3P with a failure budget of 5 % for several
prices of turning, certifies each solution, simulates the policies, and draws some episodes.

    python examples/paper_robot/true_costs.py --output figures

Needs matplotlib (`pip install '.[plot]'`). Takes about a minute.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from examples.paper_robot.figures import save_trajectories
from examples.paper_robot.robot import RobotGrid, grid_model, robot_simulator, start_state
from examples.paper_robot.study import BUDGET, RECORDED
from ssp_lp import S3P, Certificate, Solution, certify, simulate, solve
from ssp_lp.analysis.simulation import SimulationReport

TURNING_COSTS = [0.0, 0.05, 0.2]  # of a radian, where a step's length of 0.1 costs 0.1
TOLERANCE = 1e-4


@dataclass(frozen=True)
class TrueCosts:
    """A solution at one price of turning, its certificate, and its policy's simulation."""

    solution: Solution
    certificate: Certificate
    chain: SimulationReport  # episodes in the grid model
    world: SimulationReport  # episodes in the continuous world


def designed(grid: RobotGrid, episodes: int, seed: int) -> TrueCosts:
    """Solve S3P with a failure budget of 5 % on a grid, certify and simulate the solution."""
    problem = S3P(grid_model(grid), start=start_state(grid), failure_budget=BUDGET)
    solution = solve(problem, tolerance=TOLERANCE)
    chain, world = (np.random.default_rng([seed, stream]) for stream in (0, 1))
    return TrueCosts(
        solution,
        certify(solution),
        simulate(solution.policy, problem, episodes=episodes, seed=chain),
        simulate(
            solution.policy,
            problem,
            episodes=episodes,
            seed=world,
            simulator=robot_simulator(grid),
            record=RECORDED,
        ),
    )


HEADER = """\
turning           proved          | episodes in the grid model                      | the world
of a radian  c*      gap  seconds | cost given success       failure                | cost, fails"""


def row(turning_cost: float, found: TrueCosts) -> str:
    """Return one line of the table."""
    solution, chain, world = found.solution, found.chain, found.world
    cost, fails = chain.conditional_cost, chain.failure_probability
    return (
        f"{turning_cost:<9.2f} {solution.objective:.4f} {found.certificate.gap:7.0e} "
        f"{solution.seconds:7.1f}  | {cost.value:.4f} [{cost.low:.4f}, {cost.high:.4f}]  "
        f"{fails.value:.4f} [{fails.low:.4f}, {fails.high:.4f}] | "
        f"{world.conditional_cost.value:.4f} {world.failure_probability.value:.4f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and draw the episodes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100_000, help="episodes per policy")
    parser.add_argument("--segments", type=int, default=20, help="cells along x, and along y")
    parser.add_argument("--headings", type=int, default=12, help="cells of the heading")
    parser.add_argument(
        "--turning-costs", type=float, nargs="+", default=TURNING_COSTS, help="of a radian"
    )
    parser.add_argument("--output", type=Path, default=Path("robot_output"), help="folder")
    parser.add_argument("--seed", type=int, default=2024, help="seed of the simulations")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    print(HEADER)
    for turning_cost in options.turning_costs:
        grid = RobotGrid(
            segments=options.segments,
            headings=options.headings,
            points_on_the_way=None,
            turning_cost=turning_cost,
        )
        found = designed(grid, options.episodes, options.seed)
        print(row(turning_cost, found), flush=True)
        title = f"{RECORDED} episodes: a radian of turning costs {turning_cost:g}"
        name = f"turning_cost_{turning_cost:g}.png"
        save_trajectories(grid.arena, list(found.world.paths), title, options.output / name)


if __name__ == "__main__":
    main()
