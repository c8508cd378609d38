"""The lattice of accumulated costs (paper, Assumption 2-1): the common divisor of the costs."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import gcd, lcm

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError

_MOST_LAYERS_PER_STEP = 1_000_000


def common_unit(costs: FloatArray, exact: Mapping[float, Fraction]) -> Fraction:
    """The greatest number of which every cost is a whole multiple, found exactly.

    A float means its shortest decimal (0.1 is 1/10) unless ``exact`` says which fraction it is.

    Args:
        costs: non-negative; zeros do not matter.
        exact: float cost -> the fraction meant.

    Returns:
        The unit; 1 where every cost is zero.
    """
    fractions = [exact.get(c, Fraction(repr(c))) for c in np.unique(costs).tolist() if c > 0]
    if not fractions:
        return Fraction(1)
    denominator = lcm(*(f.denominator for f in fractions))
    return Fraction(gcd(*(int(f * denominator) for f in fractions)), denominator)


def layers_of(costs: FloatArray, unit: Fraction, exact: Mapping[float, Fraction]) -> IntArray:
    """Whole number of units of each cost, like ``costs``.

    Raises:
        ModelError: a single step passes too many layers for a table over accumulated cost.
    """
    distinct, back = np.unique(costs, return_inverse=True)
    counts = [
        int(exact.get(c, Fraction(repr(c))) / unit) if c > 0 else 0 for c in distinct.tolist()
    ]
    if max(counts, default=0) > _MOST_LAYERS_PER_STEP:
        raise ModelError(
            f"the costs have the common unit {float(unit):g}, so the step of cost "
            f"{float(distinct[-1]):g} passes {max(counts):,} layers of accumulated cost; round "
            "the costs to a coarser grid (for instance to multiples of "
            f"{float(distinct[-1]) / 100:g}) when building the model"
        )
    return np.array(counts, dtype=np.int64)[back].reshape(np.shape(costs))
