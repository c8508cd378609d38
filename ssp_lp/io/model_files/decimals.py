"""Sums and differences of costs as their decimals say: 0.1 + 0.2 is 0.3."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import FloatArray

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
    pairs, place = np.unique(np.stack([one, other]), axis=1, return_inverse=True)
    if pairs.shape[1] > _MOST_DISTINCT or not np.isfinite(pairs).all():
        return np.asarray(one + other)
    meant = exact or {}
    sums = [
        float(sum(meant.get(value, Fraction(repr(value))) for value in pair))
        for pair in pairs.T.tolist()
    ]
    return np.array(sums)[place.reshape(-1)]
