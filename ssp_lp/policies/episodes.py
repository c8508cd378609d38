"""Episodes of a policy, one or many at a time: which member plays, and what it remembers."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from functools import cached_property
from typing import get_args

import numpy as np

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    offsets_of,
    segment_sums,
)
from ssp_lp.errors import ModelError, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph.reachability import attention_pairs, attention_states, dead_ends
from ssp_lp.policies.policy import (
    GIVE_UP,
    GIVE_UP_CODE,
    UNDECIDED,
    Policy,
    World,
    check_costs,
)

_OTHER_WORLD = "start(rng, world='other') plays where the model does not hold"


class EpisodeBatch:
    """The members of a policy, each playing the episodes that the lottery gave it. Mutable.

    A person's own loop calls ``actions`` and ``observe`` with the states of all episodes;
    ``begin``, ``decide`` and ``remember`` take indices of episodes, states and pairs. An episode
    is over from a goal, a dead-end or giving up on, whatever is said of it afterwards.
    """

    def __init__(
        self,
        members: Sequence[Policy],
        drawn: IntArray,
        rng: np.random.Generator | None,
        world: World = "model",
    ) -> None:
        """Begin episodes.

        Args:
            members: the policies that play.
            drawn: the position of the one that plays each episode, [episodes].
            rng: draws random actions; None: there are none to draw.
            world: as of ``Policy.start``.
        """
        if world not in get_args(World):
            raise wrong_argument("world", "be 'model' or 'other'", world)
        self._members, self._drawn, self._rng = tuple(members), drawn, rng
        self.model = self._members[0].model
        self._is_model = world == "model"
        self._memory = np.zeros(len(drawn), dtype=np.int64)
        self._pairs = np.full(len(drawn), UNDECIDED, dtype=np.int64)  # of the last actions
        self._state: IntArray | None = None  # [episodes] where they stand, once begun
        self._is_observed = True  # what the last actions led to
        self.over = np.zeros(len(drawn), dtype=np.bool_)  # [episodes]

    def actions(self, states: Sequence[Hashable]) -> list[Hashable]:
        """The action of each episode in its state, [episodes].

        It is :data:`GIVE_UP` from where an episode gives up, and None where one is over, in a goal
        or in a dead-end; what state is said of it then does not matter.

        Args:
            states: [episodes].

        Raises:
            ModelError: unknown state or another than the one observed, another number of episodes,
                or a state in which the policy has no decision.
        """
        here = self._indices(states)
        if self._state is None:
            self.begin(here, ~self._ends[here])
        elif self._is_model and (moved := ~self.over & (here != self._state)).any():
            k = int(np.argmax(moved))
            raise ModelError(
                f"the episode is in state {self.model.states[int(self._state[k])]!r} by what was "
                f"observed, not in {states[k]!r}; {_OTHER_WORLD}"
            )
        self.over |= self._ends[here]
        playing = np.flatnonzero(~self.over)
        self._pairs[playing] = self.decide(playing, here[playing])
        self.over |= self._pairs == GIVE_UP_CODE
        self._state, self._is_observed = here, False
        told = {GIVE_UP_CODE: GIVE_UP, UNDECIDED: None}
        shown = np.where(self.over & (self._pairs >= 0), UNDECIDED, self._pairs)
        return [told[k] if k in told else self.model.action_of(k) for k in shown.tolist()]

    @explained
    def observe(self, successors: Sequence[Hashable], costs: Sequence[float] | FloatArray) -> None:
        """Tell where the step of each episode led and what it cost; this moves the memories.

        Args:
            successors: [episodes]; of those that are over, any state.
            costs: [episodes]; any costs >= 0 that the memory can count, the model's or not.

        Raises:
            ModelError: unknown state or one that the step cannot lead to, another number of
                episodes, no action or one observed already, or a cost that is negative, not finite
                or off the lattice that the policy was made for.
        """
        there, paid = self._indices(successors), np.asarray(costs, dtype=np.float64)
        if paid.shape != there.shape:
            raise ModelError(f"{paid.size} costs given for {there.size} episodes")
        if self._state is None:
            raise ModelError("observe() was called before the first action of the episode")
        moved = np.flatnonzero(~self.over)
        successor, pairs = there[moved], self._pairs[moved]
        check_costs(paid[moved])
        if self._is_model:
            self._check_steps(pairs, successor)
        going = ~self._ends[successor]
        self.remember(moved[going], pairs[going], successor[going], paid[moved[going]])
        self._state[moved] = successor
        self.over[moved] = ~going
        self._is_observed = True

    def _check_steps(self, pairs: IntArray, successors: IntArray) -> None:
        """Raise :class:`ModelError` unless each step is new, and one of the model's."""
        if self._is_observed and pairs.size:
            raise ModelError(f"observe() was called twice after one action; {_OTHER_WORLD}")
        first, model = self.model.outcome_offsets[pairs], self.model
        count = model.outcome_offsets[pairs + 1] - first
        index = concatenated_ranges(first, count)
        hit = model.successors[index] == np.repeat(successors, count)
        mass = segment_sums(np.where(hit, model.probabilities[index], 0.0), offsets_of(count))
        if (mass == 0.0).any():
            k = int(np.argmin(mass))
            told = model.describe_pair(int(pairs[k]))
            there = model.states[int(successors[k])]
            raise ModelError(f"{told} cannot lead to {there!r}; {_OTHER_WORLD}")

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
            mine = episodes[self._drawn[episodes] == number]
            if mine.size:
                yield member, mine

    @cached_property
    def _ends(self) -> BoolArray:
        """The states in which episodes are over, [states]."""
        return np.asarray(self.model.goal_mask | dead_ends(self.model))

    def _indices(self, states: Sequence[Hashable]) -> IntArray:
        """The positions of the episodes' states."""
        if len(states) != len(self._drawn):
            raise ModelError(f"{len(states)} states given for {len(self._drawn)} episodes")
        return np.array([self.model.index_of(state) for state in states], dtype=np.int64)


