"""Policies with a memory beside the state: steps taken, a memory of the user's, several at once.

Such a policy acts on a product of model and memory, and is carried back to the model itself.
"""

from __future__ import annotations

import enum
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product as every_choice
from math import prod

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained, explained_class
from ssp_lp.model.failure_product import FailureSSP, check_label
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.product import HorizonSSP, ProductSSP, check_product
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import (
    GIVE_UP_CODE,
    UNDECIDED,
    Branches,
    DeterministicPolicy,
    MixedPolicy,
    Policy,
    StochasticPolicy,
    as_lottery,
    check_costs,
    check_decisions,
    check_policies,
)


@explained_class
@dataclass(frozen=True, eq=False, repr=False)
class TimedPolicy(Policy):
    """One policy for each time step, the last of them for good (paper, section 3.4).

    The stages must share one memory: each must understand what any other remembers. The memory
    of the whole is ``stage memory * number of stages + stage``.

    Raises:
        ModelError: no stages, or stages on different models.
    """

    stages: tuple[Policy, ...]  # followed at times 0, 1, ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        if not self.stages:
            raise ModelError("a timed policy needs at least one stage")
        check_policies(self.stages)
        if any(p.model is not self.stages[0].model for p in self.stages):
            raise ModelError("the stages of a timed policy must act on one model")

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """The model that the timed policy's stages act on."""
        return self.stages[0].model

    def memories(self) -> list[tuple[int, Hashable]]:
        """The time step, with the memory that the stages share."""
        return _with_last(range(len(self.stages)), self.stages[0].memories())

    def start_memory(self, states: IntArray) -> IntArray:
        """The timed policy's first stage and its start memory, [episodes]."""
        return self.stages[0].start_memory(states) * len(self.stages)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The timed policy's decisions, those of each situation's stage."""
        inner, stage = np.divmod(memory, len(self.stages))
        nothing = np.zeros(0, dtype=np.int64)
        parts = [(nothing, nothing, np.zeros(0))]
        for number in np.unique(stage):
            some = np.flatnonzero(stage == number)
            branch = self.stages[number].branches(states[some], inner[some])
            parts.append((some[branch.situation], branch.pair, branch.probability))
        situation, pair, probability = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(situation, kind="stable")
        return Branches(situation[order], pair[order], probability[order])

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move the memory that the timed policy's stages share, and go on to the next stage."""
        count = len(self.stages)
        inner, stage = np.divmod(memory, count)
        inner = self.stages[0].remember(inner, pairs, successors, costs)
        return np.asarray(inner * count + np.minimum(stage + 1, count - 1))

    def __repr__(self) -> str:
        """One line: the number of stages and the last one."""
        return f"TimedPolicy({len(self.stages):,} stages, then {self.stages[-1]!r})"


@dataclass(frozen=True, eq=False)
class JointMemory(Policy):
    """The memories of several policies in one number, while one of them decides.

    The memory is a mixed-radix number, the first policy's memory its leading digit.
    """

    keepers: tuple[Policy, ...]  # one for each memory
    decider: Policy  # remembers what one of the keepers does, or nothing

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", self.decider.model)

    def followed_by(self, decider: Policy) -> JointMemory:
        """The joint memory with another policy to decide."""
        return JointMemory(self.keepers, decider)

    @property
    def remembers(self) -> str:
        """The word of a single keeper."""
        return self.keepers[0].remembers if len(self.keepers) == 1 else super().remembers

    def memories(self) -> list[tuple[int, Hashable]]:
        """The keepers' memories, a tuple if there are several keepers."""
        if len(self.keepers) == 1:
            return self.keepers[0].memories()
        parts = every_choice(*(keeper.memories() for keeper in self.keepers))
        joint = [tuple(zip(*some, strict=True)) for some in parts]
        return [(int(np.ravel_multi_index(codes, self._sizes)), words) for codes, words in joint]

    def start_memory(self, states: IntArray) -> IntArray:
        """Start of a joint memory: each keeper's, [episodes]."""
        return self._joined([k.start_memory(states) for k in self.keepers])

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Decisions by a joint memory: the decider's, given its own part."""
        meanings = [meaning_of(k) for k in self.keepers]
        mine = meaning_of(self.decider)
        if mine in meanings:
            part = self._parts(memory)[meanings.index(mine)]
        else:
            part = self.decider.start_memory(states)
        return self.decider.branches(states, part)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move each keeper's part of a joint memory."""
        parts = zip(self.keepers, self._parts(memory), strict=True)
        return self._joined([k.remember(part, pairs, successors, costs) for k, part in parts])

    def _joined(self, parts: list[IntArray]) -> IntArray:
        """The joint memory that the keepers' parts make."""
        return np.asarray(np.ravel_multi_index(parts, self._sizes))

    def _parts(self, memory: IntArray) -> tuple[IntArray, ...]:
        """Each keeper's part of a joint memory."""
        return np.unravel_index(memory, self._sizes)

    @property
    def _sizes(self) -> tuple[int, ...]:
        """Number of values of each keeper's part of a joint memory."""
        return tuple(memory_size(keeper) for keeper in self.keepers)


