"""Compiled differences in twice the working precision; twin of ``dynamic_programming.precise``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]
_SPLIT = 134217729.0  # 2**27 + 1 (Veltkamp)


@njit(cache=True, inline="always")
def _sum(a: float, b: float) -> tuple[float, float]:
    """A + b, rounded, and what the rounding lost (Knuth)."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


@njit(cache=True, inline="always")
def _product(a: float, b: float) -> tuple[float, float]:
    """A * b, rounded, and what the rounding lost (Dekker)."""
    total = a * b
    c, d = _SPLIT * a, _SPLIT * b
    a_high, b_high = c - (c - a), d - (d - b)
    a_low, b_low = a - a_high, b - b_high
    return total, a_low * b_low - (((total - a_high * b_high) - a_low * b_high) - a_high * b_low)


@one_or_all_cores
def advantages(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    high: Array, low: Array, epsilon: float, result: Array, rounding: Array,
) -> None:  # fmt: skip
    """``cost + sum p (v[successor] - v[home]) - exits * v[home]``, v = high + low, and rounding."""
    for row in prange(home.size):
        s = home[row]
        total, rest, small, whole = cost[row], 0.0, 0.0, 0.0
        if exits[row] != 0.0:
            term, lost = _product(-exits[row], high[s])
            total, slip = _sum(total, term)
            bit = exits[row] * low[s]
            rest += slip + lost - bit
            small += abs(slip) + abs(lost) + abs(bit)
            whole += abs(term)
        for k in range(indptr[row], indptr[row + 1]):
            j, p = indices[k], data[k]
            step, missed = _sum(high[j], -high[s])
            missed += low[j] - low[s]
            term, lost = _product(p, step)
            total, slip = _sum(total, term)
            bit = p * missed
            rest += slip + lost + bit
            small += abs(slip) + abs(lost) + abs(bit)
            whole += abs(term)
        result[row] = total + rest
        terms = float(indptr[row + 1] - indptr[row]) + 4.0
        rounding[row] = epsilon * (abs(result[row]) + terms * (small + epsilon * whole))


@one_or_all_cores
def safe_advantages(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """The same in working precision, less a running bound of its rounding."""
    for row in prange(home.size):
        here, leaves = values[home[row]], exits[row]
        total, rounded = cost[row], 0.0
        if leaves != 0.0:
            term = leaves * here
            total -= term
            rounded += abs(total)
            if leaves != 1.0:
                rounded += abs(term)
        for k in range(indptr[row], indptr[row + 1]):
            term = data[k] * (values[indices[k]] - here)
            if term != 0.0:
                total += term
                rounded += abs(total) + 2.0 * abs(term)
        result[row] = total - epsilon * rounded
