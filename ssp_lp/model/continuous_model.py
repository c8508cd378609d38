"""Continuous worlds: the grid of cells, the noise, the step function, and simulated episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import (
    PROBABILITY_SUM,
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    least_integer_type,
    read_only,
)
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model.arguments import check_fields, explained, explained_class
from ssp_lp.model.ssp import SSP

ON_EDGE: Final = 1e-9
"""Distance, in widths of a cell, below which a coordinate counts as lying on an edge.

Rounding moves a coordinate by some 1e-16 of its size; with this tolerance a point that lies on an
edge in exact arithmetic is treated alike on every machine.
"""

MOST_STATES: Final = 2**31 - 1
"""Successors are stored as 32-bit integers."""

Coordinates = tuple[FloatArray, ...]
"""One array for each axis; the arrays broadcast against each other."""

World = npt.NDArray[Any]
"""Positions of simulated episodes in a world, [episodes, ...]."""

Moved = tuple[World, IntArray, FloatArray]
"""Result of a step in a world: positions, states of the model, costs, [episodes] each."""


@explained_class
@dataclass(frozen=True)
class Axis:
    """A coordinate: the interval from low to high in equal cells, numbered upwards from 0.

    A point on the edge between two cells belongs to the upper one. On a periodic axis, such as an
    angle, low and high are the same point, and every number lies in some cell. To centre the cells
    of an angle on multiples of their width, let ``low`` be minus half a width. With
    ``split_edges``, a point of a quadrature on an edge counts half in each of the two cells, which
    preserves mirror symmetries.
    """

    low: float
    high: float
    cells: int
    periodic: bool = False
    split_edges: bool = False

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for an empty or infinite interval, or without cells."""
        if not isinstance(self.cells, (int, np.integer)) or not 1 <= self.cells < 2**31:
            cells = in_short(self.cells)
            raise ModelError(f"an axis needs a whole number of cells >= 1, not {cells}")
        check_fields(self)
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ModelError(f"an axis needs a finite low and a greater high: {self!r}")

    @property
    def width(self) -> float:
        """Width of a cell."""
        return (self.high - self.low) / self.cells

    def misses(self, heights: FloatArray) -> BoolArray:
        """Return a mask of the heights that are NaN or lie outside the axis.

        A height is the distance of a coordinate above ``low``, in cell widths. A finite height is
        never outside a periodic axis.
        """
        if self.periodic:
            return ~np.isfinite(heights)
        return ~((heights >= -ON_EDGE) & (heights <= self.cells + ON_EDGE))

    def above(self, heights: FloatArray) -> IntArray:
        """Return the index of the cell at each height; on an edge that of the upper cell.

        Heights are distances above ``low``, in cell widths.
        """
        return self._numbered(np.floor(heights + ON_EDGE))

    def below(self, heights: FloatArray) -> IntArray:
        """Return the index of the cell at each height; on an edge that of the lower cell.

        Heights are distances above ``low``, in cell widths.
        """
        return self._numbered(np.ceil(heights - ON_EDGE) - 1.0)

    def wrapped(self, values: FloatArray) -> FloatArray:
        """Return values, on a periodic axis moved into [low, high) by whole periods."""
        if not self.periodic:
            return values
        return self.low + np.mod(values - self.low, self.high - self.low)

    def _numbered(self, cells: FloatArray) -> IntArray:
        """Return indices of cells within the axis: wrapped if it is periodic, else clipped."""
        if self.periodic:
            inside = cells - self.cells * np.floor(cells / self.cells)
        else:
            inside = np.clip(cells, 0, self.cells - 1)
        return np.asarray(inside, dtype=np.int32)


