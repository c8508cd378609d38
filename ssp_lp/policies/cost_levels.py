"""Policies whose memory is the cost paid so far, on levels that need not be evenly spaced."""

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


@dataclass(frozen=True, eq=False, repr=False)
class CostLevelPolicy(Policy, Playable):
    """A deterministic decision for each (state, level of accumulated cost).

    Memory is the level: after a step it is the one nearest to the last level plus the step's cost.
    Where the levels are all sums that can occur, that is the cost paid; on a grid it is what is
    left of it after rounding at every step, and the policy is what it is: its cost and failure are
    evaluated with the true costs. From the last level on one decision holds for good.

    Raises:
        ModelError: levels that do not rise from 0, or decisions of another shape.
    """

    model: SSP
    levels: FloatArray  # [levels] increasing, the first is 0
    decision: IntArray  # [levels, states] position in the state's pairs, GIVE_UP_CODE or UNDECIDED

    def __post_init__(self) -> None:
        for name in ("levels", "decision"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        rising = len(self.levels) > 1 and bool((np.diff(self.levels) > 0.0).all())
        if not (rising and self.levels[0] == 0.0 and np.isfinite(self.levels[-1])):
            raise ModelError("levels of accumulated cost must rise from 0 and be finite")
        if self.decision.shape != (len(self.levels), self.model.n_states):
            raise ModelError("a policy on levels needs a decision for each level and state")
        everywhere = np.arange(self.model.n_states)
        for level in self.decision:
            check_decisions(self.model, self._pairs(level, everywhere), everywhere)

    def member(self, rng: np.random.Generator | None) -> Policy:
        """The policy itself."""
        return self

    def start_memory(self, states: IntArray) -> IntArray:
        """Nothing is paid yet: level 0, [episodes]."""
        return np.zeros(len(states), dtype=np.int64)

    def layers(self) -> CostLayers:
        """Decisions by level, the last of which is the tail."""
        costs, last = np.unique(self.model.costs), len(self.levels) - 1

        def leads(level: int) -> IntArray:
            here = np.full(len(costs), level)
            return self._moved(here, costs) - level

        return CostLayers(
            decision=self.decision[:last],
            tails=self._pairs(self.decision[last], np.arange(self.model.n_states))[None, :],
            tail_at=lambda level: np.zeros(self.model.n_states, dtype=np.int64),
            costs=costs,
            leads=leads,
            unit=None,
            width=max(int(leads(level).max(initial=0)) for level in range(last)) + 1,
        )

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The one decision of each (state, memory)."""
        pair = self._pairs(self.decision[memory, states], states)
        return Branches(np.arange(len(states)), pair, np.ones(len(states)))

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """The level nearest to the total; the last one stays."""
        acting = self.decision[0, successors] != UNDECIDED
        moving = acting & (memory < len(self.levels) - 1)
        return np.where(moving, self._moved(memory, costs), memory)

    def _moved(self, memory: IntArray, costs: FloatArray) -> IntArray:
        """The level after a cost, like ``costs``."""
        last = len(self.levels) - 1
        total = self.levels[memory] + np.where(np.isfinite(costs), costs, 0.0)
        above = np.clip(np.searchsorted(self.levels, total), 1, max(last, 1))
        below = self.levels[above - 1]
        nearest = np.where(total - below <= self.levels[above] - total, above - 1, above)
        return np.maximum(np.minimum(nearest, last), memory)

    def _pairs(self, decision: IntArray, states: IntArray) -> IntArray:
        """Pairs of the model in place of positions; codes stay, [k] of [k]."""
        return np.where(decision < 0, decision, self.model.pair_offsets[states] + decision)

    def __repr__(self) -> str:
        """One line: the levels and the last of them."""
        return f"CostLevelPolicy({len(self.levels):,} levels up to {self.levels[-1]:g})"
