"""Policies: their base class, those without a memory of their own, and lotteries over policies.

A policy decides and remembers for many episodes at once. A lottery draws one of finitely many
policies at the start (section 2.2 of the paper).
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    drawn_in_segments,
    entries_of,
    offsets_of,
    segment_sums,
)
from ssp_lp.errors import ModelError, check_whole, in_short, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.graph import attention_pairs, attention_states, dead_ends
from ssp_lp.model.report import Report, Table
from ssp_lp.model.ssp import check_model
from ssp_lp.policies.table import Decisions, Member, PolicyTable

Randomness = np.random.Generator | int
"""A generator, or the seed of a new one."""


def generator_of(seed: Randomness) -> np.random.Generator:
    """Return the random generator of a seed: the seed itself, or a new generator from a number.

    Raises:
        ModelError: neither a generator nor a whole number >= 0.
    """
    if isinstance(seed, np.random.Generator):
        return seed
    if isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and seed >= 0:
        return np.random.default_rng(int(seed))
    raise ModelError(f"seed must be a number such as 0 or a numpy.random.Generator, not {seed!r}")


class Decision(enum.StrEnum):
    """Decision of a policy that is not an action of the model: giving up."""

    GIVE_UP = "give up"

    def __repr__(self) -> str:
        return self.name


GIVE_UP: Final = Decision.GIVE_UP

GIVE_UP_CODE: Final = -1
"""Code of :data:`GIVE_UP` in arrays of pairs."""

UNDECIDED: Final = -2
"""Code of states in which a policy never acts, in arrays of pairs."""


_BY_EPISODE = ": play an episode, episode = policy.start(seed=0), and ask episode.action(state)"

MOST_EPISODES: Final = 100_000_000
"""Greatest number of episodes played side by side; they need about ten gigabytes."""

Step = tuple[IntArray, IntArray, FloatArray]
"""Steps of episodes: pairs of the model, successors and costs, [episodes] each."""

World = Literal["model", "other"]
"""World of episodes: the policy's model, or another one that the model approximates."""


class Branches(NamedTuple):
    """The possible decisions in several situations (state, memory), one entry for each."""

    situation: IntArray  # [branches] position among the given situations
    pair: IntArray  # [branches] pair of the model, or GIVE_UP_CODE
    probability: FloatArray  # [branches]
    memory: IntArray | None = (
        None  # [branches] changed where a policy gives up and goes on; or None
    )

    def kept(self, memory: IntArray) -> IntArray:
        """Return the memory after each decision and before its step, [branches].

        ``memory`` has the memory in each situation, [situations].
        """
        return memory[self.situation] if self.memory is None else self.memory

    def gives_up(self, memory: IntArray) -> BoolArray:
        """Return a mask of the decisions that give up, by an action or without one, [branches].

        ``memory`` has the memory in each situation, [situations].
        """
        changes = self.kept(memory) != memory[self.situation]
        return np.asarray((self.pair == GIVE_UP_CODE) | changes)


@dataclass(frozen=True, eq=False)
class CostLayers:
    """A decision for each (layer of accumulated cost, state), and tail policies beyond the layers.

    A run that passes the last layer follows one of the tail policies, which are stationary, from
    then on.
    """

    decision: IntArray  # [layers, states] position in the state's pairs, or a code
    tails: IntArray  # [tails, states] pair, or a code
    tail_at: Callable[[int], IntArray]  # layer beyond the last one -> tail of each state, [states]
    costs: FloatArray  # [classes] the distinct costs of a step, increasing
    leads: Callable[[int], IntArray]  # layer -> layers that each class of step passes, [classes]
    unit: float | None  # cost of a layer; None: layers are levels, to which totals are rounded
    width: int  # 1 + the most layers that a step passes
    rounds_up: bool = False  # whether costs that are not multiples of the unit are rounded up
    even: int = 0  # number of first layers whose steps pass as many layers as the first one's

    @property
    def count(self) -> int:
        """Number of cost layers of the policy."""
        return len(self.decision)