def _with_last(
    last: Sequence[Hashable], inner: list[tuple[int, Hashable]]
) -> list[tuple[int, Hashable]]:
    """Memories of two kinds in one number, of which ``last`` is the last digit, in words."""
    return [
        (code * len(last) + k, word if words is None else (word, words))
        for k, word in enumerate(last)
        for code, words in inner
    ]


def common_memory(policy: MixedPolicy) -> JointMemory | None:
    """Joint memory of a lottery's members with the first to decide; None: they remember nothing.

    Raises:
        ModelError: a member is of a class whose memory is not known here.
    """
    keepers: dict[tuple[object, ...], Policy] = {}
    for member in policy.policies:
        if memory_size(member) > 1:
            keepers.setdefault(meaning_of(member), member)
    return JointMemory(tuple(keepers.values()), policy.policies[0]) if keepers else None


def memory_size(policy: Policy) -> int:
    """Number of values that a policy's memory takes at most.

    Raises:
        ModelError: the policy is of a class whose memory is not known here.
    """
    match policy:
        case TimedPolicy():
            return len(policy.stages) * memory_size(policy.stages[0])
        case CostAwarePolicy():
            return policy.cap + len(policy.tails)
        case JointMemory():
            return prod(memory_size(keeper) for keeper in policy.keepers)
        case StochasticPolicy():
            return 1 if policy.carrier is None else memory_size(policy.carrier)
        case DeterministicPolicy():
            return 1
    raise ModelError(f"what a {type(policy).__name__} remembers is not known")


def meaning_of(policy: Policy) -> tuple[object, ...]:
    """Meaning of a joint memory: equal for policies that understand each other's memory."""
    match policy:
        case TimedPolicy():
            return len(policy.stages), *meaning_of(policy.stages[0])
        case CostAwarePolicy():
            rule = policy.tail_threshold if policy.tail_table is None else policy.tail_table
            levels = b"" if policy.levels is None else policy.levels.tobytes()
            kept = policy.cap, policy.unit, policy.rounds_up, len(policy.tails)
            return *kept, rule.tobytes(), levels
        case JointMemory():
            return tuple(meaning_of(keeper) for keeper in policy.keepers)
        case StochasticPolicy(carrier=Policy() as carrier):
            return meaning_of(carrier)
    return ()


