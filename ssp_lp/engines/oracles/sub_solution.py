"""Certified lower bounds: values v with v <= T v, checked by one backup with its rounding.

If v >= 0 satisfies v <= c_u + P_u v for every pair u of non-negative cost, then v bounds the cost
of every policy from below: of those that leave the process by iterating the inequality, and of
those that stay for ever provided that staying counts as at least max v (it does: staying is
failure, and a price times 1 is at least any value of giving up there).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
)
from ssp_lp.errors import SolverError
from ssp_lp.linear import accumulate

_ROUNDS = 12
_SHRINKAGES = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)


def backup_rounding(transitions: sp.csr_array) -> FloatArray:
    """Relative rounding of a backup of non-negative numbers, per pair, [pairs].

    Pairs without successors (giving up) are exact.
    """
    terms = np.diff(transitions.indptr)
    return np.where(terms == 0, 0.0, (terms + 3.0) * MACHINE_EPSILON)


def shortfall(
    pair_offsets: IntArray, transitions: sp.csr_array, pair_cost: FloatArray, values: FloatArray
) -> FloatArray:
    """How far each state's value exceeds its backup, rounding counted against us, [states]."""
    ahead = (pair_cost + transitions @ values) * (1.0 - backup_rounding(transitions))
    return np.maximum(values - segment_minima(ahead, pair_offsets), 0.0)


def sub_solution(
    pair_offsets: IntArray, transitions: sp.csr_array, pair_cost: FloatArray, values: FloatArray
) -> FloatArray:
    """Lower the given values, as little as is needed, to ones that pass the check.

    Args:
        pair_cost: non-negative, [pairs].
        values: near-optimal values, or any others (the bound is then worse), [states].

    Returns:
        Values that are checked lower bounds of the optimum, [states].
    """
    values = np.nan_to_num(np.maximum(values, 0.0), nan=0.0, posinf=0.0)
    lack = shortfall(pair_offsets, transitions, pair_cost, values)
    if not lack.any():
        return values
    run = _longest_run(pair_offsets, transitions, pair_cost, values, lack)
    if run is not None:
        for factor in (1.5, 4.0, 16.0, 64.0, 1024.0):
            lowered = np.maximum(values - factor * run, 0.0)
            if not shortfall(pair_offsets, transitions, pair_cost, lowered).any():
                return lowered
    for share in _SHRINKAGES:
        lowered = (1.0 - share) * values
        if not shortfall(pair_offsets, transitions, pair_cost, lowered).any():
            return lowered
    return np.zeros_like(values)


def _longest_run(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
) -> FloatArray | None:
    """Total lack gathered along the worst near-optimal policy, [states]; None if it is endless.

    Lowering the values by this amount absorbs the lack wherever it is met again: the violation
    times the longest expected run (DESIGN, section 5).
    """
    reward = np.full_like(values, float(lack.max()))
    ahead = pair_cost + transitions @ values
    choice = first_minimisers(ahead, segment_minima(ahead, pair_offsets), pair_offsets)
    spare = ahead - np.repeat(segment_minima(ahead, pair_offsets), np.diff(pair_offsets))
    run: FloatArray | None = None
    for _ in range(_ROUNDS):
        try:
            run = accumulate(transitions[choice], reward, run, exact=False)
        except SolverError:
            return None
        if (run < 0).any():
            return None
        loss = spare - transitions @ run
        worst = segment_minima(loss, pair_offsets)
        changed = worst < loss[choice] - 0.1 * reward
        if not changed.any():
            return run
        choice = np.where(changed, first_minimisers(loss, worst, pair_offsets), choice)
    return run
