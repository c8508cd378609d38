"""Blocks of pairs and of consecutive states of a model, as flat arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, IntArray, entries_of, offsets_of
from ssp_lp.errors import ModelError, in_short


class StateRows(NamedTuple):
    """Pairs and outcomes of some consecutive states, in their order, as arrays."""

    actions: npt.ArrayLike  # [some states] number of pairs of each
    outcomes: npt.ArrayLike  # [their pairs] number of outcomes of each
    successors: npt.ArrayLike  # [their outcomes] numbers of states
    probabilities: npt.ArrayLike  # [their outcomes]
    costs: npt.ArrayLike  # one number for all, or [their pairs], or [their outcomes]
    named_costs: Mapping[str, npt.ArrayLike] = {}  # further costs by name, each as ``costs``


class Outcomes(NamedTuple):
    """The outcomes of some pairs, in their order, as checked arrays."""

    lengths: IntArray  # [pairs] number of outcomes of each
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # one number for all, or [outcomes], or [outcomes, costs]

    def rows(self, positions: IntArray) -> Outcomes:
        """Return the outcomes of the pairs at some positions, in the order of the positions."""
        places, lengths = entries_of(offsets_of(self.lengths), positions)
        costs = self.costs[places] if self.costs.ndim else self.costs
        return Outcomes(lengths, self.successors[places], self.probabilities[places], costs)


def joined_outcomes(parts: Sequence[Outcomes]) -> Outcomes:
    """Concatenate outcomes of several blocks of pairs; costs that are all equal stay one number."""
    costs = [rows.costs for rows in parts] or [np.asarray(0.0)]
    if any(each.ndim or each != costs[0] for each in costs):
        shapes = (rows.successors.shape for rows in parts)
        costs = [c if c.ndim else np.broadcast_to(c, n) for c, n in zip(costs, shapes, strict=True)]
    paid = np.concatenate(costs) if costs[0].ndim else costs[0]
    empty = Outcomes(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0), paid)
    *arrays, _ = zip(empty, *parts, strict=True)
    lengths, successors, chances = map(np.concatenate, arrays)
    return Outcomes(lengths, successors, chances, paid)


Rows = Callable[[int, int], StateRows]
"""Function that returns the rows of the states first .. end - 1."""


def checked_rows(rows: Rows, first: int, end: int) -> StateRows:
    """Return the rows of some states as arrays of checked types and lengths.

    Raises:
        ModelError: an array has another type or length; the error names the call and the array.
    """
    made, call = rows(first, end), f"rows({first}, {end})"
    if not isinstance(made, StateRows):
        raise ModelError(f"{call} must be StateRows, not {in_short(made)}")
    size, arrays = end - first, dict[str, Any]()
    of = "state", "pair", "outcome", "outcome"
    for name, numbers, each in zip(made._fields, made, of, strict=False):
        part = np.asarray(numbers)
        part = part if part.size else part.astype(np.int64)
        is_number = part.dtype.kind in ("iuf" if name == "probabilities" else "iu")
        if not is_number or part.shape != (size,) or (len(arrays) < 2 and (part < 0).any()):
            raise ModelError(f"{call}: {name} must be {size} numbers, one for each {each}, not "
                             f"{in_short(part)} of {part.dtype}")  # fmt: skip
        arrays[name], size = part, int(part.sum()) if len(arrays) < 2 else size
    return made._replace(**arrays)
