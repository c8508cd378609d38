"""One loop, compiled twice: for one core, and for all of them where the work is worth the start."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FunctionType
from typing import Any, Final

from numba import njit

many_entries: Final = ContextVar("many_entries", default=1_000_000)
"""Entries, a millisecond of one core, from which waking idle cores pays."""

_OTHERS = 1.0
"""Load beyond the cores from which none is idle: where others keep both of two cores busy, all wait
for the last of two threads, and the robot in case S takes three times as long as on one."""

Loop = Callable[..., Any]


def one_or_all_cores(function: Any) -> Callable[[int], Loop]:
    """Compile a loop over ``prange`` for one core and for all.

    Returns:
        A function of the number of entries that says which of both to run.
    """
    copy = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_everywhere")
    copy.__qualname__ = copy.__name__  # numba caches by this name
    single, everywhere = njit(cache=True)(function), njit(parallel=True, cache=True)(copy)

    def loop(entries: int) -> Loop:
        """The loop for so many entries."""
        least = many_entries.get()
        return everywhere if entries >= least and (least == 0 or _has_idle_cores()) else single

    return loop


def _has_idle_cores() -> bool:
    """Whether the machine's load of the last minute leaves cores to loops on all of them."""
    if not hasattr(os, "getloadavg"):
        return True
    return os.getloadavg()[0] < (os.cpu_count() or 1) + _OTHERS


@contextmanager
def on_all_cores() -> Iterator[None]:
    """Context in which short loops too run on all cores: to compile what long ones will need."""
    before = many_entries.set(0)
    try:
        yield
    finally:
        many_entries.reset(before)
