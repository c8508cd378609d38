"""The decisions of a policy as a table: printed, shown in notebooks, or as a frame of pandas."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from itertools import islice
from typing import Any, NamedTuple, overload

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import optional_module
from ssp_lp.model import SSP
from ssp_lp.model.text_tables import html_table, text_table

_ROWS = 20  # rows printed of a member's decisions
_MEMBERS = 5  # members of a lottery that are printed


class PolicyRow(NamedTuple):
    """One decision of a policy."""

    state: Hashable
    memory: Hashable  # None: nothing is remembered; else see PolicyTable
    action: Hashable  # or GIVE_UP
    probability: float
    member: int = 0  # position in the lottery


class Decisions(NamedTuple):
    """Decisions of a policy in several situations, one entry for each."""

    state: IntArray  # [decisions]
    memory: IntArray  # [decisions] the policy's own number
    pair: IntArray  # [decisions] pair of the model, or a negative code for giving up
    probability: FloatArray  # [decisions]


class Member(NamedTuple):
    """One policy of a lottery, as a part of a table."""

    weight: float
    remembers: str  # heading of the memory
    words: Mapping[int, Hashable]  # a memory's number -> the memory in words
    decisions: Callable[[], Iterator[Decisions]]


@dataclass(frozen=True, eq=False, repr=False)
class PolicyTable(Sequence[PolicyRow]):
    """The decisions of a policy, in the order of members, memories and states.

    It is a sequence of :class:`PolicyRow`. States in which the policy never acts have no row.
    Memories are written as

    - the cost paid so far (cost-aware policies, cost levels), "tail k" from the cap on;
    - the time step, or (time step, memory of the stage) (timed policies);
    - the product's memory, or (it, memory of the inner policy);
    - "before failing", "giving up" and "after failing", likewise, where that counts;
    - "over" and "elsewhere" of a policy that acts everywhere, where the inner policy has ended, or
      begins in no state of its own;
    - a tuple, where several of these are remembered together.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> policy = DeterministicPolicy.from_actions(model, {"door": "open"})
        >>> print(policy)
        state  action  probability
        door   open              1
        >>> policy.table()[0]
        PolicyRow(state='door', memory=None, action='open', probability=1.0, member=0)
    """

    model: SSP
    members: tuple[Member, ...]
    give_up: Hashable  # the action of decisions without a pair
    note: str = ""  # printed below decisions that depend on a memory

    @cached_property
    def _rows(self) -> list[PolicyRow]:
        """All rows of the policy's table."""
        return [row for k in range(len(self.members)) for row in self._member_rows(k)]

    def _member_rows(self, member: int) -> Iterator[PolicyRow]:
        """Rows of a member's decisions, made as they are asked for."""
        model, part = self.model, self.members[member]
        for block in part.decisions():
            for state, code, pair, share in zip(*(b.tolist() for b in block), strict=True):
                action = self.give_up if pair < 0 else model.action_of(pair)
                yield PolicyRow(model.states[state], part.words.get(code), action, share, member)

    def __len__(self) -> int:
        """Number of decisions."""
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> PolicyRow: ...
    @overload
    def __getitem__(self, index: slice) -> list[PolicyRow]: ...
    def __getitem__(self, index: int | slice) -> PolicyRow | list[PolicyRow]:
        """One row, or the rows of a slice."""
        return self._rows[index]

    def __iter__(self) -> Iterator[PolicyRow]:
        """The rows in order."""
        return iter(self._rows)

    def to_frame(self) -> Any:
        """The table as a pandas ``DataFrame``, with a column for each field of a row.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        pandas = optional_module("pandas", "frames")
        return pandas.DataFrame(self._rows, columns=list(PolicyRow._fields))

    def __str__(self) -> str:
        """The first rows of each member under its weight."""
        if len(self.members) == 1:
            return "\n".join([*self._member_lines(0), *self._notes])
        lines = [f"lottery over {len(self.members)} policies, drawn once at the start"]
        for k, member in enumerate(self.members[:_MEMBERS]):
            lines.append(f"with probability {member.weight:.4g}:")
            lines += [f"  {line}" for line in self._member_lines(k)]
        if len(self.members) > _MEMBERS:
            lines.append(f"and {len(self.members) - _MEMBERS:,} more policies")
        return "\n".join([*lines, *self._notes])

    def __repr__(self) -> str:
        """The printed table."""
        return str(self)

    def _repr_html_(self) -> str:
        """The printed table for notebooks."""
        tables = []
        for k, member in enumerate(self.members[:_MEMBERS]):
            title = "policy" if len(self.members) == 1 else f"with probability {member.weight:.4g}"
            head, rows, notes = self._shown(k)
            tables.append(html_table(title, rows, head, notes))
        return "\n".join([*tables, *(f"<p>{escape(note)}</p>" for note in self._notes)])

    @property
    def _notes(self) -> list[str]:
        """The table's note, where a member remembers something."""
        words = (memory for member in self.members for memory in member.words.values())
        return [self.note] if self.note and any(memory is not None for memory in words) else []

    def _member_lines(self, member: int) -> list[str]:
        """Lines of a member's table."""
        head, rows, notes = self._shown(member)
        lines = text_table([head, *rows], left=len(head) - 1) if rows else []
        return [*lines, *notes]

    def _shown(self, member: int) -> tuple[list[str], list[list[str]], list[str]]:
        """Head, first rows and a note on the other rows of a member's table."""
        part = self.members[member]
        rows = list(islice(self._member_rows(member), _ROWS))
        count = sum(len(block.pair) for block in part.decisions())
        remembers = any(memory is not None for memory in part.words.values())
        head = ["state", *([part.remembers] if remembers else []), "action", "probability"]
        listed = []
        for row in rows:
            memory = [_in_table(row.memory)] if remembers else []
            listed.append(
                [_in_table(row.state), *memory, _in_table(row.action), f"{row.probability:.4g}"]
            )
        notes = [f"and {count - len(rows):,} more"] if count > len(rows) else []
        return head, listed, notes if rows else ["no decisions"]


def _in_table(value: Hashable) -> str:
    """A state, a memory or an action as it is printed: a whole number without decimals."""
    whole = isinstance(value, float) and value.is_integer()
    return f"{value:g}" if whole else str(value)
