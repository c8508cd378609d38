"""Named rows of a program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ssp_lp.arrays import FloatArray

_ROUNDING = 1e-9  # of the greatest coefficient: a solver's tolerance

Sense = Literal["<=", ">=", "=="]


@dataclass(frozen=True, eq=False)
class Constraint:
    """A named row: a quantity of the visits and its bound."""

    name: str
    coefficients: FloatArray  # [pairs]
    sense: Sense
    bound: float

    @property
    def sign(self) -> float:
        """-1 where more is asked for, else 1."""
        return -1.0 if self.sense == ">=" else 1.0

    @property
    def scale(self) -> float:
        """The size of its numbers: of the bound, or of the greatest coefficient."""
        return max(abs(self.bound), float(np.abs(self.coefficients).max(initial=0.0)))

    def violation(self, activity: float) -> float:
        """By how much an activity breaks the row; 0 where it does not."""
        over = activity - self.bound
        excess = {"<=": over, ">=": -over, "==": abs(over)}[self.sense]
        return max(excess, 0.0)

    def relative_violation(self, activity: float) -> float:
        """The same relative to the bound; excused where it is nothing beside the coefficients."""
        excused = _ROUNDING * float(np.abs(self.coefficients).max(initial=0.0))
        left = max(self.violation(activity) - excused, 0.0)
        return left / max(abs(self.bound), excused, 1e-300) if left else 0.0
