"""A backward sweep over the layers of a policy that remembers its cost.

Only the layers that a step can reach are held at once. Within a layer, where steps cost nothing,
and under the tails, the totals are those of a chain of its own and verified as such
(``evaluate_chain``); from layer to layer they are sums of products, which lose a rounding each.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.analysis.layers.layer_moves import (
    ENDLESS,
    FAILS,
    HOPEFUL,
    OPEN,
    LayerMoves,
    Staying,
    closed_states,
    marks_of,
)
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.dynamic_programming.evaluation import evaluate_chain
from ssp_lp.policies.policy import GIVE_UP_CODE

_LOG = logging.getLogger("ssp_lp.evaluation")


@dataclass(frozen=True, eq=False)
class Column:
    """One total: ``v(x) = reward + survival * E[v(next)]`` where something is still open."""

    ends: FloatArray  # [states] value at goals and dead-ends
    survival: float = 1.0  # factor of what is to come
    until_lost: bool = True  # open while the goal can be reached; else while some end can be
    each: float = 0.0  # reward of every decision
    reward: FloatArray | None = None  # [pairs] beside it
    gives_up: FloatArray | float = 0.0  # [states] reward of giving up
    lost: FloatArray | float = 0.0  # [states] value where nothing is open
    goes_on: bool = False  # costs go on where the goal is lost, until a dead-end is entered
    prices: int | None = None  # the column whose next value, times the cost, counts besides


@dataclass(frozen=True, eq=False)
class LayerSweep:
    """The layers of one policy, and what is totalled over them.

    First it is found where the policy may be in each layer: only these states are totalled.
    """

    moves: LayerMoves
    columns: tuple[Column, ...]
    forbidden: BoolArray  # [states] where the policy may not give up
    forbids_failing: bool

    def at_start(self, begins: IntArray) -> tuple[FloatArray, IntArray]:
        """The totals from some states on, [begins, columns], with nothing paid, and their marks.

        Args:
            begins: states, increasing.
        """
        moves, room = self.moves, self.moves.room
        met, worth, marks = self._met(begins)
        for layer in reversed(range(moves.layers.count)):
            over = 1.0 - layer / moves.layers.count
            _LOG.debug("layer %d of %d", layer, moves.layers.count, extra={"share": over})
            here = _listed_in_layer(np.unpackbits(met[layer]))
            pairs, slots = moves.pairs(layer, here), moves.slots(layer)
            sums, found = moves.expect(pairs, slots, worth, marks, *self._priced)
            staying = moves.staying(here, pairs, slots)
            found = self._settled(here, pairs, staying, sums, found)
            worth[layer % room, here], marks[layer % room, here] = sums, found
        at = np.searchsorted(here, begins)
        return sums[at], found[at]

    def _met(self, begins: IntArray) -> tuple[list[npt.NDArray[np.uint8]], FloatArray, IntArray]:
        """Where the policy may be in each layer, as bits, and what follows beyond the last one.

        Returns:
            The bits of the states, [layers]; then, of the states that may be met in the layers from
            there on, the totals, [slots, states, columns], and the marks, [slots, states].
        """
        moves, room, n = self.moves, self.moves.room, self.moves.model.n_states
        arriving, met, everywhere = np.zeros((room, n), dtype=np.bool_), [], np.arange(n)
        arriving[0, begins] = True
        for layer in range(moves.layers.count):
            here, slots = _listed_in_layer(arriving[layer % room]), moves.slots(layer)
            arriving[layer % room] = False
            if (slots < 0).any():
                here = moves.within(moves.pairs(layer, everywhere), slots, here)
            moves.reach(moves.pairs(layer, here), slots, arriving)
            is_met = np.zeros(n, dtype=np.bool_)
            is_met[here] = True
            met.append(np.packbits(is_met))
        worth, marks = np.empty((room, n, len(self.columns))), np.empty((room, n), dtype=np.uint8)
        count = moves.layers.count
        chosen = {slot % room: moves.layers.tail_at(slot) for slot in range(count, count + room)}
        for number in range(len(moves.layers.tails)):
            lands = [arriving[slot] & (tail == number) for slot, tail in chosen.items()]
            begins = _listed_in_layer(np.logical_or.reduce(lands))
            if begins.size:
                here, totals, found = self._tail(number, begins)
                for slot, tail in chosen.items():
                    own = tail[here] == number
                    worth[slot, here[own]], marks[slot, here[own]] = totals[own], found[own]
        return met, worth, marks

    def _tail(self, number: int, begins: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
        """Where a tail may come to from some states on, all of whose moves stay: totals, marks."""
        moves = self.moves
        slots, n = np.full(len(moves.layers.costs), -1), moves.model.n_states
        here = moves.within(moves.tail(number, np.arange(n)), slots, begins)
        pairs, sums = moves.tail(number, here), np.zeros((len(here), len(self.columns)))
        staying = moves.staying(here, pairs, slots)
        none = np.zeros(len(here), dtype=np.uint8)
        return here, sums, self._settled(here, pairs, staying, sums, none)

    @cached_property
    def _priced(self) -> tuple[IntArray, FloatArray]:
        """Columns (from, to) of which one, times a cost, counts in the other, and the costs.

        What is to come is discounted later, and these are not.

        Returns:
            [k, 2], and the costs of each class of steps, [k, classes].
        """
        found = [(c.prices, k) for k, c in enumerate(self.columns) if c.prices is not None]
        factors = [1.0 / self.columns[k].survival for _, k in found]
        return np.array(found, dtype=np.int64), np.outer(factors, self.moves.layers.costs)

    @cached_property
    def _ended(self) -> IntArray:
        """Marks of goals and dead-ends, [states]."""
        failed = OPEN | (FAILS if self.forbids_failing else 0)
        ended = np.where(self.moves.model.goal_mask, HOPEFUL | OPEN, failed)
        return np.where(self.moves.acting, 0, ended).astype(np.uint8)

    def _settled(
        self,
        here: IntArray,
        pairs: IntArray,
        staying: Staying | None,
        sums: FloatArray,
        met: IntArray,
    ) -> IntArray:
        """The totals from a layer on, in place of those of its moves to later ones; the marks, [k].

        Args:
            here: states, increasing, [k].
            pairs: [k].
            staying: moves within the layer; None: there are none.
            sums: expected totals after moves to later layers, overwritten, [k, columns].
            met: marks that may be met there, [k].
        """
        acting = self.moves.acting[here]
        paying, goes_on = None, [c.goes_on for c in self.columns]
        if any(goes_on) and staying is not None:
            paying = np.asarray(staying.paid.sum(axis=1)).ravel() > 0.0
        marks = marks_of(
            pairs, staying, met, self._ended[here], self.forbidden[here],
            forbids_failing=self.forbids_failing, paying=paying,
        )  # fmt: skip
        hopeful, is_open = (marks & HOPEFUL) > 0, (marks & OPEN) > 0
        finite = (marks & ENDLESS) == 0
        if any(goes_on) and staying is not None:
            finite &= ~closed_states(staying.share, staying.onward, acting & ~is_open)
        self._add_rewards(here, pairs, sums)
        inside = [
            acting & self._inside(column, hopeful, is_open, finite) for column in self.columns
        ]
        self._close(here, sums, inside)
        if staying is not None:
            chains: dict[tuple[float, bytes], tuple[IntArray, sp.csr_array, System]] = {}
            for columns in self._groups():
                survival, within = self.columns[columns[0]].survival, inside[columns[0]]
                key = survival, within.tobytes()
                if key not in chains:
                    chains[key] = _chain_in_sweep(pairs, staying, within, survival)
                self._solve(columns, *chains[key], staying, sums)
        return marks

    def _inside(
        self, column: Column, hopeful: BoolArray, is_open: BoolArray, finite: BoolArray
    ) -> BoolArray:
        """Where a total is still open, if anything happens there, [k]."""
        inside = hopeful if column.until_lost else is_open
        if column.goes_on:
            inside = inside | finite if column.survival == 1.0 else np.ones_like(inside)
        return inside

    def _add_rewards(self, here: IntArray, pairs: IntArray, sums: FloatArray) -> None:
        """Discount what follows and add what each decision earns, in place."""
        if any(column.survival < 1.0 for column in self.columns):
            sums *= np.array([column.survival for column in self.columns])
            sums += np.array([column.each for column in self.columns])
        moving, quits = np.maximum(pairs, 0), np.flatnonzero(pairs == GIVE_UP_CODE)
        for k, column in enumerate(self.columns):
            if column.reward is not None:
                sums[:, k] += np.where(pairs >= 0, column.reward[moving], 0.0)
            if quits.size:
                gain = column.gives_up
                sums[quits, k] += gain[here[quits]] if isinstance(gain, np.ndarray) else gain

    def _close(self, here: IntArray, sums: FloatArray, inside: list[BoolArray]) -> None:
        """The totals where nothing is open, in place."""
        acting = self.moves.acting[here]
        for k, column in enumerate(self.columns):
            out = np.flatnonzero(~inside[k])
            lost = 0.0 if column.goes_on else column.lost
            lost = lost[here[out]] if isinstance(lost, np.ndarray) else lost
            sums[out, k] = np.where(acting[out], lost, column.ends[here[out]])

    def _groups(self) -> list[list[int]]:
        """Columns that are totalled over the same states at once, those that need others last."""
        groups: dict[tuple[bool, bool, float, bool], list[int]] = {}
        for k, column in enumerate(self.columns):
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
            rows: their moves within the layer, [nodes, k].
            system: the equations among them.
            staying: all moves within the layer.
            worth: the totals, those at the nodes without these moves, [k, columns].
        """
        if not nodes.size:
            return
        rewards, beyond = worth[nodes][:, columns], worth[:, columns]
        beyond[nodes] = 0.0
        rewards += self.columns[columns[0]].survival * (rows @ beyond)
        for j, k in enumerate(columns):
            prices = self.columns[k].prices
            if prices is not None:
                rewards[:, j] += staying.paid[nodes] @ worth[:, prices]
        worth[nodes[:, None], columns] = evaluate_chain(system, rewards).values


def _chain_in_sweep(
    pairs: IntArray, staying: Staying, inside: BoolArray, survival: float
) -> tuple[IntArray, sp.csr_array, System]:
    """The nodes at which totals are open, their moves in the layer, and their equations."""
    nodes = np.flatnonzero(inside)
    rows = staying.share[nodes]
    own = sp.csr_array(rows[:, nodes] * survival)
    quits = (pairs[nodes] == GIVE_UP_CODE).astype(np.float64)
    left = rows @ (~inside).astype(np.float64) + staying.onward[nodes] + quits
    return nodes, rows, System(own, (1.0 - survival) + survival * left)


def _listed_in_layer(chosen: npt.NDArray[Any]) -> IntArray:
    """The states that are marked, increasing."""
    return np.flatnonzero(chosen)
