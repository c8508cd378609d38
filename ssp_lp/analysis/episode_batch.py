"""Many episodes of one policy at a time: the lottery is drawn, memories are kept per episode."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.mixed import as_lottery


class EpisodeBatch:
    """The members of a policy, each playing the episodes that the lottery gave it."""

    def __init__(
        self, policy: Policy | MixedPolicy, episodes: int, rng: np.random.Generator
    ) -> None:
        """Draw one member for each episode."""
        lottery = as_lottery(policy)
        self._members, weights = lottery.policies, lottery.weights
        self._drawn = rng.choice(len(self._members), size=episodes, p=weights)
        self._memory = np.zeros(episodes, dtype=np.int64)
        self._rng = rng

    def begin(self, states: IntArray, going: BoolArray) -> None:
        """Set the memories of the episodes that do not end where they start, [episodes]."""
        for member, mine in self._shares(np.flatnonzero(going)):
            self._memory[mine] = member.start_memory(states[mine])

    def decide(self, episodes: IntArray, states: IntArray) -> IntArray:
        """A pair or GIVE_UP_CODE for each of the given episodes, in these states."""
        pairs = np.empty(len(self._drawn), dtype=np.int64)
        state = np.empty(len(self._drawn), dtype=np.int64)
        state[episodes] = states
        for member, mine in self._shares(episodes):
            pairs[mine] = member.sample(state[mine], self._memory[mine], self._rng)
        return pairs[episodes]

    def remember(
        self, episodes: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> None:
        """Move the memories of the given episodes."""
        for number, member in enumerate(self._members):
            mine = self._drawn[episodes] == number
            here = episodes[mine]
            self._memory[here] = member.remember(
                self._memory[here], pairs[mine], successors[mine], costs[mine]
            )

    def _shares(self, episodes: IntArray) -> Iterator[tuple[Policy, IntArray]]:
        """Each member with those of the episodes that it plays."""
        for number, member in enumerate(self._members):
            yield member, episodes[self._drawn[episodes] == number]
