"""The product of a model with a memory of your own: tasks, counters, deadlines.

"Fetch the key before the door", "at most two visits of the ward", "within twenty steps": success
often depends on the history of an episode. A memory summarises it; the product's states are (state,
memory), so that every criterion and every method applies.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, Final, cast

import numpy as np

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    entries_of,
    least_integer_type,
    offsets_of,
    read_only,
    segment_ids,
    sorted_unique,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import Argument, ModelError, check_whole, did_you_mean, wrong_argument
from ssp_lp.model.arguments import check_fields, explained, explained_class
from ssp_lp.model.graph import goal_approach
from ssp_lp.model.ssp import SSP, check_hashable, check_model, no_lone_string

MOST_PLACES: Final = 250_000_000  # states times steps or memories: four bytes each in numbering

_BUILDING = logging.getLogger("ssp_lp.building")

MEMORY_FAILS = "memory fails"
"""Label of states in which the memory fails."""

NOT_ACCEPTED = "goal not accepted"
"""Label of goals of the original that the memory does not accept."""


Label = tuple[Hashable, Hashable]
"""A state of the product: (state of the original, memory)."""


def _always_in_product(memory: Any) -> bool:
    """Return True: by default, reaching a goal is a success whatever the memory is."""
    return True


def _never_in_product(memory: Any) -> bool:
    """Return False: by default, no value of the memory means that an episode has failed."""
    return False


@explained_class
@dataclass(frozen=True)
class Memory:
    """A memory of an episode: its updates, and its decisions on success and failure.

    Args:
        start: initial memory; any hashable.
        update: ``(memory, state, action, successor, cost) -> memory`` after each step.
        accepts: whether reaching a goal with this memory is a success; otherwise the goal becomes
            a dead-end.
        fails: whether an episode fails as soon as it has this memory.

    Example:
        >>> key_first = Memory(
        ...     start=False,
        ...     update=lambda has_key, state, action, successor, cost: (
        ...         has_key or successor == "key"
        ...     ),
        ...     accepts=lambda has_key: has_key,
        ... )
    """

    start: Hashable
    update: Callable[[Any, Any, Any, Any, float], Hashable]
    accepts: Callable[[Any], bool] = _always_in_product
    fails: Callable[[Any], bool] = _never_in_product

    def __post_init__(self) -> None:
        """Raise :class:`ModelError` if a function of the memory does not accept its arguments."""
        check_fields(self)


@dataclass(frozen=True)
class ProductStates(Sequence[Label]):
    """The states (state, memory) of a product: a sequence that makes each tuple on access."""

    names: Sequence[Hashable]  # the original's states
    memories: tuple[Hashable, ...]
    state: IntArray  # [states] of the original
    number: IntArray  # [states] position in memories

    def __len__(self) -> int:
        return len(self.state)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return ProductStates(self.names, self.memories, self.state[index], self.number[index])
        return self.names[int(self.state[index])], self.memories[int(self.number[index])]

    def __iter__(self) -> Iterator[Label]:
        for state, number in zip(self.state.tolist(), self.number.tolist(), strict=True):
            yield self.names[state], self.memories[number]


@dataclass(frozen=True, eq=False, repr=False)
class ProductSSP(SSP):
    """A model whose states are (state, memory); see :func:`product`.

    A product state has the same actions as its original state, in their order. It has no actions if
    the episode is over: at a goal (accepted by the memory or not), or where the memory fails.
    """

    original: SSP = field(kw_only=True)
    memory: Memory | None = field(kw_only=True, default=None)  # None: ``moved`` is overridden
    is_hidden: bool = field(kw_only=True, default=False)  # the user's problem has another model

    def start(self, start: Hashable | Mapping[Hashable, float]) -> dict[Hashable, float]:
        """Return the start of the product for a start of the original.

        Args:
            start: a state of the original, or ``{state: probability}``.

        Raises:
            ModelError: a state in which the product's episodes do not begin.
        """
        shares = start if isinstance(start, Mapping) else {start: 1.0}
        places = np.array([self.original.index_of(state, "start") for state in shares])
        memories = [self.memories[k] for k in self.first_memory(places).tolist()]
        distribution: dict[Hashable, float] = {
            (state, memory): float(share)
            for (state, share), memory in zip(shares.items(), memories, strict=True)
        }
        for label in distribution:
            self.index_of(label, "start")
        return distribution

    def first_memory(self, states: IntArray) -> IntArray:
        """Return the index of the memory with which episodes begin, [episodes].

        Args:
            states: original states in which the episodes begin, [episodes].
        """
        return np.zeros(len(states), dtype=np.int64)

    @property
    def labels(self) -> ProductStates:
        """States of the product, (state, memory) each."""
        return cast("ProductStates", self.states)

    @property
    def original_state(self) -> IntArray:
        """Original state of each state of the product, [states]."""
        return self.labels.state

    @property
    def memories(self) -> tuple[Hashable, ...]:
        """Memories that occur in the product, the initial one first.

        With a horizon these are counts of steps, and :data:`LATE`.
        """
        return self.labels.memories

    @cached_property
    def original_pair(self) -> IntArray:
        """Original pair of each pair of the product, [pairs]."""
        first = self.original.pair_offsets[self.original_state] - self.pair_offsets[:-1]
        return np.asarray(np.arange(self.n_pairs) + first[self.pair_state])

    @cached_property
    def original_outcome(self) -> IntArray:
        """Original outcome of each outcome of the product, [outcomes].

        The product has no outcomes of probability 0.
        """
        possible = np.flatnonzero(self.original.probabilities > 0.0)
        offsets = np.searchsorted(possible, self.original.outcome_offsets)
        return np.asarray(possible[entries_of(offsets, self.original_pair)[0]])

    def placed(self, states: IntArray, pairs: IntArray) -> IntArray:
        """Return the product's pair by which each given state takes an original pair, [entries].

        Args:
            states: states of the product, [entries].
            pairs: original pair to take in each of these states, [entries].
        """
        shift = self.pair_offsets[states] - self.original.pair_offsets[self.original_state[states]]
        return np.asarray(pairs + shift)

    def at(self, states: IntArray, numbers: IntArray) -> IntArray:
        """Return the product's states for original states and memories, [entries].

        Args:
            states: original states, [entries].
            numbers: indices of the memories, [entries].

        Raises:
            ModelError: a state and a memory that do not occur together.
        """
        places = self.table[states, numbers]
        if (places < 0).any():
            k = int(np.argmax(places < 0))
            raise ModelError(
                f"state {self.original.states[int(states[k])]!r} with the memory "
                f"{self.memories[int(numbers[k])]!r} does not occur in the product"
            )
        return places

    def moved(self, pairs: IntArray, successors: IntArray, costs: FloatArray) -> IntArray:
        """Return the states of the product after steps, [episodes].

        Args:
            pairs: pairs of the product that are taken, [episodes].
            successors: original states that are reached, [episodes].
            costs: costs of the steps, [episodes].

        Raises:
            ModelError: a step leads to a memory that the product does not have.
        """
        model, update = self.original, cast("Memory", self.memory).update

        @cache
        def updated(pair: int, successor: int, cost: float) -> int:
            """Return the index of the product's memory after a step."""
            (state, kept), there = self.labels[int(self.pair_state[pair])], model.states[successor]
            step = kept, state, self.action_of(pair), there, cost
            if (after := update(*step)) not in self.memory_number:
                told = f"the step from {state!r} by {step[2]!r} to {there!r} at cost {cost:g}"
                other = f"the memory {after!r}, unknown to the product: check that it is possible"
                raise ModelError(f"{told} leads to {other}")
            return self.memory_number[after]

        steps = (each.tolist() for each in (pairs, successors, costs))
        return self.at(successors, np.array(list(map(updated, *steps)), dtype=np.int64))

    def moved_by(self, pairs: IntArray, outcomes: IntArray) -> tuple[IntArray, IntArray]:
        """Return the product's successor and the product's outcome of each step, [entries] each.

        Args:
            pairs: pair of the product that is taken, [entries].
            outcomes: original outcome that occurs, [entries].
        """
        possible = np.cumsum(self.original.probabilities > 0.0)
        first = self.original.outcome_offsets[self.original_pair[pairs]]
        before = np.where(first > 0, possible[first - 1], 0)
        place = self.outcome_offsets[pairs] + possible[outcomes] - 1 - before
        return self.successors[place].astype(np.int64), place

    def places_of(self, state: Hashable) -> IntArray:
        """Return the indices of the product's states with a label.

        For a label (state, memory) this is one index; for a label of the original, all its product
        states.

        Raises:
            ModelError: neither the product nor the original has a state with the label.
        """
        place = self.find(state)
        if place is not None:
            return np.array([place])
        copies = self.table[self.original.places_of(state)]
        return np.asarray(copies[copies >= 0])

    def hint(self, state: Hashable) -> str:
        """Return a hint for the error about an unknown state."""
        if self.original.find(state) is None:
            return super().hint(state)
        return f": its states are (state, memory), start({state!r}) is the initial one"

    @cached_property
    def memory_number(self) -> dict[Hashable, int]:
        """Position of each of the product's memories in ``memories``."""
        return {memory: k for k, memory in enumerate(self.memories)}

    @cached_property
    def table(self) -> IntArray:
        """Index of the product's state (state, memory); -1: none, [states, memories]."""
        table = np.full((self.original.n_states, len(self.memories)), -1, dtype=np.int64)
        table[self.original_state, self.labels.number] = np.arange(self.n_states)
        return read_only(table)

    def find(self, state: Hashable) -> int | None:
        """Return the index of a state (state, memory); None if the product does not have it."""
        if not (isinstance(state, tuple) and len(state) == 2):
            return None
        here = self.original.find(state[0])
        try:
            number = self.memory_number.get(state[1])
        except TypeError:  # not hashable, such as a list
            return None
        if here is None or number is None:
            return None
        place = int(self.table[here, number])
        return place if place >= 0 else None


