"""The policies of the paper's section 4: how each is designed, and how each is tried out."""

from dataclasses import dataclass

import numpy as np

from examples.paper_robot.arena import FloatArray
from examples.paper_robot.robot import RobotGrid, robot_simulator
from formulations import MCMP, S3P
from ssp_lp import SSP, Evaluation, Solution, simulate, solve
from ssp_lp.analysis.simulation import SimulationReport

BUDGET = 0.05
DISCOUNT = 0.999
RECORDED = 50  # episodes drawn in a trajectory figure


@dataclass(frozen=True)
class Design:
    """One column of the tables: a criterion with its budget."""

    name: str  # the paper's pi_max^(S) is "S max", and so on; "exact" is not in the paper
    problem: MCMP | S3P


@dataclass(frozen=True)
class Trial:
    """A designed policy and how it fared."""

    design: Design
    solution: Solution
    chain: SimulationReport  # episodes in the grid model
    world: SimulationReport  # episodes in the continuous world

    @property
    def evaluation(self) -> Evaluation:
        """The policy's exact numbers on the grid model."""
        return self.solution.evaluation

    @property
    def trajectories(self) -> list[FloatArray]:
        """The first episodes in the continuous world: [steps + 1, 3] each."""
        return [np.asarray(path, dtype=np.float64) for path in self.world.paths]


def designs(model: SSP, start: int) -> list[Design]:
    """Return the paper's four designs, in its order, and the two with an exact budget."""
    return [
        Design("S max", S3P(model, start=start, failure_budget=None)),
        Design("M max", MCMP(model, start=start, failure_budget=None)),
        Design("S mod", S3P(model, start=start, failure_budget=BUDGET, discount=DISCOUNT)),
        Design("M mod", MCMP(model, start=start, failure_budget=BUDGET, discount=DISCOUNT)),
        Design("S exact", S3P(model, start=start, failure_budget=BUDGET)),
        Design("M exact", MCMP(model, start=start, failure_budget=BUDGET)),
    ]


def try_out(design: Design, grid: RobotGrid, episodes: int, seed: list[int]) -> Trial:
    """Solve a design and run its policy in the grid model and in the continuous world."""
    solution = solve(design.problem)
    policy, problem = solution.policy, design.problem
    chain_rng, world_rng = (np.random.default_rng([*seed, stream]) for stream in (0, 1))
    return Trial(
        design=design,
        solution=solution,
        chain=simulate(policy, problem, episodes=episodes, seed=chain_rng),
        world=simulate(
            policy,
            problem,
            episodes=episodes,
            seed=world_rng,
            simulator=robot_simulator(grid),
            record=RECORDED,
        ),
    )
