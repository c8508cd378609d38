"""Compiled differences in twice the working precision; twin of ``linear_systems.precise``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]
_SPLIT = 134217729.0  # 2**27 + 1 (Veltkamp)


@njit(cache=True, inline="always")
def exact_sum(a: float, b: float) -> tuple[float, float]:
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


@njit(cache=True, inline="always")
def precise_advantage(
    row: int, s: int, indptr: Array, indices: Array, data: Array, exits: Array, cost: float,
    high: Array, low: Array, epsilon: float,
) -> tuple[float, float]:  # fmt: skip
    """``cost + sum p (v[successor] - v[s]) - exits * v[s]``, v = high + low, and its rounding."""
    total, rest, small, whole = cost, 0.0, 0.0, 0.0
    if exits[row] != 0.0:
        term, lost = _product(-exits[row], high[s])
        total, slip = exact_sum(total, term)
        bit = exits[row] * low[s]
        rest += slip + lost - bit
        small += abs(slip) + abs(lost) + abs(bit)
        whole += abs(term)
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        j, p = indices[k], data[k]
        step, missed = exact_sum(high[j], -high[s])
        missed += low[j] - low[s]
        term, lost = _product(p, step)
        total, slip = exact_sum(total, term)
        bit = p * missed
        rest += slip + lost + bit
        small += abs(slip) + abs(lost) + abs(bit)
        whole += abs(term)
    total += rest
    terms = float(indptr[row + np.uint32(1)] - indptr[row]) + 4.0
    return total, epsilon * (abs(total) + terms * (small + epsilon * whole))


@njit(cache=True, inline="always")
def safe_advantage(
    row: int, s: int, indptr: Array, indices: Array, data: Array, exits: Array, cost: float,
    values: Array, epsilon: float,
) -> float:  # fmt: skip
    """The same in working precision, less a running bound of its rounding."""
    here, leaves = values[s], exits[row]
    total, rounded = cost, 0.0
    if leaves != 0.0:
        term = leaves * here
        total -= term
        rounded += abs(total)
        if leaves != 1.0:
            rounded += abs(term)
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        term = data[k] * (values[indices[k]] - here)
        if term != 0.0:
            total += term
            rounded += abs(total) + 2.0 * abs(term)
    return total - epsilon * rounded


@one_or_all_cores
def advantages(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    high: Array, low: Array, epsilon: float, result: Array, rounding: Array,
) -> None:  # fmt: skip
    """Advantages of all pairs in twice the working precision, and bounds of their rounding."""
    for row in prange(home.size):
        result[row], rounding[row] = precise_advantage(
            row, home[row], indptr, indices, data, exits, cost[row], high, low, epsilon
        )


@one_or_all_cores
def safe_advantages(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """Advantages of all pairs in working precision, never too high."""
    for row in prange(home.size):
        result[row] = safe_advantage(
            row, home[row], indptr, indices, data, exits, cost[row], values, epsilon
        )


@one_or_all_cores
def shortfalls(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """By what each state's value exceeds its backup at most, rounding counted, [states]."""
    for s in prange(result.size):
        worst = 0.0
        for row in range(offsets[s], offsets[s + np.uint32(1)]):
            ahead = safe_advantage(row, s, indptr, indices, data, exits, cost[row], values, epsilon)
            worst = max(worst, -ahead) if ahead == ahead else np.inf
        result[s] = worst
