"""The same work in compiled loops and in numpy expressions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

Switch = Callable[[bool], None]
"""Run every loop compiled, or none: the fixture ``accelerate``."""


def both(accelerate: Switch, work: Callable[[], object]) -> tuple[object, object]:
    accelerate(True)
    compiled = work()
    accelerate(False)
    return compiled, work()


def assert_same(one: object, other: object) -> None:
    if isinstance(one, tuple):
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, sp.csr_array):
        for name in ("indptr", "indices", "data"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    else:
        np.testing.assert_array_equal(one, other)