class _Playable(Report, ReadOnlyCopies, ABC):
    """Base of policies and lotteries: starts episodes, which your own loop can play.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> episode = DeterministicPolicy.from_actions(model, {"door": "open"}).start()
        >>> episode.action("door")
        'open'
        >>> episode.observe("out", 2.0)
        >>> episode.action("out") is None
        True
    """

    @explained
    def start(self, seed: Randomness | None = None, *, world: World = "model") -> Episode:
        """Return a new episode of the policy.

        The policy itself never changes: each episode has its own memory.

        Args:
            seed: generator for the draws of the lottery and of actions, which continues from
                episode to episode; or a number, with which every episode has the same draws.
            world: "model": episodes are played in the policy's model, and it is an error to observe
                a step that the model does not have, to ask for an action in a state other than the
                last observed one, or to observe twice after one action. "other": episodes are
                played in any other world, such as a simulator or a machine.

        Raises:
            ModelError: a lottery without a generator.
        """
        return Episode(self.start_many(1, seed, world=world))

    def start_many(
        self, episodes: int, seed: Randomness | None = None, *, world: World = "model"
    ) -> EpisodeBatch:
        """Return many new episodes of the policy, which are played side by side.

        Args:
            episodes: number of episodes.
            seed: as in :meth:`start`.
            world: as in :meth:`start`.

        Raises:
            ModelError: no episodes, or a lottery without a generator.
        """
        check_whole("episodes", episodes, most=MOST_EPISODES)
        rng = None if seed is None else generator_of(seed)
        weights, members = zip(*self.weighted, strict=True)
        if rng is not None:
            drawn = rng.choice(len(members), size=episodes, p=weights)
        elif len(members) > 1:
            raise ModelError("a lottery over policies needs a seed or a generator: start(0)")
        else:
            drawn = np.zeros(episodes, dtype=np.int64)
        return EpisodeBatch(members, drawn, rng, world)

    @property
    @abstractmethod
    def weighted(self) -> tuple[tuple[float, Policy], ...]:
        """Members of the policy's lottery with their weights."""

    def table(self) -> PolicyTable:
        """Return the policy's decisions as a table that prints.

        Raises:
            ModelError: the policy is of a class with unknown memory.
        """
        members = tuple(
            Member(weight, member.remembers, dict(member.memories()), member.decisions)
            for weight, member in self.weighted
        )
        note = (
            "runs need not reach all of these: solution.policy_table() lists those that they reach"
        )
        return PolicyTable(self.weighted[0][1].model, members, GIVE_UP, f"({note})")

    def to_frame(self) -> Any:
        """Return the policy's table as a pandas ``DataFrame``.

        Raises:
            MissingDependencyError: pandas is not installed.
            ModelError: the policy is of a class with unknown memory.
        """
        return self.table().to_frame()

    def tables(self) -> Sequence[Table]:
        """Return tables of the policy's decisions; a single line if its memory is unknown."""
        try:
            return self.table().tables()
        except ModelError:
            return [Table([], notes=[repr(self)])]

    @explained
    def action(self, state: Hashable) -> Hashable:
        """Return the policy's action in a state; GIVE_UP to give up, None where episodes are over.

        Raises:
            ModelError: unknown state; a state in which the policy has no decision; or the action
                depends on a lottery, a random draw or a memory, which only an episode has.
        """
        taken: dict[Hashable, None] = {}
        for _, member in self.weighted:
            here = np.array([member.model.index_of(state)])
            if member.ended[here[0]]:
                taken[None] = None
                continue
            if member.memory_size != 1:
                depends = f"the action in {state!r} depends on the {member.remembers}"
                raise ModelError(depends + _BY_EPISODE)
            for pair in member.branches(here, np.zeros(1, dtype=np.int64)).pair.tolist():
                if pair == UNDECIDED:
                    raise ModelError(
                        f"the policy has no decision in state {state!r}, which it does not reach; "
                        "solution.policy_everywhere() acts in every state"
                    )
                taken[GIVE_UP if pair == GIVE_UP_CODE else member.model.action_of(pair)] = None
        if len(taken) > 1:
            words = " or ".join(map(str, taken))
            raise ModelError(f"the action in {state!r} is drawn ({words}){_BY_EPISODE}")
        return next(iter(taken))


