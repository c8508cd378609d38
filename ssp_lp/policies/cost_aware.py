"""Semi-Markov policies: decisions that depend on the state and on the cost paid so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.policies.cost_layers import CostLayers
from ssp_lp.policies.deterministic import check_decisions
from ssp_lp.policies.playing import Playable
from ssp_lp.policies.policy import UNDECIDED, Branches, Policy

_OFF_LATTICE = 1e-6  # of a layer: far above the rounding of a sum of costs, far below a step


def _is_uniform(model: SSP) -> bool:
    return model.costs.strides == (0,)


@dataclass(frozen=True, eq=False, repr=False)
class CostAwarePolicy(Policy, Playable):
    """A deterministic decision for each (state, accumulated cost) below a cap, then a tail policy.

    Costs are counted in layers of ``unit``. Memory below ``cap`` is the layer. At the cap the
    policy switches for good to one of its stationary tails: to the last one (which fails where it
    can, the paper's pi'_or of section 3.5) where the layer has reached ``tail_threshold`` of the
    state, else to the first, or as ``tail_table`` says; memory is then ``cap + tail``.
    """

    model: SSP
    unit: float  # cost of one layer
    decision: IntArray  # [cap, states] position in the state's pairs, GIVE_UP_CODE or UNDECIDED
    tails: IntArray  # [tails, states] pair, GIVE_UP_CODE or UNDECIDED
    tail_threshold: FloatArray  # [states] layer from which the last tail is followed
    tail_table: IntArray | None = None  # [layers from the cap on, states] tail, for any other rule

    def __post_init__(self) -> None:
        for name in ("decision", "tails", "tail_threshold"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        if self.tail_table is not None:
            object.__setattr__(self, "tail_table", read_only(self.tail_table))
        everywhere = np.arange(self.model.n_states)
        for layer in self.decision:
            check_decisions(self.model, self._pairs(layer, everywhere), everywhere)
        check_decisions(self.model, self.tails, everywhere)

    @property
    def cap(self) -> int:
        """Number of layers of accumulated cost with decisions of their own (M / unit)."""
        return int(self.decision.shape[0])

    def member(self, rng: np.random.Generator | None) -> Policy:
        """The policy itself."""
        return self

    def start_memory(self, states: IntArray) -> IntArray:
        """Nothing is paid yet: layer 0, [episodes]."""
        return self._memory_at(np.zeros(len(states), dtype=np.int64), states)

    def layers(self) -> CostLayers | None:
        """Decisions by layer; None where a cost is no whole number of layers."""
        costs = np.unique(self.model.costs[:1] if _is_uniform(self.model) else self.model.costs)
        steps = np.rint(costs / self.unit)
        if not (np.abs(costs / self.unit - steps) <= _OFF_LATTICE).all() or self.cap == 0:
            return None
        passed, states = steps.astype(np.int64), np.arange(self.model.n_states)
        return CostLayers(
            decision=self.decision,
            tails=self.tails,
            tail_at=lambda layer: self._memory_at(np.full(len(states), layer), states) - self.cap,
            costs=costs,
            leads=lambda layer: passed,
            unit=self.unit,
            width=int(passed.max(initial=0)) + 1,
        )

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The one decision of each (state, memory)."""
        below = memory < self.cap
        pair = np.empty(len(states), dtype=np.int64)
        some = states[below]
        pair[below] = self._pairs(self.decision[memory[below], some], some)
        pair[~below] = self.tails[memory[~below] - self.cap, states[~below]]
        return Branches(np.arange(len(states)), pair, np.ones(len(states)))

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Add the observed cost; switch to a tail when the cap is reached.

        Raises:
            ModelError: a cost is no whole number of layers.
        """
        paid = np.where(np.isfinite(costs), costs / self.unit, -1.0)
        steps = np.rint(paid)
        acting = (self.tails[0, successors] != UNDECIDED) & (memory < self.cap)
        off = acting & ~((np.abs(paid - steps) <= _OFF_LATTICE) & (steps >= 0) & (steps < 1e15))
        if off.any():
            cost = float(costs[int(np.argmax(off))])
            raise ModelError(f"observed cost {cost!r} is no whole number of units {self.unit!r}")
        layer = memory + np.where(acting, steps, 0.0).astype(np.int64)
        return np.where(acting, self._memory_at(layer, successors), memory)

    def _pairs(self, decision: IntArray, states: IntArray) -> IntArray:
        """Pairs of the model in place of positions; codes stay, [k] of [k]."""
        return np.where(decision < 0, decision, self.model.pair_offsets[states] + decision)

    def _memory_at(self, layer: IntArray, states: IntArray) -> IntArray:
        last = len(self.tails) - 1
        if self.tail_table is None:
            tail = np.where(layer >= self.tail_threshold[states], last, 0)
        else:
            beyond = np.clip(layer - self.cap, 0, len(self.tail_table) - 1)
            tail = self.tail_table[beyond, states].astype(np.int64)
        return np.where(layer < self.cap, layer, self.cap + tail)

    def __repr__(self) -> str:
        """One line: the cap and the unit."""
        return f"CostAwarePolicy({self.cap} layers of cost {self.unit:g})"
