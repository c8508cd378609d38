"""What the pairs of an accumulated-cost process cost from layer to layer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.bellman import PairCost
from ssp_lp.processes.layered.layered_process import LayeredProcess


@dataclass(frozen=True, eq=False)
class Summands:
    """The parts of each pair's backup, for counting rounding (see ``safe_minima``)."""

    cost: PairCost
    magnitude: FloatArray  # [pairs]
    alone: FloatArray  # [pairs]


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
        sums = Summands(PairCost(paid - saved, even.slope), paid + saved, owed)
        return lambda layer: replace(sums, cost=replace(sums.cost, factor=float(totals[layer])))

    def summed(layer: int) -> Summands:
        fixed = process.charged(layer).fixed
        return Summands(PairCost(fixed + owed - saved), np.abs(fixed) + owed + saved, owed)

    return summed
