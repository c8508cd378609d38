"""Case M's process with its way back to the model (paper, section 3.1.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.policies.stochastic import StochasticPolicy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled
from ssp_lp.processes.flow import decisions, model_flow, moving_within
from ssp_lp.programs.augmented import START, ColumnLabel


@dataclass(frozen=True, eq=False)
class LabelledModel:
    """The states that have not failed yet; what fails leaves the process."""

    labelled: FailureLabelled
    start: FloatArray  # [states]

    @property
    def process(self) -> ExplicitProcess:
        """The process, whose pairs are the columns."""
        return self.labelled.process

    @property
    def model(self) -> SSP:
        """The model that it augments."""
        return self.labelled.quotient.model

    @property
    def gives_up(self) -> BoolArray:
        """Pairs by which a policy gives up, [process pairs]."""
        mask = np.zeros(self.process.n_pairs, dtype=np.bool_)
        own = self.labelled.quotient.gives_up
        mask[: own.size] = own
        return mask

    def label(self, pair: int) -> ColumnLabel:
        """The state and the action of a pair."""
        quotient = self.labelled.quotient
        if pair >= len(quotient.pair_at):
            return ColumnLabel(None, START)
        return ColumnLabel(*quotient.named(pair))

    def pairs_of(self, pair: int, state: int) -> IntArray:
        """The one pair of the process, or none."""
        return self.labelled.quotient.places_of(pair, state)

    def policy(self, choice: IntArray) -> DeterministicPolicy:
        """One decision per state."""
        return self.labelled.policy(choice)

    def randomised_policy(self, visits: FloatArray, choice: IntArray) -> StochasticPolicy:
        """A stationary policy on the model's states."""
        quotient = self.labelled.quotient
        n_pairs = len(quotient.pair_at)
        flow = model_flow(quotient, visits[:n_pairs] / self.labelled.departs)
        flow = moving_within(quotient, flow, self.start + flow.entering(quotient))
        otherwise = self.policy(choice).decision.astype(np.int64)
        return StochasticPolicy.from_flows(self.model, *decisions(quotient, flow, otherwise))
