"""How loops are compiled: each by itself when it is worth it; twice where all cores may help."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from types import FunctionType
from typing import Any, Final

from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache

from ssp_lp.compiled.accelerator import NotCompiledError, accelerated, may_compile

many_entries: Final = ContextVar("many_entries", default=1_000_000)
"""Entries, a millisecond of one core, from which waking idle cores pays."""

_OTHERS = 1.0
"""Load beyond the cores from which none is idle: where others keep both of two cores busy, all wait
for the last of two threads, and the robot in case S takes three times as long as on one."""

_HALVED: Final = 20
"""Entries that a second core saves as long for as numpy takes for one."""

Loop = Callable[..., Any]


class _Cache(FunctionCache):
    """Numba's cache of a loop, in which files that cannot be read count as missing."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled loop for these types; None: it has to be compiled."""
        with suppress(Exception):
            return super().load_overload(sig, target_context)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled loop, in place of a damaged index if need be, or only in this process."""
        try:
            super().save_overload(sig, data)
        except Exception:  # of whatever kind, as a damaged file may raise any
            with suppress(Exception):
                self.flush()
                super().save_overload(sig, data)


class _Permission(event.Listener):
    """Asks before numba compiles a loop of this package; loops within it come with it."""

    depth = 0

    def on_start(self, event: Any) -> None:
        """Numba's cache has no such loop for these types.

        Raises:
            NotCompiledError: it must not be compiled now.
        """
        self.depth += 1
        function = event.data["dispatcher"].py_func
        package, _, module = function.__module__.rpartition(".")
        name = f"{module}.{function.__qualname__}"
        if self.depth == 1 and package == __package__ and not may_compile(name):
            raise NotCompiledError(name)

    def on_end(self, event: Any) -> None:
        """The loop is compiled, or was refused."""
        self.depth -= 1


event.register("numba:compile", _Permission())


def compiled_loop(function: Any = None, **options: Any) -> Any:
    """Compile a loop at its first call, or load it from numba's cache where there is one.

    Args:
        function: the loop.
        options: numba's.
    """
    if function is None:
        return lambda function: compiled_loop(function, **options)
    dispatcher = njit(**options)(function)
    with suppress(RuntimeError):  # no folder of the cache can be written: compiled in each process
        dispatcher._cache = _Cache(function)
    return dispatcher


def one_or_all_cores(function: Any) -> Callable[[int], Loop]:
    """Compile a loop over ``prange`` for one core and for all.

    Returns:
        A function of the number of entries that says which of both to run.
    """
    copy = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_everywhere")
    copy.__qualname__ = copy.__name__  # numba caches by this name
    single: Loop = compiled_loop(function)
    everywhere: Loop = compiled_loop(copy, parallel=True)
    name = f"{function.__module__.rpartition('.')[2]}.{copy.__qualname__}"

    def loop(entries: int) -> Loop:
        """The loop for so many entries."""
        least = many_entries.get()
        if least > 0 and (entries < least or not _has_idle_cores()):
            return single
        return everywhere if least == 0 or accelerated(entries // _HALVED, name) else single

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
