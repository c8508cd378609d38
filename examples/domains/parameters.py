"""Checks of a generator's parameters; every error names the parameter."""

import math
from fractions import Fraction
from numbers import Integral, Real
from typing import Any

from ssp_lp import ModelError

Number = float | Fraction
"""A probability or a cost; a `Fraction` is taken exactly."""


def check_count(name: str, value: Any, least: int) -> None:
    """Raise `ModelError` unless `value` is a whole number of at least `least`."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value < least:
        raise ModelError(f"{name} must be a whole number of at least {least}, not {value!r}")


def check_probability(name: str, value: Any) -> None:
    """Raise `ModelError` unless `value` is a number from 0 to 1."""
    if not isinstance(value, Real) or not 0 <= float(value) <= 1:
        raise ModelError(f"{name} must be a probability from 0 to 1, not {value!r}")


def check_cost(name: str, value: Any) -> None:
    """Raise `ModelError` unless `value` is a finite number of at least 0."""
    if not isinstance(value, Real) or not math.isfinite(value) or float(value) < 0:
        raise ModelError(f"{name} must be a finite cost of at least 0, not {value!r}")