def copied_parts(
    model: SSP,
    pair_offsets: IntArray,
    outcome_offsets: IntArray,
    successors: IntArray,
    pairs: IntArray,
    outcomes: IntArray,
) -> dict[str, Any]:
    """Return the graph of a product, with the fields that are copies of the model's.

    Args:
        model: the model.
        pair_offsets: of the product, like the next two.
        outcome_offsets: of the product.
        successors: of the product.
        pairs: the model's pair of each pair of the product, [product pairs].
        outcomes: the model's outcome of each outcome of the product, [product outcomes].
    """
    return {
        "pair_offsets": read_only(pair_offsets),
        "outcome_offsets": read_only(outcome_offsets),
        "successors": read_only(successors, np.int32),
        "action_names": model.action_names,
        "pair_action": read_only(model.pair_action[pairs]),
        "probabilities": read_only(model.probabilities[outcomes]),
        "costs": read_only(model.costs[outcomes]),
        "exact_costs": model.exact_costs,
        "named_costs": {name: read_only(c[outcomes]) for name, c in model.named_costs.items()},
        "original": model,
    }


@explained
def product(
    model: SSP,
    memory: Memory,
    *,
    start: Iterable[Hashable] | None = None,
    state_limit: int = 1_000_000,
) -> ProductSSP:
    """Explore the product of a model with a memory.

    Args:
        model: the model.
        memory: the memory.
        start: states in which episodes may begin; None: every state of the model.
        state_limit: greatest number of states of the product.

    Returns:
        The product. Labels of the model's states are kept; states where the memory fails bear the
        label "memory fails", and goals that it does not accept bear the label
        "goal not accepted".

    Raises:
        ModelError: more states than the limit (a memory that grows without end), no goal that the
            memory accepts, or a function of the memory returns a wrong value.
    """
    check_model(model, "product")
    if not isinstance(memory, Memory):
        raise ModelError(f"product() takes a Memory after the model, not {memory!r}")
    check_whole("state_limit", state_limit)
    numbers, failing = dict[Hashable, int](), list[bool]()  # of memories, in the order of finding
    pair_of, names = segment_ids(model.outcome_offsets), model.states

    def number_of(kept: Hashable) -> int:
        """Return the number of a memory; a new one is appended."""
        check_hashable(kept, "the memory of a product")
        if kept not in numbers:
            numbers[kept] = len(numbers)
            failing.append(bool(memory.fails(kept)))
        return numbers[kept]

    def after(before: IntArray, outcomes: IntArray) -> IntArray:
        """Return the number of the memory after each outcome, given the one before, [entries]."""
        memories, moved = [*numbers], list[int]()
        for number, k in zip(before.tolist(), outcomes.tolist(), strict=True):
            state, action = names[int(model.pair_state[pair_of[k]])], model.action_of(pair_of[k])
            step = state, action, names[int(model.successors[k])], float(model.costs[k])
            moved.append(number_of(memory.update(memories[number], *step)))
        return np.array(moved, dtype=np.int64)

    def fails(states: IntArray, numbers: IntArray) -> BoolArray:
        """Return a mask of the memories with which an episode has failed, [entries]."""
        return np.array(failing, dtype=np.bool_)[numbers]

    begin = model.states if start is None else no_lone_string(start, "start")
    first = np.array([model.index_of(state, "start") for state in begin], dtype=np.int64)
    memories = np.full(len(first), number_of(memory.start))
    state, number, fields = unfold(model, (first, memories), after, fails, state_limit)
    failed, kept = fails(state, number), [*numbers]
    refused = model.goal_mask[state] & ~failed
    goal = np.zeros_like(refused)
    goal[refused] = [bool(memory.accepts(kept[k])) for k in number[refused].tolist()]
    refused &= ~goal
    if not goal.any():
        raise ModelError("no run from the start reaches a goal with an accepted memory")
    return ProductSSP(
        **fields,
        states=ProductStates(names, tuple(numbers), read_only(state), read_only(number)),
        goal_mask=read_only(goal),
        state_labels=labels_in_product(model, state, {MEMORY_FAILS: failed, NOT_ACCEPTED: refused}),
        memory=memory,
    )


