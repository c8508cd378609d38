"""Whether inner loops run compiled by numba (extra ``fast``) or as numpy expressions.

Every compiled loop has a numpy twin of the same shape; results agree to rounding. The modules of
``ssp_lp.compiled`` import numba and are imported only when a loop is long enough to be worth it.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from functools import cache
from pathlib import Path
from typing import Final

from ssp_lp.errors import ModelError

SWITCH: Final = "SSP_LP_ACCELERATOR"
"""Environment variable: "numba", "none", or unset: numba where it is installed."""

_LOADED: Final = 10_000
"""Entries of a loop that is worth running compiled where compiled loops have been loaded."""

_CACHED: Final = 60_000
"""Entries that are worth loading compiled loops from numba's cache, which takes about a second."""

_COLD: Final = 1_500_000
"""Entries that are worth compiling loops for the first time, which takes some ten seconds."""

_INDEX: Final = "**/bellman.back_up*.nbi"  # numba's index of the loop that every solve needs


@cache
def has_accelerator() -> bool:
    """Whether compiled loops are available and not switched off.

    Raises:
        ModelError: the environment variable holds another word.
    """
    wish = os.environ.get(SWITCH, "")
    if wish not in ("", "numba", "none"):
        raise ModelError(f"{SWITCH} must be 'numba' or 'none', not {wish!r}")
    return wish != "none" and importlib.util.find_spec("numba") is not None


def accelerated(entries: int) -> bool:
    """Whether a loop over so many entries is to run compiled."""
    return entries >= least_entries() and has_accelerator()


def least_entries() -> int:
    """Entries from which a loop is run compiled, the start of compiled code counted."""
    if not _is_compiled_before():
        return _COLD
    return _LOADED if "ssp_lp.compiled.loops" in sys.modules else _CACHED


@cache
def _is_compiled_before() -> bool:
    """Whether numba's cache holds the compiled loops of this version of the library."""
    sources = Path(__file__).parent / "compiled"
    changed = (sources / "bellman.py").stat().st_mtime
    wished = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(wished)] if wished else [sources / "__pycache__", Path.home() / ".cache/numba"]
    found = (index for place in places for index in place.glob(_INDEX))
    return any(index.stat().st_mtime >= changed for index in found)