@dataclass(frozen=True)
class Grid:
    """The cells of a box, numbered so that the position along the last axis varies fastest."""

    axes: tuple[Axis, ...]

    @explained
    def __init__(self, axes: Sequence[Axis]) -> None:
        """Create the grid of axes in the order of the coordinates.

        Raises:
            ModelError: no axis, or more cells than a model may have states.
        """
        object.__setattr__(self, "axes", tuple(axes))
        if not self.axes or not all(isinstance(axis, Axis) for axis in self.axes):
            raise ModelError("a grid needs at least one axis: Grid([Axis(0.0, 1.0, cells=20)])")
        if self.n_cells > MOST_STATES:
            raise ModelError(f"a grid of {self.n_cells:,} cells is too large; 2**31 is the limit")

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of cells along each axis."""
        return tuple(int(axis.cells) for axis in self.axes)

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    @cached_property
    def strides(self) -> tuple[int, ...]:
        """Difference between the indices of neighbouring cells along each axis."""
        return tuple(math.prod(self.shape[k + 1 :]) for k in range(len(self.axes)))

    @explained
    def index_of(self, cells: npt.ArrayLike) -> tuple[IntArray, ...]:
        """Return the position of each cell along each axis.

        Args:
            cells: a number for each cell, in any shape.

        Raises:
            ModelError: a number that no cell has.
        """
        given = np.asarray(cells)
        if given.dtype.kind not in "iu" or (given < 0).any() or (given >= self.n_cells).any():
            raise ModelError(f"cells are whole numbers 0 .. {self.n_cells - 1}; ends are no cells")
        return np.unravel_index(given, self.shape)

    @explained
    def centre(self, cells: npt.ArrayLike) -> FloatArray:
        """Return the midpoints of cells, [..., axes], from an array of cell numbers, [...].

        Raises:
            ModelError: a number that no cell has.
        """
        index = zip(self.axes, self.index_of(cells), strict=True)
        return np.stack([axis.low + (k + 0.5) * axis.width for axis, k in index], axis=-1)

    @explained
    def place(self, state: int) -> tuple[int, int] | None:
        """Return a cell's position along the first two axes, for pictures.

        For a state of the discretised model that is not a cell, the goal or a dead-end, return
        None.

        Raises:
            ModelError: the grid has one axis, or the number is negative.
        """
        if len(self.axes) < 2:
            raise ModelError("grid.place needs a grid of at least two axes")
        if state >= self.n_cells:
            return None
        first, second = self.index_of(state)[:2]
        return int(first), int(second)

    @explained
    def cell_of(self, points: npt.ArrayLike) -> Any:
        """Return the number of the cell that contains each point, [...]; an int for a single point.

        Args:
            points: coordinates, [..., axes].

        Raises:
            ModelError: a point lies outside the box, or has another number of coordinates.
        """
        given = np.asarray(points, dtype=np.float64)
        if given.ndim == 0 or given.shape[-1] != len(self.axes):
            raise ModelError(f"points need {len(self.axes)} coordinates in their last dimension")
        heights = self.heights(tuple(np.moveaxis(given, -1, 0)))
        missed = self.misses(heights)
        if missed.any():
            raise ModelError(f"the point {given[missed][0].tolist()} lies outside {self}")
        cells = self.numbers_about(heights, split=False)[0].astype(np.int64)
        return int(cells) if cells.ndim == 0 else cells

    def heights(self, coordinates: Coordinates) -> Coordinates:
        """Return the distances of coordinates above the low end of their axis, in cell widths."""
        return tuple(
            np.asarray((values - axis.low) * (axis.cells / (axis.high - axis.low)))
            for axis, values in zip(self.axes, coordinates, strict=True)
        )

    def misses(self, heights: Coordinates) -> BoolArray:
        """Return a mask of the points outside the box; its shape broadcasts to that of the points.

        ``heights`` has an array for each axis: distances above its low end, in cell widths.
        """
        missed: BoolArray = np.zeros((), dtype=np.bool_)
        for axis, values in zip(self.axes, heights, strict=True):
            off = axis.misses(values)
            if off.any():
                missed = missed | off
        return missed

    def numbers_about(self, heights: Coordinates, *, split: bool = True) -> list[IntArray]:
        """Return the cells that contain each point, as a list of arrays of cell numbers.

        The list has one array, except if points lie on an edge of an axis with ``split_edges``. It
        then has two arrays, with the lower and the upper cell at the edge; a point counts half in
        each. Points that are not on an edge have the same cell in both arrays. If points lie on
        edges of several such axes, there are 4, 8, ... arrays. On an edge of any other axis the
        point belongs to the upper cell.
        """
        parts: list[list[IntArray]] = []
        for axis, stride, values in zip(self.axes, self.strides, heights, strict=True):
            upper = axis.above(values)
            sides = [upper]
            if split and axis.split_edges:
                lower = axis.below(values)
                sides += [lower] if (lower != upper).any() else []
            parts.append([side * np.int32(stride) for side in sides])
        parts.sort(key=lambda sides: sides[0].size)  # the largest array is made last, once
        totals = parts[0]
        for sides in parts[1:]:
            totals = [total + side for total in totals for side in sides]
        return totals

    def __str__(self) -> str:
        """Return the box, interval by interval."""
        return "the box " + " x ".join(
            f"[{axis.low:g}, {axis.high:g}{')' if axis.periodic else ']'}" for axis in self.axes
        )


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class Distribution(ReadOnlyCopies):
    """A random number, given by its quantile function; independent of all others.

    ``Distribution(scipy.stats.norm(0.0, 0.1).ppf)`` is a normal distribution. The quantile function
    may be any non-decreasing vectorised function from levels in (0, 1) to values. :meth:`uniform`
    and :meth:`discrete` make common distributions.
    """

    quantile: Callable[[FloatArray], npt.ArrayLike]
    values: FloatArray | None = None  # [atoms], of a discrete one
    probabilities: FloatArray | None = None  # [atoms]

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` unless the quantile function is callable."""
        check_fields(self)

    @classmethod
    @explained
    def uniform(cls, low: float, high: float) -> Distribution:
        """Return uniform noise on an interval; :class:`ModelError` for a wrong interval."""
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise ModelError(f"a uniform distribution needs low <= high, not {low!r}, {high!r}")
        return cls(partial(_between, float(low), float(high)))

    @classmethod
    @explained
    def discrete(cls, values: npt.ArrayLike, probabilities: npt.ArrayLike) -> Distribution:
        """Return noise with finitely many values, [atoms], and probabilities, [atoms].

        Raises:
            ModelError: arrays of different shapes, a value that is not finite, or probabilities
                that are negative or do not sum to 1.
        """
        atoms = np.asarray(values, dtype=np.float64)
        chance = np.asarray(probabilities, dtype=np.float64)
        if atoms.ndim != 1 or atoms.size == 0 or atoms.shape != chance.shape:
            raise ModelError("a discrete distribution needs as many values as probabilities")
        if not np.isfinite(atoms).all():
            raise ModelError("a value of a discrete distribution is not finite")
        total = float(chance.sum())
        if not (chance >= 0.0).all() or not abs(total - 1.0) <= PROBABILITY_SUM:
            raise ModelError(f"probabilities of a distribution must be >= 0 and sum to 1: {total}")
        atoms, chance = atoms[chance > 0.0], chance[chance > 0.0] / total
        quantile = partial(_atoms_at, atoms, np.cumsum(chance[:-1]))
        return cls(quantile, read_only(atoms), read_only(chance))

    def __repr__(self) -> str:
        """Return the quantile function, or the number of values."""
        law = in_short(self.quantile) if self.values is None else f"{self.values.size} values"
        return f"Distribution({law})"

    @explained
    def at(self, levels: FloatArray) -> FloatArray:
        """Return the noise at levels in (0, 1); :class:`ModelError` if not finite."""
        values = np.asarray(self.quantile(levels))
        real = values.dtype.kind in "biuf" and values.shape == levels.shape
        if not real or not np.isfinite(values).all():
            raise ModelError("a quantile function must return a finite number for each level")
        return values.astype(np.float64, copy=False)


