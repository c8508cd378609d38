"""The policies of the paper's section 4: their design and their simulation."""

import time
from dataclasses import dataclass

import numpy as np

from examples.paper_robot.arena import FloatArray
from examples.paper_robot.grid import RobotGrid
from examples.paper_robot.robot import robot_simulator, start_state
from ssp_lp import MCMP, S3P, SSP, Evaluation, MixedPolicy, evaluate, simulate, solve
from ssp_lp.analysis.simulation import SimulationReport
from ssp_lp.game import Game, play, stationary_player

BUDGET = 0.05
DISCOUNT = 0.999
RECORDED = 50  # episodes drawn in a trajectory figure


@dataclass(frozen=True)
class Design:
    """One column of the tables: a criterion with its budget, and the choice of its policy."""

    name: str
    group: str
    criterion: type[MCMP | S3P]
    failure_budget: float | None
    discount: float | None = None
    given_c: float | None = None  # the policy of the game at this c; None: of the optimum, c*
    published: str = ""  # the policy of the paper's tables that it is compared with


PAPERS = (
    Design("S max", "least failure", S3P, None, published="S max"),
    Design("M max", "least failure", MCMP, None, published="M max"),
    Design("S mod", "failure <= 5 %", S3P, BUDGET, DISCOUNT, published="S mod"),
    Design("M mod", "failure <= 5 %", MCMP, BUDGET, DISCOUNT, published="M mod"),
)
"""The paper's policies: "S max" is pi_max^(S), and so on."""

DESIGNS = (
    *PAPERS,
    Design("S, c = 18", "reconstruction", S3P, BUDGET, DISCOUNT, 18.0, published="S mod"),
    Design("M, c = 17", "reconstruction", MCMP, BUDGET, DISCOUNT, 17.0, published="M mod"),
    Design("S exact", "no discount", S3P, BUDGET),
    Design("M exact", "no discount", MCMP, BUDGET),
)


@dataclass(frozen=True)
class Reading:
    """A method, not stated in the paper, of computing transition probabilities and collisions."""

    name: str
    says: str
    grid: RobotGrid
    designs: tuple[Design, ...]


READINGS = (
    Reading(
        "as in the paper",
        "heading: the centre of its cell; collisions: 4 points along a step",
        RobotGrid(quadrature=(4, 4, 1, 4), points_on_the_way=4),
        DESIGNS,
    ),
    Reading(
        "as the robot moves",
        "heading: spread over its cell; collisions: the end of a step",
        RobotGrid(),
        PAPERS,
    ),
)
COMPARED = "M mod"
IN_BETWEEN = Reading(
    "in between",
    "heading: spread over its cell; collisions: 4 points along a step",
    RobotGrid(points_on_the_way=4),
    tuple(design for design in PAPERS if design.name == COMPARED),
)
"""The reading "as in the paper" except for the heading: `COMPARED` shows the heading's effect."""


@dataclass(frozen=True)
class Trial:
    """A designed policy with its evaluation and simulations."""

    design: Design
    problem: MCMP | S3P
    evaluation: Evaluation  # exact, on the grid model
    gap: float  # relative, of the certified bound
    failure_price: float | None
    seconds: float  # to find the policy
    members: int  # number of deterministic policies that are mixed
    ready: MixedPolicy  # the policy with actions in all cells, also unreachable ones
    chain: SimulationReport  # episodes in the grid model
    world: SimulationReport  # in the continuous world, with collisions detected as in the model

    @property
    def trajectories(self) -> list[FloatArray]:
        """The first episodes in the continuous world: [steps + 1, 3] each."""
        return [np.asarray(path, dtype=np.float64) for path in self.world.paths]


def try_out(design: Design, model: SSP, grid: RobotGrid, episodes: int, seed: list[int]) -> Trial:
    """Design a policy and run it in the grid model and in the continuous world."""
    budget, discount, start = design.failure_budget, design.discount, start_state(grid)
    problem = design.criterion(model, start=start, failure_budget=budget, discount=discount)
    began = time.perf_counter()
    if design.given_c is None or budget is None:
        solution = solve(problem)
        policy, gap, price = solution.policy, solution.gap, solution.failure_price
        seconds, ready = time.perf_counter() - began, solution.policy_everywhere()
    else:
        player = stationary_player(problem)
        share = 1.0 - budget if problem.ratio else 1.0
        game = play(player, Game(share * design.given_c, budget))
        seconds = time.perf_counter() - began
        policy = ready = game.policy(player)  # a best response decides in every cell
        gap, price = 1.0 - game.lower / game.upper, game.failure_price
    chain_rng, world_rng = (np.random.default_rng([*seed, stream]) for stream in (0, 1))
    return Trial(
        design,
        problem,
        evaluate(policy, problem),
        gap,
        price,
        seconds,
        len(policy.policies),
        ready,
        chain=simulate(policy, problem, episodes=episodes, seed=chain_rng),
        world=run_in_world(ready, problem, grid, episodes, world_rng),
    )


def run_in_world(
    policy: MixedPolicy,
    problem: MCMP | S3P,
    grid: RobotGrid,
    episodes: int,
    seed: np.random.Generator,
) -> SimulationReport:
    """Run a policy in the continuous world, with collisions detected as in the grid model."""
    return simulate(
        policy,
        problem,
        episodes=episodes,
        seed=seed,
        simulator=robot_simulator(grid),
        record=RECORDED,
    )