@dataclass(frozen=True, eq=False, repr=False)
class RememberingPolicy(Policy):
    """A policy of (state, memory) that acts on states and carries the memory itself.

    Its own memory is the product's, and that of the policy besides: ``inner * memories + number``.
    """

    inner: Policy  # on the product

    def __post_init__(self) -> None:
        check_product(self.inner.model)

    @property
    def product(self) -> ProductSSP:
        """Product that the policy remembering its memory lives on."""
        return check_product(self.inner.model)

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """Original model of a policy that remembers a product's memory."""
        return self.product.original

    @property
    def step_limit(self) -> int | None:
        """Step limit of a policy that remembers: the fewest of its products."""
        own = self.product.steps if isinstance(self.product, HorizonSSP) else None
        return min((n for n in (own, self.inner.step_limit) if n is not None), default=None)

    def memories(self) -> list[tuple[int, Hashable]]:
        """The product's memory, with the inner policy's."""
        return _with_last(self.product.memories, self.inner.memories())

    def listed_states(self, memory: int) -> IntArray:
        """States that the product has with this memory, [states]."""
        number = memory % len(self.product.memories)
        return np.flatnonzero(self.product.table[:, number] >= 0)

    def begins(self, states: IntArray) -> BoolArray:
        """Whether the product has these states with the memory's start, [episodes]."""
        number = self.product.memory_number[self.product.memory.start]
        return np.asarray(self.product.table[states, number] >= 0)

    def start_memory(self, states: IntArray) -> IntArray:
        """Start of the product's memory and of the inner policy's, remembered, [episodes]."""
        product = self.product
        first = product.memory_number[product.memory.start]
        inner = self.inner.start_memory(self._at(states, np.full(len(states), first)))
        return np.asarray(inner * len(product.memories) + first)

    @property
    def goes_on(self) -> bool:
        """Whether the remembering policy's inner one goes on after failing."""
        return self.inner.goes_on

    @property
    def ended(self) -> BoolArray:
        """Goals, and dead-ends in which the remembering policy's inner one acts without memory."""
        over = super().ended.copy()
        over[self.product.original_state[~self.inner.ended]] = False
        return over

    def after_giving_up(self, states: IntArray, memory: IntArray) -> IntArray:
        """Memory of a remembering policy after giving up, the inner one's, [episodes]."""
        inner, number = np.divmod(memory, len(self.product.memories))
        moved = self.inner.after_giving_up(self._at(states, number), inner)
        return np.where(moved < 0, -1, moved * len(self.product.memories) + number)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Decisions of a remembering policy as pairs of the original; giving up where lost."""
        product = self.product
        inner, number = np.divmod(memory, len(product.memories))
        here = self._at(states, number)
        inside = self.inner.branches(here, inner)
        shift = product.pair_offsets[here] - self.model.pair_offsets[states]
        pair = np.where(inside.pair >= 0, inside.pair - shift[inside.situation], inside.pair)
        over = (np.diff(product.pair_offsets) == 0) & ~product.goal_mask
        lost = dead_ends(product)[here][inside.situation] & (inside.pair == UNDECIDED)
        pair = np.where(over[here][inside.situation] | lost, GIVE_UP_CODE, pair)
        return Branches(inside.situation, pair, inside.probability)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Update the remembered memory with each step, and the inner policy's, [episodes].

        Raises:
            ModelError: a cost is negative or not finite, or a step leads to a memory that the
                product does not have.
        """
        check_costs(costs)
        product, model = self.product, self.model
        inner, begun = np.divmod(memory, len(product.memories))
        steps = np.stack([begun, pairs, successors], axis=1).astype(np.float64)
        distinct, back = np.unique(np.column_stack([steps, costs]), axis=0, return_inverse=True)
        numbers = []
        for number, pair, successor, cost in distinct.tolist():
            state = model.states[int(model.pair_state[int(pair)])]
            action, there = model.action_of(int(pair)), model.states[int(successor)]
            kept = product.memory.update(product.memories[int(number)], state, action, there, cost)
            if kept not in product.memory_number:
                raise ModelError(
                    f"the step from {state!r} by {action!r} to {there!r} at cost {cost:g} leads to "
                    f"the memory {kept!r}, which the product does not have"
                )
            numbers.append(product.memory_number[kept])
        after = np.array(numbers, dtype=np.int64)[np.ravel(back)]
        here = self._at(model.pair_state[pairs], begun)
        taken = pairs + product.pair_offsets[here] - model.pair_offsets[model.pair_state[pairs]]
        moved = self.inner.remember(inner, taken, self._at(successors, after), costs)
        return np.asarray(moved * len(product.memories) + after)

    def _at(self, states: IntArray, numbers: IntArray) -> IntArray:
        """States of the product by what is remembered.

        Raises:
            ModelError: a state and a memory that do not occur together.
        """
        places = self.product.table[states, numbers]
        if (places < 0).any():
            k = int(np.argmax(places < 0))
            raise ModelError(
                f"state {self.model.states[int(states[k])]!r} with the memory "
                f"{self.product.memories[int(numbers[k])]!r} does not occur in the product"
            )
        return places

    def __repr__(self) -> str:
        """One line: how many memories there are, and the inner policy."""
        return f"RememberingPolicy({len(self.product.memories):,} memories, {self.inner!r})"