def unfold(
    model: SSP,
    begin: tuple[IntArray, IntArray],
    after: Callable[[IntArray, IntArray], IntArray],
    is_over: Callable[[IntArray, IntArray], BoolArray],
    state_limit: int = MOST_PLACES,
) -> tuple[IntArray, IntArray, dict[str, Any]]:
    """Explore the states (state, memory) of a product breadth-first, with their pairs.

    Each round finds the states one step further, in the order of their memories, then of their
    states in the model.

    Args:
        model: the model.
        begin: states in which episodes may begin, and the numbers of their memories.
        after: function (numbers of memories, outcomes) -> numbers of the memories after the
            outcomes, [entries] each.
        is_over: function (states, numbers of memories) -> mask of the entries at which an episode
            ends even if the model has actions there, [entries] each.
        state_limit: greatest number of states of the product.

    Returns:
        The model's state and the number of the memory of each state of the product, [states] each;
        and the product's fields except ``states``, ``goal_mask`` and ``state_labels``.

    Raises:
        ModelError: the product has more states than the limit, or the model's states times the
            memories are more than ``MOST_PLACES``.
    """
    n, possible = model.n_states, np.flatnonzero(model.probabilities > 0.0)
    offsets = np.searchsorted(possible, model.outcome_offsets)  # [pairs + 1] in ``possible``
    first, widths = offsets[model.pair_offsets[:-1]], np.diff(offsets[model.pair_offsets])
    new, n_found = sorted_unique(begin[1] * n + begin[0]).astype(np.int32), 0
    rounds = list[tuple[Any, ...]]()
    # place in the product of the state with memory m and state s of the model: places[m * n + s]
    places = np.full(max(n, int(new.max(initial=0)) + 1), -1, dtype=np.int32)
    while new.size or not rounds:
        check_time()
        places[new] = np.arange(n_found, n_found + new.size)
        n_found += new.size
        if n_found > state_limit:
            told = f"more than state_limit={state_limit:,} states are reachable"
            raise ModelError(f"{told}: raise the limit or bound the memory")
        number, state = np.divmod(new, n)
        goes_on = ~is_over(state, number)
        width = widths[state] * goes_on
        outcomes = possible[concatenated_ranges(first[state], width)]
        moved = after(np.repeat(number, width), outcomes)
        if (room := (int(moved.max(initial=0)) + 1) * n) > MOST_PLACES:
            raise ModelError(f"{room // n:,} memories on {n:,} states are too many: use fewer")
        target = moved.astype(np.int32, copy=False) * np.int32(n) + model.successors[outcomes]
        rounds.append((state, number, goes_on, outcomes, target))
        if room > places.size:
            more = np.full(max(room, 2 * places.size) - places.size, -1, dtype=np.int32)
            places = np.concatenate([places, more])
        new = target[places[target] < 0]
        places[new] = np.arange(new.size)
        new = np.sort(new[places[new] == np.arange(new.size)])  # keep one of equal entries
    state, number, goes_on, outcomes, target = map(np.concatenate, zip(*rounds, strict=True))
    actions = np.diff(model.pair_offsets)[state] * goes_on
    pairs = concatenated_ranges(model.pair_offsets[state], actions)
    bounds = offsets_of(actions), offsets_of(np.diff(offsets)[pairs])
    fields = copied_parts(model, *bounds, places[target], pairs, outcomes)
    return state.astype(np.int64), number, fields