class Policy(_Playable):
    """Base class of policies, with a finite memory or none.

    The methods work on many episodes at once. A policy's memory is an integer for each episode,
    which only the policy interprets. By default a policy has no memory, or that of its ``carrier``.
    """

    model: SSP
    carrier: Policy | None = None  # the policy whose memory this one has
    goes_on: bool = False  # whether the policy has decisions after failing
    step_limit: int | None = None  # steps to reach the goal within, if it was made for a horizon

    @property
    def declares_failing(self) -> bool:
        """Whether the policy acts on states with a failure label, and declares failing itself."""
        return self.model.failure_label is not None

    @property
    def memory_size(self) -> int | None:
        """Number of values of the policy's memory, which are 0 .. size - 1; None: unknown."""
        return None if self.carrier is None else self.carrier.memory_size

    @property
    def meaning(self) -> tuple[object, ...]:
        """Key of the memory's meaning: policies with equal keys can share one memory."""
        return () if self.carrier is None else self.carrier.meaning

    @property
    def remembers(self) -> str:
        """Name of the quantity that the policy remembers."""
        return "memory" if self.carrier is None else self.carrier.remembers

    @property
    def weighted(self) -> tuple[tuple[float, Policy], ...]:
        """The policy as a lottery with a single member."""
        return ((1.0, self),)

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return the values of the policy's memory, each with the name that tables show.

        Raises:
            ModelError: the memory is unbounded.
        """
        if self.carrier is not None:
            return self.carrier.memories()
        if (size := self.memory_size) is None:
            raise ModelError(f"the memory of a {type(self).__name__} cannot be listed")
        return [(0, None)] if size == 1 else [(k, k) for k in range(size)]

    def listed_states(self, memory: int) -> IntArray:
        """Return the indices of the states in which the policy may decide with this memory."""
        return np.arange(self.model.n_states)

    def decisions(self) -> Iterator[Decisions]:
        """Yield the policy's decisions, a block for each value of its memory."""
        for code, _ in self.memories():
            states = self.listed_states(code)
            memory = np.full(len(states), code, dtype=np.int64)
            branches = self.branches(states, memory)
            pair = np.where(branches.gives_up(memory), GIVE_UP_CODE, branches.pair)
            kept = np.flatnonzero((pair != UNDECIDED) & (branches.probability > 0.0))
            here = branches.situation[kept]
            yield Decisions(states[here], memory[here], pair[kept], branches.probability[kept])

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the policy's memory at the start of episodes in these states, [episodes]."""
        nothing = np.zeros(len(states), dtype=np.int64)
        return nothing if self.carrier is None else self.carrier.start_memory(states)

    def reaches(self, states: IntArray, memory: IntArray) -> BoolArray:
        """Return a mask of the episodes that are at the goal, [episodes].

        Args:
            states: states of the episodes, [episodes].
            memory: values of the policy's memory, [episodes].
        """
        return self.model.goal_mask[states]

    def begins(self, states: IntArray) -> BoolArray:
        """Return a mask of states in which an episode of the policy may begin, [episodes]."""
        return np.ones(len(states), dtype=np.bool_)

    def layers(self) -> CostLayers | None:
        """Return the decisions by layer of the cost paid; None if they depend on something else."""
        return None

    @abstractmethod
    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the policy's possible decisions in each situation (state, memory)."""

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps, [episodes].

        ``step`` has the pairs, the successors and the costs of the steps, [episodes] each.
        """
        return memory if self.carrier is None else self.carrier.remember(memory, *step)

    def remember_outcomes(self, memory: IntArray, pairs: IntArray, outcomes: IntArray) -> IntArray:
        """Return the memory after steps that are given by pair and outcome, [episodes].

        By default this is :meth:`remember` with the successors and costs of the outcomes. A policy
        overrides it if its memory distinguishes outcomes with the same successor and cost.
        """
        if self.carrier is not None:
            return self.carrier.remember_outcomes(memory, pairs, outcomes)
        successors = self.model.successors[outcomes].astype(np.int64)
        return self.remember(memory, pairs, successors, self.model.costs[outcomes])

    @property
    def ended(self) -> BoolArray:
        """Mask of states in which the policy's episodes are over: goals, dead-ends, [states]."""
        return np.asarray(self.model.goal_mask | dead_ends(self.model))

    @property
    def staying(self) -> IntArray:
        """For each state a pair that surely avoids the goal; UNDECIDED: none, [states]."""
        pairs = np.flatnonzero(attention_pairs(self.model, attention_states(self.model)))
        states, first = np.unique(self.model.pair_state[pairs], return_index=True)
        decision = np.full(self.model.n_states, UNDECIDED, dtype=np.int64)
        decision[states] = pairs[first]
        return decision

    def sample(
        self, states: IntArray, memory: IntArray, rng: np.random.Generator | None
    ) -> tuple[IntArray, IntArray]:
        """Draw a decision for each episode; return the pairs and the memories after them.

        Both arrays have an entry for each episode, [episodes].

        Raises:
            ModelError: the policy has no decision in one of the states.
        """
        branches = self.branches(states, memory)
        drawn: IntArray = np.arange(len(states))
        if len(branches.situation) > len(states):  # otherwise one branch each: no draws
            if rng is None:
                raise ModelError("a stochastic policy needs a seed or a generator: start(0)")
            offsets = np.searchsorted(branches.situation, np.arange(len(states) + 1))
            sums = np.append(0.0, np.cumsum(branches.probability))
            drawn = drawn_in_segments(sums, offsets[:-1], offsets[1:], rng)
        self.check_decided(branches.pair[drawn], states)
        return branches.pair[drawn], branches.kept(memory)[drawn]

    def check_decided(self, pairs: IntArray, states: IntArray) -> None:
        """Raise :class:`ModelError` if the policy has no decision in one of the states."""
        if (pairs == UNDECIDED).any():
            state = self.model.states[int(states[int(np.argmax(pairs == UNDECIDED))])]
            raise ModelError(f"the policy has no decision in state {state!r}")


