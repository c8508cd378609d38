"""Compiled sums whose rounding is counted, or undone in twice the working precision.

The twin of differences is ``linear_systems.advantages``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.cores import one_or_all_cores
from ssp_lp.compiled.elimination import solve_by_elimination

Array = np.ndarray[Any, Any]
_LOWERINGS = 8  # of a value by what it still lacks: after two of them nothing does, as a rule
_SPLIT = 134217729.0  # 2**27 + 1 (Veltkamp)


@njit(cache=True, inline="always")
def exact_sum(a: float, b: float) -> tuple[float, float]:
    """With twice the precision: a + b, rounded, and what the rounding lost (Knuth)."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


@njit(cache=True, inline="always")
def _precise_product(a: float, b: float) -> tuple[float, float]:
    """With twice the precision: a * b, rounded, and what the rounding lost (Dekker)."""
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
        term, lost = _precise_product(-exits[row], high[s])
        total, slip = exact_sum(total, term)
        bit = exits[row] * low[s]
        rest += slip + lost - bit
        small += abs(slip) + abs(lost) + abs(bit)
        whole += abs(term)
    for k in range(indptr[row], indptr[row + np.uint32(1)]):
        j, p = indices[k], data[k]
        step, missed = exact_sum(high[j], -high[s])
        missed += low[j] - low[s]
        term, lost = _precise_product(p, step)
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
def advantages_precisely(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    high: Array, low: Array, epsilon: float, result: Array, rounding: Array,
) -> None:  # fmt: skip
    """Advantages of all pairs in twice the working precision, and bounds of their rounding."""
    for row in prange(home.size):
        result[row], rounding[row] = precise_advantage(
            row, home[row], indptr, indices, data, exits, cost[row], high, low, epsilon
        )


@one_or_all_cores
def advantages_safely(
    home: Array, indptr: Array, indices: Array, data: Array, exits: Array, cost: Array,
    values: Array, epsilon: float, result: Array,
) -> None:  # fmt: skip
    """Advantages of all pairs in working precision, never too high."""
    for row in prange(home.size):
        result[row] = safe_advantage(
            row, home[row], indptr, indices, data, exits, cost[row], values, epsilon
        )


@one_or_all_cores
def shortfalls_safely(
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


@njit(cache=True)
def lower_in_order(
    offsets: Array, indptr: Array, indices: Array, data: Array, exits: Array, order: Array,
    cost: Array, epsilon: float, values: Array,
) -> None:  # fmt: skip
    """Lower values of a process without cycles, in place, until none exceeds its backup.

    Args:
        offsets: [states + 1].
        indptr: [pairs + 1].
        indices: [entries].
        data: [entries].
        exits: [pairs].
        order: states, ends first, [states].
        cost: [pairs].
        epsilon: of the machine.
        values: [states].
    """
    for s in order:
        for row in range(offsets[s], offsets[s + np.uint32(1)]):
            departs = exits[row]
            for k in range(indptr[row], indptr[row + np.uint32(1)]):
                departs += data[k] if indices[k] != s else 0.0
            for _ in range(_LOWERINGS):
                lack = -safe_advantage(
                    row, s, indptr, indices, data, exits, cost[row], values, epsilon
                )
                if not (lack > 0.0 and departs > 0.0):
                    break
                values[s] -= max(lack / departs, epsilon * abs(values[s]))


@njit(cache=True)
def evaluate_precisely(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    order: Array, offsets: Array, most: int, rewards: Array, accuracy: float, corrections: int,
    epsilon: float, x: Array, low: Array, runs: Array, missed: Array,
) -> bool:  # fmt: skip
    """Expected totals ``x + low`` and run lengths of the policy whose rows are given.

    Args:
        indptr: [rows + 1].
        indices: [entries].
        data: [entries].
        exits: [rows].
        rows: the row of each state, [states].
        order: states, component by component, ends first, [states].
        offsets: of the components in the order, [components + 1].
        most: states of the largest component.
        rewards: of rows, [rows, rewards].
        accuracy: error, relative to the greatest total, down to which to correct.
        corrections: how often at most.
        epsilon: of the machine.
        x: written, [states, rewards].
        low: written, [states, rewards].
        runs: written, checked run lengths, [states].
        missed: written, by what the equations are missed at most, [rewards].

    Returns:
        Whether the run lengths are a super-solution.
    """
    n, k = x.shape
    right, solved = np.ones((n, k + 1)), np.empty((n, k + 1))
    for s in range(n):
        right[s, :k] = rewards[rows[s], :]
    chain = indptr, indices, data, exits, rows
    if solve_by_elimination(*chain, order, offsets, 0, offsets.size - 1, most, right, solved) >= 0:
        return False
    longest = 0.0
    for s in range(n):
        x[s, :], low[s, :], runs[s] = solved[s, :k], 0.0, -solved[s, k]
        longest = max(longest, solved[s, k])
    for s in range(n):
        row = rows[s]
        if not safe_advantage(row, s, indptr, indices, data, exits, -0.5, runs, epsilon) >= 0.0:
            return False
    runs *= -1.0
    before = np.full(k, np.inf)
    right, solved = np.empty((n, k)), np.empty((n, k))
    for _ in range(corrections):
        _precise_miss(*chain, rewards, x, low, epsilon, right, missed)
        enough, better = True, False
        for j in range(k):
            scale = 0.0
            for s in range(n):
                scale = max(scale, abs(x[s, j]))
            enough &= 2.0 * longest * missed[j] <= accuracy * scale
            better |= missed[j] < 0.5 * before[j]
        if enough or not better:
            break
        before[:] = missed
        solve_by_elimination(*chain, order, offsets, 0, offsets.size - 1, most, right, solved)
        for s in range(n):
            for j in range(k):
                x[s, j], low[s, j] = exact_sum(x[s, j], low[s, j] + solved[s, j])
    return True


@njit(cache=True)
def _precise_miss(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    rewards: Array, x: Array, low: Array, epsilon: float, off: Array, missed: Array,
) -> None:  # fmt: skip
    """By what totals miss their equations, in twice the working precision, and the most of it."""
    for j in range(x.shape[1]):
        missed[j] = 0.0
        for s in range(x.shape[0]):
            row = rows[s]
            off[s, j], rounding = precise_advantage(
                row, s, indptr, indices, data, exits, rewards[row, j], x[:, j], low[:, j], epsilon
            )
            wrong = abs(off[s, j]) + rounding
            missed[j] = max(missed[j], wrong) if wrong == wrong else np.inf
