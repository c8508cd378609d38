"""Answers by name, and as text: states, actions and pairs of a model; tables for people."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from html import escape
from typing import TypeVar, cast

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray, ReadOnlyCopies
from ssp_lp.errors import ModelError, did_you_mean

_Value = TypeVar("_Value")

_LISTED = 5  # actions that an error names


class ByName(dict[str, _Value]):
    """Values by name, whose KeyError says which name was probably meant."""

    def __missing__(self, name: object) -> _Value:
        """Raise :class:`KeyError`."""
        names = ", ".join(map(repr, self)) or "none"
        nearest = did_you_mean(name, self) or f"; there are {names}"
        raise KeyError(f"{name!r} is no name here{nearest}")


class Naming(ReadOnlyCopies):
    """The names of a model's states and actions, and the model in a line."""

    states: Sequence[Hashable]  # [states] labels
    action_names: Sequence[Hashable]
    pair_action: IntArray  # [pairs]
    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    goal_mask: BoolArray  # [states]

    @cached_property
    def _index(self) -> Mapping[Hashable, int]:
        """Positions of the states by their names."""
        return {label: i for i, label in enumerate(self.states)}

    def index_of(self, state: Hashable) -> int:
        """Index of the state with this label.

        Raises:
            ModelError: no state has the label.
        """
        found = self.find(state)
        if found is None:
            raise ModelError(f"{state!r} is not a state of the model{self.hint(state)}")
        return found

    def find(self, state: Hashable) -> int | None:
        """Index of the state with this label, None if there is none."""
        if isinstance(self.states, range):
            known = isinstance(state, (int, np.integer)) and state in self.states
            return int(cast("int", state)) if known else None
        try:
            return self._index.get(state)
        except TypeError:  # a list, say
            return None

    def hint(self, state: Hashable) -> str:
        """A clause for errors: what may be meant by what is no state."""
        if isinstance(self.states, range):
            return f": states are 0 .. {len(self.states) - 1}"
        return did_you_mean(state, self.states)

    def places_of(self, state: Hashable) -> IntArray:
        """All states that a label stands for: here one, in a product possibly several.

        Raises:
            ModelError: no state has the label.
        """
        return np.array([self.index_of(state)])

    def action_of(self, pair: int) -> Hashable:
        """Label of the action of a pair; raises :class:`ModelError` if there is no such pair."""
        try:
            return self.action_names[int(self.pair_action[pair])]
        except (IndexError, TypeError) as error:
            last = len(self.pair_action) - 1
            raise ModelError(f"{pair!r} is no pair of the model: they are 0 .. {last}") from error

    def no_such_action(self, state: int, action: Hashable) -> str:
        """What to say of an action that a state does not have: the nearest one, or some."""
        first, end = int(self.pair_offsets[state]), int(self.pair_offsets[state + 1])
        known = [self.action_of(pair) for pair in range(first, end)]
        some = ", ".join(repr(name) for name in known[:_LISTED]) or "none"
        nearest = did_you_mean(action, known) or f"; it has {some}"
        return f"state {self.states[state]!r} has no action {action!r}{nearest}"

    def describe_pair(self, pair: int) -> str:
        """Name a pair for a person: "action 'go' of state 'start'"."""
        state = int(np.searchsorted(self.pair_offsets, pair, side="right")) - 1
        return f"action {self.action_of(pair)!r} of state {self.states[state]!r}"

    def _describe_outcome(self, outcome: int) -> str:
        """Name an outcome for a person, by its pair."""
        pair = int(np.searchsorted(self.outcome_offsets, outcome, side="right")) - 1
        return self.describe_pair(pair)

    @property
    def _sizes(self) -> dict[str, int]:
        """How many there are of everything."""
        return {
            "states": len(self.pair_offsets) - 1,
            "pairs": len(self.outcome_offsets) - 1,
            "outcomes": len(self.successors),
            "goals": int(self.goal_mask.sum()),
        }

    def __repr__(self) -> str:
        """One line: the sizes."""
        sizes = ", ".join(f"{count:,} {name}" for name, count in self._sizes.items())
        return f"{type(self).__name__}({sizes})"

    def _repr_html_(self) -> str:
        """The sizes as a table, for notebooks."""
        rows = [(name, f"{count:,}") for name, count in self._sizes.items()]
        return html_table(type(self).__name__, rows)


def text_table(rows: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """Rows of text in columns as wide as what they hold, the first ``left`` of them flush left."""
    table = [*rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join([*map(str.ljust, row[:left], widths), *map(str.rjust, row[left:], widths[left:])])
        for row in table
    ]


class Summarised:
    """Mix-in of answers whose ``summary`` is what is printed, and shown in notebooks."""

    @abstractmethod
    def summary(self) -> str:
        """The answer as text, perhaps in columns."""

    def __str__(self) -> str:
        """The summary."""
        return self.summary()

    def _repr_html_(self) -> str:
        """The summary, for notebooks: text in columns as it stands, escaped."""
        return html_text(self.summary())


def html_table(
    title: str,
    rows: Iterable[Sequence[str]],
    head: Sequence[str] = (),
    notes: Iterable[str] = (),
) -> str:
    """Rows of text as an HTML table under a title, with notes below it, escaped."""
    lines = [f'<caption style="white-space: nowrap">{escape(title)}</caption>']
    tagged = [(head, "th")] if head else []
    for cells, tag in [*tagged, *((row, "td") for row in rows)]:
        inside = (f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell in cells)
        lines.append(f"<tr>{''.join(inside)}</tr>")
    below = [f"<p>{escape(note)}</p>" for note in notes]
    return "\n".join(["<table>", *lines, "</table>", *below])


def html_text(text: str) -> str:
    """Text in columns as it stands, escaped."""
    return f'<pre style="line-height: 1.2">{escape(text)}</pre>'