def check_policies(policies: Sequence[Any], parts: str) -> None:
    """Raise :class:`ModelError` unless all entries are policies on one model.

    ``parts`` is what the entries are called in errors.
    """
    for one in policies:
        if not isinstance(one, Policy):
            raise ModelError(
                f"a policy is needed, not {in_short(one)}: pass solution.policy, or your own"
            )
        if one.model is not policies[0].model:
            raise ModelError(f"the {parts} must act on one model")


def check_costs(costs: FloatArray | float) -> None:
    """Raise :class:`ModelError` unless observed costs are finite numbers >= 0."""
    paid = np.atleast_1d(costs)
    wrong = ~((paid >= 0.0) & np.isfinite(paid))
    if wrong.any():
        cost = float(paid[int(np.argmax(wrong))])
        raise ModelError(f"observed cost {cost!r} must be >= 0 and finite")


_OTHER_WORLD = "start(seed, world='other') plays in a world other than the model"


class EpisodeBatch:
    """Episodes of a policy that are played side by side, each by a drawn member. Mutable.

    Your own loop calls ``actions`` and ``observe`` with the labels of states of all episodes. The
    library's simulation calls ``begin``, ``decide`` and ``remember``, with indices of episodes,
    states and pairs.

    An episode is over at a goal, in a dead-end or after giving up, whatever is observed afterwards.
    If the policy has decisions after failing, a failed episode goes on, and its entry of ``failed``
    is True.
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
            drawn: index of the member that plays each episode, [episodes].
            rng: draws random actions; None: the policies have none.
            world: as in ``Policy.start``.
        """
        if world not in get_args(World):
            raise wrong_argument("world", "be 'model' or 'other'", world)
        self._members, self._drawn, self._rng = tuple(members), drawn, rng
        self.model = self._members[0].model
        self._is_model = world == "model"
        self.memory = np.zeros(len(drawn), dtype=np.int64)  # [episodes], of those that go on
        self._pairs = np.full(len(drawn), UNDECIDED, dtype=np.int64)  # of the last actions
        self._state: IntArray | None = None  # [episodes] current states, once begun
        self._is_observed = True  # whether the last actions were observed
        self.over = np.zeros(len(drawn), dtype=np.bool_)  # [episodes]
        self.reached = np.zeros(len(drawn), dtype=np.bool_)  # [episodes] the goal, by the memory
        self.failed = np.zeros(len(drawn), dtype=np.bool_)  # [episodes] the goal is lost

    def actions(self, states: Sequence[Hashable]) -> list[Hashable]:
        """Return the policy's action in each episode of the batch, [episodes].

        If an episode is over, the entry is :data:`GIVE_UP` after giving up, and None after reaching
        a goal or a dead-end. An episode that gives up and goes on has an action, and ``failed`` is
        True from then on.

        Args:
            states: the state that each episode is in, [episodes]; any state if the episode is over.

        Raises:
            ModelError: a wrong number of states, or a state that is unknown, is not the observed
                one, or has no decision.
        """
        here = self._indices(states)
        if self._state is None:
            self.begin(here, ~self._ends[here])
        elif self._is_model and (moved := ~self.over & (here != self._state)).any():
            k = int(np.argmax(moved))
            raise ModelError(
                f"the episode is in state {self.model.states[int(self._state[k])]!r} by the last "
                f"observation, not in {states[k]!r}; {_OTHER_WORLD}"
            )
        self.over |= self._ends[here]
        for member, mine in self.shares(going := np.flatnonzero(~self.over)):
            own = going[mine]
            self.reached[own] = member.reaches(here[own], self.memory[own])
        self.over |= self.reached
        self.failed |= ~self.over & dead_ends(self.model)[here]
        playing = np.flatnonzero(~self.over)
        self._pairs[playing] = self.decide(playing, here[playing])
        self.over |= self._pairs == GIVE_UP_CODE
        self.failed |= self.over & ~self.model.goal_mask[here] & ~self.reached
        self._state, self._is_observed = here, False
        codes = {GIVE_UP_CODE: GIVE_UP, UNDECIDED: None}
        shown = np.where(self.over & (self._pairs >= 0), UNDECIDED, self._pairs)
        return [codes[k] if k in codes else self.model.action_of(k) for k in shown.tolist()]

    @explained
    def observe(self, successors: Sequence[Hashable], costs: Sequence[float] | FloatArray) -> None:
        """Update the policies' memories, given the successors and costs of the last steps.

        Args:
            successors: state that each episode has reached, [episodes]; any state if it is over.
            costs: cost of each step, >= 0, [episodes]. It may differ from the model's if the
                policy's memory can count it.

        Raises:
            ModelError: unknown state or one that the step cannot lead to, a wrong number of
                entries, no action or one observed already, or a cost that is negative, not finite
                or not a multiple of the policy's unit.
        """
        there, paid = self._indices(successors), np.asarray(costs, dtype=np.float64)
        if paid.shape != there.shape:
            raise ModelError(f"{paid.size} costs given for {there.size} episodes")
        if self._state is None:
            raise ModelError("observe() was called before the first action of the episode")
        moved = np.flatnonzero(~self.over)
        successor, pairs = there[moved], self._pairs[moved]
        check_costs(paid[moved])
        if self._is_model and self._is_observed and pairs.size:
            raise ModelError(f"observe() was called twice after one action; {_OTHER_WORLD}")
        if self._is_model:
            model = self.model
            index, count = entries_of(model.outcome_offsets, pairs)
            hit = model.successors[index] == np.repeat(successor, count)
            mass = segment_sums(np.where(hit, model.probabilities[index], 0.0), offsets_of(count))
            if (mass == 0.0).any():
                k = int(np.argmin(mass))
                pair_words, to = model.describe_pair(int(pairs[k])), model.states[int(successor[k])]
                raise ModelError(f"{pair_words} cannot lead to {to!r}; {_OTHER_WORLD}")
        going = ~self._ends[successor]
        self.remember(moved[going], pairs[going], successor[going], paid[moved[going]])
        self._state[moved] = successor
        self.over[moved] = ~going
        self._is_observed = True

    def begin(self, states: IntArray, going: BoolArray) -> None:
        """Set the initial memory of each episode, except those that are over at their start.

        Args:
            states: indices of the states in which episodes begin, [episodes].
            going: mask of the episodes that are not over at their start, [episodes].
        """
        for member, mine in self.shares(begun := np.flatnonzero(going)):
            self.memory[begun[mine]] = member.start_memory(states[begun[mine]])

    def decide(self, episodes: IntArray, states: IntArray) -> IntArray:
        """Return the pair that each given episode takes, or GIVE_UP_CODE, [given episodes].

        A policy that goes on after giving up has a pair instead of GIVE_UP_CODE.

        Args:
            episodes: indices of the episodes.
            states: index of the state of each, [given episodes].
        """
        pairs = np.empty(len(episodes), dtype=np.int64)
        for member, mine in self.shares(episodes):
            own = episodes[mine]
            pairs[mine], moved = member.sample(states[mine], self.memory[own], self._rng)
            self.failed[own] |= moved != self.memory[own]
            self.memory[own] = moved
        return pairs

    def remember(self, episodes: IntArray, *step: *Step) -> None:
        """Update the policies' memories in the given episodes after a step.

        ``step`` has the pairs, the successors and the costs of these steps, [given episodes] each.
        """
        pairs, successors, costs = step
        for member, mine in self.shares(episodes):
            own, taken = episodes[mine], (pairs[mine], successors[mine], costs[mine])
            self.memory[own] = member.remember(self.memory[own], *taken)

    def shares(self, episodes: IntArray) -> Iterator[tuple[Policy, IntArray]]:
        """Yield each member with the positions in ``episodes`` of those that it plays."""
        for number, member in enumerate(self._members):
            mine = np.flatnonzero(self._drawn[episodes] == number)
            if mine.size:
                yield member, mine

    @cached_property
    def _ends(self) -> BoolArray:
        """Mask of states in which episodes of the policy are over, [states]."""
        return np.asarray(np.all([member.ended for member in self._members], axis=0))

    def _indices(self, states: Sequence[Hashable]) -> IntArray:
        """Return the index of each episode's state from its label, [episodes]."""
        if len(states) != len(self._drawn):
            raise ModelError(f"{len(states)} states given for {len(self._drawn)} episodes")
        return np.array([self.model.index_of(state) for state in states], dtype=np.int64)


