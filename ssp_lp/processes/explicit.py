"""A substochastic process in explicit form: what every method for case M works on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics


@dataclass(frozen=True, eq=False)
class ExplicitProcess:
    """A process from which goal, failure, giving up and discounting take mass out for good.

    The rows satisfy ``transitions.sum(axis=1) + goal + failure == 1``: what does not go on has
    reached the goal or counts as failure (mathematics, section 3).
    """

    pair_offsets: IntArray  # [states + 1]
    transitions: sp.csr_array  # [pairs, states]
    start: FloatArray  # [states]
    cost: FloatArray  # [pairs] non-negative
    failure: FloatArray  # [pairs] mass that fails
    goal: FloatArray  # [pairs] mass that reaches the goal

    @property
    def n_states(self) -> int:
        """Number of states of the process."""
        return len(self.pair_offsets) - 1

    @property
    def n_pairs(self) -> int:
        """Number of pairs of the process."""
        return len(self.cost)

    @cached_property
    def dynamics(self) -> Dynamics:
        """What the process does, whatever it costs."""
        return Dynamics(self.pair_offsets, self.transitions, self.goal + self.failure)

    @cached_property
    def pair_state(self) -> IntArray:
        """The state of each pair, [pairs]."""
        return np.repeat(np.arange(self.n_states), np.diff(self.pair_offsets))
