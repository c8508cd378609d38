"""Named rows of a program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ssp_lp.arrays import FloatArray

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

    def violation(self, activity: float) -> float:
        """By how much an activity breaks the row; 0 where it does not."""
        over = activity - self.bound
        excess = {"<=": over, ">=": -over, "==": abs(over)}[self.sense]
        return max(excess, 0.0)
