"""How costs and arrivals of a model are counted at the pairs of an augmented process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, BoolArray, FloatArray
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_states
from ssp_lp.processes.expectations import cost_means, successor_means
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    dead_end_charges,
    give_up_charges,
)
from ssp_lp.processes.quotient import Quotient

_DUST = 8.0 * MACHINE_EPSILON  # of what leaves by a pair: the rounding of a difference


@dataclass(frozen=True, eq=False)
class Counting:
    """A process as far as counting needs it: pairs of its quotient, and a source.

    The source is where start mass on goals and dead-ends enters (``programs.augmented``); what is
    counted there comes second in every answer.
    """

    quotient: Quotient
    departs: FloatArray  # [pairs] what rows were divided by
    goal: FloatArray  # [pairs] mass that reaches the goal
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [states]
    semantics: FailureSemantics
    survival: float  # the discount, 1 in the exact setting

    def cost(self, model: SSP) -> tuple[FloatArray, float]:
        """Another cost of the same model, charged as its own is, [pairs].

        Args:
            model: the model with the other costs.
        """
        cost, entering = stage_costs(model, self.quotient, self.semantics, self.survival)
        return cost / self.departs, float(self.start @ entering)

    def arrivals(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Probability of stepping into some states, [pairs], and of starting in those that end."""
        into = self.quotient.at_pairs(successor_means(self.quotient.model, states))
        ended = states & (self.quotient.node_of < 0)
        return self.survival * into / self.departs, float(self.start[ended].sum())

    def endings(self) -> tuple[FloatArray, float]:
        """Mass that leaves the process, [pairs]."""
        return self.goal + self.failure, float(self.start[self.quotient.node_of < 0].sum())

    def other_endings(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Mass that leaves otherwise than by stepping into some final states, [pairs]."""
        if (states == self.quotient.model.goal_mask).all():
            return self.failure, float(self.start[self.quotient.dead].sum())
        (every, at_once), (into, there) = self.endings(), self.arrivals(states)
        left = every - into
        return np.where(left <= _DUST * every, 0.0, left), max(at_once - there, 0.0)


def stage_costs(
    model: SSP, quotient: Quotient, semantics: FailureSemantics, survival: float
) -> tuple[FloatArray, FloatArray]:
    """Expected cost of each pair, charges included, and what entering each dead-end costs.

    Args:
        model: the model whose costs are meant.
        quotient: the live part of it.
        semantics: what giving up and entering a dead-end is charged.
        survival: the discount.

    Returns:
        [quotient pairs] and [states].
    """
    means = cost_means(model)
    charges = give_up_charges(model, attention_states(model), quotient.merged, semantics, means)
    entering = dead_end_charges(model, quotient.dead, semantics, means)
    stage = quotient.at_pairs(means, quotient.least_over_members(charges))
    if entering.any():
        stage = stage + survival * quotient.at_pairs(successor_means(model, entering))
    return stage, entering
