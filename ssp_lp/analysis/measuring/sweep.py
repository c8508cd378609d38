"""A backward sweep over the layers of a policy that remembers its cost.

Only the layers that a step can reach are held at once. Within a layer, where steps cost nothing,
and under the tails, the totals are those of a chain of its own and verified as such
(``evaluate_chain``); from layer to layer they are sums of products, which lose a rounding each.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.measuring.columns import Column, Columns
from ssp_lp.analysis.measuring.marks import (
    ENDLESS,
    FAILS,
    HOPEFUL,
    OPEN,
    closed_states,
    marks_of,
)
from ssp_lp.analysis.measuring.moves import Moves, Staying
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.dynamic_programming.linear_systems.system import System
from ssp_lp.dynamic_programming.linear_systems.totals import evaluate_chain
from ssp_lp.policies.policy import GIVE_UP_CODE

_ENDED = -3  # in place of a pair


@dataclass(frozen=True, eq=False)
class Values:
    """What is totalled from each state of a layer on."""

    totals: FloatArray  # [states, columns]
    marks: IntArray  # [states]


@dataclass(frozen=True, eq=False)
class Sweep:
    """The layers of one policy, and what is totalled over them."""

    moves: Moves
    asked: Columns
    known_tails: dict[bytes, Values] = field(default_factory=dict)  # grows, shared by members

    def at_start(self) -> Values:
        """The totals from each state on, with nothing paid."""
        layers = self.moves.layers
        room, shape = max(layers.width - 1, 1), (self.moves.model.n_states, len(self._columns))
        worth, marks = np.empty((room, *shape)), np.empty((room, shape[0]), dtype=np.uint8)
        tails = [self._tail(pair) for pair in layers.tails]
        for layer in range(layers.count, layers.count + room):
            slot, chosen = layer % room, layers.tail_at(layer)
            for number, tail in enumerate(tails):
                there = chosen == number
                worth[slot, there], marks[slot, there] = tail.totals[there], tail.marks[there]
        del tails
        for layer in reversed(range(layers.count)):
            pairs, slots = self.moves.pairs(layers.decision[layer]), self.moves.slots(layer)
            sums, met = self.moves.expect(pairs, slots, worth, marks, *self._priced)
            found = self._settled(pairs, self.moves.staying(pairs, slots), sums, met)
            worth[layer % room], marks[layer % room] = found.totals, found.marks
        return found

    @property
    def _columns(self) -> tuple[Column, ...]:
        return self.asked.columns

    @cached_property
    def _priced(self) -> tuple[IntArray, FloatArray]:
        """Columns (from, to) of which one, times a cost, counts in the other, and the costs.

        What is to come is discounted later, and these are not.

        Returns:
            [k, 2], and the costs of each class of steps, [k, classes].
        """
        found = [(c.prices, k) for k, c in enumerate(self._columns) if c.prices is not None]
        factors = [1.0 / self._columns[k].survival for _, k in found]
        return np.array(found, dtype=np.int64), np.outer(factors, self.moves.layers.costs)

    @cached_property
    def _ended(self) -> IntArray:
        """Marks of goals and dead-ends, [states]."""
        failed = OPEN | (FAILS if self.asked.forbids_failing else 0)
        ended = np.where(self.moves.model.goal_mask, HOPEFUL | OPEN, failed)
        return np.where(self.moves.acting, 0, ended).astype(np.uint8)

    def _tail(self, tail: IntArray) -> Values:
        """The totals under a tail, all of whose moves stay."""
        key = tail.tobytes()
        if key not in self.known_tails:
            self.known_tails[key] = self._alone(np.where(self.moves.acting, tail, _ENDED))
        return self.known_tails[key]

    def _alone(self, pairs: IntArray) -> Values:
        """The totals of decisions that hold for good, by pairs, [states]."""
        staying = self.moves.staying(pairs, np.full(len(self.moves.layers.costs), -1))
        sums = np.zeros((len(pairs), len(self._columns)))
        return self._settled(pairs, staying, sums, np.zeros(len(pairs), dtype=np.uint8))

    def _settled(
        self, pairs: IntArray, staying: Staying | None, sums: FloatArray, met: IntArray
    ) -> Values:
        """The totals from a layer on, given those of its moves to later ones.

        Args:
            pairs: [states].
            staying: moves within the layer; None: there are none.
            sums: expected totals after moves to later layers, overwritten, [states, columns].
            met: marks that may be met there, [states].
        """
        paying, goes_on = None, [c.goes_on for c in self._columns]
        if any(goes_on) and staying is not None:
            paying = np.asarray(staying.paid.sum(axis=1)).ravel() > 0.0
        marks = marks_of(
            pairs, staying, met, self._ended, self.asked.forbidden,
            forbids_failing=self.asked.forbids_failing, paying=paying,
        )  # fmt: skip
        hopeful, is_open = (marks & HOPEFUL) > 0, (marks & OPEN) > 0
        finite = (marks & ENDLESS) == 0
        if any(goes_on) and staying is not None:
            finite &= ~closed_states(staying.share, staying.onward, self.moves.acting & ~is_open)
        self._add_rewards(pairs, sums)
        inside = [self._inside(column, hopeful, is_open, finite) for column in self._columns]
        worth = self._outside(sums, inside)
        if staying is not None:
            chains: dict[tuple[float, bytes], tuple[IntArray, sp.csr_array, System]] = {}
            for columns in self._groups():
                survival, within = self._columns[columns[0]].survival, inside[columns[0]]
                key = survival, within.tobytes()
                if key not in chains:
                    chains[key] = _chain(pairs, staying, within, survival)
                self._solve(columns, *chains[key], staying, worth)
        return Values(worth, marks)

    def _inside(
        self, column: Column, hopeful: BoolArray, is_open: BoolArray, finite: BoolArray
    ) -> BoolArray:
        """Acting states at which a total is still open, [states]."""
        inside = hopeful if column.until_lost else is_open
        if column.goes_on:
            inside = inside | finite if column.survival == 1.0 else np.ones_like(inside)
        return inside & self.moves.acting

    def _add_rewards(self, pairs: IntArray, sums: FloatArray) -> None:
        """Discount what follows and add what each decision earns, in place."""
        if any(column.survival < 1.0 for column in self._columns):
            sums *= np.array([column.survival for column in self._columns])
            sums += np.array([column.each for column in self._columns])
        moving, quits = np.maximum(pairs, 0), np.flatnonzero(pairs == GIVE_UP_CODE)
        for k, column in enumerate(self._columns):
            if column.reward is not None:
                sums[:, k] += np.where(pairs >= 0, column.reward[moving], 0.0)
            if quits.size:
                gain = column.gives_up
                sums[quits, k] += gain[quits] if isinstance(gain, np.ndarray) else gain

    def _outside(self, sums: FloatArray, inside: list[BoolArray]) -> FloatArray:
        """The totals but for moves within the layer: settled where nothing is open, in place."""
        for k, column in enumerate(self._columns):
            out = np.flatnonzero(~inside[k])
            lost = 0.0 if column.goes_on else column.lost
            lost = lost[out] if isinstance(lost, np.ndarray) else lost
            sums[out, k] = np.where(self.moves.acting[out], lost, column.ends[out])
        return sums

    def _groups(self) -> list[list[int]]:
        """Columns that are totalled over the same states at once, those that need others last."""
        groups: dict[tuple[bool, bool, float, bool], list[int]] = {}
        for k, column in enumerate(self._columns):
            key = column.prices is not None, column.until_lost, column.survival, column.goes_on
            groups.setdefault(key, []).append(k)
        return [columns for _, columns in sorted(groups.items())]

    def _solve(
        self,
        columns: list[int],
        nodes: IntArray,
        rows: sp.csr_array,
        system: System,
        staying: Staying,
        worth: FloatArray,
    ) -> None:
        """The totals with the moves within a layer, verified, in place.

        Args:
            columns: that are open at the same states, with the same discount.
            nodes: those states.
            rows: their moves within the layer, [nodes, states].
            system: the equations among them.
            staying: all moves within the layer.
            worth: the totals, those at the nodes without these moves, [states, columns].
        """
        if not nodes.size:
            return
        rewards, beyond = worth[nodes][:, columns], worth[:, columns]
        beyond[nodes] = 0.0
        rewards += self._columns[columns[0]].survival * (rows @ beyond)
        for j, k in enumerate(columns):
            prices = self._columns[k].prices
            if prices is not None:
                rewards[:, j] += staying.paid[nodes] @ worth[:, prices]
        worth[nodes[:, None], columns] = evaluate_chain(system, rewards).values


def _chain(
    pairs: IntArray, staying: Staying, inside: BoolArray, survival: float
) -> tuple[IntArray, sp.csr_array, System]:
    """The nodes at which totals are open, their moves in the layer, and their equations."""
    nodes = np.flatnonzero(inside)
    rows = staying.share[nodes]
    own = sp.csr_array(rows[:, nodes] * survival)
    quits = (pairs[nodes] == GIVE_UP_CODE).astype(np.float64)
    left = rows @ (~inside).astype(np.float64) + staying.onward[nodes] + quits
    return nodes, rows, System(own, (1.0 - survival) + survival * left)
