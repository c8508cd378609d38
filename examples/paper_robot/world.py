"""The robot in its continuous world: the process that the grid model approximates.

A policy designed on the grid is run here by telling it only the cell the robot is in.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper_robot.arena import FloatArray, Place, PlaceArray
from examples.paper_robot.grid import (
    N_ACTIONS,
    NOISE,
    START_BOX,
    STEP_LENGTH,
    TURN_STEP,
    IntArray,
    RobotGrid,
)


@dataclass(frozen=True)
class ContinuousRobot:
    """A simulator (see `ssp_lp.analysis.simulation`) whose world is [episodes, 3]: x, y, theta.

    The grid says how worlds map to states of the model, what lies where, and whether a collision is
    tested along the whole step or at its end point. Every step costs 1.
    """

    grid: RobotGrid

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
        """Draw starts uniformly: x and y in [0.1, 0.15], theta within +-pi / 12."""
        low, high = (START_BOX[0], START_BOX[0], -NOISE), (START_BOX[1], START_BOX[1], NOISE)
        world = rng.uniform(low, high, size=(episodes, 3))
        return world, self.grid.states_of(world)

    def step(
        self, world: FloatArray, pair: npt.NDArray[np.integer[Any]], rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Turn by the action and a uniform error, then move straight on by one step length.

        pair: the state-action pair of the model that is played, [k]; only its action matters.
        Returns the worlds [k, 3], the states of the model [k] and the costs [k]. With
        `along_segment` a robot that meets something stops there.
        """
        error = rng.uniform(-NOISE, NOISE, size=len(world))
        heading = world[:, 2] + (pair % N_ACTIONS - N_ACTIONS // 2) * TURN_STEP + error
        motion = STEP_LENGTH * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        place, moved = self._arrive(world[:, :2], motion)
        after = np.column_stack([moved, np.mod(heading, 2 * np.pi)])
        states = np.array([self.grid.end_state(end) for end in Place])[place]
        free = place == Place.FREE
        states[free] = self.grid.states_of(after[free])
        return after, states, np.ones(len(world))

    def _arrive(self, position: FloatArray, motion: FloatArray) -> tuple[PlaceArray, FloatArray]:
        """Return what the robots meet and where they stand after the motion."""
        arena, end = self.grid.arena, position + motion
        if not self.grid.along_segment:
            return arena.classify(*end.T), end
        place, time = arena.first_contact(*position.T, *motion.T)
        return place, position + time[:, None] * motion
