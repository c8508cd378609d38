"""Whether inner loops run compiled by numba (extra ``fast``) or as numpy expressions.

Every compiled loop has a numpy twin of the same shape; results agree to rounding. The modules of
``ssp_lp.compiled`` import numba and are imported only when a loop is long enough to be worth it.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final

from ssp_lp.compiled.deadline import seconds_left
from ssp_lp.errors import ModelError

SWITCH: Final = "SSP_LP_ACCELERATOR"
"""Environment variable: "none", "numba" (every loop is compiled, however short), or unset: long
loops are, where numba is installed."""

_CACHED: Final = 60_000
"""Entries of a loop that are worth loading compiled loops from numba's cache: about a second."""

_COLD: Final = 1_000_000
"""Entries of a loop that are worth compiling loops for the first time: some ten seconds, once.

A solve passes over them some hundred times, a second for each hundred million in numpy, and what
is compiled is kept for every later process.
"""

_COMPILING: Final = 20.0
"""Seconds that a call has left at least where loops are compiled for the first time in it."""

_CALL: Final = 3_000
"""Entries that take as long as the calls around a short loop of numpy expressions."""

_LOOPS: Final = 300
"""Loops as long as is worth loading, or compiling, for one: many short ones are worth it too."""

_INDEX: Final = "**/backups.back_up*.nbi"  # numba's index of the loop that every solve needs


def has_accelerator() -> bool:
    """Whether the accelerator, numba's compiled loops, is installed and not switched off.

    Raises:
        ModelError: the environment variable holds another word.
    """
    return not _interpreted.is_for_good and _load()


def give_up_compiling() -> None:
    """Go on in numpy until the process ends, as numba was left halfway."""
    _interpreted.is_for_good = True
    message = "numba was interrupted while it compiled: this process goes on without it"
    logging.getLogger("ssp_lp.compiling").info(message)


@cache
def _load() -> bool:
    """Load numba, once, unless it is missing or switched off.

    Ctrl-C waits for the second that loading takes: what is loaded by half would stay so, and every
    later loop of the process would fail ("module 'numba' has no attribute 'core'"). After any other
    exception from outside, such as an alarm of the caller's, numba is not used any more.
    """
    wish = os.environ.get(SWITCH, "")
    if wish not in ("", "numba", "none"):
        raise ModelError(f"{SWITCH} must be 'numba' or 'none', not {wish!r}")
    if wish == "none" or importlib.util.find_spec("numba") is None:
        return False
    try:
        with _interrupts_deferred():
            target = importlib.import_module("numba.core.registry").cpu_target
            target.typing_context.refresh()  # what the first loop would load besides
            target.target_context.refresh()
            importlib.import_module("ssp_lp.compiled.half_compiled")
    except Exception:
        give_up_compiling()
        raise
    return True


def accelerated(entries: int) -> bool:
    """Whether a loop over so many entries is to run compiled, by the accelerator.

    Once compiled loops are loaded every loop is: they cost less than a numpy expression. Before
    that, what short loops have taken adds up, as it does for a just-in-time compiler: a process
    that goes on solving small models loads them in the end, one that solves a few never does.
    """
    if entries >= least_entries():
        return has_accelerator() and _announces_compiling()
    _interpreted.entries += entries + _CALL
    return False


@cache
def _announces_compiling() -> bool:
    """Log, once, that the accelerator compiles its loops for the first time."""
    if not _is_compiled_before():
        message = "inner loops for the first time, some ten seconds for each kind of problem; kept"
        logging.getLogger("ssp_lp.compiling").info(message)
    return True


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """While the accelerator is loaded Ctrl-C waits; only the main thread is interrupted."""
    before, heard = signal.getsignal(signal.SIGINT), list[int]()
    if threading.current_thread() is not threading.main_thread() or before is None:
        yield
        return
    signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if heard:
            signal.raise_signal(signal.SIGINT)


def least_entries() -> int:
    """Entries from which a loop runs on the accelerator, the start of compiled code counted."""
    if os.environ.get(SWITCH) == "numba":
        return 0
    worth, is_loaded = _CACHED, "ssp_lp.compiled.cores" in sys.modules
    if not _is_compiled_before():
        if not is_loaded and seconds_left() < _COMPILING:
            return sys.maxsize
        worth, is_loaded = _COLD, False
    return 0 if is_loaded or _interpreted.entries > _LOOPS * worth else worth


class _Interpreted:
    """Entries that this process has passed over in numpy expressions; decides on speed only."""

    entries = 0
    is_for_good = False  # whether compiled loops must not be used any more


_interpreted: Final = _Interpreted()


@cache
def _is_compiled_before() -> bool:
    """Whether numba's cache holds the compiled loops of this version of the library."""
    sources = Path(__file__).parent
    changed = (sources / "backups.py").stat().st_mtime
    wished = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(wished)] if wished else [sources / "__pycache__", Path.home() / ".cache/numba"]
    indices = (index for place in places for index in place.glob(_INDEX))
    return any(index.stat().st_mtime >= changed for index in indices)
