"""How a policy that remembers the cost paid moves from layer to layer, without its nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ssp_lp.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class CostLayers:
    """A decision for each (layer, state); beyond the last layer a tail is followed for good."""

    decision: IntArray  # [layers, states] position in the state's pairs, or a code
    tails: IntArray  # [tails, states] pair, or a code
    tail_at: Callable[[int], IntArray]  # layer beyond the last one -> tail of each state, [states]
    costs: FloatArray  # [classes] the distinct costs of a step, increasing
    leads: Callable[[int], IntArray]  # layer -> layers that each class of step passes, [classes]
    unit: float | None  # cost of a layer; None: layers are levels that totals are rounded to
    width: int  # 1 + the most layers that a step passes
    rounds_up: bool = False  # whether steps that cost no whole number of units pass one layer more

    @property
    def count(self) -> int:
        """Number of layers."""
        return len(self.decision)
