"""The end of the time that a solver was given, looked at inside its loops."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ssp_lp.errors import SolverError

_GRACE = 0.5
"""Seconds beyond the deadline for which a loop goes on: what small models need is soon done."""


class OutOfTimeError(SolverError):
    """The time limit passed inside a loop; whoever has an answer by then gives that."""


@dataclass(frozen=True)
class Deadline:
    """A point in time after which loops stop."""

    at: float = float("inf")  # on the clock of time.perf_counter

    def check(self) -> None:
        """Stop the loop that asks, if it is time.

        Raises:
            OutOfTimeError: the deadline has passed, with its grace.
        """
        if time.perf_counter() > self.at + _GRACE:
            raise OutOfTimeError("the time limit ended before an answer was found: allow more time")


NEVER = Deadline()
