"""Episodes of a policy, one or many at a time: which member plays, and what it remembers."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_pairs, attention_states, dead_ends
from ssp_lp.policies.policy import GIVE_UP, GIVE_UP_CODE, UNDECIDED, Policy


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


class EpisodeBatch:
    """The members of a policy, each playing the episodes that the lottery gave it. Mutable.

    A person's own loop calls ``actions`` and ``observe`` with the states of all episodes;
    ``begin``, ``decide`` and ``remember`` take indices of episodes, states and pairs.
    """

    def __init__(
        self, members: Sequence[Policy], drawn: IntArray, rng: np.random.Generator | None
    ) -> None:
        """Begin episodes.

        Args:
            members: the policies that play.
            drawn: the position of the one that plays each episode, [episodes].
            rng: draws random actions; None: there are none to draw.
        """
        self._members, self._drawn, self._rng = tuple(members), drawn, rng
        self._model = self._members[0].model
        self._memory = np.zeros(len(drawn), dtype=np.int64)
        self._pairs = np.full(len(drawn), UNDECIDED, dtype=np.int64)  # of the last actions
        self._begun = False

    def actions(self, states: Sequence[Hashable]) -> list[Hashable]:
        """The action of each episode in its state, [episodes].

        It is :data:`GIVE_UP` from where an episode gives up, and None where one is over, in a goal
        or in a dead-end; what state is said of it then does not matter.

        Args:
            states: [episodes].

        Raises:
            ModelError: unknown state, another number of episodes, or a state in which the policy
                has no decision.
        """
        here = self._indices(states)
        gave_up = self._pairs == GIVE_UP_CODE
        going = ~(self._over[here] | gave_up)
        if not self._begun:
            self.begin(here, going)
            self._begun = True
        playing = np.flatnonzero(going)
        self._pairs = np.where(gave_up, GIVE_UP_CODE, UNDECIDED)
        self._pairs[playing] = self.decide(playing, here[playing])
        told = {GIVE_UP_CODE: GIVE_UP, UNDECIDED: None}
        return [told[k] if k in told else self._model.action_of(k) for k in self._pairs.tolist()]

    def observe(self, successors: Sequence[Hashable], costs: Sequence[float] | FloatArray) -> None:
        """Tell where the step of each episode led and what it cost; this moves the memories.

        Args:
            successors: [episodes]; of those that are over, any state.
            costs: [episodes].

        Raises:
            ModelError: unknown state, another number of episodes, or a cost off the lattice that
                the policy was made for.
        """
        there, paid = self._indices(successors), np.asarray(costs, dtype=np.float64)
        if paid.shape != there.shape:
            raise ModelError(f"{paid.size} costs given for {there.size} episodes")
        moved = np.flatnonzero((self._pairs >= 0) & ~self._over[there])
        self.remember(moved, self._pairs[moved], there[moved], paid[moved])

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

    @cached_property
    def _over(self) -> BoolArray:
        """The states in which episodes are over, [states]."""
        return np.asarray(self._model.goal_mask | dead_ends(self._model))

    def _indices(self, states: Sequence[Hashable]) -> IntArray:
        """The positions of the episodes' states."""
        if len(states) != len(self._drawn):
            raise ModelError(f"{len(states)} states given for {len(self._drawn)} episodes")
        return np.array([self._model.index_of(state) for state in states], dtype=np.int64)


def staying_policy(model: SSP) -> IntArray:
    """A pair that surely avoids the goal in each state that has one, else UNDECIDED, [states]."""
    pairs = np.flatnonzero(attention_pairs(model, attention_states(model)))
    states = model.pair_state[pairs]
    first = np.flatnonzero(np.diff(states, prepend=-1))
    decision = np.full(model.n_states, UNDECIDED, dtype=np.int64)
    decision[states[first]] = pairs[first]
    return decision
