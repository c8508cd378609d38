"""Compiled sweeps over one component of a policy's chain, and a Krylov method on top of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ssp_lp.compiled.cores import one_or_all_cores

Array = np.ndarray[Any, Any]


@one_or_all_cores
def gather_inside(
    indptr: Array, indices: Array, data: Array, exits: Array, states: Array, place: Array,
    own_indptr: Array, own_indices: Array, own_data: Array, departs: Array, leaving: Array,
) -> None:  # fmt: skip
    """For sweeps, moves among the members of a component, seen on departing only.

    Args:
        indptr: of the chain, [states + 1].
        indices: [entries].
        data: [entries].
        exits: [states].
        states: the members, in the order in which they are swept.
        place: position of each state among them, -1 elsewhere, [states].
        own_indptr: the length of each member's row, [members + 1].
        own_indices: written, positions, its own one where a move leads elsewhere, [own entries].
        own_data: written, divided by the probability of departing, 0 there, [own entries].
        departs: written: the probability of departing, [members].
        leaving: written: the probability of leaving the component, [members].
    """
    for i in prange(states.size):
        s, at = states[i], np.int64(own_indptr[i])
        leaves, stays = exits[s], 0.0
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            j, p = indices[k], data[k]
            if j == s or p <= 0.0:
                continue
            if place[j] < 0:
                leaves += p
                continue
            stays += p
            own_indices[at], own_data[at] = place[j], p
            at += 1
        departs[i], leaving[i] = leaves + stays, leaves
        for k in range(np.int64(own_indptr[i]), at):
            own_data[k] /= departs[i]
        for k in range(at, np.int64(own_indptr[i + 1])):
            own_indices[k], own_data[k] = place[s], 0.0


@one_or_all_cores
def from_beyond(
    indptr: Array, indices: Array, data: Array, states: Array, place: Array, departs: Array,
    rewards: Array, x: Array, right: Array,
) -> None:  # fmt: skip
    """For sweeps, rewards of the members with what they lead to outside, [members, rewards]."""
    for i in prange(states.size):
        s = states[i]
        for j in range(rewards.shape[1]):
            right[i, j] = rewards[s, j]
        for k in range(indptr[s], indptr[s + np.uint32(1)]):
            if place[indices[k]] < 0:
                for j in range(rewards.shape[1]):
                    right[i, j] += data[k] * x[indices[k], j]
        for j in range(rewards.shape[1]):
            right[i, j] /= departs[i]


@njit(cache=True)
def sweep(
    indptr: Array, indices: Array, data: Array, right: Array, x: Array
) -> tuple[float, float]:
    """Set each x in turn to ``right + rows @ x``, in place (Gauss and Seidel).

    One core only: so the result does not depend on timing, and two cores would save less than
    using new values at once does.

    Returns:
        The greatest change and the greatest size.
    """
    change, size = 0.0, 0.0
    if x.shape[1] == 2:  # each entry is read once
        for s in range(x.shape[0]):
            first, second = right[s, 0], right[s, 1]
            for k in range(indptr[s], indptr[np.uint32(s + 1)]):
                weight, column = data[k], indices[k]
                first += weight * x[column, 0]
                second += weight * x[column, 1]
            change = max(change, max(abs(first - x[s, 0]), abs(second - x[s, 1])))
            size = max(size, max(abs(first), abs(second)))
            x[s, 0], x[s, 1] = first, second
        return change, size
    for s in range(x.shape[0]):
        for j in range(x.shape[1]):
            total = right[s, j]
            for k in range(indptr[s], indptr[np.uint32(s + 1)]):
                total += data[k] * x[indices[k], j]
            change = max(change, abs(total - x[s, j]))
            size = max(size, abs(total))
            x[s, j] = total
    return change, size


@njit(cache=True)
def _miss_of_sweep(indptr: Array, indices: Array, data: Array, x: Array, miss: Array) -> None:
    """``x - G x``, written, where G is one sweep without rewards (Gauss and Seidel), [states]."""
    miss[:] = x
    for s in range(x.size):
        total = 0.0
        for k in range(indptr[s], indptr[np.uint32(s + 1)]):
            total += data[k] * miss[indices[k]]
        miss[s] = total
    for s in range(x.size):
        miss[s] = x[s] - miss[s]


def start_bicgstab(residual: Array) -> tuple[Array, Array, Array, Array]:
    """What ``bicgstab`` carries from step to step: shadow, p and v, [members], and rho, [1]."""
    rho = np.zeros(1)
    _square_in_sweep(residual, rho)
    return residual.copy(), residual.copy(), np.zeros_like(residual), rho


@njit(cache=True)
def _square_in_sweep(residual: Array, rho: Array) -> None:
    """The sum of squares, in order."""
    for s in range(residual.size):
        rho[0] += residual[s] * residual[s]


@njit(cache=True)
def bicgstab(
    indptr: Array, indices: Array, data: Array,
    residual: Array, target: float, most_steps: int, x: Array,
    shadow: Array, p: Array, v: Array, scalar: Array,
) -> tuple[int, bool]:  # fmt: skip
    """Add to ``x`` until ``residual``, which is overwritten, is at most ``target`` everywhere.

    BiCGStab of van der Vorst (1992) on ``x - G x = g``, where G is one sweep: the sweep is the
    preconditioner and costs no more than a product. ``residual`` is ``g - (x - G x)``. What
    ``start_bicgstab`` made is carried on, so that steps can be taken a few at a time.

    Returns:
        The number of sweeps, and whether it ended.
    """
    n = residual.size
    t, rho = np.empty(n), scalar[0]
    for step in range(most_steps):
        _miss_of_sweep(indptr, indices, data, p, v)
        along = 0.0
        for s in range(n):
            along += shadow[s] * v[s]
        if along == 0.0 or not np.isfinite(along):
            return 2 * step + 1, True
        alpha = rho / along
        for s in range(n):
            residual[s] -= alpha * v[s]
        _miss_of_sweep(indptr, indices, data, residual, t)
        cross, square = 0.0, 0.0
        for s in range(n):
            cross += t[s] * residual[s]
            square += t[s] * t[s]
        omega = cross / square if square > 0.0 else 0.0
        following, size = 0.0, 0.0
        for s in range(n):
            x[s] += alpha * p[s] + omega * residual[s]
            residual[s] -= omega * t[s]
            following += shadow[s] * residual[s]
            size = max(size, abs(residual[s]))
        if size <= target or omega == 0.0 or following == 0.0 or not np.isfinite(following):
            return 2 * step + 2, True
        beta = following / rho * (alpha / omega)
        rho = scalar[0] = following
        for s in range(n):
            p[s] = residual[s] + beta * (p[s] - omega * v[s])
    return 2 * most_steps, False


@njit(cache=True)
def widest_level(indptr: Array, indices: Array) -> int:
    """Before sweeping: most states at one distance from the first one."""
    n = indptr.size - 1
    seen, queue = np.zeros(n, dtype=np.bool_), np.empty(n, dtype=np.uint32)
    seen[0], queue[0] = True, 0
    begin, filled, widest = 0, 1, 1
    while begin < filled:
        end = filled
        for head in range(begin, end):
            s = queue[head]
            for k in range(indptr[s], indptr[s + np.uint32(1)]):
                if not seen[indices[k]]:
                    seen[indices[k]] = True
                    queue[filled] = indices[k]
                    filled += 1
        widest, begin = max(widest, filled - end), end
    return widest