def labels_in_product(
    model: SSP, state: IntArray, own: Mapping[str, BoolArray]
) -> dict[str, IntArray]:
    """Return the labels of states in a product: the original's and the product's own, merged.

    Args:
        model: the original.
        state: the original's state of each state of the product, [states].
        own: label -> the product's states that bear it, [states].
    """
    marked = dict(own)
    for name, members in model.state_labels.items():
        among = np.isin(state, members)
        marked[name] = among | marked[name] if name in marked else among
    return {name: read_only(np.flatnonzero(mask)) for name, mask in marked.items()}


def check_product(model: SSP) -> ProductSSP:
    """Return the model, checked to be a product.

    Raises:
        ModelError: it is another model.
    """
    if not isinstance(model, ProductSSP):
        raise ModelError("the policy's model is not a product: make one by product(model, memory)")
    return model


LATE: Final = "out of time"
"""Memory of an episode that has used up its steps, and label of the states it ends in."""


@dataclass(frozen=True, eq=False, repr=False)
class HorizonSSP(ProductSSP):
    """A model whose states are (state, steps taken); see :func:`within_steps`."""

    steps: int = field(kw_only=True)
    survive: tuple[str, ...] | None = field(kw_only=True, default=None)  # :func:`within_steps`

    def moved(self, pairs: IntArray, successors: IntArray, costs: FloatArray) -> IntArray:
        """Return the states of the product after steps, [episodes].

        After the last step the memory is "out of time", unless the reached state has no actions.

        Raises:
            ModelError: a step leads to a state that does not occur after so many steps.
        """
        count = self.labels.number[self.pair_state[pairs]].astype(np.int64) + 1
        over = (count == self.steps) & (np.diff(self.original.pair_offsets)[successors] > 0)
        return self.at(successors, np.where(over, self.steps + 1, count))


