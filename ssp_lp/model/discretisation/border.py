"""The border between a user's step function and the library: every answer is checked here."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model.discretisation.continuous_model import ContinuousModel
from ssp_lp.model.discretisation.grid import Coordinates


class Taken(NamedTuple):
    """What a step came to; every array has the points' dimensions and broadcasts to them."""

    point: Coordinates
    heights: Coordinates  # in widths of a cell above the low ends; 0 where that is off the axis
    cost: FloatArray
    end: IntArray  # 0 goes on, 1 goal, 2 .. dead-ends


def take_step(
    model: ContinuousModel,
    point: Coordinates,
    action: int,
    noise: Coordinates,
    shape: tuple[int, ...],
) -> Taken:
    """Take a step from many points.

    Args:
        model: the world.
        point: an array for each axis, of as many dimensions as ``shape`` and broadcasting to it.
        action: its position among the actions.
        noise: an array for each random number, likewise.
        shape: of all the points together.

    Raises:
        ModelError: the step function's answer is of a wrong form, or it leaves the box.
    """
    name = model.actions[action]
    coordinates, cost, end = _read(model.step(point, name, noise), len(model.grid.axes), shape)
    who = _Culprit(f"action {name!r}", point, shape)
    last = 1 + len(model.dead_ends)
    if end.min(initial=0) < 0 or end.max(initial=0) > last:
        who.refuse((end < 0) | (end > last), f"to an end outside 0 .. {last}")
    who.refuse(~(np.isfinite(cost) & (cost >= 0.0)), "to a cost that is negative or not finite")
    heights = model.grid.heights(coordinates)
    missed = model.grid.misses(heights)
    if missed.any():
        end = _stray(model, missed & (end == 0), coordinates, end, who)
        axes = zip(model.grid.axes, heights, strict=True)
        heights = tuple(np.where(axis.misses(h), 0.0, h) for axis, h in axes)
    return Taken(coordinates, heights, cost, end)


def _read(
    answer: Any, n_axes: int, shape: tuple[int, ...]
) -> tuple[Coordinates, FloatArray, IntArray]:
    """Coordinates, cost and end of an answer, each of the points' number of dimensions."""
    if not isinstance(answer, tuple) or len(answer) != 3:
        raise ModelError(f"step must return (new point, cost, end), not {type(answer).__name__}")
    moved, paid, ended = answer
    if len(moved) != n_axes:
        raise ModelError(f"step returned {len(moved)} coordinates; there are {n_axes} axes")
    coordinates = tuple(
        _shaped(c, shape, f"coordinate {number}").astype(np.float64, copy=False)
        for number, c in enumerate(moved)
    )
    cost = _shaped(paid, shape, "the cost").astype(np.float64, copy=False)
    end = _shaped(ended, shape, "the end")
    if end.dtype.kind not in "biu":
        raise ModelError("step must return ends as whole numbers: 0 goes on, 1 goal, 2 .. dead-end")
    return coordinates, cost, end


def _shaped(answer: npt.ArrayLike, shape: tuple[int, ...], what: str) -> npt.NDArray[Any]:
    """The answer as an array of the points' number of dimensions."""
    array = np.asarray(answer)
    array = array.reshape((1,) * (len(shape) - array.ndim) + array.shape)
    fits = array.ndim == len(shape) and all(
        n in (1, m) for n, m in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in "biuf":
        raise ModelError(
            f"step returned {what} of shape {np.shape(answer)} and type {array.dtype}; it must "
            f"be real numbers that broadcast to {shape}, the shape of all points"
        )
    return array


class _Culprit(NamedTuple):
    """Who is to blame for an answer that cannot be."""

    action: str
    point: Coordinates
    shape: tuple[int, ...]

    def refuse(self, broken: BoolArray, words: str, moved: Coordinates = ()) -> None:
        """Raise :class:`ModelError` for the first broken point, and say where it moved."""
        if not broken.any():
            return
        first = tuple(np.argwhere(np.broadcast_to(broken, self.shape))[0])
        begin, end = (
            [float(np.broadcast_to(values, self.shape)[first]) for values in coordinates]
            for coordinates in (self.point, moved)
        )
        raise ModelError(f"{self.action} leads from {begin} {words.format(end)}")


def _stray(
    model: ContinuousModel, lost: BoolArray, moved: Coordinates, end: IntArray, who: _Culprit
) -> IntArray:
    """Ends in which what goes on outside the box fails, or an error where there is none."""
    for number, values in enumerate(moved):
        who.refuse(np.isnan(values) & (end == 0), f"to NaN as coordinate {number}")
    if model.outside is None:
        remedy = "return an end there, or name a dead-end outside=..."
        who.refuse(lost, f"to {{}}, outside {model.grid}: {remedy}", moved)
        return end
    failed = model.end_state(model.outside) - model.grid.n_cells + 1
    return np.where(lost, np.int64(failed), end)
