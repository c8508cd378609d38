"""A box of coordinates, some of which may wrap around, cut into a regular grid of cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model.arguments import check_fields, explained

ON_EDGE: Final = 1e-9
"""A coordinate this close to an edge, in widths of a cell, lies on it.

Rounding moves a coordinate by some 1e-16 of its size, so that a point which lies on an edge in
exact arithmetic is treated alike on every machine.
"""

MOST_STATES: Final = 2**31 - 1
"""Successors are kept as 32-bit integers."""

Coordinates = tuple[FloatArray, ...]
"""One array for each axis; they broadcast against each other."""


@dataclass(frozen=True)
class Axis:
    """One coordinate: the interval from low to high in equal cells, numbered upwards from 0.

    A point between two cells belongs to the upper one. On a periodic axis, such as an angle, low
    and high are the same point and every number lies in some cell; to centre the cells of a heading
    on multiples of their width, begin half a width below 0. ``split_edges``: a point of a
    quadrature that lies between two cells counts half in each, which keeps mirrored motions alike.
    """

    low: float
    high: float
    cells: int
    periodic: bool = False
    split_edges: bool = False

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` for an empty or infinite interval, or without cells."""
        if not isinstance(self.cells, (int, np.integer)) or not 1 <= self.cells < 2**31:
            told = in_short(self.cells)
            raise ModelError(f"an axis needs a whole number of cells >= 1, not {told}")
        check_fields(self)
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ModelError(f"an axis must run from low to a greater high: {self!r}")

    @property
    def width(self) -> float:
        """The width of a cell."""
        return (self.high - self.low) / self.cells

    def in_cells(self, values: FloatArray) -> FloatArray:
        """How many widths of a cell each value lies above the low end."""
        return np.asarray((values - self.low) * (self.cells / (self.high - self.low)))

    def misses(self, heights: FloatArray) -> BoolArray:
        """Which of the heights, in widths of a cell, are off the axis, or no numbers."""
        if self.periodic:
            return ~np.isfinite(heights)
        return ~((heights >= -ON_EDGE) & (heights <= self.cells + ON_EDGE))

    def above(self, heights: FloatArray) -> IntArray:
        """The cell at each height on the axis, the upper one on an edge."""
        return self._numbered(np.floor(heights + ON_EDGE))

    def below(self, heights: FloatArray) -> IntArray:
        """The cell at each height on the axis, the lower one on an edge."""
        return self._numbered(np.ceil(heights - ON_EDGE) - 1.0)

    def wrapped(self, values: FloatArray) -> FloatArray:
        """Values of a periodic axis within low and high; others as they are."""
        if not self.periodic:
            return values
        return self.low + np.mod(values - self.low, self.high - self.low)

    def _numbered(self, cells: FloatArray) -> IntArray:
        """Numbers of cells on the grid's axis, kept within it."""
        if self.periodic:
            inside = cells - self.cells * np.floor(cells / self.cells)
        else:
            inside = np.clip(cells, 0, self.cells - 1)
        return np.asarray(inside, dtype=np.int32)


@dataclass(frozen=True)
class Grid:
    """The cells of a box, numbered with the first axis slowest and the last one fastest."""

    axes: tuple[Axis, ...]

    @explained
    def __init__(self, axes: Sequence[Axis]) -> None:
        """Take the axes in the order of the coordinates.

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
        """Cells along each axis."""
        return tuple(int(axis.cells) for axis in self.axes)

    @property
    def n_cells(self) -> int:
        """How many cells there are."""
        return math.prod(self.shape)

    @cached_property
    def strides(self) -> tuple[int, ...]:
        """By how much the number of a cell grows along each axis."""
        return tuple(math.prod(self.shape[k + 1 :]) for k in range(len(self.axes)))

    @explained
    def index_of(self, cells: npt.ArrayLike) -> tuple[IntArray, ...]:
        """Position of each cell along each axis; raises :class:`ModelError` if there is none."""
        rest = np.asarray(cells)
        if rest.dtype.kind not in "iu" or (rest < 0).any() or (rest >= self.n_cells).any():
            raise ModelError(f"cells are whole numbers, 0 .. {self.n_cells - 1}")
        positions = []
        for stride in self.strides:
            along = rest // stride
            positions.append(along)
            rest = rest - along * stride
        return tuple(positions)

    @explained
    def centre(self, cells: npt.ArrayLike) -> FloatArray:
        """Midpoints of cells: numbers of any shape -> [..., axes]."""
        index = zip(self.axes, self.index_of(cells), strict=True)
        return np.stack([axis.low + (k + 0.5) * axis.width for axis, k in index], axis=-1)

    @explained
    def cell_of(self, points: npt.ArrayLike) -> Any:
        """The cell that each point lies in: [..., axes] -> numbers, an int for a single point.

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
        cells = self.number(heights).astype(np.int64)
        return int(cells) if cells.ndim == 0 else cells

    def heights(self, coordinates: Coordinates) -> Coordinates:
        """Coordinates in widths of a cell above the low ends."""
        pairs = zip(self.axes, coordinates, strict=True)
        return tuple(axis.in_cells(values) for axis, values in pairs)

    def misses(self, heights: Coordinates) -> BoolArray:
        """Which points lie outside the box, broadcast over those axes that any of them misses."""
        missed: BoolArray = np.zeros((), dtype=np.bool_)
        for axis, values in zip(self.axes, heights, strict=True):
            off = axis.misses(values)
            if off.any():
                missed = missed | off
        return missed

    def number(self, heights: Coordinates) -> IntArray:
        """The cell of each point inside, the upper one on edges; broadcast over all axes."""
        return self.numbers_about(heights, split=False)[0]

    def numbers_about(self, heights: Coordinates, *, split: bool = True) -> list[IntArray]:
        """The cells that each point counts in, with equal shares: one array, or 2, 4, ...

        Several only where a point lies on an edge of an axis that splits them.
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
        """The box, interval by interval."""
        return "the box " + " x ".join(
            f"[{axis.low:g}, {axis.high:g}{')' if axis.periodic else ']'}" for axis in self.axes
        )
