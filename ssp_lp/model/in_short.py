"""A value as an argument in a short repr: no arrays, no long tables."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sized
from typing import Any

import numpy as np

_LONGEST = 60  # characters
_LISTED = 4  # entries of a table


def in_short(value: Any) -> str:
    """The value's repr where it is short; else what it is and how large."""
    if isinstance(value, enum.Enum):
        return repr(str(value.value))
    if isinstance(value, np.ndarray):
        return f"<array of shape {value.shape}>"
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, Mapping) and len(value) <= _LISTED:
        told = ", ".join(f"{in_short(k)}: {in_short(v)}" for k, v in value.items())
        return f"{{{told}}}"
    if callable(value) and hasattr(value, "__name__"):
        return f"<{value.__name__}>".replace("<<lambda>>", "<lambda>")
    if isinstance(value, Sized) and not isinstance(value, str) and len(value) > _LISTED:
        return f"<{type(value).__name__} of {len(value):,}>"
    told = repr(value)
    return told if len(told) <= _LONGEST or value is None else f"{told[: _LONGEST - 3]}..."
