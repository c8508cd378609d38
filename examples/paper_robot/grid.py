"""Motion of the paper's robot, and the cells of its positions and headings.

Source: sections 4.1 and 4.2 of the paper.
"""

from dataclasses import dataclass, field

import numpy as np

from examples.paper_robot.arena import Arena, Place
from ssp_lp import Axis, Grid, ModelError

STEP_LENGTH = 0.1  # speed 1.0 for 0.1 s
TURN_STEP = np.pi / 6  # radians between neighbouring actions
N_ACTIONS = 5  # turns of -2 .. 2 times TURN_STEP
NOISE = np.pi / 12  # half width of the uniform steering error, radians
START_BOX = (0.1, 0.15)  # continuous runs start uniformly here, in x and in y
START_POINT = (0.125, 0.125, 0.0)  # x, y, theta for which the policies are designed


@dataclass(frozen=True)
class RobotGrid:
    """A discretisation of the robot: cells of x, y and theta, and a midpoint quadrature.

    segments: cells along x, and along y.
    headings: cells of theta, centred on the multiples of 2 pi / headings.
    quadrature: midpoints in x, y, theta (within the cell) and the steering error: one number for
        each, or one for all of them.
    wall_cost: stage cost after a collision with the wall (after any other collision it is 1).
    points_on_the_way: equally spaced points of a step at which the robot may collide or arrive,
        the last of them its end point; None: anywhere on the way.
    turning_cost: cost of a radian; with it, a step costs the length of its way plus the cost of its
        turn (None: every step costs 1, as in the paper).
    """

    segments: int = 20
    headings: int = 12
    quadrature: int | tuple[int, int, int, int] = 4
    wall_cost: float = 1.0
    points_on_the_way: int | None = 1
    turning_cost: float | None = None
    arena: Arena = field(default_factory=Arena)

    def __post_init__(self) -> None:
        """Raise ModelError for a step without a point at which the robot may collide."""
        if self.points_on_the_way is not None and self.points_on_the_way < 1:
            raise ModelError(
                f"points_on_the_way={self.points_on_the_way}: give at least 1, or None"
            )

    @property
    def cells(self) -> Grid:
        """The cells: x slowest, theta fastest.

        A heading exactly between two cells counts half in each. Such headings are common (a
        quarter of all that are tried at the default), and giving them to one side would make the
        robot drift. The rule moves the safest policy's cost, 25.3 steps, by up to 0.2.
        """
        side, half = Axis(0.0, self.arena.side, self.segments), np.pi / self.headings
        low, high = -half, 2 * np.pi - half
        return Grid([side, side, Axis(low, high, self.headings, periodic=True, split_edges=True)])

    @property
    def n_cells(self) -> int:
        """The number of cells; their states are 0 .. n_cells - 1."""
        return self.cells.n_cells

    def end_state(self, place: Place) -> int:
        """Return the state of an end: goal, obstacle and wall follow the cells in this order."""
        return self.n_cells + int(place) - 1
