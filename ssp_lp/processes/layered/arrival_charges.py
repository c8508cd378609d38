"""What arriving at the goal is charged in expectation, pair by pair and layer by layer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.bellman import PairCost
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.arrival_cost import Charge, TotalCost

_TABLE = 1_000_000
"""Charges, layers x pairs or x layers of a step, that are worked out together."""


@dataclass(frozen=True, eq=False)
class ArrivalCharges:
    """A charge of the total cost at the pairs of an accumulated-cost process."""

    base: AccumulatedCost
    charge: Charge
    n_layers: int  # how many will be asked for

    @property
    def grow_evenly(self) -> bool:
        """Whether the charge is the total cost itself, so that a layer adds the same everywhere."""
        return isinstance(self.charge, TotalCost)

    def from_layer(self, layer: int) -> PairCost:
        """Expected charge of arriving at the goal by each pair from a layer, [pairs]."""
        base = self.base
        if self.grow_evenly or base.arrivals is None:
            return PairCost(base.gain_cost, self._growth, float(layer))
        size = max(_TABLE // max(*base.arrivals.shape, 1), 1)
        block, place = divmod(layer, size)
        if block not in self._blocks:
            width, layers = base.arrivals.shape[1], min(size, self.n_layers)
            ahead = block * size + np.arange(layers + width - 1)
            windows = sliding_window_view(self.charge.at(ahead, base.exact_unit), width)
            self._blocks.clear()
            self._blocks[block] = np.ascontiguousarray((base.arrivals @ windows.T).T)
        return PairCost(self._blocks[block][place])

    @property
    def at_start(self) -> float:
        """Charge of the start mass that lies on goals."""
        at_once = self.charge.at(np.zeros(1, dtype=np.int64), self.base.exact_unit)
        return self.base.start_goal * float(at_once[0])

    @cached_property
    def _growth(self) -> FloatArray:
        """What a layer adds to the charge of each pair in case S, [pairs]."""
        return np.asarray(self.base.gain * self.base.unit)

    @cached_property
    def _blocks(self) -> dict[int, FloatArray]:
        """Charges of a block of layers, kept: [layers, pairs] by the number of the block."""
        return {}
