"""What every policy can do: decide and remember, for many episodes at once."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar, Final, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model import SSP
from ssp_lp.policies.cost_layers import CostLayers


class Decision(enum.Enum):
    """What a policy may answer besides an action of the model."""

    GIVE_UP = "give up"


GIVE_UP: Final = Decision.GIVE_UP

GIVE_UP_CODE: Final = -1
"""Stands for :data:`GIVE_UP` in arrays of pairs."""

UNDECIDED: Final = -2
"""Stands in arrays of pairs for states in which a policy never has to act."""


class Branches(NamedTuple):
    """The possible decisions in several situations at once, one entry per branch."""

    situation: IntArray  # [branches] position among the situations asked about
    pair: IntArray  # [branches] pair of the model, or GIVE_UP_CODE
    probability: FloatArray  # [branches]


class Policy(ABC):
    """A policy without or with a finite memory, which starts, decides and remembers.

    The three abstract methods work on many episodes at once. Memory is an integer whose meaning
    is the policy's own; it never decreases along an episode unless ``monotone`` is false.
    """

    model: SSP
    monotone: bool = True
    is_stationary: ClassVar[bool] = False  # whether there is no memory at all

    @property
    def step_limit(self) -> int | None:
        """The steps within which it was made to reach the goal; None: it knows of none."""
        return None

    @abstractmethod
    def start_memory(self, states: IntArray) -> IntArray:
        """Memory at the start of episodes that begin in these states, [episodes]."""

    def layers(self) -> CostLayers | None:
        """The policy layer by layer of the cost paid; None where its memory is another one."""
        return None

    @abstractmethod
    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The decisions with their probabilities in each (state, memory), [situations]."""

    @abstractmethod
    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Memory after taking these pairs to these successors at these costs, [episodes]."""

    def sample(
        self, states: IntArray, memory: IntArray, rng: np.random.Generator | None
    ) -> IntArray:
        """Draw one decision per episode: a pair or GIVE_UP_CODE, [episodes].

        Raises:
            ModelError: the policy has no decision in one of the states.
        """
        found = self.branches(states, memory)
        if len(found.situation) == len(states):  # one branch each: nothing to draw
            pairs = found.pair
        else:
            if rng is None:
                raise ModelError("a stochastic policy needs a random generator: reset(rng)")
            cumulative = np.cumsum(found.probability)
            first = np.searchsorted(found.situation, np.arange(len(states)))
            before = np.concatenate([[0.0], cumulative])[first]
            last = np.concatenate([first[1:], [len(found.situation)]]) - 1
            drawn = np.searchsorted(cumulative, before + rng.random(len(states)), side="right")
            pairs = found.pair[np.clip(drawn, first, last)]
        if (pairs == UNDECIDED).any():
            state = self.model.states[int(states[int(np.argmax(pairs == UNDECIDED))])]
            raise ModelError(f"the policy has no decision in state {state!r}")
        return pairs


def check_policies(policies: Iterable[object]) -> None:
    """Raise :class:`ModelError` unless all of these are policies; a solution has one."""
    for one in policies:
        if not isinstance(one, Policy):
            told = "; pass solution.policy" if hasattr(one, "policy") else ""
            raise ModelError(f"a policy is needed, not {in_short(one)}{told}")
