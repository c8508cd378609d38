"""Playing a policy step by step: reset, action, observe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_pairs, attention_states
from ssp_lp.policies.episode_batch import EpisodeBatch
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED, Policy
from ssp_lp.policies.randomness import Randomness, generator_of


@dataclass
class Episode:
    """One episode of a policy: the member drawn, its memory, whether it gave up. Mutable.

    Any number of episodes run side by side, each with a memory of its own.
    """

    policy: Policy
    rng: np.random.Generator | None
    memory: IntArray | None = None
    taken: int = UNDECIDED  # the pair of the last action
    staying: IntArray | None = None  # [states], once the episode goes on after giving up

    def action(self, state: Hashable) -> Hashable:
        """The action in this state, or :data:`GIVE_UP`, with which the episode ends.

        Raises:
            ModelError: unknown state, or one in which the policy has no decision.
        """
        model = self.policy.model
        here = np.array([model.index_of(state)])
        if self.staying is not None:
            pair = int(self.staying[here[0]])
            if pair == UNDECIDED:
                raise ModelError(f"no action of state {state!r} surely avoids the goal")
            return model.action_of(pair)
        if self.memory is None:
            self.memory = self.policy.start_memory(here)
        pair = self.taken = int(self.policy.sample(here, self.memory, self.rng)[0])
        return GIVE_UP if pair == GIVE_UP_CODE else model.action_of(pair)

    def observe(self, successor: Hashable, cost: float) -> None:
        """Tell where the step led and what it cost; this moves the memory.

        Raises:
            ModelError: a cost off the lattice that the policy was made for.
        """
        if self.memory is None:
            raise ModelError("observe() was called before the first action() of the episode")
        if self.staying is None:
            there = np.array([self.policy.model.index_of(successor)])
            taken, paid = np.array([self.taken]), np.array([float(cost)])
            self.memory = self.policy.remember(self.memory, taken, there, paid)

    def continue_after_give_up(self) -> None:
        """From now on play the policy that stays in the attention states (it avoids the goal)."""
        self.staying = staying_policy(self.policy.model)


class Playable(ABC):
    """Mix-in of the policies that a person's own loop can drive.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> policy = DeterministicPolicy.from_actions(model, {"door": "open"})
        >>> policy.reset(0)
        >>> policy.action("door")
        'open'
        >>> policy.observe("out", 2.0)
    """

    _episode: Episode | None = None

    @abstractmethod
    def member(self, rng: np.random.Generator | None) -> Policy:
        """The policy that plays the next episode, drawn where there is a lottery."""

    def start(self, rng: Randomness | None = None) -> Episode:
        """A new episode of its own, beside any others; ``rng`` draws the lottery and actions.

        Args:
            rng: a generator, which goes on from episode to episode, or a seed, with which every
                episode begins afresh.

        Raises:
            ModelError: a lottery without a generator.
        """
        drawn = None if rng is None else generator_of(rng)
        return Episode(self.member(drawn), drawn)

    def start_many(self, episodes: int, rng: Randomness | None = None) -> EpisodeBatch:
        """Many new episodes side by side, whose ``actions`` are asked for all at once.

        Args:
            episodes: how many.
            rng: as of :meth:`start`.

        Raises:
            ModelError: no episodes, or a lottery without a generator.
        """
        if episodes < 1:
            raise ModelError(f"episodes must be at least 1, not {episodes!r}")
        drawn = None if rng is None else generator_of(rng)
        return EpisodeBatch(*self.draw(episodes, drawn), drawn)

    def draw(
        self, episodes: int, rng: np.random.Generator | None
    ) -> tuple[tuple[Policy, ...], IntArray]:
        """The members of the lottery, and the position of the one that plays each episode."""
        return (self.member(rng),), np.zeros(episodes, dtype=np.int64)

    def reset(self, rng: Randomness | None = None) -> None:
        """Begin the policy's own episode afresh; ``rng`` draws the lottery and random actions.

        Raises:
            ModelError: a lottery without a generator.
        """
        object.__setattr__(self, "_episode", self.start(rng))

    def action(self, state: Hashable) -> Hashable:
        """The action in this state, or :data:`GIVE_UP`, with which an episode ends.

        Raises:
            ModelError: unknown state, or one in which the policy has no decision.
        """
        return self._current().action(state)

    def observe(self, successor: Hashable, cost: float) -> None:
        """Tell the policy where the step led and what it cost; this moves its memory.

        Raises:
            ModelError: a cost off the lattice that the policy was made for.
        """
        self._current().observe(successor, cost)

    def continue_after_give_up(self) -> None:
        """From now on play the policy that stays in the attention states (it avoids the goal)."""
        self._current().continue_after_give_up()

    def _current(self) -> Episode:
        if self._episode is None:
            raise ModelError("call reset(rng) before the first action of an episode")
        return self._episode


def staying_policy(model: SSP) -> IntArray:
    """A pair that surely avoids the goal in each state that has one, else UNDECIDED, [states]."""
    pairs = np.flatnonzero(attention_pairs(model, attention_states(model)))
    states = model.pair_state[pairs]
    first = np.flatnonzero(np.diff(states, prepend=-1))
    decision = np.full(model.n_states, UNDECIDED, dtype=np.int64)
    decision[states[first]] = pairs[first]
    return decision
