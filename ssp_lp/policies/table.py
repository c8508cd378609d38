"""Tables of a policy's decisions: as text, in notebooks, or as a pandas frame."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple, overload

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.model import SSP
from ssp_lp.model.report import Report, Table

_ROWS = 20  # rows printed of a member's decisions
_MEMBERS = 5  # members of a lottery that are printed


class PolicyRow(NamedTuple):
    """One decision of a policy."""

    state: Hashable
    memory: Hashable  # None without memory; otherwise see PolicyTable
    action: Hashable  # or GIVE_UP
    probability: float
    member: int = 0  # position in the lottery


class Decisions(NamedTuple):
    """Decisions of a policy in several situations (state, memory), one entry for each."""

    state: IntArray  # [decisions]
    memory: IntArray  # [decisions] values of the policy's memory
    pair: IntArray  # [decisions] pair of the model, or a negative code for giving up
    probability: FloatArray  # [decisions]


class Member(NamedTuple):
    """One policy of a lottery, as a part of a table."""

    weight: float
    remembers: str  # heading of the memory
    words: Mapping[int, Hashable]  # value of the memory -> its name
    decisions: Callable[[], Iterator[Decisions]]


@dataclass(frozen=True, eq=False, repr=False)
class PolicyTable(Report, Sequence[PolicyRow]):
    """The decisions of a policy, in the order of members, memories and states.

    It is a sequence of :class:`PolicyRow`. States in which the policy never acts have no row. The
    memory of a row is

    - for cost-aware policies and policies on cost levels, the cost paid so far, or "tail k" once
      the cost has reached the policy's cap: from then on the stationary policy k is followed;
    - for timed policies, the time step, or (time step, memory of the stage);
    - for policies on a product, the product's memory, or (product's memory, memory of the inner
      policy);
    - for policies that act after failing, "before failing", "giving up" or "after failing", alone
      or with the inner memory;
    - for policies that act everywhere, "over" after the end of the policy that is extended, and
      "elsewhere" in an episode that begins where that policy cannot begin;
    - a tuple, if several of these are remembered together.

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
        return [row for k in range(len(self.members)) for row in self._member_rows(k)]

    def _member_rows(self, member: int) -> Iterator[PolicyRow]:
        """Yield the rows of a member of the lottery, each made when it is requested."""
        model, part = self.model, self.members[member]
        for block in part.decisions():
            for state, code, pair, share in zip(*(b.tolist() for b in block), strict=True):
                action = self.give_up if pair < 0 else model.action_of(pair)
                yield PolicyRow(model.states[state], part.words.get(code), action, share, member)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> PolicyRow: ...
    @overload
    def __getitem__(self, index: slice) -> list[PolicyRow]: ...
    def __getitem__(self, index: int | slice) -> PolicyRow | list[PolicyRow]:
        """Return a row, or the rows of a slice."""
        return self._rows[index]

    def tables(self) -> list[Table]:
        """Return a table for each of the first members, with the member's weight and first rows."""
        several = len(self.members) > 1
        tables = [self._member_table(k, several) for k in range(min(len(self.members), _MEMBERS))]
        if several:
            drawn = f"lottery over {len(self.members)} policies, drawn once at the start"
            tables.insert(0, Table([], title=drawn))
        if (more := len(self.members) - _MEMBERS) > 0:
            tables.append(Table([], notes=[f"and {more:,} more policies"]))
        words = (memory for member in self.members for memory in member.words.values())
        if self.note and any(memory is not None for memory in words):
            tables.append(Table([], notes=[self.note]))
        return tables

    def all_rows(self) -> Table:
        """Return the decisions of all members as one table, a row for each decision."""
        return Table(self._rows, PolicyRow._fields)

    def to_frame(self) -> Any:
        """Return all rows as a pandas ``DataFrame``, with a column for each field of a row.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return self.all_rows().to_frame()

    def __repr__(self) -> str:
        """Return the printed table."""
        return str(self)

    def _member_table(self, member: int, titled: bool) -> Table:
        """Return the table of a member's first rows; a note counts the rows that are not shown."""
        part = self.members[member]
        count = sum(len(block.pair) for block in part.decisions())
        remembers = any(memory is not None for memory in part.words.values())
        rows = [
            (*map(_in_table, (row.state, row.memory, row.action)), row.probability)
            for row in islice(self._member_rows(member), _ROWS)
        ]
        notes = [f"and {count - len(rows):,} more"] * (count > len(rows))
        return Table(
            rows,
            ("state", part.remembers, "action", "probability"),
            f"with probability {part.weight:.4g}:" if titled else "",
            notes,
            {"probability": 4},
            left=3 if remembers else 2,
            hidden=() if remembers else {part.remembers},
        )


def _in_table(value: Hashable) -> str:
    """Return a state, memory or action as text; a whole number has no decimals."""
    whole = isinstance(value, float) and value.is_integer()
    return f"{value:g}" if whole else str(value)