@explained
def within_steps(
    model: SSP,
    steps: int,
    *,
    start: Iterable[Hashable] | None = None,
    survive: bool | Iterable[str] = False,
) -> HorizonSSP:
    """Return the product in which an episode fails unless it reaches the goal within some steps.

    Its memory counts steps. A policy on the product knows the number of steps left; ``on_original``
    lets it act on the model's states. With ``survive``, an episode that takes all steps succeeds
    ("do not fall within 500 steps"). It fails if it reaches a state without actions earlier, or a
    state with a label in ``survive``.

    Args:
        model: the model. If only surviving counts, its goal is a state that no action leads to.
        steps: number of steps; a goal reached with the last one counts.
        start: states in which episodes may begin; None: every state of the model.
        survive: True: an episode that takes all steps succeeds. Labels of states: the same, and an
            episode fails in a state with one of these labels although it has actions. False: only
            reaching the goal is success.

    Returns:
        The product, with states (state, steps taken), and (state, "out of time") after the last
        step, which are goals with ``survive``. States from which the goal is too many steps away
        are dead-ends with the label "out of time"; other labels are kept.

    Raises:
        ModelError: ``steps`` is no positive number, an unknown start, or no goal can be reached.

    Example:
        >>> model = SSP.from_transitions(
        ...     {"lock": {"try": [(0.5, "open", 1.0), (0.5, "lock", 1.0)]}}, goal={"open"})
        >>> three = within_steps(model, 3, start=["lock"])
        >>> list(three.states)[-2:], three.start("lock")
        ([('open', 3), ('lock', 'out of time')], {('lock', 0): 1.0})
    """
    check_model(model, "within_steps")
    check_whole("steps", steps)
    labels = (survive,) if isinstance(survive, str) else survive
    if not isinstance(labels, (bool, Iterable)):
        raise wrong_argument("survive", "be True, False or labels of states", survive)
    lost = (None, ())[labels] if isinstance(labels, bool) else tuple(labels)
    for label in set(lost or ()) - model.state_labels.keys():
        near = did_you_mean(label, model.state_labels, "the labels:")
        raise ModelError(f"no state bears the label {label!r}{near}")
    if lost:
        inside = np.zeros(model.n_states, dtype=np.bool_)
        inside[np.concatenate([model.state_labels[label] for label in lost])] = True
        source = model.pair_state[segment_ids(model.outcome_offsets)]
        leaving = inside[source] & ~inside[model.successors] & (model.probabilities > 0.0)
        if leaving.any():
            state = model.states[int(source[int(np.argmax(leaving))])]
            raise ModelError(f"survive must name absorbing states, but state {state!r} can be left")
    begin = None
    if start is not None:
        begin = [model.index_of(state) for state in no_lone_string(start, "start")]
    horizon = unroll_steps(model, steps, begin, lost)
    if not horizon.goal_mask.any():
        raise ModelError(f"no goal can be reached within {steps} steps from the start")
    return horizon


