"""Blocks of consecutive states of a model, as arrays that a function returns for their numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.errors import ModelError, in_short


class StateRows(NamedTuple):
    """Pairs and outcomes of some consecutive states, in their order, as arrays."""

    actions: npt.ArrayLike  # [some states] number of pairs of each
    outcomes: npt.ArrayLike  # [their pairs] number of outcomes of each
    successors: npt.ArrayLike  # [their outcomes] numbers of states
    probabilities: npt.ArrayLike  # [their outcomes]
    costs: npt.ArrayLike  # one number for all, or [their pairs], or [their outcomes]
    named_costs: Mapping[str, npt.ArrayLike] = {}  # further costs by name, each as ``costs``


Rows = Callable[[int, int], StateRows]
"""Function that returns the rows of the states first .. end - 1."""


def checked_rows(rows: Rows, first: int, end: int) -> StateRows:
    """Return the rows of some states as arrays of checked types and lengths.

    Raises:
        ModelError: naming the call and the wrong array.
    """
    made, call = rows(first, end), f"rows({first}, {end})"
    if not isinstance(made, StateRows):
        raise ModelError(f"{call} must be StateRows, not {in_short(made)}")
    size, arrays = end - first, dict[str, Any]()
    of = "state", "pair", "outcome", "outcome"
    for name, numbers, each in zip(made._fields, made, of, strict=False):
        part = np.asarray(numbers)
        part = part if part.size else part.astype(np.int64)
        is_number = part.dtype.kind in ("iuf" if name == "probabilities" else "iu")
        if not is_number or part.shape != (size,) or (len(arrays) < 2 and (part < 0).any()):
            raise ModelError(f"{call}: {name} must be {size} numbers, one for each {each}, not "
                             f"{in_short(part)} of {part.dtype}")  # fmt: skip
        arrays[name], size = part, int(part.sum()) if len(arrays) < 2 else size
    return made._replace(**arrays)
