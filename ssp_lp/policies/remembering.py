"""Policies with a memory: steps taken, a memory of your own, or several at once.

Such a policy is computed on a product of the model with the memory, and then translated to the
model.
"""

from __future__ import annotations

import enum
from abc import abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product as every_choice
from math import prod
from typing import ClassVar

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.failure_product import FailureSSP, check_label
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import HorizonSSP, ProductSSP, check_product
from ssp_lp.policies.policy import (
    GIVE_UP_CODE,
    UNDECIDED,
    Branches,
    DeterministicPolicy,
    MixedPolicy,
    Policy,
    Step,
    as_lottery,
    check_costs,
    check_decisions,
    check_policies,
)


class _Carried(Policy):
    """A policy whose memory is another policy's memory and a digit that it adds itself.

    The memory is stored as the number ``inner memory * len(digits) + digit``.
    """

    inner: Policy

    @property
    @abstractmethod
    def digits(self) -> Sequence[Hashable]:
        """Names of the values of the digit that this policy adds to the inner policy's memory."""

    @property
    def model(self) -> SSP:  # type: ignore[override]
        return self.inner.model

    @property
    def step_limit(self) -> int | None:  # type: ignore[override]
        return self.inner.step_limit

    @property
    def goes_on(self) -> bool:  # type: ignore[override]
        """Whether the inner policy goes on after failing."""
        return self.inner.goes_on

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return the values of the memory with their names: the digit, or (digit, inner memory)."""
        return [
            (code * len(self.digits) + k, word if words is None else (word, words))
            for k, word in enumerate(self.digits)
            for code, words in self.inner.memories()
        ]

    def split(self, memory: IntArray) -> tuple[IntArray, IntArray]:
        """Split memories into the inner policy's memory and the digit, [episodes] each."""
        return np.divmod(memory, len(self.digits))

    def joined(self, inner: IntArray, digit: IntArray | int) -> IntArray:
        """Return the memory that consists of an inner memory and a digit, [episodes]."""
        return np.asarray(inner * len(self.digits) + digit)


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class TimedPolicy(_Carried):
    """One policy (stage) for each time step; the last one acts in all later steps.

    This is the paper's form of section 3.4. The memory consists of the number of the current stage
    and of a memory that all stages share, which must have the same meaning in all of them.

    Raises:
        ModelError: no stages, or stages on different models.
    """

    stages: tuple[Policy, ...]  # followed at times 0, 1, ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        if not self.stages:
            raise ModelError("a timed policy needs at least one stage")
        check_policies(self.stages, "stages of a timed policy")

    @property
    def inner(self) -> Policy:  # type: ignore[override]
        """Policy of the first stage, which updates the memory that all stages share."""
        return self.stages[0]

    @property
    def digits(self) -> Sequence[Hashable]:
        """The stage numbers 0, 1, ..."""
        return range(len(self.stages))

    @property
    def memory_size(self) -> int | None:
        """Size of the first stage's memory times the number of stages."""
        own = self.inner.memory_size
        return None if own is None else own * len(self.stages)

    @property
    def meaning(self) -> tuple[object, ...]:
        """Number of stages, and the meaning of the memory that they share."""
        return len(self.stages), *self.inner.meaning

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the initial memory: the first stage, and its own initial memory, [episodes]."""
        return self.joined(self.inner.start_memory(states), 0)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions in each (state, memory), taken by the stage in the memory."""
        inner, stage = self.split(memory)
        parts = []
        for number in np.unique(np.append(stage, 0)):
            own = asked(self.stages[number], np.flatnonzero(stage == number), states, inner)
            parts.append(own._replace(memory=self.joined(own.kept(inner), number)))
        return merged(memory, *parts)

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps: the shared memory, updated, and the next stage."""
        inner, stage = self.split(memory)
        moved = self.inner.remember(inner, *step)
        return self.joined(moved, np.minimum(stage + 1, len(self.stages) - 1))

    def __repr__(self) -> str:
        """Return a line with the number of stages and the last one."""
        return f"TimedPolicy({len(self.stages):,} stages, then {self.stages[-1]!r})"


def asked(policy: Policy, some: IntArray, states: IntArray, memory: IntArray) -> Branches:
    """Return a policy's decisions in some of the given situations (state, memory).

    ``some`` has the indices of these situations in ``states`` and ``memory``, and the decisions
    refer to the situations by these indices.
    """
    branches = policy.branches(states[some], memory[some])
    return branches._replace(situation=some[branches.situation])


def merged(memory: IntArray, *parts: Branches) -> Branches:
    """Merge decisions in different situations (state, memory) into one ``Branches``, in order.

    Args:
        memory: the memory in each situation, [situations].
        parts: decisions, each part in other situations.
    """
    situation, pair, probability, kept = (
        np.concatenate(part)
        for part in zip(*((*part[:3], part.kept(memory)) for part in parts), strict=True)
    )
    order = np.argsort(situation, kind="stable")
    return Branches(situation[order], pair[order], probability[order], kept[order])


@dataclass(frozen=True, eq=False)
class JointMemory(Policy):
    """A policy that decides as another policy, and updates the memories of several policies.

    The policies whose memories are updated are the keepers. The joint memory is a mixed-radix
    number; its digits are the keepers' memories, the first keeper's most significant.
    """

    keepers: tuple[Policy, ...]  # one for each memory, all of which have a known size
    decider: Policy  # has the memory of one of the keepers, or none

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """Model of the policy that decides."""
        return self.decider.model

    @property
    def memory_size(self) -> int | None:
        """Number of values of the joint memory."""
        return prod(self._sizes)

    @property
    def meaning(self) -> tuple[object, ...]:
        """Key of the memory's meaning: the meaning of each keeper's memory."""
        return tuple(keeper.meaning for keeper in self.keepers)

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return the values of the joint memory; a name is the tuple of the keepers' names."""
        parts = every_choice(*(keeper.memories() for keeper in self.keepers))
        joint = [tuple(zip(*some, strict=True)) for some in parts]
        return [(int(np.ravel_multi_index(codes, self._sizes)), words) for codes, words in joint]

    def listed_states(self, memory: int) -> IntArray:
        """Return the states that every keeper lists for its part of the joint memory."""
        listed = [keeper.listed_states(int(part)) for keeper, part in self._parts(memory)]
        return reduce(np.intersect1d, listed, np.arange(self.model.n_states))

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the initial joint memory, from the initial memory of each keeper, [episodes]."""
        parts: list[IntArray] = [keeper.start_memory(states) for keeper in self.keepers]
        return np.asarray(np.ravel_multi_index(parts, self._sizes))

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions of the policy ``decider``, given its part of the joint memory."""
        meaning = self.decider.meaning
        mine = (part for keeper, part in self._parts(memory) if keeper.meaning == meaning)
        own = next(mine, None)
        own = self.decider.start_memory(states) if own is None else own
        return self.decider.branches(states, own)._replace(memory=None)

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the joint memory after steps, with each keeper's part updated, [episodes]."""
        moved = [keeper.remember(part, *step) for keeper, part in self._parts(memory)]
        return np.asarray(np.ravel_multi_index(moved, self._sizes))

    def _parts(self, memory: IntArray | int) -> list[tuple[Policy, IntArray]]:
        """Return each keeper with its part of the joint memory."""
        return [*zip(self.keepers, np.unravel_index(memory, self._sizes), strict=True)]

    @property
    def _sizes(self) -> tuple[int, ...]:
        """Number of values of each keeper's memory."""
        return tuple(keeper.memory_size or 1 for keeper in self.keepers)


