"""Accumulated cost up to a cap and one place for all costs beyond it, with its way back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.flow import decisions
from ssp_lp.processes.layered.open_ended import OpenEnded
from ssp_lp.programs.accumulated_cost import layer_flows
from ssp_lp.programs.augmented import START, ColumnLabel


@dataclass(frozen=True, eq=False)
class OpenEndedModel:
    """States and the cost paid so far; from the cap on one policy for all costs."""

    layered: OpenEnded

    @property
    def process(self) -> ExplicitProcess:
        """All layers, whose pairs are the columns."""
        return self.layered.process

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        return self.layered.base.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        own = self.layered.base.quotient.gives_up
        return np.append(np.tile(own, self.layered.cap + 1), False)

    def label(self, pair: int) -> ColumnLabel:
        """The state, the action and the accumulated cost of a pair; the last stands for more."""
        base = self.layered.base
        if pair == self.process.n_pairs - 1:
            return ColumnLabel(None, START, 0.0)
        layer, inner = divmod(pair, len(base.gain))
        return ColumnLabel(*base.quotient.named(inner), float(self.layered.totals[layer]))

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """One pair of the process for each accumulated cost."""
        base = self.layered.base
        layers = np.arange(self.layered.cap + 1)[:, None] * len(base.gain)
        return np.asarray((layers + base.quotient.places_of(pair, state)).ravel())

    def policy(self, choice: IntArray) -> CostAwarePolicy:
        """One decision for each state and accumulated cost."""
        return self.layered.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A policy on states and accumulated cost."""
        layered, n_states = self.layered, self.model.n_states
        carrier, everywhere = self.policy(choice), np.arange(n_states)
        flows = layer_flows(layered.base, visits, layered.start, layered.cap + 1, layered.leads[0])
        found = []
        for layer, flow in enumerate(flows):
            otherwise = carrier.branches(everywhere, np.full(n_states, layer)).pair
            state, pair, share = decisions(layered.base.quotient, flow, otherwise)
            found.append((layer * n_states + state, pair, share))
        keys, pairs, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return StochasticPolicy.from_flows(self.model, keys, pairs, shares, carrier)
