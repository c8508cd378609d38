"""The product of a model with an automaton that reads the outcomes of a run.

Limits on whole runs ("at most 10 units of fuel with 95 %", "the key before the door") depend on the
history of a run. An automaton with finitely many values summarises it; the product has the states
(state, value) that a run can reach, and is built array by array.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from itertools import compress

import numpy as np

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    ReadOnlyCopies,
    entries_of,
    least_integer_type,
    read_only,
    sorted_unique,
)
from ssp_lp.errors import ModelError
from ssp_lp.model.product import (
    MOST_PLACES,
    NOT_ACCEPTED,
    ProductSSP,
    ProductStates,
    labels_in_product,
    unfold,
)
from ssp_lp.model.report import Report, Table
from ssp_lp.model.ssp import SSP

_BUILDING = logging.getLogger("ssp_lp.building")


@dataclass(frozen=True, eq=False)
class Automaton(Report, ReadOnlyCopies):
    """A finite automaton that reads the outcomes of a run and remembers one of several values."""

    name: str  # the quantity or task that it follows, in words
    words: tuple[Hashable, ...]  # [values], all different
    letters: tuple[str, ...]  # [letters] in words
    moves: IntArray  # [values, letters] value after a letter is read
    letter: IntArray  # [outcomes] of the model
    begin: IntArray  # [states] value with which an episode begins
    unit: float = 0.0  # to whose multiples amounts are rounded up; negative: down; 0: exact

    def __post_init__(self) -> None:
        self.keep_read_only("moves", "letter", "begin")

    def edges(self) -> list[tuple[int, int, str]]:
        """Return the moves as (value, next value, the letters that lead from one to the other)."""
        return [
            (value, after, " or ".join(compress(self.letters, self.moves[value] == after)))
            for value in range(len(self.words))
            for after in sorted_unique(self.moves[value]).tolist()
        ]

    def tables(self) -> list[Table]:
        """Return a table of the automaton's moves."""
        rows = [(self.words[a], self.words[b], letters) for a, b, letters in self.edges()]
        return [Table(rows, ("value", "next", "after"), self.name, left=3)]

    def dot(self) -> str:
        """Return the automaton as a graph in the language of Graphviz."""
        quoted = [str(word).replace('"', "'") for word in self.words]
        edges = ((quoted[a], quoted[b], c) for a, b, c in self.edges())
        lines = [f'  "{a}" -> "{b}" [label="{letters}"]' for a, b, letters in edges]
        return "\n".join(["digraph {", *lines, "}"])


@dataclass(frozen=True, eq=False, repr=False)
class TrackedSSP(ProductSSP):
    """A model whose states are (state, value of an automaton); see :func:`track`."""

    automaton: Automaton = field(kw_only=True)
    follows: object = field(kw_only=True)  # limit or task of the automaton

    def first_memory(self, states: IntArray) -> IntArray:
        """Return the index of the automaton's value with which episodes begin, [episodes]."""
        return self.automaton.begin[states]

    def moved(self, pairs: IntArray, successors: IntArray, costs: FloatArray) -> IntArray:
        """Return the states after steps; the automaton reads the outcome of each step, [episodes].

        Raises:
            ModelError: the model has no such step, or several outcomes have the step's successor
                and cost but lead to different values.
        """
        model, automaton = self.original, self.automaton
        value, taken = self.labels.number[self.pair_state[pairs]], self.original_pair[pairs]
        outcome, counts = entries_of(model.outcome_offsets, taken)
        step = np.repeat(np.arange(len(pairs)), counts)
        there = (model.successors[outcome] == successors[step]) & (model.probabilities[outcome] > 0)
        alike = there & (model.costs[outcome] == costs[step])
        alike |= there & ~(np.bincount(step[alike], minlength=len(pairs)) > 0)[step]
        after = automaton.moves[value[step], automaton.letter[outcome]][alike]
        least, most = np.full(len(pairs), len(automaton.words)), np.full(len(pairs), -1)
        np.minimum.at(least, step[alike], after)
        np.maximum.at(most, step[alike], after)
        if (least != most).any():
            k = int(np.argmax(least != most))
            told = f"{model.describe_pair(int(taken[k]))} to {model.states[int(successors[k])]!r}"
            if most[k] < 0:
                raise ModelError(f"the model has no step by {told}")
            raise ModelError(
                f"{told} at cost {float(costs[k]):g}: outcomes with this successor and this cost "
                f"differ in {automaton.name}: give them different successors or different costs"
            )
        return self.at(successors, least)


