"""Whether inner loops run compiled by numba (extra ``fast``) or as numpy expressions.

Every compiled loop has a numpy twin of the same shape; results agree to rounding. The modules of
``ssp_lp.compiled`` import numba and are imported only when a loop is long enough to be worth it.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from typing import Final

from ssp_lp.errors import ModelError

SWITCH: Final = "SSP_LP_ACCELERATOR"
"""Environment variable: "numba", "none", or unset: numba where it is installed."""

_WORTH_COMPILING: Final = 100_000
"""Entries below which loading compiled code costs more than it saves."""


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
    return entries >= _WORTH_COMPILING and has_accelerator()