class Episode:
    """One episode of a policy: the drawn member, its memory, and whether it is over. Mutable.

    Any number of episodes can run side by side, each with its own memory.
    """

    def __init__(self, alone: EpisodeBatch) -> None:
        """Play the only episode of a batch."""
        self._alone = alone

    @explained
    def action(self, state: Hashable) -> Hashable:
        """Return the policy's action in this state.

        Once the episode is over, return :data:`GIVE_UP` after giving up, and None at a goal or in a
        dead-end. If the problem counts quantities after failing, a failed episode goes on with
        actions. ``failed`` is True once the goal is given up.

        Raises:
            ModelError: the state is unknown, is not the observed one, or has no decision.
        """
        return self._alone.actions([state])[0]

    @explained
    def observe(self, successor: Hashable, cost: float) -> None:
        """Update the policy's memory, given the successor and the cost of the last step.

        Args:
            successor: state to which the action led.
            cost: cost of the step, >= 0. It may differ from the model's if the memory can count it.

        Raises:
            ModelError: unknown state or one that the step cannot lead to, an episode that is over,
                no action or one observed already, or a cost that is negative, not finite or not a
                multiple of the policy's unit.
        """
        if self._alone.over.any():
            raise ModelError("the episode is over: there is no step to observe")
        self._alone.observe([successor], [cost])

    @property
    def failed(self) -> bool:
        """Whether the goal was lost or given up before or by the last action."""
        return bool(self._alone.failed[0])


