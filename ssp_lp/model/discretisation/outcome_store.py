"""The outcomes of pairs in turn, collected piece by piece in arrays that grow where they stand."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges
from ssp_lp.model.discretisation.tally import Rows

_ROOM: Final = 1 << 16  # outcomes
_GROWTH: Final = 8  # by an eighth: large arrays grow without being copied


class Outcomes(NamedTuple):
    """The arrays of a model's outcomes."""

    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes], or [] for one number

    def rows(self, wanted: IntArray) -> Rows:
        """The rows of these numbers, one after the other."""
        begins = self.outcome_offsets[wanted]
        lengths = self.outcome_offsets[wanted + 1] - begins
        places = concatenated_ranges(begins, lengths)
        costs = self.costs[places] if self.costs.ndim else self.costs
        return Rows(lengths, self.successors[places], self.probabilities[places], costs)


class OutcomeStore:
    """A growing list of rows; their costs are one number as long as they are all the same."""

    def __init__(self, room: int = _ROOM) -> None:
        """Begin without rows, with room for some outcomes."""
        self._lengths: list[IntArray] = []
        self._size = 0
        self._successors = np.empty(room, dtype=np.int32)
        self._probabilities = np.empty(room)
        self._cost: FloatArray | None = None
        self._costs: FloatArray | None = None

    def append(self, rows: Rows) -> None:
        """Add the outcomes of more pairs."""
        begin, end = self._size, self._size + len(rows.successors)
        self._reserve(end)
        self._lengths.append(rows.lengths)
        self._successors[begin:end] = rows.successors
        self._probabilities[begin:end] = rows.probabilities
        if self._cost is None and rows.costs.ndim == 0:
            self._cost = rows.costs
        if self._costs is None and (rows.costs.ndim or rows.costs != self._cost):
            known = 0.0 if self._cost is None else self._cost
            self._costs = np.full(len(self._successors), known)
        if self._costs is not None:
            self._costs[begin:end] = rows.costs
        self._size = end

    def outcomes(self) -> Outcomes:
        """All of them; nothing can be added afterwards."""
        for array in self._grown():
            array.resize(self._size, refcheck=False)
        offsets = np.concatenate([[0], *self._lengths])
        np.cumsum(offsets, out=offsets)
        cost = np.asarray(0.0) if self._cost is None else self._cost
        costs = cost if self._costs is None else self._costs
        return Outcomes(offsets, self._successors, self._probabilities, costs)

    def _reserve(self, size: int) -> None:
        room = len(self._successors)
        if size > room:
            for array in self._grown():
                array.resize(max(size, room + room // _GROWTH), refcheck=False)

    def _grown(self) -> list[npt.NDArray[Any]]:
        arrays: list[npt.NDArray[Any]] = [self._successors, self._probabilities]
        return arrays if self._costs is None else [*arrays, self._costs]
