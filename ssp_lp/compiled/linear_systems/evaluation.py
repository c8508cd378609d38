"""Totals of a policy on small components, corrected and verified in one go, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ssp_lp.compiled.linear_systems.elimination import solve_components
from ssp_lp.compiled.linear_systems.precise import exact_sum, precise_advantage, safe_advantage

Array = np.ndarray[Any, Any]


@njit(cache=True)
def evaluate_components(
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
    if solve_components(*chain, order, offsets, 0, offsets.size - 1, most, right, solved) >= 0:
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
        _miss(*chain, rewards, x, low, epsilon, right, missed)
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
        solve_components(*chain, order, offsets, 0, offsets.size - 1, most, right, solved)
        for s in range(n):
            for j in range(k):
                x[s, j], low[s, j] = exact_sum(x[s, j], low[s, j] + solved[s, j])
    return True


@njit(cache=True)
def _miss(
    indptr: Array, indices: Array, data: Array, exits: Array, rows: Array,
    rewards: Array, x: Array, low: Array, epsilon: float, off: Array, missed: Array,
) -> None:  # fmt: skip
    """By what totals miss their equations, [states, rewards], and the most of it, [rewards]."""
    for j in range(x.shape[1]):
        missed[j] = 0.0
        for s in range(x.shape[0]):
            row = rows[s]
            off[s, j], rounding = precise_advantage(
                row, s, indptr, indices, data, exits, rewards[row, j], x[:, j], low[:, j], epsilon
            )
            wrong = abs(off[s, j]) + rounding
            missed[j] = max(missed[j], wrong) if wrong == wrong else np.inf
