"""Certified lower bounds: values v with v <= T v, checked by one backup with its rounding.

If v satisfies v <= c_u + P_u v for every pair u, then v bounds the cost of every policy from below:
of those that leave the process by iterating the inequality, and of those that stay for ever since
staying is failure, which costs at least as much as v says.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.bellman import ChosenRows, PairCost, best_pairs, safe_minima
from ssp_lp.errors import SolverError
from ssp_lp.linear import accumulate

_ROUNDS = 12
_TIED = 1024.0  # lacks within which a pair may turn out to be the best after lowering
_RUN_ACCURACY = 1e-3  # runs are used times 1.5 and checked
_LARGE = 50_000  # states from which looking for the least that will do takes too long
_SLIGHT = 1e-13  # share by which a large model's values are lowered throughout
_SHRINKAGES = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)


def shortfall(
    pair_offsets: IntArray, transitions: sp.csr_array, pair_cost: FloatArray, values: FloatArray
) -> FloatArray:
    """How far each state's value exceeds its backup, rounding counted against us, [states]."""
    size = np.abs(pair_cost)
    safe = safe_minima(pair_offsets, transitions, PairCost(pair_cost), size, size, values)
    return np.maximum(values - safe, 0.0)


def sub_solution(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    pair_cost: FloatArray,
    values: FloatArray,
    floor: float = 0.0,
) -> FloatArray:
    """Lower the given values, as little as is needed, to ones that pass the check.

    Args:
        pair_cost: [pairs].
        values: near-optimal values, or any others (the bound is then worse), [states].
        floor: a constant that is known to be a sub-solution: 0 where no pair cost is negative.

    Returns:
        Values that are checked lower bounds of the optimum, [states].
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    lack = shortfall(pair_offsets, transitions, pair_cost, values)
    if not lack.any():
        return values

    def passes(lowered: FloatArray) -> bool:
        return not shortfall(pair_offsets, transitions, pair_cost, lowered).any()

    def shrunk(share: float) -> FloatArray:
        return np.asarray(floor + (1.0 - share) * (values - floor))

    if floor == 0.0 and len(values) > _LARGE and passes(lowered := shrunk(_SLIGHT)):
        return lowered
    lowered, still = values, lack
    for _ in range(_ROUNDS):
        lowered = np.maximum(lowered - still, floor)
        still = shortfall(pair_offsets, transitions, pair_cost, lowered)
        if not still.any():
            return lowered
    run = _longest_run(pair_offsets, transitions, pair_cost, values, lack)
    if run is not None:
        for factor in (1.5, 4.0, 16.0, 64.0, 1024.0):
            lowered = np.maximum(values - factor * run, floor)
            if passes(lowered):
                return lowered
    for share in _SHRINKAGES:
        if passes(lowered := shrunk(share)):
            return lowered
    return np.full_like(values, floor)


def _longest_run(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
) -> FloatArray | None:
    """Total lack gathered along the worst near-optimal policy, [states]; None if it is endless.

    Lowering the values by this amount absorbs the lack wherever it is met again: the violation
    times the longest expected run (DESIGN, section 5). States that never meet it are left alone.
    """
    worst_lack, met = float(lack.max()), lack > 0
    ahead = pair_cost + transitions @ values
    backup = best_pairs(pair_offsets, transitions, pair_cost, values)
    choice = backup.choice
    spare = ahead - np.repeat(backup.minima, np.diff(pair_offsets))
    spare[spare <= _TIED * worst_lack] = 0.0
    run: FloatArray | None = None
    for _ in range(_ROUNDS):
        reward = np.where(met, worst_lack, 0.0)
        try:
            run = accumulate(ChosenRows(transitions, choice), reward, run, accuracy=_RUN_ACCURACY)
        except SolverError:
            return None
        if (run < 0).any():
            return None
        worst = best_pairs(pair_offsets, transitions, spare, -run, choice)
        changed = worst.minima < worst.here - 0.1 * reward
        if not changed.any() and np.array_equal(met, run > 0):
            return run
        met = run > 0
        choice = np.where(changed, worst.choice, choice)
    return run
