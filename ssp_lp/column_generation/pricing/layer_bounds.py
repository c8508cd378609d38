"""Lower bounds of every policy's values in one layer of accumulated cost, rounding counted."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.pricing.layer_costs import Summands
from ssp_lp.dynamic_programming.bellman import backup_rounding, safe_minima
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.policy_iteration import improve
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost

_ONE = np.ones(1)


def bound_layer(base: AccumulatedCost, sums: Summands, ahead: FloatArray) -> FloatArray:
    """Of a layer whose steps all lead on to later ones, [nodes].

    Args:
        base: one layer of the process.
        sums: what its pairs cost.
        ahead: bounds of what they lead to, as the columns of steps are, [layers * nodes].
    """
    return safe_minima(base.pair_offsets, base.later, sums.cost, sums.magnitude, sums.alone, ahead)


def bound_free_steps(
    base: AccumulatedCost,
    sums: Summands,
    ahead: FloatArray,
    given: FloatArray,
    inner: IntArray,
    floor: float,
) -> tuple[FloatArray, IntArray]:
    """Of a layer with steps inside it, [nodes], and its best choice.

    Args:
        base: one layer of the process.
        sums: what its pairs cost.
        ahead: bounds of what they lead to in later layers, [layers * nodes].
        given: values that are not to be exceeded, [nodes].
        inner: a choice to begin with, [nodes].
        floor: no value is less.
    """
    growth = 0.0 if sums.cost.slope is None else sums.cost.factor * sums.cost.slope
    size = (sums.magnitude + growth) + base.later @ np.abs(ahead)
    onward = (sums.cost.fixed + growth) + base.later @ ahead
    onward = np.where(size == sums.alone, onward, onward - backup_rounding(base.later) * size)
    settled = improve(base.instant_dynamics, onward[:, None], _ONE, inner)
    given = np.minimum(settled.values, given)
    return sub_solution(base.instant_dynamics, onward, given, floor), settled.choice
