"""The paper's moving robot (section 4): its grid model, its start and its continuous world.

    grid = RobotGrid()                      # 20 x 20 positions, 12 headings, as in the paper
    model = grid_model(grid)                # 4,800 cells, then goal, obstacle, wall
    problem = MCMP(model, start=start_state(grid), failure_budget=0.05)

The geometry is in `arena`, the cells in `grid`, the quadrature in `transitions`.
"""

import numpy as np

from examples.paper_robot.arena import Arena, Box, Place
from examples.paper_robot.grid import START_POINT, RobotGrid
from examples.paper_robot.progress_bar import Progress
from examples.paper_robot.transitions import GridArrays, grid_arrays
from examples.paper_robot.world import ContinuousRobot
from ssp_lp import SSP

__all__ = [
    "Arena",
    "Box",
    "ContinuousRobot",
    "GridArrays",
    "Place",
    "RobotGrid",
    "grid_arrays",
    "grid_model",
    "start_state",
]


def grid_model(
    grid: RobotGrid, arrays: GridArrays | None = None, progress: Progress | None = None
) -> SSP:
    """Return the robot's grid model as an SSP whose states are 0 .. n_cells + 2.

    The cells come first, then the goal, the obstacles and the wall (`RobotGrid.end_state`). Every
    step costs 1; the dead-end "wall" costs `wall_cost` per stage.

    arrays: the transitions, if they are at hand (models that differ in wall_cost share them).
    progress: told how far the transitions are, unless they are at hand (see `grid_arrays`).
    """
    arrays = grid_arrays(grid, progress) if arrays is None else arrays
    costs: float | np.ndarray = 1.0
    if grid.wall_cost != 1.0:
        costs = np.ones(arrays.n_pairs)
        costs[-1] = grid.wall_cost
    return SSP.from_arrays(
        pair_offsets=arrays.pair_offsets,
        outcome_offsets=arrays.outcome_offsets,
        successors=arrays.successors,
        probabilities=arrays.probabilities,
        costs=costs,
        goal_states=np.array([grid.end_state(Place.GOAL)]),
        state_labels={
            "obstacle": [grid.end_state(Place.OBSTACLE)],
            "wall": [grid.end_state(Place.WALL)],
        },
    )


def start_state(grid: RobotGrid) -> int:
    """Return the cell for which policies are designed: that of x = y = 0.125, theta = 0."""
    return int(grid.states_of(np.array([START_POINT]))[0])
