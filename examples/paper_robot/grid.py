"""How the robot's positions and headings are cut into cells, and which angles are sampled.

Source: section 4.2 of the paper. Angles on the sampling lattice are integers (see `angle_unit`):
a heading that falls exactly between two cells is then recognised exactly, on every machine.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from examples.paper_robot.arena import TOLERANCE, Arena, FloatArray, Place

IntArray = npt.NDArray[np.int64]

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
    quadrature: midpoints in each of x, y, theta (within the cell) and the steering error.
    wall_cost: stage cost after a collision with the wall (after any other collision it is 1).
    along_segment: test the whole straight motion of a step, not its end point only.
    """

    segments: int = 20
    headings: int = 12
    quadrature: int = 4
    wall_cost: float = 1.0
    along_segment: bool = False
    arena: Arena = field(default_factory=Arena)

    def __post_init__(self) -> None:
        """Raise ValueError if a count is not positive."""
        if min(self.segments, self.headings, self.quadrature) < 1:
            raise ValueError("segments, headings and quadrature must be at least 1")

    @property
    def n_cells(self) -> int:
        """The number of cells; their states are 0 .. n_cells - 1, x slowest and theta fastest."""
        return self.segments * self.segments * self.headings

    def end_state(self, place: Place) -> int:
        """Return the state of an end: goal, obstacle and wall follow the cells in this order."""
        return self.n_cells + int(place) - 1

    @property
    def angle_unit(self) -> float:
        """The unit, in radians, in which every sampled angle is an integer."""
        return float(np.pi / (12 * self.quadrature * self.headings))

    @property
    def midpoints(self) -> IntArray:
        """The sampled midpoints of an interval, [quadrature].

        Counted from the interval's centre in units of width / (2 * quadrature).
        """
        return 2 * np.arange(self.quadrature) + 1 - self.quadrature

    def states_of(self, world: FloatArray) -> IntArray:
        """Return the cell of each (x, y, theta) in free space: world [n, 3] -> states [n]."""
        column, row = np.floor(world[:, :2] * (self.segments / self.arena.side) + TOLERANCE).T
        heading = np.floor(world[:, 2] * (self.headings / (2 * np.pi)) + 0.5 + TOLERANCE)
        flat = (column * self.segments + row) * self.headings + np.mod(heading, self.headings)
        return np.asarray(flat, dtype=np.int64)
