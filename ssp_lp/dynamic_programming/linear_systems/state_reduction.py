"""State reduction of a dense chain without subtractions; its twin: ``compiled``, elimination."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.dynamic_programming.linear_systems.equations import HOLDS_MASS
from ssp_lp.errors import SolverError


def reduce_states(inner: FloatArray, leaving: FloatArray, rewards: FloatArray) -> FloatArray:
    """Expected total rewards of a chain, with every entry's relative accuracy where they are >= 0.

    Grassmann, Taksar and Heyman (1985): a state is taken out by sending what would enter it to
    where it goes next; the probability of departing is summed, never formed as 1 - p.

    Args:
        inner: probabilities among the states, [states, states]; overwritten.
        leaving: probabilities of leaving for good, [states]; overwritten.
        rewards: [states, rewards]; overwritten.

    Returns:
        Totals, [states, rewards].

    Raises:
        SolverError: some states are never left.
    """
    for i in range(len(leaving) - 1, -1, -1):
        departs = leaving[i] + inner[i, :i].sum()
        if departs <= 0.0:
            raise SolverError(HOLDS_MASS)
        inner[i, :i] /= departs
        leaving[i] /= departs
        rewards[i] /= departs
        weight = inner[:i, i]
        inner[:i, :i] += np.outer(weight, inner[i, :i])
        leaving[:i] += weight * leaving[i]
        rewards[:i] += np.outer(weight, rewards[i])
    for i in range(1, len(leaving)):
        rewards[i] += inner[i, :i] @ rewards[:i]
    return rewards
