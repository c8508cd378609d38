"""Refinement: attempts at finer and finer processes, until the gap meets the tolerance.

A process that truncates, rounds or compares too coarsely leaves a gap. What to refine next is each
method's own: it hands in its attempts one by one. When to end is decided here, for all of them.
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
    """A bound of every policy that counts, beside what one of them attains."""

    attained: float
    bound: float
    allowed: float  # the failure with which a policy counts
    reason: str = ""  # why nothing is proved
    tail: float = 0.0  # case S: the part of the relative gap that a cap leaves
    least_failure_bound: float | None = None  # at least failure: of the failure of every policy

    @property
    def gap(self) -> float:
        """Relative gap between a value and the bound that is proved."""
        return two_sided_gap(self.attained, self.bound)


class _WithGap(Protocol):
    """An answer, or a proof, as far as one process gives it."""

    @property
    def gap(self) -> float:
        """Relative gap between what is attained and what is proved."""
        ...


_Attempt = TypeVar("_Attempt", bound=_WithGap)


def refine(attempts: Iterable[_Attempt], tolerance: float) -> _Attempt:
    """The attempt of least gap, once that meets the tolerance, none is finer, or time is up.

    Args:
        attempts: each by a finer process; they end where refining would not help, or with a
            ModelError where a table would be too large.
        tolerance: relative gap.

    Raises:
        Stop: the time ended before the first of them.
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
