"""A decision process with continuous coordinates: what a step does, and how space is cut."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from ssp_lp.arrays import IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model.discretisation.distribution import Distribution
from ssp_lp.model.discretisation.grid import MOST_STATES, Coordinates, Grid

Step = Callable[
    [Coordinates, Any, Coordinates], tuple[Sequence[npt.ArrayLike], npt.ArrayLike, npt.ArrayLike]
]
"""``step(point, action, noise) -> (new point, cost, end)``; see :class:`ContinuousModel`."""

Alike = Callable[[tuple[IntArray, ...], IntArray], IntArray]


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousModel:
    """Continuous coordinates, a step function, and the grid on which policies see the world.

    **The step function** is called with one action and many points at a time:
    ``step(point, action, noise) -> (new point, cost, end)``. ``point`` holds one array for each
    axis, ``noise`` one for each random number; the arrays broadcast against each other and need
    not be of one shape, so work with them as with numbers (``np.where``, no boolean masks).
    Returned are one array for each axis, the cost (>= 0) and the end, a whole number: 0 the
    episode goes on, 1 it reached the goal, 2, 3, ... it failed in the first, second, ...
    dead-end; each a number, or an array that broadcasts to the rest.

    Attributes:
        grid: the box of coordinates and its cells.
        actions: every one is there in every cell.
        step: the step function.
        noise: the independent random numbers that a step draws.
        dead_ends: label of each way to fail -> cost of each stage spent in it; the library
            charges it only where a criterion says so (``charge_failing_step``).
        outside: the dead-end of a step that goes on outside the box; None: such a step is an error.
        alike: where it is known that pairs share their outcomes, exactly, a function that
            says so, and each such set of pairs is worked out once: (positions of cells along
            each axis, positions of actions) -> whole numbers >= 0, not many more than pairs,
            equal for pairs with equal outcomes.

    The model that :func:`~ssp_lp.model.discretisation.discretise.discretise` makes of it has the
    cells as states 0, 1, ..., then the goal, then the dead-ends (:meth:`end_state`).
    """

    grid: Grid
    actions: Sequence[Hashable]
    step: Step
    noise: Sequence[Distribution] = ()
    dead_ends: Mapping[str, float] = field(default_factory=dict)
    outside: str | None = None
    alike: Alike | None = None

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for actions, noise or an outside that cannot be."""
        if len(self.actions) == 0 or len(set(self.actions)) < len(self.actions):
            raise ModelError("a continuous model needs actions, each of them once")
        if not all(isinstance(draw, Distribution) for draw in self.noise):
            raise ModelError("noise must list distributions: [Distribution.uniform(-0.1, 0.1)]")
        if self.outside is not None and self.outside not in self.dead_ends:
            raise ModelError(f"outside={self.outside!r} is none of the dead-ends")
        if self.n_states > MOST_STATES:
            raise ModelError(f"{self.n_states:,} states are too many; 2**31 is the limit")

    def __repr__(self) -> str:
        """One line: the box, and how much there is of what."""
        ends = ", ".join(("goal", *self.dead_ends))
        return (
            f"ContinuousModel({self.grid}, {self.grid.n_cells:,} cells, {len(self.actions)} "
            f"actions, {len(self.noise)} random numbers; ends: {ends})"
        )

    @property
    def n_states(self) -> int:
        """Cells, the goal and the dead-ends."""
        return self.grid.n_cells + 1 + len(self.dead_ends)

    def end_state(self, end: str | int) -> int:
        """The state of an end: "goal", a dead-end's label, or its number 1, 2, ...

        Raises:
            ModelError: there is no such end.
        """
        names = ("goal", *self.dead_ends)
        if isinstance(end, str) and end not in names:
            raise ModelError(f"{end!r} is no end; there are {', '.join(names)}")
        number = names.index(end) + 1 if isinstance(end, str) else int(end)
        if not 1 <= number <= len(names):
            raise ModelError(f"{end!r} is no end; there are 1 .. {len(names)}")
        return self.grid.n_cells + number - 1
