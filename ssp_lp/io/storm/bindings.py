"""Storm's Python bindings, imported where they are first asked for, and what Storm refuses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ssp_lp.errors import ModelError, optional_module

_OF_OUTCOMES = "Transition rewards are not supported"
_AVERAGED = (
    " (The cost differs between outcomes of one action, which Storm could only average: give each "
    "outcome that costs more a step of its own.)"
)


def storm() -> Any:
    """The module ``stormpy``.

    Raises:
        MissingDependencyError: it is not installed.
    """
    return optional_module("stormpy", "storm")


def ask_storm(source: object, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Ask Storm for something.

    Args:
        source: what it is about, a file perhaps, for the error.
        call: a function of stormpy.
        arguments: of the function.
        options: of the function, by name.

    Raises:
        ModelError: Storm refuses; the message says why in Storm's words.
    """
    try:
        with _quiet_storm():
            return call(*arguments, **options)
    except ModelError:
        raise
    except (*_REFUSALS, storm().exceptions.StormError) as error:
        hint = _AVERAGED if _OF_OUTCOMES in str(error) else ""
        raise ModelError(f"{source}: Storm refuses it: {error}{hint}") from error


_REFUSALS = (RuntimeError, ValueError, IndexError, TypeError, OverflowError, MemoryError)
"""Errors of Storm arrive as errors of Python's own classes, too."""


@contextmanager
def _quiet_storm() -> Iterator[None]:
    """Storm's log off: it goes to standard output, and errors arrive as exceptions as well."""
    log = storm().developer
    level = log.get_log_level()
    log.set_log_level(log.LogLevel.OFF)
    try:
        yield
    finally:
        log.set_log_level(level)
