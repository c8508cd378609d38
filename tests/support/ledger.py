"""A policy that plays another one and also keeps accounts of the cost paid."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends
from ssp_lp.policies.policy import Branches, Policy

_OFF_LATTICE = 1e-6  # of a layer: far above the rounding of one cost, far below a step


@dataclass(frozen=True, eq=False, repr=False)
class Ledger(Policy):
    """Any policy, with the cost paid so far beside its own memory.

    The memory is ``inner memory * (horizon + 2) + layer``. Layers ``0 .. horizon`` are whole
    multiples of ``unit``; what lies beyond is one layer more, which is never left. What entering a
    dead-end costs is not booked: no success pays it, and it may lie off the lattice.
    """

    policy: Policy
    unit: Fraction  # cost of one layer
    horizon: int  # last layer that is told apart

    def __post_init__(self) -> None:
        if self.unit <= 0 or self.horizon < 0:
            raise ModelError("a ledger needs a unit above 0 and a horizon of at least 0")

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """The model that the inner policy acts on."""
        return self.policy.model

    def layer(self, memory: IntArray) -> IntArray:
        """Layers paid so far, ``horizon + 1`` beyond the horizon, like ``memory``."""
        return np.asarray(memory) % (self.horizon + 2)

    def start_memory(self, states: IntArray) -> IntArray:
        """The inner start memory, and nothing paid, [episodes]."""
        return self.policy.start_memory(states).astype(np.int64) * (self.horizon + 2)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """What the inner policy decides."""
        return self.policy.branches(states, np.asarray(memory) // (self.horizon + 2))

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move the inner memory and book the cost, which must be a whole number of units."""
        inner, layer = np.divmod(memory, self.horizon + 2)
        paid = np.where(dead_ends(self.model)[successors], 0.0, costs / float(self.unit))
        steps = np.rint(paid)
        off = ~((np.abs(paid - steps) <= _OFF_LATTICE) & (steps >= 0.0))
        if off.any():
            cost = float(costs[int(np.argmax(off))])
            raise ModelError(f"observed cost {cost!r} is no whole number of units {self.unit}")
        booked = np.minimum(layer + steps, self.horizon + 1).astype(np.int64)
        after = self.policy.remember(inner, pairs, successors, costs).astype(np.int64)
        return np.asarray(after * (self.horizon + 2) + booked)

    def __repr__(self) -> str:
        return f"Ledger({self.policy!r}, {self.horizon:,} layers of cost {float(self.unit):g})"
