"""How what is minimised on a process stands for what a problem asks."""

from __future__ import annotations

from dataclasses import dataclass

_ROUNDED = 4e-15  # of what a complement is taken from


@dataclass(frozen=True)
class Sense:
    """A minimum in place of a maximum, or of a quantity with negative weights on ends."""

    constant: float | None = None  # what is maximised is this, less what is minimised
    shift: float = 0.0  # what every episode is charged on top, so that no charge is negative
    offset: float = 0.0  # what is minimised is so much more than what is asked

    def worth(self, value: float) -> float:
        """The problem's objective where what is minimised has a value."""
        return value - self.offset if self.constant is None else self.constant - value

    def settled_bound(self, value: float, bound: float) -> float:
        """The bound, or the value where only the rounding of a complement parts them."""
        taken = self.offset if self.constant is None else self.constant
        return value if abs(value - bound) <= _ROUNDED * abs(taken) else bound
