"""Refinement: solve on finer and finer processes until the gap meets the tolerance.

A process that truncates, rounds or compares too coarsely leaves a gap. Each method yields its
attempts on finer processes; :func:`refine` decides when to stop.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from ssp_lp.column_generation.column import two_sided_gap
from ssp_lp.compiled.deadline import Stop, WithIncumbent, is_late
from ssp_lp.errors import ModelError


@dataclass(frozen=True)
class Proved:
    """A proved bound of all policies within the allowed failure, and the value of one policy."""

    attained: float
    bound: float
    allowed: float  # largest failure of the policies that the bound is about
    reason: str = ""  # why there is no proof
    tail: float = 0.0  # case S: the part of the relative gap that is due to the cap
    least_failure_bound: float | None = None  # with least failure: lower bound of all failures

    @property
    def gap(self) -> float:
        """Relative gap between the value and the bound."""
        return two_sided_gap(self.attained, self.bound)


class _WithGap(Protocol):
    """An answer or a proof from one process."""

    @property
    def gap(self) -> float:
        """Relative gap between value and bound."""
        ...


_Attempt = TypeVar("_Attempt", bound=_WithGap)


def refine(attempts: Iterable[_Attempt], tolerance: float) -> _Attempt:
    """Return the attempt of least gap, from attempts on finer and finer processes.

    It stops when the gap meets the tolerance, the attempts end, or the time limit is reached.

    Args:
        attempts: each from a finer process; they end if refining would not help, or with a
            ModelError if a table would be too large.
        tolerance: relative gap.

    Raises:
        Stop: the time limit was reached before the first attempt ended.
    """
    best: _Attempt | None = None
    with WithIncumbent() as search:
        try:
            for attempt in attempts:
                if best is None or attempt.gap <= best.gap:
                    best = attempt
                if best.gap <= tolerance or is_late():
                    break
        except ModelError:
            if best is None:
                raise
    if best is None:
        raise search.stop or Stop
    return best
