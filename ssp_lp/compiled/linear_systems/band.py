"""Compiled state reduction of a narrow component, see ``compiled.linear_systems.elimination``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True)
def eliminate_band(band: Array, leaving: Array, weights: Array) -> bool:
    """Take the states of a banded chain out, last first, in place.

    Args:
        band: ``band[i, width + j - i]`` is the probability of going from i to j,
            [states, 2 * width + 1]; then, for j < i, what remains of it, divided by the
            probability of departing, and for j > i the weights with which j is replaced.
        leaving: probability of leaving from each state, [states].
        weights: probability of departing from each state, written, [states].

    Returns:
        False if the chain is never left.
    """
    n, width = band.shape[0], band.shape[1] // 2
    for i in range(n - 1, -1, -1):
        low = max(0, i - width)
        departs = leaving[i]
        for j in range(low, i):
            departs += band[i, width + j - i]
        if departs <= 0.0:
            return False
        weights[i] = departs
        for j in range(low, i):
            band[i, width + j - i] /= departs
        leaving[i] /= departs
        for r in range(low, i):
            weight = band[r, width + i - r]
            if weight > 0.0:
                for j in range(low, i):
                    band[r, width + j - r] += weight * band[i, width + j - i]
                leaving[r] += weight * leaving[i]
    return True


@njit(cache=True)
def solve_band(band: Array, departs: Array, right: Array) -> None:
    """Solve with an eliminated band, in place, [states, rewards]."""
    n, width = band.shape[0], band.shape[1] // 2
    n_rewards = right.shape[1]
    for i in range(n - 1, -1, -1):
        for k in range(n_rewards):
            right[i, k] /= departs[i]
        for r in range(max(0, i - width), i):
            weight = band[r, width + i - r]
            if weight > 0.0:
                for k in range(n_rewards):
                    right[r, k] += weight * right[i, k]
    for i in range(1, n):
        for j in range(max(0, i - width), i):
            weight = band[i, width + j - i]
            if weight > 0.0:
                for k in range(n_rewards):
                    right[i, k] += weight * right[j, k]
