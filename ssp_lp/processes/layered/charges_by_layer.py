"""What arriving at the goal is charged in expectation, pair by pair and layer by layer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.bellman import PairCost
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.charges import Charge, TotalCost
from ssp_lp.processes.totals.lattice import totals_of

_TABLE = 1_000_000
"""Charges, layers x pairs or x layers of a step, that are worked out together."""


@dataclass(frozen=True, eq=False)
class ArrivalCharges:
    """A charge of the total cost at the pairs of an accumulated-cost process."""

    base: AccumulatedCost
    charge: Charge
    totals: FloatArray  # [layers] what has been paid there

    @property
    def grow_evenly(self) -> bool:
        """Whether the charge is the total cost itself, so that a layer adds the same everywhere."""
        return isinstance(self.charge, TotalCost)

    def from_layer(self, layer: int) -> PairCost:
        """Expected charge of arriving at the goal by each pair from a layer, [pairs]."""
        base = self.base
        if self.grow_evenly or base.arrivals is None:
            return PairCost(base.gain_cost, base.gain, float(self.totals[layer]))
        size = max(_TABLE // max(*base.arrivals.shape, 1), 1)
        block, place = divmod(layer, size)
        if block not in self._blocks:
            charged = self._charged(block * size, min(size, len(self.totals)))
            self._blocks.clear()
            self._blocks[block] = np.ascontiguousarray((base.arrivals @ charged.T).T)
        return PairCost(self._blocks[block][place])

    def _charged(self, first: int, n_layers: int) -> FloatArray:
        """Charge of arriving from some layers by each kind of step, [layers, kinds]."""
        base = self.base
        if base.last_steps is not None:
            paid = self.totals[first : first + n_layers, None]
            return self.charge.at(paid + base.last_steps)
        width = base.lattice.width
        ahead = first + np.arange(n_layers + width - 1)
        return sliding_window_view(self.charge.at(totals_of(ahead, base.exact_unit)), width)

    @property
    def at_start(self) -> float:
        """Charge of the start mass that lies on goals."""
        return self.base.start_goal * float(self.charge.at(np.zeros(1))[0])

    @cached_property
    def _blocks(self) -> dict[int, FloatArray]:
        """Charges of a block of layers, kept: [layers, pairs] by the number of the block."""
        return {}