@with_twin
def _unrolled(model: SSP, steps: int, begin: IntArray) -> tuple[IntArray, IntArray, dict[str, Any]]:
    """Return the result of :func:`unfold` whose memory is the number of steps taken so far.

    The memory ``steps + 1`` stands for "out of time".
    """
    acting = np.diff(model.pair_offsets) > 0
    if accelerated(steps * model.n_outcomes, "graphs.find_layers", "graphs.fill_layers"):
        from ssp_lp.compiled.graphs import unroll

        graph = model.pair_offsets, model.outcome_offsets, model.successors, model.probabilities
        state, layers, parts = unroll(graph, sorted_unique(begin), steps)
        count, last = np.arange(steps + 1).repeat(np.diff(layers)), layers[-2]
        count[last:] += acting[state[last:]]
        return state, count, copied_parts(model, *parts)

    def after(before: IntArray, outcomes: IntArray) -> IntArray:
        """Return the count of steps after each outcome, [entries]."""
        if not (before == steps - 1).any():
            return before + 1
        return np.asarray(before + 1 + acting[model.successors[outcomes]])  # all of one round

    first = begin, np.zeros_like(begin)
    return unfold(model, first, after, lambda states, counts: counts >= steps)


def unroll_steps(
    model: SSP,
    steps: int,
    begin: Sequence[int] | None,
    survive: tuple[str, ...] | None = None,
    *,
    is_hidden: bool = False,
) -> HorizonSSP:
    """Return the model of :func:`within_steps`, without checking that a goal can be reached.

    Args:
        model: the model.
        steps: number of steps, >= 1.
        begin: states in which episodes may begin; None: all.
        survive: labels of states in which an episode fails, if taking all steps is success; None:
            taking all steps is failure.
        is_hidden: whether the user's problem has another model.

    Raises:
        ModelError: states times steps are too many.
    """
    steps = int(steps)
    if (steps + 2) * model.n_states > MOST_PLACES:
        raise ModelError(
            f"{steps:,} steps on {model.n_states:,} states are too many: take ",
            Argument("horizon", None),
            ", or make the model smaller",
        )
    first = np.array(range(model.n_states) if begin is None else begin, dtype=np.int64)
    state, count, fields = _unrolled(model, steps, first)
    goal, late = model.goal_mask[state], dict[str, BoolArray]()
    if survive is None:  # label states from which the goal is too many steps away
        nearer, needed = goal_approach(model)
        late[LATE] = np.where(nearer >= 0, needed, -1)[state] > steps - count
    else:
        lost = np.concatenate([[], *(model.state_labels[name] for name in survive)])
        goal |= (count > steps) & ~np.isin(state, lost)
    number = read_only(count, least_integer_type(steps + 1))
    check_time()
    horizon = HorizonSSP(
        **fields,
        states=ProductStates(model.states, (*range(steps + 1), LATE), read_only(state), number),
        goal_mask=read_only(goal),
        state_labels=labels_in_product(model, state, late),
        steps=steps,
        survive=survive,
        is_hidden=is_hidden,
    )
    _BUILDING.info("%r", horizon)
    return horizon
