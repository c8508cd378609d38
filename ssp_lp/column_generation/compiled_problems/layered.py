"""What compiled problems on accumulated cost have in common: the methods' views of a process."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ssp_lp.arrays import IntArray
from ssp_lp.column_generation.pricing.layered import LayeredPricing
from ssp_lp.column_generation.pricing.pricing_problem import Column, required
from ssp_lp.errors import ModelError
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess, chosen_pairs, materialise

MOST_ENTRIES = 800_000_000
"""Largest table of decisions, nodes x layers: 0.8 GB a policy at a byte each."""


def check_table(layers: int, base: AccumulatedCost, remedy: str) -> None:
    """Raise :class:`ModelError` with a remedy where a table of so many layers is too large."""
    if (layers + base.width) * base.n_nodes > MOST_ENTRIES:
        raise ModelError(
            f"{layers:.6g} layers of accumulated cost (unit {base.unit:g}) on {base.n_nodes:,} "
            f"states are too many; a coarser grid of costs, or a smaller {remedy}, makes it less"
        )


class CompiledLayered(ABC):
    """An compiled whose process is layered."""

    @property
    @abstractmethod
    def process(self) -> LayeredProcess:
        """The process cut at the cap."""

    def pricing(self) -> LayeredPricing:
        """One backward sweep over the layers."""
        return LayeredPricing(self.process)

    def explicit(self) -> ExplicitProcess:
        """All layers below the cap, written out."""
        return materialise(self.process)

    def explicit_choice(self, column: Column) -> IntArray:
        """The column's pairs in all layers, its tails beyond them and the source's only pair."""
        return chosen_pairs(self.process, required(column.choice), column.tail_price)

    def tail_loss(self, price: float, *, slack: bool = False) -> float:
        """How much of a bound at this price the cap costs; 0 where it is proved lossless."""
        return self.pricing().tail_loss(price, slack=slack)
