"""Facts about a model that are worked out once and kept with it, for every problem on it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import numpy as np

from ssp_lp.compiled.deadline import check_time
from ssp_lp.model.ssp import SSP

Fact = TypeVar("Fact")


def kept(find: Callable[[SSP], Fact]) -> Callable[[SSP], Fact]:
    """Keep what a function finds out about a model, an array or a tuple of arrays, read-only."""

    @wraps(find)
    def _fact(model: SSP) -> Fact:
        known = model.kept_facts
        if find.__name__ not in known:
            check_time()
            found = find(model)
            for array in found if isinstance(found, tuple) else (found,):
                if isinstance(array, np.ndarray):
                    array.flags.writeable = False
            known[find.__name__] = found
        result: Fact = known[find.__name__]
        return result

    return _fact
