"""The totals at which a law of costs can have its quantile, numbered in increasing order."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.processes.totals.step_sums import MOST_SUMS, last_steps, room_of, step_lattice, sums_in


@dataclass(frozen=True)
class ThresholdMultiples:
    """Multiples of a unit: of all costs, or, not sharp, of a grid."""

    unit: Fraction
    sharp: bool = True  # no total can occur between two of them

    def total(self, number: int) -> float:
        """The total of a number, as the nearest float."""
        return float(number * self.unit)

    def number(self, total: float) -> int:
        """The number of the multiple nearest to a total."""
        return round(total / float(self.unit))


class ThresholdSums:
    """Sums of steps of which the last one leads into the goal. Mutable: they are found as needed.

    Raises:
        ModelError: more of them are needed than are told apart.
    """

    sharp = True

    def __init__(self, model: SSP) -> None:
        self._model = model
        self._steps, self._last = step_lattice(model)[1], last_steps(model)[1]
        self._cap = 4.0 * float(max(self._steps[-1], self._last[-1])) or 1.0
        self._totals = self._found()

    def total(self, number: int) -> float:
        """The total of a number; the greatest one where there are no more."""
        while number >= len(self._totals):
            before, self._cap = len(self._totals), 2.0 * self._cap
            self._totals = self._found()
            if len(self._totals) == before:
                break
        return float(self._totals[min(number, len(self._totals) - 1)])

    def number(self, total: float) -> int:
        """The number of the nearest total."""
        while self._cap <= total * (1.0 + 1e-9):
            self._cap *= 2.0
            self._totals = self._found()
        above = int(np.searchsorted(self._totals, total))
        if above == 0:
            return 0
        if above == len(self._totals):
            return above - 1
        nearer_below = total - self._totals[above - 1] <= self._totals[above] - total
        return above - 1 if nearer_below else above

    def _found(self) -> FloatArray:
        """All sums up to the cap that a threshold may be."""
        sums = sums_in(self._model, self._cap, MOST_SUMS)
        if sums is None:
            raise ModelError(f"more than {MOST_SUMS:,} sums of costs lie below {self._cap:g}")
        every = np.unique((sums[:, None] + self._last).ravel())
        every = every[every < self._cap]
        room = room_of(np.union1d(self._steps, self._last), self._cap)
        return np.asarray(every[np.diff(every, prepend=-np.inf) > room])


Thresholds = ThresholdMultiples | ThresholdSums
"""Totals, each with its number, 0, 1, ..."""
