"""One loop, compiled twice: for one core, and for all of them where the work is worth the start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FunctionType
from typing import Any, Final

from numba import njit

many_entries: Final = ContextVar("many_entries", default=1_000_000)
"""Entries, a millisecond of one core, from which waking idle cores pays: with both of two cores
busy otherwise, loops of a million take a third longer, which from ten millions on is not seen."""

Loop = Callable[..., Any]


def one_or_all_cores(function: Any) -> Callable[[int], Loop]:
    """Compile a loop over ``prange`` for one core and for all.

    Returns:
        A function of the number of entries that says which of both to run.
    """
    copy = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_everywhere")
    copy.__qualname__ = copy.__name__  # numba caches by this name
    single, everywhere = njit(cache=True)(function), njit(parallel=True, cache=True)(copy)
    return lambda entries: everywhere if entries >= many_entries.get() else single


@contextmanager
def on_all_cores() -> Iterator[None]:
    """Context in which short loops too run on all cores: to compile what long ones will need."""
    before = many_entries.set(0)
    try:
        yield
    finally:
        many_entries.reset(before)
