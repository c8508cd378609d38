"""The totals that the rows of a layered process stand for, and which step leads where.

Where costs have a common unit every multiple of it is a row, and a step leads as many rows ahead as
it has units. Elsewhere the rows are the sums of steps that can occur (``ladder.py``): then a table
says where each kind of step leads. A step beyond the cap leads to a total of its own, at which a
tail takes over. A backward sweep sees the rows ahead of it through a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.processes.totals.ladder import Ladder
from ssp_lp.processes.totals.lattice import totals_of
from ssp_lp.processes.totals.step_sums import room_of


@dataclass(frozen=True, eq=False)
class Levels:
    """Totals in increasing order; from the cap on they are those at which tails take over."""

    totals: FloatArray  # [rows]
    cap: int  # rows below the cap
    ahead: IntArray | None = None  # [cap, kinds] row that a step leads to, less the next row

    @classmethod
    def of_lattice(cls, unit: Fraction, cap: int, width: int) -> Levels:
        """A level for every multiple of a unit.

        Args:
            unit: cost of one row.
            cap: rows.
            width: rows that one step can reach: 0 .. width - 1 ahead.
        """
        return cls(read_only(totals_of(np.arange(cap + width - 1), unit)), cap)

    @classmethod
    def of_sums(cls, ladder: Ladder) -> Levels:
        """A level for each sum below the last rung, and where steps lead from them."""
        below, last = ladder.rungs[:-1], float(ladder.rungs[-1])
        room = room_of(ladder.steps, last)
        reached = below[:, None] + ladder.steps[1:]
        beyond = np.unique(reached[reached >= last - room])
        beyond = beyond[np.diff(beyond, prepend=-np.inf) > room]
        totals = np.concatenate([below, beyond])
        row = np.searchsorted(totals, reached - room)
        ahead = row - np.arange(1, len(below) + 1)[:, None]
        return cls(read_only(totals), len(below), read_only(ahead))

    def leads(self, kinds: int) -> IntArray:
        """The level that each kind of step leads to from each one below the cap, [cap, kinds]."""
        here = np.arange(self.cap)[:, None]
        if self.ahead is None:
            return here + np.arange(kinds)
        return np.concatenate([here, here + 1 + self.ahead], axis=1)

    @property
    def span(self) -> int:
        """Levels that must be at hand: the farthest that steps lead to, and all beyond the cap."""
        beyond = len(self.totals) - self.cap
        return beyond if self.ahead is None else max(beyond, int(self.ahead.max(initial=-1)) + 1)


_SLACK = 4  # the buffer holds this many windows, so that all is moved once in three windows


class Window:
    """Values of the next layers, nearest first; a layer is pushed at the front."""

    def __init__(self, first: FloatArray, levels: Levels | None = None) -> None:
        """Begin at the cap.

        Args:
            first: values of the layers beyond the cap, [layers, ...].
            levels: which step leads where; None: to as many layers ahead as it costs units.
        """
        self._length = len(first) if levels is None else levels.span
        self._leads = None if levels is None else levels.ahead
        self._layer = 0 if levels is None else levels.cap - 1
        self._buffer = np.zeros((_SLACK * self._length, *first.shape[1:]))
        self._front = len(self._buffer) - self._length
        self._buffer[self._front : self._front + len(first)] = first

    @property
    def ahead(self) -> FloatArray:
        """The levels ahead, contiguous, [layers, ...]."""
        return self._buffer[self._front : self._front + self._length]

    @property
    def flat(self) -> FloatArray:
        """What steps lead to, one level after the other, as their columns are, [layers * nodes]."""
        ahead = self.ahead
        if self._leads is not None:
            ahead = ahead[self._leads[self._layer]]
        return ahead.reshape(-1, *ahead.shape[2:])

    def push(self, layer: FloatArray) -> None:
        """Put a level at the front of the window and drop the farthest."""
        self._layer -= 1
        if self._length == 0:
            return
        if self._front == 0:
            back = len(self._buffer) - self._length
            self._buffer[back:] = self._buffer[: self._length]
            self._front = back
        self._front -= 1
        self._buffer[self._front] = layer
