"""Compiled solution of ``x = reward + chain @ x`` for the chain of one chosen pair per state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.loops import one_or_all_cores

Array = np.ndarray[Any, Any]


@njit(cache=True)
def sweep(
    indptr: Array, indices: Array, data: Array, reward: Array, x: Array
) -> tuple[float, float]:
    """Set each x in turn to what the others imply (Gauss and Seidel), in place.

    One core only: so the result does not depend on timing, and two cores would save less than
    using new values at once does. Visiting states by increasing value takes as many sweeps.

    Returns:
        The greatest change and the greatest size.
    """
    change, size = 0.0, 0.0
    for s in range(x.shape[0]):
        for j in range(x.shape[1]):
            total = 0.0
            for k in range(indptr[s], indptr[s + 1]):
                total += data[k] * x[indices[k], j]
            total = reward[s, j] + total
            change = max(change, abs(total - x[s, j]))
            size = max(size, abs(total))
            x[s, j] = total
    return change, size


@njit(cache=True)
def sweep_two(
    indptr: Array, indices: Array, data: Array, reward: Array, x: Array
) -> tuple[float, float]:
    """The same for two rewards, reading each entry once."""
    change, size = 0.0, 0.0
    for s in range(x.shape[0]):
        first, second = 0.0, 0.0
        for k in range(indptr[s], indptr[s + 1]):
            weight, column = data[k], indices[k]
            first += weight * x[column, 0]
            second += weight * x[column, 1]
        first, second = reward[s, 0] + first, reward[s, 1] + second
        change = max(change, max(abs(first - x[s, 0]), abs(second - x[s, 1])))
        size = max(size, max(abs(first), abs(second)))
        x[s, 0], x[s, 1] = first, second
    return change, size


@one_or_all_cores
def bicgstab(
    choice: Array,
    indptr: Array,
    indices: Array,
    data: Array,
    residual: Array,
    target: float,
    most_steps: int,
    x: Array,
) -> int:
    """Add to ``x`` until ``residual``, which is overwritten, is at most ``target`` everywhere.

    BiCGStab of van der Vorst (1992) without a preconditioner; returns the number of products.
    """
    n = choice.size
    shadow, p, v, t = residual.copy(), residual.copy(), np.zeros(n), np.zeros(n)
    rho = 0.0
    for s in prange(n):
        rho += shadow[s] * residual[s]
    for step in range(most_steps):
        along = 0.0
        for s in prange(n):
            row = choice[s]
            total = 0.0
            for k in range(indptr[row], indptr[row + 1]):
                total += data[k] * p[indices[k]]
            v[s] = p[s] - total
            along += shadow[s] * v[s]
        if along == 0.0 or not np.isfinite(along):
            return 2 * step + 1
        alpha = rho / along
        for s in prange(n):
            residual[s] -= alpha * v[s]
        cross, square = 0.0, 0.0
        for s in prange(n):
            row = choice[s]
            total = 0.0
            for k in range(indptr[row], indptr[row + 1]):
                total += data[k] * residual[indices[k]]
            t[s] = residual[s] - total
            cross += t[s] * residual[s]
            square += t[s] * t[s]
        omega = cross / square if square > 0.0 else 0.0
        following, size = 0.0, 0.0
        for s in prange(n):
            x[s] += alpha * p[s] + omega * residual[s]
            residual[s] -= omega * t[s]
            following += shadow[s] * residual[s]
            size = max(size, abs(residual[s]))
        if size <= target or omega == 0.0 or following == 0.0 or not np.isfinite(following):
            return 2 * step + 2
        beta = following / rho * (alpha / omega)
        rho = following
        for s in prange(n):
            p[s] = residual[s] + beta * (p[s] - omega * v[s])
    return 2 * most_steps