def common_memory(policy: MixedPolicy) -> tuple[Policy, ...]:
    """Return members of a lottery, one for each kind of memory that its members have.

    Members have the same kind of memory if their ``meaning`` is equal. Members without memory are
    left out.

    Raises:
        ModelError: a member is of a class with unknown memory.
    """
    keepers: dict[tuple[object, ...], Policy] = {}
    for member in policy.policies:
        if member.memory_size is None:
            raise ModelError(f"the memory of a {type(member).__name__} cannot be listed")
        if member.memory_size > 1:
            keepers.setdefault(member.meaning, member)
    return tuple(keepers.values())


@dataclass(frozen=True, eq=False, repr=False)
class RememberingPolicy(_Carried):
    """A policy on a product (state, memory), translated to the original model's states.

    The policy keeps the product's memory itself, as the digit that it adds to the inner policy's
    memory.
    """

    inner: Policy  # on the product

    def __post_init__(self) -> None:
        check_product(self.inner.model)

    @property
    def product(self) -> ProductSSP:
        """Product on which the inner policy acts."""
        return check_product(self.inner.model)

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """Original model of the product."""
        return self.product.original

    @property
    def step_limit(self) -> int | None:  # type: ignore[override]
        """Least of the step limits of the product and of the inner policy."""
        own = self.product.steps if isinstance(self.product, HorizonSSP) else None
        return min((n for n in (own, self.inner.step_limit) if n is not None), default=None)

    @property
    def digits(self) -> Sequence[Hashable]:
        """Memories of the product."""
        return self.product.memories

    def listed_states(self, memory: int) -> IntArray:
        """Return the original states in which the policy may have a decision with this memory."""
        inner, number = divmod(memory, len(self.product.memories))
        listed = self.inner.listed_states(inner)
        here = listed[self.product.labels.number[listed] == number]
        return np.sort(self.product.original_state[here])

    def begins(self, states: IntArray) -> BoolArray:
        """Return a mask of the states in which episodes of the product may begin, [episodes]."""
        return np.asarray(self.product.table[states, self.product.first_memory(states)] >= 0)

    def reaches(self, states: IntArray, memory: IntArray) -> BoolArray:
        """Return a mask of episodes that are at a goal of the product, [episodes]."""
        inner, number = self.split(memory)
        return self.inner.reaches(self.product.at(states, number), inner)

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the initial memory, the product's and the inner policy's as one, [episodes]."""
        begun = self.product.first_memory(states)
        here = self.product.at(states, begun)
        return self.joined(self.inner.start_memory(here), begun)

    @property
    def ended(self) -> BoolArray:
        """Mask of the states in which an episode is over, [states].

        These are goals and dead-ends, except states where the inner policy may still act.
        """
        over = super().ended.copy()
        over[self.product.original_state[~self.inner.ended]] = False
        return over

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions as original pairs; giving up where the goal cannot be reached."""
        product, (inner, number) = self.product, self.split(memory)
        here = product.at(states, number)
        inside = self.inner.branches(here, inner)
        shift = product.pair_offsets[here] - self.model.pair_offsets[states]
        pair = np.where(inside.pair >= 0, inside.pair - shift[inside.situation], inside.pair)
        over = (np.diff(product.pair_offsets) == 0) & ~product.goal_mask
        lost = dead_ends(product)[here][inside.situation] & (inside.pair == UNDECIDED)
        pair = np.where(over[here][inside.situation] | lost, GIVE_UP_CODE, pair)
        moved = inside.kept(inner) if inside.memory is not None else None
        kept = None if moved is None else self.joined(moved, number[inside.situation])
        return Branches(inside.situation, pair, inside.probability, kept)

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps, the product's and the inner policy's as one, [episodes].

        Raises:
            ModelError: a cost is negative or not finite, or a step leads to a memory that the
                product does not have.
        """
        pairs, successors, costs = step
        check_costs(costs)
        product, (inner, begun) = self.product, self.split(memory)
        taken = product.placed(product.at(self.model.pair_state[pairs], begun), pairs)
        there = product.moved(taken, successors, costs)
        moved = self.inner.remember(inner, taken, there, costs)
        return self.joined(moved, product.labels.number[there])

    def remember_outcomes(self, memory: IntArray, pairs: IntArray, outcomes: IntArray) -> IntArray:
        """Return the memory after steps that are given by pair and outcome, [episodes]."""
        product, (inner, begun) = self.product, self.split(memory)
        taken = product.placed(product.at(self.model.pair_state[pairs], begun), pairs)
        there, places = product.moved_by(taken, outcomes)
        moved = self.inner.remember_outcomes(inner, taken, places)
        return self.joined(moved, product.labels.number[there])

    def __repr__(self) -> str:
        """Return a line with the number of memories, and the inner policy."""
        return f"RememberingPolicy({len(self.product.memories):,} memories, {self.inner!r})"


@dataclass(frozen=True, eq=False, repr=False)
class LabelledPolicy(_Carried):
    """A policy on (state, failure label), translated to the original states; it acts after failing.

    The policy keeps the label itself, as the digit that it adds to the inner policy's memory. When
    it gives up it also takes an action; until this step is observed, the label is "giving up". In a
    dead-end the policy goes on acting if its problem counts quantities there.
    """

    inner: Policy  # on the product with the label
    goes_on = True
    digits: ClassVar = "before failing", "giving up", "after failing"

    @property
    def product(self) -> FailureSSP:
        """Product with the failure label on which the inner policy acts."""
        return check_label(self.inner.model)

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """Original model of the product, without failure labels."""
        return self.product.original

    @property
    def ended(self) -> BoolArray:
        """Mask of goals, and of dead-ends in which the problem counts no quantities, [states]."""
        return super().ended & ~self.product.is_open

    @property
    def staying(self) -> IntArray:
        """For each state a pair that surely avoids the goal; UNDECIDED: none, [states].

        If possible, the pair adds nothing to the counted quantities when it is repeated after
        failing.
        """
        decision, pairs = super().staying, self.product.staying_after
        decision[self.model.pair_state[pairs]] = pairs
        return decision

    def listed_states(self, memory: int) -> IntArray:
        """Return the states in which the policy may have a decision with this memory."""
        failed = memory % len(self.digits) > 0
        return np.flatnonzero(self.product.is_open if failed else ~self.ended)

    def start_memory(self, states: IntArray) -> IntArray:
        """Return the initial memory, before failing, [episodes]."""
        return self.joined(self.inner.start_memory(states), _Label.BEFORE)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the decisions as original pairs; a decision that gives up changes the memory."""
        product, (inner, label) = self.product, self.split(memory)
        here = states + product.n_original * (label == _Label.AFTER)
        situation, pair, chance, _ = self.inner.branches(here, inner)
        over = super().ended[states][situation] | (label[situation] == _Label.AFTER)
        pair = np.where(over & (pair == UNDECIDED), GIVE_UP_CODE, pair)
        taking = (pair >= 0) & product.fails[pair] & ~over
        kept = taking | (label[situation] != _Label.GIVING_UP)
        situation, pair, chance, taking = (each[kept] for each in (situation, pair, chance, taking))
        total = np.bincount(situation, weights=chance, minlength=len(states))
        acting = np.where(pair >= 0, product.original_pair[pair], pair)
        quits = taking & (label[situation] == _Label.BEFORE)
        kept = memory[situation] + quits * (_Label.GIVING_UP - _Label.BEFORE)
        return Branches(situation, acting, chance / total[situation], kept)

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps: the failure label and the inner memory, [episodes].

        The inner policy observes the charge as the cost of the step that fails, and 0 for later
        steps.
        """
        pairs, successors, costs = step
        product, (inner, label) = self.product, self.split(memory)
        here = self.model.pair_state[pairs] + product.n_original * (label == _Label.AFTER)
        taking = label == _Label.GIVING_UP
        taken = np.where(taking, product.giving_up_by(pairs), product.placed(here, pairs))
        if (taken < 0).any():
            pair_words = self.model.describe_pair(int(pairs[int(np.argmax(taken < 0))]))
            raise ModelError(f"{pair_words} may reach the goal: after failing, take another action")
        moved = product.moved(taken, successors, costs)
        failed = product.after[moved]
        charge = product.costs[product.outcome_offsets[taken]]
        paid = np.where(failed, charge, costs)
        inner = self.inner.remember(inner, taken, moved, paid)
        return self.joined(inner, np.where(failed, _Label.AFTER, _Label.BEFORE))

    def __repr__(self) -> str:
        """Return a line with the number of states after failing, and the inner policy."""
        count = int(self.product.is_open.sum())
        return f"LabelledPolicy(goes on after failing in {count:,} states, {self.inner!r})"


class _Label(enum.IntEnum):
    """Values of the failure label in the memory of a policy that acts after failing."""

    BEFORE = 0
    GIVING_UP = 1  # with the next action
    AFTER = 2


@dataclass(frozen=True, eq=False, repr=False)
class CompletePolicy(_Carried):
    """A policy that extends another one to all states with actions.

    The digit that it adds to the inner policy's memory is

    - 0 while the inner policy acts;
    - 1 once the inner policy's episode is over (it gave up, or is in a dead-end);
    - 2 in an episode that begins where the inner policy cannot begin.

    Raises:
        ModelError: a decision is not a pair of its state.
    """

    inner: Policy
    otherwise: IntArray  # [states] pair if the inner policy has no decision, or UNDECIDED
    afterwards: IntArray  # [states] pair if its episode is over, or UNDECIDED
    goes_on = True
    digits: ClassVar = "", "over", "elsewhere"

    def __post_init__(self) -> None:
        self.keep_read_only("otherwise", "afterwards")
        for decision in (self.otherwise, self.afterwards):
            check_decisions(self.model, decision)

    @property
    def ended(self) -> BoolArray:
        """Mask of goals and states without actions, [states]."""
        return np.asarray(self.model.goal_mask | (np.diff(self.model.pair_offsets) == 0))

    def memories(self) -> list[tuple[int, Hashable]]:
        """Return the values of the memory with their names.

        The names are those of the inner policy, then "over" and, if episodes may begin where the
        inner policy cannot, "elsewhere".
        """
        known = [(3 * code, words) for code, words in self.inner.memories()]
        begins = self.inner.begins(np.arange(self.model.n_states)).all()
        return [*known, (1, "over"), *([] if begins else [(2, "elsewhere")])]

    def listed_states(self, memory: int) -> IntArray:
        """Return the states with actions that occur with this memory, [states]."""
        inner, alone = divmod(memory, 3)
        acting = np.diff(self.model.pair_offsets) > 0
        of_product = isinstance(self.inner, RememberingPolicy) and not alone
        listed = self.inner.listed_states(inner) if of_product else np.arange(acting.size)
        return listed[acting[listed]]

    def start_memory(self, states: IntArray) -> IntArray:
        """Return 3 times the inner policy's initial memory, or 2 where it has none, [episodes]."""
        memory, begins = np.full(len(states), 2), self.inner.begins(states)
        memory[begins] = 3 * self.inner.start_memory(states[begins])
        return memory

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Return the inner policy's decisions; where it has none, those that this policy adds.

        They are ``afterwards`` once the inner policy's episode is over, otherwise ``otherwise``.
        """
        inner, alone = self.split(memory)
        over = (alone == 1) | self.inner.ended[states]
        found = asked(self.inner, np.flatnonzero(~over & (alone == 0)), states, inner)
        here, quits = states[found.situation], found.pair == GIVE_UP_CODE
        pair = np.where(found.pair == UNDECIDED, self.otherwise[here], found.pair)
        pair = np.where(quits, self.afterwards[here], pair)
        kept = self.joined(found.kept(inner), quits)
        silent = np.flatnonzero(over | (alone > 0))
        rest = np.where(over, self.afterwards[states], self.otherwise[states])[silent]
        planned = Branches(found.situation, pair, found.probability, kept)
        return merged(memory, planned, Branches(silent, rest, np.ones(silent.size)))

    def remember(self, memory: IntArray, *step: *Step) -> IntArray:
        """Return the memory after steps, [episodes].

        The inner policy's memory is updated until its episode is over.
        """
        pairs, _, costs = step
        check_costs(costs)
        inner, alone = self.split(memory)
        ended = self.inner.ended[self.model.pair_state[pairs]]
        moved, going = np.where(ended, 3 * inner + 1, memory), np.flatnonzero((alone == 0) & ~ended)
        own = pairs[going], step[1][going], costs[going]
        moved[going] = 3 * self.inner.remember(inner[going], *own)
        return np.asarray(moved)

    def __repr__(self) -> str:
        """Return a line with the inner policy."""
        return f"CompletePolicy({self.inner!r})"


Default = Hashable | Mapping[Hashable, Hashable] | DeterministicPolicy
"""An action for all states that have it, ``{state: action}``, or a policy without memory."""


@explained
def acting_everywhere(
    policy: Policy | MixedPolicy,
    default: Default | None = None,
    otherwise: IntArray | None = None,
    afterwards: IntArray | None = None,
) -> MixedPolicy:
    """Return a policy that acts in every state of its model that has actions, except at goals.

    Where the given policy has a decision, that decision is taken. Elsewhere the action is, in this
    order:

    - ``default``, where it has an action;
    - after giving up and in dead-ends, ``afterwards``;
    - ``otherwise``.

    If the problem counts quantities after failing, the given policy has decisions also after giving
    up and in dead-ends.

    Args:
        policy: any policy, or a lottery.
        default: an action, taken in all states that have it; ``{state: action}``; or a policy
            without memory; None: no default.
        otherwise: pairs to take where the policy has no decision, [states]; None: the first pair of
            each state. ``Solution.policy_everywhere`` chooses better pairs.
        afterwards: pairs to take after giving up and in dead-ends, [states]; None: pairs that
            surely avoid the goal, where there are any.

    Raises:
        ModelError: an unknown state or action, or a default that is a policy of another model.
    """
    lottery = as_lottery(policy)
    model = lottery.model
    if isinstance(default, Mapping):
        default = DeterministicPolicy.from_actions(model, default)
    if isinstance(default, DeterministicPolicy):
        if default.model is not model:
            raise ModelError("the default is a policy of another model")
        preferred = default.decision
    else:
        preferred = np.full(model.n_states, UNDECIDED, dtype=np.int64)
        named = np.array([name == default for name in model.action_names], dtype=np.bool_)
        pairs = np.flatnonzero(named[model.pair_action]) if named.any() else np.zeros(0, np.int64)
        if default is not None and not pairs.size:
            raise ModelError(f"no state has the action {default!r} given as default")
        preferred[model.pair_state[pairs]] = pairs
    acts = (np.diff(model.pair_offsets) > 0) & ~model.goal_mask
    first = np.where(acts, model.pair_offsets[:-1], UNDECIDED)
    planned = first if otherwise is None else np.where(otherwise >= 0, otherwise, first)

    def preferring(decision: IntArray) -> IntArray:
        """Return the pair to take in each state without a decision of the given policy, [states].

        It is the default's pair, else the pair in ``decision``, else the planned one.
        """
        return np.where(preferred >= 0, preferred, np.where(decision >= 0, decision, planned))

    later = np.full(model.n_states, UNDECIDED) if afterwards is None else afterwards
    members = tuple(
        CompletePolicy(
            member, preferring(planned), preferring(np.where(later >= 0, later, member.staying))
        )
        for member in (m.inner if isinstance(m, CompletePolicy) else m for m in lottery.policies)
    )
    return MixedPolicy(members, lottery.weights)


@explained
def on_original(policy: Policy | MixedPolicy) -> MixedPolicy:
    """Translate a policy on a product to the original model; the policy then keeps the memory.

    Args:
        policy: policy on a product, such as that of a solution on ``product(model, memory)``.

    Raises:
        ModelError: its model is not a product.
    """
    lottery = as_lottery(policy)
    kind = RememberingPolicy if lottery.model.failure_label is None else LabelledPolicy
    members = tuple(kind(member) for member in lottery.policies)
    return MixedPolicy(members, lottery.weights)
