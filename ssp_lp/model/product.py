"""The product of a model with a memory of the user's own: tasks, counters, deadlines.

"Fetch the key before the door", "at most two visits of the ward", "within twenty steps": what an
episode must do is often told by what happened on the way. A memory says what has to be kept of it;
the product's states are (state, memory), so that every criterion and every method applies.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import IntArray, concatenated_ranges
from ssp_lp.errors import ModelError
from ssp_lp.model.arguments import check_fields, explained
from ssp_lp.model.builders import no_lone_string
from ssp_lp.model.ssp import SSP, check_model

MEMORY_FAILS = "memory fails"
"""Label of states where the memory fails."""

NOT_ACCEPTED = "goal not accepted"
"""Label of goals of the original that the memory does not accept."""


Label = tuple[Hashable, Hashable]
"""A state of the product: the original's, and the memory."""


def _always_in_product(memory: Any) -> bool:
    """A product's memory that accepts everything."""
    return True


def _never_in_product(memory: Any) -> bool:
    """A product's memory that never fails."""
    return False


@dataclass(frozen=True)
class Memory:
    """What is remembered of an episode, and what it decides.

    Args:
        start: at the beginning; any hashable.
        update: ``(memory, state, action, successor, cost) -> memory`` after each step.
        accepts: whether reaching a goal with this memory is a success; else it is a dead-end.
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
        """Raise :class:`ModelError` for what is no function, or one of other arguments."""
        check_fields(self)


@dataclass(frozen=True, eq=False, repr=False)
class ProductSSP(SSP):
    """A model whose states are (state, memory); see :func:`product`.

    Actions are those of the original, in their order; a state has none where the episode is over:
    at goals, where the memory fails, and at goals of the original that it does not accept.
    """

    original: SSP = field(kw_only=True)
    memory: Memory = field(kw_only=True)
    is_hidden: bool = field(kw_only=True, default=False)  # behind a problem that states another

    def start(self, start: Hashable | Mapping[Hashable, float]) -> dict[Hashable, float]:
        """The start of the product for a start of the original.

        Args:
            start: a state of the original, or ``{state: probability}``.

        Raises:
            ModelError: a state from which the product was not explored.
        """
        shares = start if isinstance(start, Mapping) else {start: 1.0}
        found: dict[Hashable, float] = {
            (state, self.memory.start): float(share) for state, share in shares.items()
        }
        for label in found:
            self.index_of(label)
        return found

    @cached_property
    def original_state(self) -> IntArray:
        """State of the original, [states]."""
        return np.array([self.original.index_of(state) for state, _ in self._labels])

    @cached_property
    def memories(self) -> tuple[Hashable, ...]:
        """The memories that occur, in the order in which they do."""
        return tuple(dict.fromkeys(memory for _, memory in self._labels))

    @cached_property
    def original_pair(self) -> IntArray:
        """Pair of the original, [pairs]."""
        first = self.original.pair_offsets[self.original_state] - self.pair_offsets[:-1]
        return np.asarray(np.arange(self.n_pairs) + first[self.pair_state])

    @cached_property
    def original_outcome(self) -> IntArray:
        """Outcome of the original, [outcomes]; its impossible ones are not in the product."""
        possible = np.flatnonzero(self.original.probabilities > 0.0)
        first = np.searchsorted(possible, self.original.outcome_offsets[self.original_pair])
        return np.asarray(possible[concatenated_ranges(first, np.diff(self.outcome_offsets))])

    def places_of(self, state: Hashable) -> IntArray:
        """The state with this label, or all states of the product for a state of the original.

        Raises:
            ModelError: neither model has a state with the label.
        """
        found = self.find(state)
        if found is not None:
            return np.array([found])
        copies = self.table[self.original.places_of(state)]
        return np.asarray(copies[copies >= 0])

    def hint(self, state: Hashable) -> str:
        """A clause for errors: what may be meant by what is no state."""
        if self.original.find(state) is None:
            return super().hint(state)
        return f": its states are (state, memory), start({state!r}) is where it begins"

    @property
    def _labels(self) -> Sequence[Label]:
        """The product's states, (state, memory) each."""
        return cast("Sequence[Label]", self.states)

    @cached_property
    def memory_number(self) -> dict[Hashable, int]:
        """Position of each memory in ``memories``."""
        return {memory: k for k, memory in enumerate(self.memories)}

    @cached_property
    def table(self) -> IntArray:
        """The product's state of each state and memory, -1 for none, [states, memories]."""
        table = np.full((self.original.n_states, len(self.memories)), -1, dtype=np.int64)
        number = [self.memory_number[memory] for _, memory in self._labels]
        table[self.original_state, number] = np.arange(self.n_states)
        return table


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
        memory: what is remembered.
        start: states in which episodes may begin; None: every state of the model.
        state_limit: raise when the product has more states than this.

    Returns:
        The product. Labels of the model's states are kept; states where the memory fails bear the
        label "memory fails", goals that it does not accept "goal not accepted".

    Raises:
        ModelError: the limit was passed (a memory that grows without end), or the memory's
            functions do not return what they should.
    """
    check_model(model, "product")
    if not isinstance(memory, Memory):
        raise ModelError(f"product takes a Memory after the model, not {memory!r}")
    task = _ProductTask(model, memory)
    begin = model.states if start is None else no_lone_string(start, "start")
    plain = SSP.from_successors(
        [(state, memory.start) for state in begin],
        task.successors,
        task.is_goal,
        state_limit=state_limit,
        state_labels=task.labels(),
        treat_actionless_as_dead_ends=True,
    )
    fields = {name: getattr(plain, name) for name in SSP.__dataclass_fields__}
    fields["exact_costs"] = model.exact_costs
    return ProductSSP(**fields, original=model, memory=memory)


@dataclass(frozen=True)
class _ProductTask:
    """The product as functions of (state, memory)."""

    model: SSP
    memory: Memory

    def has_failed(self, label: Label) -> bool:
        """Whether the memory fails."""
        return bool(self.memory.fails(label[1]))

    def is_at_goal(self, label: Label) -> bool:
        """Whether a goal of the original is reached, and the memory does not fail."""
        at_goal = bool(self.model.goal_mask[self.model.index_of(label[0])])
        return at_goal and not self.has_failed(label)

    def is_goal(self, label: Label) -> bool:
        """Whether the memory accepts it, too."""
        return self.is_at_goal(label) and bool(self.memory.accepts(label[1]))

    def is_refused(self, label: Label) -> bool:
        """Whether it does not."""
        return self.is_at_goal(label) and not self.is_goal(label)

    def successors(self, label: Label) -> dict[Hashable, list[tuple[float, Label, float]]]:
        """What each action of the original leads to; nothing where the episode is over."""
        if self.is_at_goal(label) or self.has_failed(label):
            return {}
        model, update, (state, kept) = self.model, self.memory.update, label
        here = model.index_of(state)
        found = {}
        for pair in range(int(model.pair_offsets[here]), int(model.pair_offsets[here + 1])):
            action = model.action_of(pair)
            found[action] = [
                (p, (to, update(kept, state, action, to, cost)), cost)
                for p, to, cost in _outcomes_for_product(model, pair)
            ]
        return found

    def labels(self) -> dict[str, Callable[[Label], bool]]:
        """The labels of the original, and why an episode failed; a label may say both."""
        found: dict[str, Callable[[Label], bool]] = {
            MEMORY_FAILS: self.has_failed,
            NOT_ACCEPTED: self.is_refused,
        }
        for name, members in self.model.state_labels.items():
            among = frozenset(self.model.states[k] for k in members.tolist())
            found[name] = partial(_holds_in_product, among, found.get(name, _never_in_product))
        return found


def _holds_in_product(
    among: frozenset[Hashable], otherwise: Callable[[Label], bool], label: Label
) -> bool:
    """Whether a label holds in a state of the product."""
    return label[0] in among or otherwise(label)


def _outcomes_for_product(model: SSP, pair: int) -> list[tuple[float, Hashable, float]]:
    """The possible outcomes of a pair."""
    some = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
    rows = zip(
        model.probabilities[some].tolist(),
        model.successors[some].tolist(),
        model.costs[some].tolist(),
        strict=True,
    )
    return [(p, model.states[to], cost) for p, to, cost in rows if p > 0.0]


def check_product(model: SSP) -> ProductSSP:
    """The model, if it is a product.

    Raises:
        ModelError: it is not.
    """
    if not isinstance(model, ProductSSP):
        raise ModelError("the policy lives on no product: product(model, memory) makes one")
    return model
