"""Compiled backup of one layer of accumulated cost, with the measures of what it chose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def back_up_layer(
    offsets: Array, indptr: Array, indices: Array, data: Array,
    cost: Array, slope: Array, layer: float,
    charge: Array, growth: Array, gain: Array, failure: Array, survival: float,
    values: Array, measured: Array, minima: Array, position: Array, totals: Array,
) -> None:  # fmt: skip
    """Least values of a layer, who attains them, and the (charge, failure, goal) of that choice.

    The chosen row is read again while it is still near.
    """
    for s in prange(offsets.size - 1):
        least, pick = np.inf, offsets[s]
        for pair in range(offsets[s], offsets[s + 1]):
            total = 0.0
            for k in range(indptr[pair], indptr[pair + 1]):
                total += data[k] * values[indices[k]]
            stage = cost[pair]
            if layer != 0.0:
                stage += layer * slope[pair]
            total = stage + total
            if total < least:
                least, pick = total, pair
        minima[s], position[s] = least, pick - offsets[s]
        paid, failed, reached = 0.0, 0.0, 0.0
        for k in range(indptr[pick], indptr[pick + 1]):
            weight, column = data[k], indices[k]
            paid += weight * measured[column, 0]
            failed += weight * measured[column, 1]
            reached += weight * measured[column, 2]
        if layer != 0.0:
            paid += layer * growth[pick]
        totals[s, 0] = charge[pick] + paid
        totals[s, 1] = failure[pick] + failed
        totals[s, 2] = survival * gain[pick] + reached