def followed_in(model: SSP, follows: object) -> tuple[TrackedSSP, IntArray] | None:
    """Return the product, among nested products, that was built for a given limit or task.

    Args:
        model: a model that may be a product of a product, and so on.
        follows: the limit or task.

    Returns:
        The product and, for each state of the model, the product's state, [states]; None if there
        is no such product.
    """
    place: IntArray = np.arange(model.n_states)
    while isinstance(model, ProductSSP):
        if isinstance(model, TrackedSSP) and model.follows is follows:
            return model, place
        place, model = model.original_state[place], model.original
    return None


def rounded_in(model: SSP) -> dict[object, float]:
    """Return the unit of rounding of each limit whose amounts a model's products round up."""
    found = dict[object, float]()
    while isinstance(model, ProductSSP):
        if isinstance(model, TrackedSSP) and model.automaton.unit > 0.0:
            found[model.follows] = model.automaton.unit
        model = model.original
    return found


def check_not_rounded(model: SSP, what: str) -> None:
    """Refuse a computation on a model whose products round the amounts of a limit.

    Args:
        model: the model.
        what: name of the computation, for the error.

    Raises:
        ModelError: totals of a limit are rounded.
    """
    for follows, unit in rounded_in(model).items():
        raise ModelError(
            f"{what} does not support rounded totals, but those of {follows!r} are too many and "
            f"rounded to multiples of {unit:.3g}: round the amounts to fewer values"
        )


def track(
    model: SSP,
    automaton: Automaton,
    follows: object,
    begin: IntArray,
    succeeds: Callable[[IntArray, IntArray], BoolArray] | None = None,
) -> TrackedSSP:
    """Return the product of a model with an automaton, explored from the start.

    Args:
        model: the model.
        automaton: automaton that reads the model's outcomes.
        follows: the limit or task that the automaton stands for.
        begin: indices of the states in which episodes may begin.
        succeeds: function (states, automaton values) -> mask of the entries at which a run ends
            with success, [entries] each; None: runs end at the model's goals.

    Raises:
        ModelError: states times values are too many.
    """
    n, size = model.n_states, len(automaton.words)
    if n * size > MOST_PLACES:
        raise ModelError(
            f"{automaton.name}: {size:,} values on {n:,} states are too many: lower "
            "the bound, round the amounts to a coarser grid, or make the model smaller"
        )

    def after(before: IntArray, outcomes: IntArray) -> IntArray:
        """Return the automaton's value after each outcome, given the value before it, [entries]."""
        return automaton.moves[before, automaton.letter[outcomes]]

    def ends(state: IntArray, value: IntArray) -> BoolArray:
        """Return a mask of the entries at which a run ends with success, [entries]."""
        return model.goal_mask[state] if succeeds is None else succeeds(state, value)

    first = automaton.begin[begin].astype(np.int64)
    state, value, fields = unfold(model, (begin, first), after, ends)
    goal = ends(state, value)
    refused = {NOT_ACCEPTED: model.goal_mask[state] & ~goal} if succeeds is not None else {}
    number = read_only(value, least_integer_type(size))
    tracked = TrackedSSP(
        **fields,
        states=ProductStates(model.states, automaton.words, read_only(state), number),
        goal_mask=read_only(goal),
        state_labels=labels_in_product(model, state, refused),
        is_hidden=succeeds is None,
        automaton=automaton,
        follows=follows,
    )
    _BUILDING.info("%r", tracked)
    return tracked