@dataclass(frozen=True, eq=False, repr=False)
class DeterministicPolicy(Policy):
    """One decision for each state: a pair of the model, giving up, or none where it never acts."""

    model: SSP
    decision: IntArray  # [states] pair, GIVE_UP_CODE or UNDECIDED

    def __post_init__(self) -> None:
        self.keep_read_only("decision")
        if self.decision.shape != (self.model.n_states,):
            raise ModelError(f"a decision is needed for each of {self.model.n_states} states")
        check_decisions(self.model, self.decision)

    @classmethod
    @explained
    def from_actions(cls, model: SSP, actions: Mapping[Hashable, Hashable]) -> DeterministicPolicy:
        """Build a policy from ``{state: action}``; an action may be :data:`GIVE_UP`.

        Raises:
            ModelError: unknown state, or an action that the state does not have.
        """
        check_model(model, "from_actions")
        decision = np.full(model.n_states, UNDECIDED, dtype=np.int64)
        for state, action in actions.items():
            s = model.index_of(state)
            decision[s] = _decided_pair(model, s, action)
        return cls(model, decision)

    @property
    def memory_size(self) -> int | None:
        """1, since the policy has no memory."""
        return 1

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decision in each of the given states, as one branch of probability 1."""
        n = len(states)
        return Branches(np.arange(n), self.decision[states].astype(np.int64), np.ones(n))

    def actions(self) -> dict[Hashable, Hashable]:
        """Return ``{state: action or GIVE_UP}`` for states in which the policy has a decision."""
        return {
            self.model.states[s]: GIVE_UP if p == GIVE_UP_CODE else self.model.action_of(int(p))
            for s, p in enumerate(self.decision)
            if p != UNDECIDED
        }

    def __repr__(self) -> str:
        """Return a line with the numbers of states in which it acts and gives up."""
        gives_up = int((self.decision == GIVE_UP_CODE).sum())
        decides = int((self.decision >= 0).sum())
        return f"DeterministicPolicy(acts in {decides:,} states, gives up in {gives_up:,})"


def _decided_pair(model: SSP, state: int, action: Hashable) -> int:
    """Return the pair by which a state takes an action; GIVE_UP_CODE for giving up.

    The text "give up" means giving up unless an action of the state has this name.
    """
    own = map(model.action_of, model.pairs_of(state))
    if action is GIVE_UP or (action == GIVE_UP and action not in own):
        return GIVE_UP_CODE
    return model.pair_of(state, action)


def check_decisions(model: SSP, decision: IntArray, *, as_positions: bool = False) -> None:
    """Raise :class:`ModelError` if the decision in some state is not a pair of this state.

    Args:
        model: the model.
        decision: pair or negative code of each state, [..., states].
        as_positions: pairs are given by their position among the pairs of their state.
    """
    low, high = model.pair_offsets[:-1], model.pair_offsets[1:]
    if as_positions:
        counts = high - low
        most = np.iinfo(decision.dtype).max if decision.dtype.kind == "i" else -1
        small = int(counts.max(initial=0)) <= most  # small integers compare fast
        counts = counts.astype(decision.dtype) if small else counts
        wrong = (decision < UNDECIDED) | (decision >= counts)
    else:
        wrong = (decision < UNDECIDED) | ((decision >= 0) & ((decision < low) | (decision >= high)))
    if wrong.any():
        name = model.states[int(np.argwhere(wrong)[0][-1])]
        raise ModelError(f"the decision in state {name!r} is not a pair of that state")


@dataclass(frozen=True, eq=False, repr=False)
class StochasticPolicy(Policy):
    """A distribution over decisions in each situation, that is in each (state, memory).

    Situations are sorted by memory, then by state. The memory is that of the policy ``carrier``;
    without a carrier the policy is stationary on the model's states. The randomised policy that is
    equivalent to a mixed policy (paper, section 2.2) has this form.
    """

    model: SSP
    situation_key: IntArray  # [situations] memory * n_states + state, increasing
    offsets: IntArray  # [situations + 1] branches of situation i: offsets[i] : offsets[i + 1]
    pair: IntArray  # [branches] pair of the model or GIVE_UP_CODE
    probability: FloatArray  # [branches], each situation's sum to one
    carrier: Policy | None = None

    def __post_init__(self) -> None:
        self.keep_read_only("situation_key", "offsets", "pair", "probability")
        sums = segment_sums(self.probability, self.offsets)
        if not ((self.probability >= 0).all() and (np.abs(sums - 1.0) <= 1e-9).all()):
            raise ModelError("the decisions of each state need probabilities that sum to one")

    @classmethod
    @explained
    def from_actions(
        cls, model: SSP, actions: Mapping[Hashable, Mapping[Hashable, float]]
    ) -> StochasticPolicy:
        """Build a stationary policy from ``{state: {action or GIVE_UP: probability}}``.

        Raises:
            ModelError: unknown state or action, or probabilities that do not sum to one.
        """
        check_model(model, "from_actions")
        rows = sorted((model.index_of(state), table) for state, table in actions.items())
        pairs = [_decided_pair(model, s, action) for s, table in rows for action in table]
        return cls(
            model,
            np.array([s for s, _ in rows], dtype=np.int64),
            np.cumsum([0] + [len(table) for _, table in rows]),
            np.array(pairs, dtype=np.int64),
            np.array([w for _, table in rows for w in table.values()], dtype=np.float64),
        )

    @classmethod
    def from_flows(
        cls,
        model: SSP,
        keys: IntArray,
        pairs: IntArray,
        flows: FloatArray,
        carrier: Policy | None = None,
    ) -> StochasticPolicy:
        """Return the policy that draws decisions in proportion to their flows in each situation.

        Args:
            model: the model.
            keys: situation of each decision, memory * n_states + state, in any order, [decisions].
                A decision may be listed repeatedly.
            pairs: pair of the model or GIVE_UP_CODE, [decisions].
            flows: expected number of times that the decision is taken, [decisions].
            carrier: policy whose memory stands in ``keys``; None: no memory.
        """
        joint, back = np.unique(keys * (model.n_pairs + 1) + pairs + 1, return_inverse=True)
        flow = np.bincount(back, weights=flows).astype(np.float64)
        key, pair = np.divmod(joint, model.n_pairs + 1)
        situation, first = np.unique(key, return_index=True)
        offsets = np.append(first, key.size)
        total = np.repeat(segment_sums(flow, offsets), np.diff(offsets))
        even = 1.0 / np.repeat(np.diff(offsets), np.diff(offsets))  # if all visits underflow
        share = np.where(total > 0, flow / np.where(total > 0, total, 1.0), even)
        return cls(model, situation, offsets, pair - 1, share, carrier)

    @property
    def memory_size(self) -> int | None:
        """Number of values of the carrier's memory."""
        return 1 if self.carrier is None else super().memory_size

    def listed_states(self, memory: int) -> IntArray:
        """Return the states whose decisions are listed with this memory, [states]."""
        n = self.model.n_states
        first, last = np.searchsorted(self.situation_key, [memory * n, (memory + 1) * n])
        return np.asarray(self.situation_key[first:last] - memory * n)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions with probabilities; UNDECIDED where no decision is listed."""
        key = np.asarray(memory, dtype=np.int64) * self.model.n_states + states
        at = np.searchsorted(self.situation_key, key)
        listed = np.append(self.situation_key, -1)[at] == key  # -1: a key that no situation has
        place = np.where(listed, at, len(self.situation_key))  # for situations without a decision
        index, count = entries_of(np.append(self.offsets, len(self.pair) + 1), place)
        return Branches(
            np.repeat(np.arange(len(states)), count),
            np.append(self.pair, UNDECIDED)[index],
            np.append(self.probability, 1.0)[index],
        )

    def __repr__(self) -> str:
        """Return a line with the numbers of situations, and of those with random decisions."""
        random = int((np.diff(self.offsets) > 1).sum())
        return f"StochasticPolicy({len(self.situation_key):,} situations, {random:,} at random)"


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class MixedPolicy(_Playable):
    """A lottery over a few policies, drawn once at the start (paper, section 2.2).

    Raises:
        ModelError: no members, or weights that are negative or do not sum to one.
    """

    policies: tuple[Policy, ...]
    weights: FloatArray  # [policies]

    def __post_init__(self) -> None:
        object.__setattr__(self, "policies", tuple(self.policies))
        self.keep_read_only("weights", dtype=np.float64)
        check_policies(self.policies, "members of a mixed policy")
        if not self.policies or self.weights.shape != (len(self.policies),):
            raise ModelError("a mixed policy needs one weight for each of its policies")
        weights = self.weights.tolist()
        if not (min(weights) >= 0.0 and abs(sum(weights) - 1.0) <= 1e-9):
            raise ModelError(f"weights must form a distribution, not {weights}")

    @property
    def model(self) -> SSP:
        """Model on which the mixed policy's members act."""
        return self.policies[0].model

    @property
    def weighted(self) -> tuple[tuple[float, Policy], ...]:
        """Members of the mixed policy with their weights."""
        return tuple(zip(self.weights.tolist(), self.policies, strict=True))

    def __repr__(self) -> str:
        """Return a line with the number of members, and the first three with their weights."""
        parts = [f"{weight:.6g} x {policy!r}" for weight, policy in self.weighted[:3]]
        parts += ["..."] * (len(self.policies) > len(parts))
        count = f"{len(self.policies)} member{'s' if len(self.policies) > 1 else ''}"
        return f"MixedPolicy({count}: {' + '.join(parts)})"


def as_lottery(policy: Policy | MixedPolicy) -> MixedPolicy:
    """Return a lottery: the argument itself, or a lottery with a single policy as its only member.

    Raises:
        ModelError: the argument is no policy.
    """
    return policy if isinstance(policy, MixedPolicy) else MixedPolicy((policy,), np.ones(1))
