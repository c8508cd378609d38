"""Sums and differences of costs as their decimals say: 0.1 + 0.2 is 0.3."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray

_MOST_DISTINCT = 100_000
"""Distinct pairs of summands beyond which sums are rounded as floats are."""


def decimal_sum(
    one: FloatArray, other: FloatArray, exact: Mapping[float, Fraction] | None = None
) -> FloatArray:
    """Add two arrays of one shape, each number meaning its shortest decimal.

    Args:
        one: [numbers].
        other: [numbers].
        exact: the fraction meant by a float such as 1/3.

    Returns:
        The floats next to the exact sums, [numbers].
    """
    if not (one.any() and other.any()):
        return one if one.any() else other
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return np.asarray(one + other)
    first, second, place = distinct_decimal_pairs(one, other)
    if first.size > _MOST_DISTINCT:
        return np.asarray(one + other)
    meant = exact or {}
    sums = [
        float(sum(meant.get(value, Fraction(repr(value))) for value in pair))
        for pair in zip(first.tolist(), second.tolist(), strict=True)
    ]
    return np.array(sums)[place]


def distinct_decimal_pairs(
    one: FloatArray, other: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """The distinct pairs of finite numbers, sorted.

    Args:
        one: [numbers].
        other: [numbers].

    Returns:
        The first and the second number of each distinct pair, and the place of each given pair
        among them, [numbers].
    """
    both = np.empty(one.size, dtype=np.complex128)  # as one number: sorting rows is slow
    both.real, both.imag = one, other
    distinct, place = np.unique(both, return_inverse=True)
    return distinct.real.copy(), distinct.imag.copy(), place.reshape(-1)
