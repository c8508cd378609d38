"""The arena of the paper's robot: a unit square with two obstacles and a goal region.

Source: section 4.1 and figure 1 of the paper. `Arena.classify` returns the place at a point;
`Arena.first_contact` returns the place that a straight motion meets first.
"""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
PlaceArray = npt.NDArray[np.uint8]

TOLERANCE = 1e-9
"""Distance at which a point counts as on an edge. Rounding moves a point by about 1e-16, so that a
point on an edge in exact arithmetic is treated equally on every machine."""

_NO_MOTION = 1e-300
"""Replaces a displacement of exactly 0: a quotient by it is huge and has the right sign."""


class Place(IntEnum):
    """The place at a point. Every place except FREE ends an episode."""

    FREE = 0
    GOAL = 1
    OBSTACLE = 2
    WALL = 3


_ORDER = np.array([Place.OBSTACLE, Place.WALL, Place.GOAL, Place.FREE], dtype=np.uint8)
"""Order of precedence if a point, or an instant, belongs to several places."""


@dataclass(frozen=True)
class Box:
    """A closed axis-parallel rectangle: points on its edge belong to it."""

    left: float
    right: float
    bottom: float
    top: float

    def contains(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which points (x, y) lie in the box; x and y broadcast against each other."""
        in_columns = (x >= self.left - TOLERANCE) & (x <= self.right + TOLERANCE)
        in_rows = (y >= self.bottom - TOLERANCE) & (y <= self.top + TOLERANCE)
        return np.asarray(in_columns & in_rows)

    def entry_time(
        self, x: FloatArray, y: FloatArray, across: FloatArray, up: FloatArray
    ) -> FloatArray:
        """Return when the motion from (x, y) by (across, up) enters the box: 0 .. 1, or inf."""
        enter_x, leave_x = _crossing_times(x, across, self.left, self.right, TOLERANCE)
        enter_y, leave_y = _crossing_times(y, up, self.bottom, self.top, TOLERANCE)
        enter = np.maximum(np.maximum(enter_x, enter_y), 0.0)
        leave = np.minimum(np.minimum(leave_x, leave_y), 1.0)
        return np.where(enter <= leave, enter, np.inf)


@dataclass(frozen=True)
class Arena:
    """The square in which the robot moves, with obstacles and the goal.

    Touching an obstacle or the wall is a collision, so the free space is open.
    """

    obstacles: tuple[Box, ...] = (Box(0.15, 0.7, 0.3, 0.4), Box(0.4, 1.0, 0.65, 0.75))
    goal: Box = field(default_factory=lambda: Box(0.75, 0.9, 0.8, 0.95))
    side: float = 1.0

    def classify(self, x: FloatArray, y: FloatArray) -> PlaceArray:
        """Return the `Place` of each point: obstacle tested before wall before goal.

        x and y broadcast against each other; the result has their common shape, dtype uint8.
        """
        place = np.where(self.goal.contains(x, y), np.uint8(Place.GOAL), np.uint8(Place.FREE))
        place[self._beyond(x) | self._beyond(y)] = Place.WALL
        for box in self.obstacles:
            place[box.contains(x, y)] = Place.OBSTACLE
        return place

    def first_contact(
        self,
        x: FloatArray,
        y: FloatArray,
        across: FloatArray,
        up: FloatArray,
        points: int | None = None,
    ) -> tuple[PlaceArray, FloatArray]:
        """Return the place that the motion from (x, y) by (across, up) meets first, and the time.

        The time is the fraction of the motion in [0, 1]; it is 1 if nothing is met (`Place.FREE`).
        At times equal to rounding an obstacle precedes the wall, and the wall the goal.

        points: number of equally spaced points that are tested, the last of which is the end of the
            motion; None: the whole motion.
        """
        if points is not None:
            place, time = self.classify(x + across, y + up), np.asarray(1.0)
            for k in range(points - 1, 0, -1):  # an earlier contact replaces a later one
                here = self.classify(x + k / points * across, y + k / points * up)
                met = here != Place.FREE
                place, time = np.where(met, here, place), np.where(met, k / points, time)
            return place, time
        obstacle = np.asarray(np.inf)
        for box in self.obstacles:
            obstacle = np.minimum(obstacle, box.entry_time(x, y, across, up))
        wall = np.minimum(self._exit_time(x, across), self._exit_time(y, up))
        goal = self.goal.entry_time(x, y, across, up)
        times = np.stack(np.broadcast_arrays(obstacle, wall, goal, 1.0))
        first = np.argmax(times <= times.min(axis=0) + TOLERANCE, axis=0)
        return _ORDER[first], np.take_along_axis(times, first[None], axis=0)[0]

    def _beyond(self, coordinate: FloatArray) -> BoolArray:
        """Return which coordinates touch or pass the wall."""
        return np.asarray((coordinate <= TOLERANCE) | (coordinate >= self.side - TOLERANCE))

    def _exit_time(self, coordinate: FloatArray, motion: FloatArray) -> FloatArray:
        """Return when a coordinate reaches the wall: in [0, 1], else inf."""
        _, leave = _crossing_times(coordinate, motion, 0.0, self.side, -TOLERANCE)
        return np.where(leave <= 1.0, np.maximum(leave, 0.0), np.inf)


def _crossing_times(
    start: FloatArray, motion: FloatArray, low: float, high: float, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Return when start + time * motion enters and leaves [low - margin, high + margin]."""
    moved = np.where(motion == 0.0, _NO_MOTION, motion)
    at_low, at_high = (low - margin - start) / moved, (high + margin - start) / moved
    return np.minimum(at_low, at_high), np.maximum(at_low, at_high)
