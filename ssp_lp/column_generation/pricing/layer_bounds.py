"""What the pairs of a layer of accumulated cost cost, and lower bounds of every policy's values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.column_generation.column import Proof
from ssp_lp.column_generation.pricing.layer_choices import is_acyclic
from ssp_lp.column_generation.pricing.one_pass import OnePass
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import PairCost, Work, backup_rounding, safe_minima
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

Summands = tuple[PairCost, FloatArray, FloatArray]
"""The parts of each pair's backup, for counting rounding: cost, magnitude and what is counted once
(see ``safe_minima``), [pairs] each."""

_ONE = np.ones(1)

_BELOW_EVERY_VALUE = 1e-6
"""No value is below minus the price; a floor this much lower leaves room to count rounding."""

_KEPT_VALUES = 25_000_000
"""Largest table of checked values that is kept, nodes x layers: 0.2 GB. Of a larger one only the
shape is: infinite values ask for the best that can be proved, which one more sweep gives."""

SAME: Final = 1e-14
"""Relative difference of values, and share of a bound, below which there is only rounding."""


def lost_beyond(process: LayeredProcess, price: float, failing: float) -> FloatArray:
    """How much more the tails are worth than the lower bound beyond the cap, [layers, nodes].

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts: the price, or 0 with minus the price for success.
    """
    tails, least = process.beyond_value(price, failing), process.beyond_bound(price, failing)
    return np.where(tails - least > SAME * (np.abs(tails) + np.abs(least)), tails - least, 0.0)


def bound_layers(
    process: LayeredProcess,
    price: float,
    failing: float,
    values: FloatArray,
    beyond: FloatArray,
    whole: OnePass | None,
    first: IntArray,
    choice: IntArray | None = None,
) -> Proof:
    """A lower bound of every policy's value, by a sweep that counts its rounding against itself.

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts: the price, or 0 with minus the price for success.
        values: are not exceeded, [cap, nodes].
        beyond: lower bounds beyond the cap, [layers beyond, nodes].
        whole: a compiled pass over all layers, where the process is small.
        first: pairs to begin with where a layer has free steps, [nodes].
        choice: written by compiled loops where there are none: whose values these are, as
            positions among the pairs of each node, [cap, nodes].
    """
    base, success = process.base, price - failing
    owed, saved = failing * base.failure, success * base.survival * base.gain
    floor = -(success - process.charge.lowest) * (1.0 + _BELOW_EVERY_VALUE)
    is_kept = values.size <= _KEPT_VALUES
    kept = np.empty(values.shape) if is_kept else np.broadcast_to(np.inf, values.shape)
    begun, sizes = np.zeros(process.cap), np.zeros(process.cap)  # of the start, by layer
    entries = np.flatnonzero(base.start)
    shares = base.start[entries]
    if whole is not None:
        for some, bounds in whole.lowest(owed, saved, values, floor, beyond):
            begun[some] = bounds[:, entries] @ shares
            sizes[some] = np.abs(bounds[:, entries]) @ shares
            if is_kept:
                kept[some] = bounds
        return _proof_of_layers(process, price, failing, begun, sizes, kept)
    summed, window, inner = summed_layers(process, owed, saved), process.window(beyond), first
    for layer in reversed(range(process.cap)):
        check_time()
        given, asked = values[layer], bool(np.isposinf(values[layer]).all())
        if not asked:
            given = np.maximum(np.nan_to_num(given, nan=floor, posinf=np.inf), floor)
        if is_acyclic(base):
            position = None if choice is None else choice[layer]
            sums = *summed(layer), window.flat
            lowest = safe_minima(base.pair_offsets, base.later, *sums, position)
            lowest = lowest if asked else np.minimum(lowest, given)
        else:
            lowest, inner = bound_free_steps(base, summed(layer), window.flat, given, inner, floor)
        begun[layer] = lowest[entries] @ shares
        sizes[layer] = np.abs(lowest[entries]) @ shares
        if is_kept:
            kept[layer] = lowest
        window.push(lowest)
    return _proof_of_layers(process, price, failing, begun, sizes, kept)


def _proof_of_layers(
    process: LayeredProcess,
    price: float,
    failing: float,
    begun: FloatArray,
    sizes: FloatArray,
    kept: FloatArray,
) -> Proof:
    """The bounds that values give at the start, whatever the layer in which it lies.

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts.
        begun: values at the start, [layers].
        sizes: sums of their parts' magnitudes, [layers].
        kept: the values, [layers, nodes], or infinite.
    """
    base = process.base
    ended = [failing * base.start_failure, -(price - failing) * base.start_goal]
    ended.append(process.start_charge)
    terms = max(int(np.count_nonzero(base.start)) + int(np.count_nonzero(ended)) - 1, 0)
    loss = terms * MACHINE_EPSILON * (sizes + float(np.abs(ended).sum()))
    bounds = begun + sum(ended) - loss
    bound = float(bounds[0]) if len(bounds) else sum(ended)
    return Proof(price, failing, bound, kept, Work(process.cap, 0), by_layer=bounds)


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