def _between(low: float, high: float, levels: FloatArray) -> FloatArray:
    """Return the quantiles of uniform noise at ``levels``, in the shape of ``levels``."""
    return low + (high - low) * levels


def _atoms_at(atoms: FloatArray, cumulative: FloatArray, levels: FloatArray) -> FloatArray:
    """Return the quantiles of discrete noise at ``levels``, in the shape of ``levels``."""
    return np.asarray(atoms[np.searchsorted(cumulative, levels, side="right")])


Step = Callable[
    [Coordinates, Any, Coordinates], tuple[Sequence[npt.ArrayLike], npt.ArrayLike, npt.ArrayLike]
]
"""``step(point, action, noise) -> (new point, cost, end)``; see :class:`ContinuousModel`."""

Alike = Callable[[tuple[IntArray, ...], IntArray], IntArray]
Allowed = Callable[[Coordinates, Any], npt.ArrayLike]


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class ContinuousModel:
    """A continuous world: coordinates, a step function, and a grid of cells for its policies.

    **The step function** is called with one action and many points at a time: ``step(point, action,
    noise) -> (new point, cost, end)``. ``point`` holds one array for each axis, ``noise`` one for
    each random number; the arrays broadcast against each other and need not be of one shape, so
    work with them as with numbers (``np.where``, no boolean masks). It returns one array for each
    axis, the cost (>= 0) and the end. The end is a whole number: 0 if the episode goes on, 1 if it
    reached the goal, 2, 3, ... if it failed in the first, second, ... dead-end. Each of these
    results is a number, or an array that broadcasts to the others.

    Attributes:
        grid: the box of coordinates and its cells.
        actions: available in every cell, unless ``allowed`` is given.
        step: the step function.
        noise: the independent random numbers that a step draws.
        dead_ends: label of each way to fail -> cost of each stage spent in it; the library charges
            it only if the criterion does (``charge_failing_step``).
        outside: the dead-end of a step that leaves the box; None: such a step is an error.
        alike: function that groups pairs with exactly equal outcomes, so that each group is
            computed once. It maps (positions of cells along each axis, positions of actions) to the
            number of the group, a whole number >= 0 (small numbers need less memory).
        allowed: function that says which actions a cell has: ``allowed(point, action) -> truth
            values``, called with the midpoints of many cells, an array for each axis. The answer at
            the midpoint holds for the whole cell, in the model and in the simulated world; ``step``
            is called for allowed pairs only. None: every action in every cell.

    The states of the model that :func:`~ssp_lp.model.discretise.discretise` makes of it are the
    cells 0, 1, ..., then the goal, then the dead-ends (:meth:`end_state`).
    """

    grid: Grid
    actions: Sequence[Hashable]
    step: Step
    noise: Sequence[Distribution] = ()
    dead_ends: Mapping[str, float] = field(default_factory=dict)
    outside: str | None = None
    alike: Alike | None = None
    allowed: Allowed | None = None

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for wrong actions, noise or ``outside``."""
        check_fields(self)
        if len(self.actions) == 0 or len(set(self.actions)) < len(self.actions):
            raise ModelError("a continuous model needs actions, without repetitions")
        if self.outside is not None and self.outside not in self.dead_ends:
            raise ModelError(f"outside={self.outside!r} is not one of the dead-ends")
        if self.n_states > MOST_STATES:
            raise ModelError(f"{self.n_states:,} states are too many; 2**31 is the limit")

    def __repr__(self) -> str:
        """Return a line with the box, the numbers of cells, actions and noise, and the ends."""
        ends = ", ".join(("goal", *self.dead_ends))
        return (
            f"ContinuousModel({self.grid}, {self.grid.n_cells:,} cells, {len(self.actions)} "
            f"actions, {len(self.noise)} random numbers; ends: {ends})"
        )

    @property
    def n_states(self) -> int:
        """Number of states of the discretised model: cells, goal and dead-ends."""
        return self.grid.n_cells + 1 + len(self.dead_ends)

    @cached_property
    def allowed_pairs(self) -> IntArray | None:
        """Allowed pairs, each as cell * actions + action, [pairs]; None: all pairs.

        Raises:
            ModelError: ``allowed`` returns no truth values, or leaves a cell without actions.
        """
        return None if self.allowed is None else self.pairs_between(0, self.grid.n_cells)

    def pairs_between(self, first: int, end: int) -> IntArray:
        """Return the allowed pairs of cells first .. end - 1, as in ``allowed_pairs``.

        Raises:
            ModelError: ``allowed`` returns no truth values, or leaves a cell without actions.
        """
        n_actions, count = len(self.actions), end - first
        kind = least_integer_type(self.grid.n_cells * n_actions)
        pairs = np.arange(first * n_actions, end * n_actions, dtype=kind)
        if self.allowed is None:
            return pairs
        middles = tuple(self.grid.centre(np.arange(first, end)).T)
        there = np.empty((count, n_actions), dtype=np.bool_)
        for k, action in enumerate(self.actions):
            answer = np.asarray(self.allowed(middles, action))
            if answer.dtype != np.bool_ or answer.shape not in ((), (count,)):
                raise ModelError(
                    f"allowed() must return True or False for each of {count:,} cells, not "
                    f"{in_short(answer)}"
                )
            there[:, k] = answer
        idle = ~there.any(axis=1)
        if idle.any():
            middle = [float(values[np.argmax(idle)]) for values in middles]
            raise ModelError(
                f"no action is allowed in the cell around {middle}: allow one, or let the steps "
                "that lead there end in a dead-end"
            )
        return read_only(pairs[there.ravel()])

    @explained
    def end_state(self, end: str | int) -> int:
        """Return the state that stands for an end: "goal", a dead-end's label, or its number.

        Raises:
            ModelError: no such end exists.
        """
        names = ("goal", *self.dead_ends)
        if isinstance(end, str) and end not in names:
            raise ModelError(f"{end!r} is not an end; ends are {', '.join(names)}")
        number = names.index(end) + 1 if isinstance(end, str) else int(end)
        if not 1 <= number <= len(names):
            raise ModelError(f"{end!r} is not an end; ends are 1 .. {len(names)}")
        return self.grid.n_cells + number - 1


class _Taken(NamedTuple):
    """Results of a step from many points; every array broadcasts to the shape of the points."""

    point: Coordinates
    heights: Coordinates  # in widths of a cell above the low ends; 0 if off the axis
    cost: FloatArray
    end: IntArray  # 0 goes on, 1 goal, 2 .. dead-ends


def take_step_in_world(
    model: ContinuousModel,
    point: Coordinates,
    action: int,
    noise: Coordinates,
    shape: tuple[int, ...],
) -> _Taken:
    """Take a step of a continuous model from many points.

    Args:
        model: the world.
        point: an array for each axis, with as many dimensions as ``shape``, broadcasting to it.
        action: position of the action among the model's actions.
        noise: an array for each random number, also with as many dimensions as ``shape``.
        shape: common shape of the points.

    Raises:
        ModelError: the step function returns a value of a wrong form, or leaves the box.
    """
    name, grid = model.actions[action], model.grid
    moved, cost, end = _read_world(model.step(point, name, noise), len(grid.axes), shape)

    def refuse(broken: BoolArray, words: str) -> None:
        """Raise :class:`ModelError` for the first point at which ``broken`` is True."""
        if broken.any():
            first = tuple(np.argwhere(np.broadcast_to(broken, shape))[0])
            begin, there = (
                [float(np.broadcast_to(values, shape)[first]) for values in coordinates]
                for coordinates in (point, moved)
            )
            raise ModelError(f"action {name!r} leads from {begin} {words.format(there)}")

    last = 1 + len(model.dead_ends)
    if end.min(initial=0) < 0 or end.max(initial=0) > last:
        refuse((end < 0) | (end > last), f"to an end outside 0 .. {last}")
    refuse(~(np.isfinite(cost) & (cost >= 0.0)), "to a cost that is negative or not finite")
    heights = grid.heights(moved)
    missed = grid.misses(heights)
    if missed.any():  # outside the box a step fails, or is an error
        lost = missed & (end == 0)
        for number, values in enumerate(moved):
            refuse(np.isnan(values) & (end == 0), f"to NaN as coordinate {number}")
        if model.outside is None:
            remedy = "return an end there, or name a dead-end outside=..."
            refuse(lost, f"to {{}}, outside {grid}: {remedy}")
        else:
            failed = model.end_state(model.outside) - grid.n_cells + 1
            end = np.where(lost, np.int64(failed), end)
        axes = zip(grid.axes, heights, strict=True)
        heights = tuple(np.where(axis.misses(h), 0.0, h) for axis, h in axes)
    return _Taken(moved, heights, cost, end)


def _read_world(
    answer: Any, n_axes: int, shape: tuple[int, ...]
) -> tuple[Coordinates, FloatArray, IntArray]:
    """Return the checked coordinates, cost and end in the answer of a step function."""
    if not isinstance(answer, tuple) or len(answer) != 3:
        raise ModelError(f"step() must return (new point, cost, end), not {type(answer).__name__}")
    moved, paid, ended = answer
    listed = isinstance(moved, Sequence) or (isinstance(moved, np.ndarray) and moved.ndim > 0)
    count = len(moved) if listed else "no"
    if count != n_axes:
        raise ModelError(f"step() returned {count} coordinates; there are {n_axes} axes")
    coordinates = tuple(
        _shaped_answer(c, shape, f"coordinate {number}").astype(np.float64, copy=False)
        for number, c in enumerate(moved)
    )
    cost = _shaped_answer(paid, shape, "the cost").astype(np.float64, copy=False)
    end = _shaped_answer(ended, shape, "the end")
    if end.dtype.kind not in "biu":
        raise ModelError("step(): ends are whole numbers: 0 (goes on), 1 (goal), >= 2 (dead-end)")
    return coordinates, cost, end


def _shaped_answer(answer: npt.ArrayLike, shape: tuple[int, ...], what: str) -> npt.NDArray[Any]:
    """Check a result of a step function and return it as an array that broadcasts to ``shape``.

    The array has as many dimensions as ``shape``; ``what`` names the result in errors.
    """
    array = np.asarray(answer)
    array = array.reshape((1,) * (len(shape) - array.ndim) + array.shape)
    fits = array.ndim == len(shape) and all(
        n in (1, m) for n, m in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in "biuf":
        raise ModelError(
            f"step() returned {what} of shape {np.shape(answer)} and type {array.dtype}; it must "
            f"be real numbers that broadcast to {shape}, the shape of all points"
        )
    return array


@explained_class
@dataclass(frozen=True, eq=False)
class WorldSimulator:
    """Simulator of the continuous world: ``simulate(..., simulator=WorldSimulator(...))``.

    Episodes are played by the step function, not in the discretised model. So the confidence
    interval of the goal probability that ``simulate`` returns holds in the continuous world. The
    interval is exact for every number of episodes (Clopper and Pearson). An episode in which the
    policy gives up ends as a failure.

    Attributes:
        world: the continuous model.
        start: for each axis a number, or a distribution.
    """

    world: ContinuousModel
    start: Sequence[float | Distribution]

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for a wrong type, or unless each axis has a start value."""
        check_fields(self)
        axes = self.world.grid.axes
        if len(self.start) != len(axes):
            raise ModelError(f"start needs {len(axes)} coordinates, not {len(self.start)}")

    def check_model(self, model: SSP) -> None:
        """Raise :class:`ModelError` if model and world have different numbers of states."""
        if model.n_states != self.world.n_states:
            raise ModelError(
                f"the simulator's world has {self.world.n_states:,} states, the policy's model "
                f"{model.n_states:,}: pass the world of which the model was made"
            )

    def reset(self, episodes: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
        """Draw the starts of episodes: coordinates, [episodes, axes], and their cells, [episodes].

        Raises:
            ModelError: a start outside the box.
        """
        levels = rng.random((episodes, len(self.start)))
        columns = [
            first.at(levels[:, k])
            if isinstance(first, Distribution)
            else np.full(episodes, float(first))
            for k, first in enumerate(self.start)
        ]
        world = np.stack(columns, axis=1)
        return world, self.world.grid.cell_of(world)

    def step(self, world: FloatArray, pair: IntArray, rng: np.random.Generator) -> Moved:
        """Take a step from coordinates, [k, axes], by pairs, [k].

        Returns:
            The new coordinates, [k, axes] (on a periodic axis moved into the box by whole
            periods); the states of the discretised model, [k]; and the costs, [k].
        """
        model, grid = self.world, self.world.grid
        levels = rng.random((len(pair), len(model.noise)))
        noise = [draw.at(levels[:, k]) for k, draw in enumerate(model.noise)]
        pairs = model.allowed_pairs
        action = np.asarray(pair if pairs is None else pairs[pair]) % len(model.actions)
        after, paid = np.empty_like(world), np.empty(len(pair))
        state = np.empty(len(pair), dtype=np.int64)
        for number in np.unique(action):
            some = np.flatnonzero(action == number)
            point = tuple(world[some].T)
            drawn = tuple(values[some] for values in noise)
            taken = take_step_in_world(model, point, int(number), drawn, (len(some),))
            for k, (axis, values) in enumerate(zip(grid.axes, taken.point, strict=True)):
                after[some, k] = axis.wrapped(values)
            ended = grid.n_cells - 1 + taken.end.astype(np.int64)
            cells = grid.numbers_about(taken.heights, split=False)[0]
            state[some] = np.where(taken.end != 0, ended, cells)
            paid[some] = taken.cost
        return after, state, paid
