"""The paper's moving robot (section 4): its step, its grid model, and its continuous world.

    grid = RobotGrid()                      # 20 x 20 positions, 12 headings, as in the paper
    model = grid_model(grid)                # 4,800 cells, then goal, obstacle, wall
    problem = MCMP(model, start=start_state(grid), failure_budget=0.05)

The geometry is in `arena`, the cells in `grid`; the library does the rest.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper_robot.arena import Arena, Box, FloatArray, Place, PlaceArray
from examples.paper_robot.grid import (
    N_ACTIONS,
    NOISE,
    START_BOX,
    START_POINT,
    STEP_LENGTH,
    TURN_STEP,
    RobotGrid,
)
from examples.paper_robot.progress_bar import Progress
from ssp_lp import SSP, ContinuousModel, Distribution, Quadrature, WorldSimulator, discretise

__all__ = [
    "Arena",
    "Box",
    "Place",
    "RobotGrid",
    "continuous_robot",
    "grid_model",
    "robot_simulator",
    "start_state",
]

_Point = tuple[FloatArray, ...]
_IntArray = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True)
class _Dynamics:
    """The robot's step, and the pairs with equal transitions."""

    grid: RobotGrid

    def step(
        self, point: _Point, action: int, noise: _Point
    ) -> tuple[_Point, float | FloatArray, PlaceArray]:
        """Turn by the action and an error, then move straight on by one step length.

        The numbers of `Place` are those that the library gives to ends: goal, then dead-ends.
        A robot that meets something stops there.
        """
        (x, y, theta), (error,) = point, noise
        turn = (action - N_ACTIONS // 2) * TURN_STEP
        heading = theta + turn + error
        across, up = STEP_LENGTH * np.cos(heading), STEP_LENGTH * np.sin(heading)
        points = self.grid.points_on_the_way
        place, time = self.grid.arena.first_contact(x, y, across, up, points)
        return (x + time * across, y + time * up, heading), self._cost(turn, time), place

    def _cost(self, turn: float, share: FloatArray) -> float | FloatArray:
        """Return the cost of a turn, in radians, and a share of a step: 1, or length and turn."""
        turning = self.grid.turning_cost
        return 1.0 if turning is None else share * STEP_LENGTH + turning * abs(turn)

    def alike(self, cell: tuple[_IntArray, ...], action: _IntArray) -> _IntArray:
        """Number the pairs, with one number for all pairs of equal position and total turn."""
        (column, row, heading), headings = cell, self.grid.headings
        unit = math.gcd(12, headings)  # an action turns by a twelfth of a circle
        turns = 12 * headings // unit
        turn = (12 * heading + headings * (action - N_ACTIONS // 2)) // unit % turns
        return np.asarray((column * self.grid.segments + row) * turns + turn)


def continuous_robot(grid: RobotGrid) -> ContinuousModel:
    """Return the robot in its continuous world, with the grid of the policies."""
    dynamics = _Dynamics(grid)
    return ContinuousModel(
        grid.cells,
        range(N_ACTIONS),
        dynamics.step,
        noise=[Distribution.uniform(-NOISE, NOISE)],
        dead_ends={"obstacle": 1.0, "wall": grid.wall_cost},
        alike=dynamics.alike if grid.turning_cost is None else None,
    )


def grid_model(grid: RobotGrid, progress: Progress | None = None) -> SSP:
    """Return the robot's grid model as an SSP whose states are 0 .. n_cells + 2.

    The cells come first, then the goal, the obstacles and the wall (`RobotGrid.end_state`). Every
    step costs 1, or its length and its turn (`turning_cost`); the dead-end "wall" costs
    `wall_cost` per stage.

    progress: called with the progress of the transitions.
    """
    return discretise(continuous_robot(grid), Quadrature(grid.quadrature), progress=progress)


def robot_simulator(grid: RobotGrid) -> WorldSimulator:
    """Return the continuous world with its starts: x, y in [0.1, 0.15], theta within +-pi / 12."""
    place, heading = Distribution.uniform(*START_BOX), Distribution.uniform(-NOISE, NOISE)
    return WorldSimulator(continuous_robot(grid), [place, place, heading])


def start_state(grid: RobotGrid) -> int:
    """Return the cell for which policies are designed: that of x = y = 0.125, theta = 0."""
    return int(grid.cells.cell_of(START_POINT))