class _GoingOn(Policy):
    """A policy that acts as an inner one does, and goes on where that ends."""

    inner: Policy

    @property
    def step_limit(self) -> int | None:
        """The inner policy's."""
        return self.inner.step_limit

    @property
    def goes_on(self) -> bool:
        """Yes."""
        return True


@dataclass(frozen=True, eq=False, repr=False)
class LabelledPolicy(_GoingOn):
    """A policy of (state, label of failing) that acts on states, also after failing.

    It gives up as others do, and goes on with :meth:`after_giving_up`; in a dead-end from which its
    problem counts what happens it acts on. Its memory is ``inner * 3 + label``.
    """

    inner: Policy  # on the product with the label

    @property
    def product(self) -> FailureSSP:
        """Product with the remembered label of failing that the inner policy lives on."""
        return check_label(self.inner.model)

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """Original model of a policy that remembers the label of failing."""
        return self.product.original

    @property
    def ended(self) -> BoolArray:
        """Goals, and dead-ends from which nothing counts after the remembered failing, [states]."""
        return super().ended & ~self.product.is_open

    @property
    def staying(self) -> IntArray:
        """Staying pairs of a policy that remembers failing: for ever where that adds nothing."""
        decision, pairs = super().staying, self.product.staying_after
        decision[self.model.pair_state[pairs]] = pairs
        return decision

    def memories(self) -> list[tuple[int, Hashable]]:
        """The label of failing in words, with the inner policy's memory."""
        return _with_last(FAILING_WORDS, self.inner.memories())

    def listed_states(self, memory: int) -> IntArray:
        """States with decisions before failing, or after it, [states]."""
        failed = memory % len(FAILING_WORDS) > 0
        return np.flatnonzero(self.product.is_open if failed else ~self.ended)

    def start_memory(self, states: IntArray) -> IntArray:
        """Start memory of a policy that remembers failing, before it, [episodes]."""
        return np.asarray(self.inner.start_memory(states) * len(_Label) + _Label.BEFORE)

    def after_giving_up(self, states: IntArray, memory: IntArray) -> IntArray:
        """Memory of a policy that remembers giving up now, -1: nothing counts on, [episodes]."""
        inner, label = np.divmod(memory, len(_Label))
        goes_on = (label == _Label.BEFORE) & self.product.is_open[states] & ~super().ended[states]
        quits = np.zeros(len(states), dtype=np.bool_)
        branches = self.inner.branches(states[goes_on], inner[goes_on])
        taking = (branches.pair >= 0) & self.product.fails[branches.pair]
        quits[np.flatnonzero(goes_on)[branches.situation[taking]]] = True
        return np.where(quits, inner * len(_Label) + _Label.GIVING_UP, -1)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Decisions of a policy that remembers failing, as the original's pairs or giving up."""
        product, (inner, label) = self.product, np.divmod(memory, len(_Label))
        here = states + product.n_original * (label == _Label.AFTER)
        situation, pair, chance = self.inner.branches(here, inner)
        over = super().ended[states][situation] | (label[situation] == _Label.AFTER)
        pair = np.where(over & (pair == UNDECIDED), GIVE_UP_CODE, pair)
        taking = (pair >= 0) & product.fails[pair] & ~over
        kept = taking | (label[situation] != _Label.GIVING_UP)
        situation, pair, chance, taking = (each[kept] for each in (situation, pair, chance, taking))
        total = np.bincount(situation, weights=chance, minlength=len(states))
        acting = np.where(pair >= 0, product.original_pair[pair], pair)
        quits = taking & (label[situation] == _Label.BEFORE)
        return Branches(situation, np.where(quits, GIVE_UP_CODE, acting), chance / total[situation])

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Move the remembered label of failing, and the inner policy's memory, [episodes].

        What is paid after failing is none of the inner policy's costs.
        """
        product, (inner, label) = self.product, np.divmod(memory, len(_Label))
        here = self.model.pair_state[pairs] + product.n_original * (label == _Label.AFTER)
        taking = label == _Label.GIVING_UP
        taken = np.where(taking, product.giving_up_by(pairs), product.placed(here, pairs))
        if (taken < 0).any():
            pair_words = self.model.describe_pair(int(pairs[int(np.argmax(taken < 0))]))
            raise ModelError(f"{pair_words} may lead to the goal: it is not taken after failing")
        moved = product.moved(taken, successors)
        failed = product.after[moved]
        charge = product.costs[product.outcome_offsets[taken]]
        paid = np.where(failed, charge, costs)
        inner = self.inner.remember(inner, taken, moved, paid)
        return np.asarray(inner * len(_Label) + np.where(failed, _Label.AFTER, _Label.BEFORE))

    def __repr__(self) -> str:
        """One line: where it acts after failing, and the inner policy."""
        count = int(self.product.is_open.sum())
        return f"LabelledPolicy(goes on after failing in {count:,} states, {self.inner!r})"


FAILING_WORDS = ("before failing", "giving up", "after failing")
"""What a policy remembers of failing, in words."""


class _Label(enum.IntEnum):
    """Label of failing in a policy's memory."""

    BEFORE = 0
    GIVING_UP = 1  # with the action that comes next
    AFTER = 2