class Episode:
    """One episode of a policy: the member drawn, its memory, and whether it is over. Mutable.

    Any number of episodes run side by side, each with a memory of its own.
    """

    def __init__(self, alone: EpisodeBatch) -> None:
        """Play the only episode of a batch."""
        self._alone = alone
        self._staying: IntArray | None = None  # [states], once it goes on after giving up

    def action(self, state: Hashable) -> Hashable:
        """The action in this state; :data:`GIVE_UP` or None from where the episode is over.

        It is over from giving up on, or from a goal or a dead-end.

        Raises:
            ModelError: unknown state or another than the one observed, or one in which the policy
                has no decision.
        """
        if self._staying is None:
            return self._alone.actions([state])[0]
        model = self._alone.model
        pair = int(self._staying[model.index_of(state)])
        if pair == UNDECIDED:
            raise ModelError(f"no action of state {state!r} surely avoids the goal")
        return model.action_of(pair)

    @explained
    def observe(self, successor: Hashable, cost: float) -> None:
        """Tell where the step led and what it cost; this moves the memory.

        Args:
            successor: the state that the action led to.
            cost: of the step, >= 0, the model's or not.

        Raises:
            ModelError: unknown state or one that the step cannot lead to, an episode that is over,
                no action or one observed already, or a cost that is negative, not finite or off the
                lattice that the policy was made for.
        """
        if self._staying is not None:
            return
        if self._alone.over.any():
            raise ModelError("the episode is over: there is no step to observe")
        self._alone.observe([successor], [cost])

    def continue_after_give_up(self) -> None:
        """From now on play the policy that stays in the attention states (it avoids the goal)."""
        self._staying = staying_policy(self._alone.model)


def staying_policy(model: SSP) -> IntArray:
    """A pair that surely avoids the goal in each state that has one, else UNDECIDED, [states]."""
    pairs = np.flatnonzero(attention_pairs(model, attention_states(model)))
    states = model.pair_state[pairs]
    first = np.flatnonzero(np.diff(states, prepend=-1))
    decision = np.full(model.n_states, UNDECIDED, dtype=np.int64)
    decision[states[first]] = pairs[first]
    return decision
