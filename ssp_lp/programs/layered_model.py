"""Accumulated cost written out in layers, with its way back to the model (paper, section 3.1.1).

Its last layer stands for all costs beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.accumulated_cost.process import spread_layer
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.stationary import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.flow import ModelFlow, Spread, decisions, model_flow, moving_within
from ssp_lp.processes.quantities.conditions import Term
from ssp_lp.processes.quotient import Quotient
from ssp_lp.programs.augmented import Augmented


@dataclass(frozen=True, eq=False)
class LayeredModel(Augmented):
    """States and the cost paid so far; from the cap on one policy for all costs."""

    layered: OpenEnded
    start: FloatArray  # [states]

    @property
    def process(self) -> ExplicitProcess:
        """All layers, written out."""
        return self.layered.process

    @property
    def quotient(self) -> Quotient:
        """The live part of a layer."""
        return self.layered.base.quotient

    @property
    def departs(self) -> FloatArray:
        """As the rows of a layer were divided."""
        return self.layered.base.departs

    def flows(self, visits: FloatArray) -> Iterator[ModelFlow]:
        """One flow for each layer, the open end included; what enters a layer left another."""
        base, quotient, below = self.layered.base, self.quotient, self.layered.leads[0]
        model, merged, n_pairs = quotient.model, bool(quotient.merged.any()), len(base.gain)
        entering = np.zeros((self.copies + base.width if merged else 0, model.n_states))
        entering[:1] = self.layered.start
        for layer in range(self.copies):
            taken = visits[layer * n_pairs : (layer + 1) * n_pairs] / base.departs
            flow = model_flow(quotient, taken)
            if merged:
                mass = np.repeat(flow.pairs, np.diff(model.outcome_offsets)) * model.probabilities
                moved = np.flatnonzero(mass)
                reached = below[layer, base.step_classes.ahead[moved]]
                np.add.at(entering, (reached, model.successors[moved]), mass[moved])
                flow = moving_within(quotient, flow, entering[layer])
            yield flow

    def spread(self, spread: Spread) -> LayeredModel:
        """The layers spread out."""
        base = spread_layer(self.layered.base, spread, self.start)
        return replace(self, layered=replace(self.layered, base=base))

    def counted(self, term: Term) -> FloatArray:
        """The same in all layers, [process pairs]."""
        return self.layered.everywhere(*term.at(self.layered.counting()))

    @property
    def copies(self) -> int:
        """The layers up to the cap, which stands for all costs beyond it."""
        return self.layered.cap + 1

    def paid(self, copy: int) -> float:
        """The layer's total; the last stands for more."""
        return float(self.layered.totals.values[copy])

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """One decision for each state and accumulated cost."""
        return self.layered.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A policy on states and accumulated cost."""
        carrier, n_states, found = self.policy(choice), self.model.n_states, []
        for layer, flow in enumerate(self.flows(visits)):  # the carrier's where none is visited
            otherwise = carrier.branches(np.arange(n_states), np.full(n_states, layer)).pair
            state, pair, share = decisions(self.quotient, flow, otherwise)
            found.append((layer * n_states + state, pair, share))
        keys, pairs, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, carrier)
