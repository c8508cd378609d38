"""Compilation of loops by numba, once this saves time, for one core or for all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from types import FunctionType
from typing import Any, Final

from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache

from ssp_lp.compiled.accelerator import NotCompiledError, accelerated, may_compile

many_entries: Final = ContextVar("many_entries", default=1_000_000)
"""Entries from which on all cores are used: a millisecond of one core."""

_OTHERS = 1.0
"""If the machine's load exceeds its number of cores by this, no core counts as idle. When other
processes keep both of two cores busy, a loop on two threads waits for the slower thread, and the
robot in case S takes three times as long as on one core."""

_HALVED: Final = 20
"""Number of entries with which a second core saves the time that numpy takes for one entry."""

Loop = Callable[..., Any]


class _Cache(FunctionCache):
    """Numba's cache of a loop, with unreadable files treated as missing."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled loop for these types; None if it must be compiled."""
        with suppress(Exception):
            return super().load_overload(sig, target_context)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled loop, replacing a damaged index; ignore further errors."""
        try:
            super().save_overload(sig, data)
        except Exception:  # a damaged file may raise any error
            with suppress(Exception):
                self.flush()
                super().save_overload(sig, data)


class _Permission(event.Listener):
    """Listener of numba's compiler that refuses to compile a loop too early."""

    depth = 0

    def on_start(self, event: Any) -> None:
        """Refuse to compile a loop of this package unless ``may_compile`` allows it.

        Raises:
            NotCompiledError: the loop must not be compiled now.
        """
        self.depth += 1
        function = event.data["dispatcher"].py_func
        package, _, module = function.__module__.rpartition(".")
        name = f"{module}.{function.__qualname__}"
        if self.depth == 1 and package == __package__ and not may_compile(name):
            raise NotCompiledError(name)

    def on_end(self, event: Any) -> None:
        """Count the end of a compilation, finished or refused; compilations may be nested."""
        self.depth -= 1


event.register("numba:compile", _Permission())


def compiled_loop(function: Any = None, **options: Any) -> Any:
    """Compile a loop at its first call, or load it from numba's cache.

    Args:
        function: the loop.
        options: options of numba.
    """
    if function is None:
        return partial(compiled_loop, **options)
    dispatcher = njit(**options)(function)
    with suppress(RuntimeError):  # without a writable cache each process compiles the loop
        dispatcher._cache = _Cache(function)
    return dispatcher


def one_or_all_cores(function: Any) -> Callable[[int], Loop]:
    """Compile a loop over ``prange`` in two versions: for one core, and for all cores.

    Returns:
        A function from the number of entries to the version to run.
    """
    copy = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_everywhere")
    copy.__qualname__ = copy.__name__  # numba caches by this name
    single: Loop = compiled_loop(function)
    everywhere: Loop = compiled_loop(copy, parallel=True)
    name = f"{function.__module__.rpartition('.')[2]}.{copy.__qualname__}"

    def loop(entries: int) -> Loop:
        least = many_entries.get()
        if least > 0 and (entries < least or not _has_idle_cores()):
            return single
        return everywhere if least == 0 or accelerated(entries // _HALVED, name) else single

    return loop


def _has_idle_cores() -> bool:
    """Return whether the machine's load of the last minute leaves idle cores."""
    with suppress(AttributeError):  # not on all platforms
        return os.getloadavg()[0] < (os.cpu_count() or 1) + _OTHERS
    return True


@contextmanager
def on_all_cores() -> Iterator[None]:
    """Return a context in which all loops, even short ones, use their version for all cores."""
    before = many_entries.set(0)
    try:
        yield
    finally:
        many_entries.reset(before)
