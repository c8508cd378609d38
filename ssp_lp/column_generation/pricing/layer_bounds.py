"""What the pairs of a layer of accumulated cost cost, and lower bounds of every policy's values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import PairCost, backup_rounding
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

Summands = tuple[PairCost, FloatArray, FloatArray]
"""The parts of each pair's backup, for counting rounding: cost, magnitude and what is counted once
(see ``safe_minima``), [pairs] each."""

_ONE = np.ones(1)


def bound_free_steps(
    base: AccumulatedCost,
    sums: Summands,
    ahead: FloatArray,
    given: FloatArray,
    inner: IntArray,
    floor: float,
) -> tuple[FloatArray, IntArray]:
    """Lower bounds of a layer with steps inside it, [nodes], and its best choice.

    Args:
        base: one layer of the process.
        sums: what its pairs cost.
        ahead: bounds of what they lead to in later layers, [layers * nodes].
        given: values that are not to be exceeded, [nodes].
        inner: a choice to begin with, [nodes].
        floor: no value is less.
    """
    cost, magnitude, alone = sums
    growth = 0.0 if cost.slope is None else cost.factor * cost.slope
    size = (magnitude + growth) + base.later @ np.abs(ahead)
    onward = (cost.fixed + growth) + base.later @ ahead
    onward = np.where(size == alone, onward, onward - backup_rounding(base.later) * size)
    settled = iterate_policy(base.instant_dynamics, onward[:, None], _ONE, inner)
    given = np.minimum(settled.values, given)
    return sub_solution(base.instant_dynamics, onward, given, floor), settled.choice


def priced_layers(process: LayeredProcess, owed: FloatArray) -> Callable[[int], PairCost]:
    """What each pair costs at a layer: the charge of arriving and what is owed, [pairs].

    Args:
        process: the process.
        owed: the same in all layers, [pairs].
    """
    if not process.grows_evenly:
        return lambda layer: PairCost(process.charged(layer).fixed + owed)
    even, totals = process.charged(0), process.levels.totals
    paid = PairCost(even.fixed + owed, even.slope)
    return lambda layer: replace(paid, factor=float(totals[layer]))


def summed_layers(
    process: LayeredProcess, owed: FloatArray, saved: FloatArray
) -> Callable[[int], Summands]:
    """The parts of ``charge + owed - saved`` at a layer.

    Args:
        process: the process.
        owed: non-negative, [pairs].
        saved: non-negative, [pairs].
    """
    if process.grows_evenly:
        even, totals = process.charged(0), process.levels.totals
        paid = even.fixed + owed
        cost, whole = PairCost(paid - saved, even.slope), paid + saved
        return lambda layer: (replace(cost, factor=float(totals[layer])), whole, owed)

    def summed(layer: int) -> Summands:
        """What the pairs of a layer sum up, each layer's charges by themselves."""
        fixed = process.charged(layer).fixed
        return PairCost(fixed + owed - saved), np.abs(fixed) + owed + saved, owed

    return summed
