"""Named rows of a program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray

_ROUNDING = 1e-9  # of the greatest coefficient: a solver's tolerance


@dataclass(frozen=True, eq=False)
class ProgramRow:
    """``<coefficients, x> <= bound``: a quantity of the visits and how much of it is allowed."""

    name: str
    coefficients: FloatArray  # [pairs]
    bound: float
    told: str = ""  # what is bounded, in words; empty: the name

    @property
    def words(self) -> str:
        """What is bounded, in words."""
        return self.told or self.name

    @property
    def largest(self) -> float:
        """The size of the greatest coefficient."""
        return float(np.abs(self.coefficients).max(initial=0.0))

    @property
    def scale(self) -> float:
        """The size of the row's numbers: of the bound, or of the greatest coefficient."""
        return max(abs(self.bound), self.largest)

    def violation(self, activity: float) -> float:
        """By how much an activity exceeds the bound, relative to that; 0 where it does not.

        What is nothing beside the coefficients is excused.
        """
        excused = _ROUNDING * self.largest
        left = max(activity - self.bound - excused, 0.0)
        return left / max(abs(self.bound), excused, 1e-300) if left else 0.0