@dataclass(frozen=True, eq=False, repr=False)
class CompletePolicy(_GoingOn):
    """A policy that acts wherever there is anything to do, as another one as far as that says.

    Its memory is ``3 * inner``; one more from where on that policy is over, having given up or from
    a dead-end on; two more from the start on where none of its episodes begins.

    Raises:
        ModelError: a decision is no pair of its state.
    """

    inner: Policy
    otherwise: IntArray  # [states] pair where the inner policy has no decision, or UNDECIDED
    afterwards: IntArray  # [states] pair where it is over, or UNDECIDED

    def __post_init__(self) -> None:
        for name in ("otherwise", "afterwards"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
            check_decisions(self.model, getattr(self, name))

    @property
    def model(self) -> SSP:  # type: ignore[override]
        """The model of the inner policy."""
        return self.inner.model

    @property
    def ended(self) -> BoolArray:
        """Goals, and states without an action, [states]."""
        return np.asarray(self.model.goal_mask | (np.diff(self.model.pair_offsets) == 0))

    def memories(self) -> list[tuple[int, Hashable]]:
        """The inner policy's memories, "over" and, where it does not begin, "elsewhere"."""
        known = [(3 * code, words) for code, words in self.inner.memories()]
        begins = self.inner.begins(np.arange(self.model.n_states)).all()
        return [*known, (1, "over"), *([] if begins else [(2, "elsewhere")])]

    def listed_states(self, memory: int) -> IntArray:
        """States with actions, those of the product where the inner policy lives on one."""
        inner, alone = divmod(memory, 3)
        acting = np.diff(self.model.pair_offsets) > 0
        of_product = isinstance(self.inner, RememberingPolicy) and not alone
        listed = self.inner.listed_states(inner) if of_product else np.arange(acting.size)
        return listed[acting[listed]]

    def start_memory(self, states: IntArray) -> IntArray:
        """The inner policy's, where its episodes begin, [episodes]."""
        memory, begins = np.full(len(states), 2), self.inner.begins(states)
        memory[begins] = 3 * self.inner.start_memory(states[begins])
        return memory

    def after_giving_up(self, states: IntArray, memory: IntArray) -> IntArray:
        """As the inner policy goes on, else by what is done afterwards, [episodes]."""
        inner, alone = np.divmod(memory, 3)
        moved = self.inner.after_giving_up(states, inner)
        return np.where((alone == 0) & (moved >= 0), 3 * moved, 3 * inner + 1)

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The inner policy's decisions, or what is done where it has none."""
        inner, alone = np.divmod(memory, 3)
        over = (alone == 1) | self.inner.ended[states]
        asked, silent = np.flatnonzero(~over & (alone == 0)), np.flatnonzero(over | (alone > 0))
        found = self.inner.branches(states[asked], inner[asked])
        here = states[asked][found.situation]
        pair = np.where(found.pair == UNDECIDED, self.otherwise[here], found.pair)
        rest = np.where(over, self.afterwards[states], self.otherwise[states])[silent]
        situation = np.append(asked[found.situation], silent)
        order, chance = np.argsort(situation, kind="stable"), np.ones(silent.size)
        chance = np.append(found.probability, chance)[order]
        return Branches(situation[order], np.append(pair, rest)[order], chance)

    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """The inner policy's, as long as it has something to say, [episodes]."""
        check_costs(costs)
        inner, alone = np.divmod(memory, 3)
        ended = self.inner.ended[self.model.pair_state[pairs]]
        moved, going = np.where(ended, 3 * inner + 1, memory), np.flatnonzero((alone == 0) & ~ended)
        step = pairs[going], successors[going], costs[going]
        moved[going] = 3 * self.inner.remember(inner[going], *step)
        return np.asarray(moved)

    def __repr__(self) -> str:
        """One line: the inner policy."""
        return f"CompletePolicy({self.inner!r})"


Default = Hashable | Mapping[Hashable, Hashable] | DeterministicPolicy
"""An action wherever it exists, ``{state: action}``, or the decisions of a policy."""


@explained
def acting_everywhere(
    policy: Policy | MixedPolicy,
    default: Default | None = None,
    otherwise: IntArray | None = None,
    afterwards: IntArray | None = None,
) -> MixedPolicy:
    """A policy that acts in every state of its model that has actions, a goal excepted.

    It acts as the policy given where that decides. After giving up, and in dead-ends, it goes on as
    the policy does where its problem counts what happens then; else it surely avoids the goal if it
    can. ``default`` comes before that, and before what is done where there is no decision.

    Args:
        policy: any policy, or a lottery.
        default: an action, for all states that have it, ``{state: action}``, or a policy without
            memory; None: none.
        otherwise: pairs where the policy has no decision, [states]; None: the first of each state.
            A solution knows better ones (``Solution.policy_everywhere``).
        afterwards: pairs after giving up and in dead-ends, likewise; None: that avoid the goal.

    Raises:
        ModelError: an unknown state or action, or a default that is a policy of another model.
    """
    lottery = as_lottery(policy)
    model = lottery.model
    if isinstance(default, DeterministicPolicy) and default.model is not model:
        raise ModelError("the default is a policy of another model")
    if isinstance(default, DeterministicPolicy):
        preferred = default.decision
    elif isinstance(default, Mapping):
        preferred = DeterministicPolicy.from_actions(model, default).decision
    else:
        preferred = np.full(model.n_states, UNDECIDED, dtype=np.int64)
        named = np.array([name == default for name in model.action_names], dtype=np.bool_)
        pairs = np.flatnonzero(named[model.pair_action]) if named.any() else np.zeros(0, np.int64)
        if default is not None and not pairs.size:
            raise ModelError(f"no state has the action {default!r} that is to be the default")
        preferred[model.pair_state[pairs]] = pairs
    acts = (np.diff(model.pair_offsets) > 0) & ~model.goal_mask
    first = np.where(acts, model.pair_offsets[:-1], UNDECIDED)
    planned = first if otherwise is None else np.where(otherwise >= 0, otherwise, first)

    def preferring(decision: IntArray) -> IntArray:
        """Decisions that the default comes before, [states]."""
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
    """Policy of a product as one that remembers its memory on the original model.

    Args:
        policy: such as a solution's, of a problem on ``product(model, memory)``.

    Raises:
        ModelError: it lives on no product.
    """
    lottery = as_lottery(policy)
    kind = RememberingPolicy if lottery.model.failure_label is None else LabelledPolicy
    members = tuple(kind(member) for member in lottery.policies)
    return MixedPolicy(members, lottery.weights)
