"""One large strong component of a chain: iterated, reduced as a band, or by sparse factors.

What iterates is tried first (see ``iteration``). A component that is narrow in some order is
reduced state by state without subtractions; others take sparse factors.
"""

from __future__ import annotations

from functools import cached_property
from weakref import proxy

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import FloatArray, IntArray, offsets_of, unsigned
from ssp_lp.compiled.accelerator import accelerated, has_accelerator
from ssp_lp.compiled.deadline import pieces
from ssp_lp.dynamic_programming.linear_systems.direct_solvers import (
    Solver,
    band_solver,
    factor_solver,
)
from ssp_lp.dynamic_programming.linear_systems.iteration import Iteration
from ssp_lp.errors import SolverError

_BAND_WORK = 6e8
"""States times the square of the bandwidth: about a second of compiled reduction."""

_MOST_BAND_WORK = 1e10  # the same where nothing else is precise enough


class LargeComponent:
    """Equations ``y = right + own @ y`` of one component, seen on departing only."""

    def __init__(self, matrix: sp.csr_array, exits: FloatArray, states: IntArray) -> None:
        """Take the component out of its chain.

        Args:
            matrix: of the whole chain, [states, states].
            exits: of the whole chain, [states].
            states: the members, in the order in which they are swept.
        """
        self._chain, self._states = matrix, states
        self._is_compiled = accelerated(matrix.nnz)
        self._place = np.full(matrix.shape[0], -1, dtype=np.int32)
        self._place[states] = np.arange(len(states), dtype=np.int32)
        self._own, self._departs, self._leaving = self._gathered(exits)
        self._direct: Solver | None = None
        weak = proxy(self)  # in a ring of references large arrays would wait for its collection
        self._iteration = Iteration(
            self._own, lambda: weak.direct_work, is_compiled=self._is_compiled
        )

    @cached_property
    def direct_work(self) -> float:
        """About the multiplications of a direct solution: states times the square of the width."""
        size = len(self._states)
        if not self._is_compiled:
            return float(size) * self._band[1] ** 2
        from ssp_lp.compiled.sweeps import widest_level

        own = self._own
        return float(size) * widest_level(unsigned(own.indptr), unsigned(own.indices)) ** 2

    @cached_property
    def _band(self) -> tuple[IntArray, int]:
        """An order in which the component is narrow, and how far moves lead in it at most."""
        order = csgraph.reverse_cuthill_mckee(self._own, symmetric_mode=False)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        entry = self._own.tocoo()
        return order, int(np.abs(place[entry.row] - place[entry.col]).max(initial=0))

    def solve(self, rewards: FloatArray, x: FloatArray, accuracy: float) -> int:
        """Solve for the members in place, given the totals of all that they lead to.

        Args:
            rewards: of the whole chain, [states, rewards].
            x: of the whole chain, [states, rewards]; members hold a guess.
            accuracy: relative residual.

        Returns:
            Passes over the component's matrix.

        Raises:
            SolverError: no method gets anywhere.
        """
        right, y, before = self._right(rewards, x), x[self._states], self._iteration.products
        if self._direct is None and not self._iteration.solve(right, y, accuracy):
            self._direct = self._direct_solver()
        x[self._states] = y if self._direct is None else self._direct(right)
        return max(self._iteration.products - before, 1)

    def reduce(self, rewards: FloatArray, x: FloatArray) -> None:
        """The same as ``solve`` without any subtraction: for chains that are hardly left.

        Raises:
            SolverError: the component is not narrow enough, or numba is missing.
        """
        self._is_compiled, (order, width) = has_accelerator(), self._band
        if not self._is_compiled or len(order) * width**2 > _MOST_BAND_WORK:
            raise SolverError(
                "a policy's totals could not be verified: its chain is left too seldom for double "
                "precision"
            )
        exits, right = self._leaving / self._departs, self._right(rewards, x)
        x[self._states] = band_solver(self._own, exits, order, width)(right)

    def _gathered(self, exits: FloatArray) -> tuple[sp.csr_array, FloatArray, FloatArray]:
        """Moves among members divided by the probability of departing, that, and what leaves."""
        size, states = len(self._states), self._states
        if not self._is_compiled:
            rows = self._chain[states]
            entry = sp.csr_array(rows[:, states]).tocoo()
            away = (entry.row != entry.col) & (entry.data > 0.0)
            row, column, data = entry.row[away], entry.col[away], entry.data[away]
            leaving = exits[states] + rows @ (self._place < 0).astype(np.float64)
            departs = leaving + np.bincount(row, weights=data, minlength=size)
            own = sp.csr_array((data / departs[row], (row, column)), shape=(size, size))
            return own, departs, leaving
        from ssp_lp.compiled.sweeps import gather_inside

        members, begin = unsigned(states), self._chain.indptr
        indptr = offsets_of(np.diff(begin)[states]).astype(np.int32)
        indices, data = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1])
        departs, leaving = np.empty(size), np.empty(size)
        for some in pieces(size, len(indices)):
            gather_inside(len(indices))(
                *self._arrays, exits, members[some], self._place,
                unsigned(indptr)[some.start : some.stop + 1], unsigned(indices), data,
                departs[some], leaving[some],
            )  # fmt: skip
        return sp.csr_array((data, indices, indptr), shape=(size, size)), departs, leaving

    @property
    def _arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The chain's arrays, as compiled sweeps of a large component read them."""
        return unsigned(self._chain.indptr), unsigned(self._chain.indices), self._chain.data

    def _right(self, rewards: FloatArray, x: FloatArray) -> FloatArray:
        """Rewards of the members and what lies beyond, on departing, [members, rewards]."""
        if not self._is_compiled:
            outside = np.where((self._place < 0)[:, None], x, 0.0)
            beyond = rewards[self._states] + self._chain[self._states] @ outside
            return np.asarray(beyond / self._departs[:, None])
        from ssp_lp.compiled.sweeps import from_beyond

        right = np.empty((len(self._states), rewards.shape[1]))
        run, states = from_beyond(self._own.nnz), unsigned(self._states)
        run(*self._arrays, states, self._place, self._departs, rewards, x, right)
        return right

    def _direct_solver(self) -> Solver:
        """The component reduced as a band where it is narrow, else its sparse factors."""
        exits = self._leaving / self._departs
        if self.direct_work <= _BAND_WORK:
            order, width = self._band
            if len(order) * width**2 <= _BAND_WORK:
                if self._is_compiled:
                    return band_solver(self._own, exits, order, width)
                return factor_solver(self._own, exits, order)
        return factor_solver(self._own, exits)
