"""One large strong component of a chain: by sweeps, as a band, by a Krylov method, or by factors.

Which of them is seen from how sweeps converge: where the component is left soon they are best.
Where they are slow, a component that is narrow in some order is reduced state by state without
subtractions; others take BiCGStab with a sweep as its preconditioner, and, where that fails, sparse
factors.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph, linalg

from ssp_lp.arrays import FloatArray, IntArray, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.dynamic_programming.linear_systems.direct_solvers import (
    Solver,
    band_solver,
    factor_solver,
)
from ssp_lp.errors import SolverError

_TRIAL = 6  # sweeps over which the contraction is judged
_CONTRACTION = 0.7  # per sweep; slower components are left to other methods
_SWEEPS = 300

_KRYLOV_STEPS = 400
_AT_ONCE = 10_000_000  # entries of steps between two looks at the time
_RESTARTS = 8
_SWEEPS_BETWEEN = 20  # where a Krylov run broke down
_LEAST_RESIDUAL = 1e-12
"""Relative residual of a Krylov method that is let pass: what is missed is corrected later."""

_BAND_WORK = 6e8
"""States times the square of the bandwidth: about a second of compiled reduction."""

_QUICKLY_FACTORED = 2_500
"""States up to which sparse factors cost less than a Krylov method."""


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
        self.own, self._departs, self._leaving = self._gathered(exits)
        self._direct: Solver | None = None
        self._products = 0

    def take_products(self) -> int:
        """Passes over the matrix since this was last asked."""
        taken, self._products = self._products, 0
        return taken

    def solve(self, rewards: FloatArray, x: FloatArray, accuracy: float) -> None:
        """Solve for the members in place, given the totals of all that they lead to.

        Args:
            rewards: of the whole chain, [states, rewards].
            x: of the whole chain, [states, rewards]; members hold a guess.
            accuracy: relative residual.

        Raises:
            SolverError: no method gets anywhere.
        """
        right = self._right(rewards, x)
        if self._direct is None:
            y = x[self._states]
            if self._iterated(right, y, accuracy):
                x[self._states] = y
                return
            self._direct = factor_solver(self.own, self._leaving / self._departs)
        x[self._states] = self._direct(right)
        self._products += 1

    def _iterated(self, right: FloatArray, y: FloatArray, accuracy: float) -> bool:
        """Solve in place by what converges; false where factors are called for."""
        if self._swept(right, y, accuracy):
            return True
        poor = np.abs(right + self.own @ y - y).max(axis=0) > np.abs(right).max(axis=0)
        if poor.any():  # the guess misses by more than 0 does
            y[:, poor] = 0.0
            if self._swept(right, y, accuracy):
                return True
        self._direct = self._narrow()
        if self._direct is not None:
            y[:] = self._direct(right)
            return True
        return len(right) > _QUICKLY_FACTORED and self._by_krylov(right, y, accuracy)

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
        from ssp_lp.compiled import sweeps as compiled

        arrays, members = self._arrays, unsigned(states)
        counts = np.empty(size, dtype=np.int64)
        compiled.count_inside(*arrays, members, self._place, counts)
        indptr = np.append(0, np.cumsum(counts)).astype(np.int32)
        indices, data = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1])
        departs, leaving = np.empty(size), np.empty(size)
        for some in pieces(size, len(indices)):
            compiled.gather_inside(
                *arrays, exits, members[some], self._place,
                unsigned(indptr)[some.start : some.stop + 1], unsigned(indices), data,
                departs[some], leaving[some],
            )  # fmt: skip
        return sp.csr_array((data, indices, indptr), shape=(size, size)), departs, leaving

    @property
    def _arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The chain's arrays, as compiled sweeps of a large component read them."""
        return unsigned(self._chain.indptr), unsigned(self._chain.indices), self._chain.data

    @cached_property
    def _own_arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The arrays of moves among members of the large component."""
        return unsigned(self.own.indptr), unsigned(self.own.indices), self.own.data

    def _right(self, rewards: FloatArray, x: FloatArray) -> FloatArray:
        """Rewards of the members and what lies beyond, on departing, [members, rewards]."""
        if not self._is_compiled:
            outside = np.where((self._place < 0)[:, None], x, 0.0)
            beyond = rewards[self._states] + self._chain[self._states] @ outside
            return np.asarray(beyond / self._departs[:, None])
        from ssp_lp.compiled.sweeps import from_beyond

        right = np.empty((len(self._states), rewards.shape[1]))
        states = unsigned(self._states)
        from_beyond(*self._arrays, states, self._place, self._departs, rewards, x, right)
        return right

    def _sweep(self, right: FloatArray, y: FloatArray) -> tuple[float, float]:
        """One sweep in place: the greatest change and the greatest size."""
        check_time()
        self._products += 1
        if self._is_compiled:
            from ssp_lp.compiled.sweeps import sweep

            return sweep(*self._own_arrays, right, y)
        ahead = right + self.own @ y
        change = float(np.abs(ahead - y).max())
        y[:] = ahead
        return change, float(np.abs(ahead).max())

    def _swept(self, right: FloatArray, y: FloatArray, target: float) -> bool:
        """Sweep while it contracts well; whether that reached the target."""
        changes: list[float] = []
        most = float(np.abs(right).max())
        while len(changes) <= _SWEEPS:
            change, size = self._sweep(right, y)
            relative = change / (size + most) if size + most > 0 else 0.0
            if relative <= target:
                return True
            if not np.isfinite(relative):
                raise SolverError("a policy's totals overflow")
            judged = len(changes) >= _TRIAL
            if judged and relative > _CONTRACTION**_TRIAL * changes[-_TRIAL]:
                return False
            changes.append(relative)
        return False

    def _by_krylov(self, right: FloatArray, y: FloatArray, target: float) -> bool:
        """BiCGStab on each reward; whether all reached the target, or what must do."""
        for j in range(right.shape[1]):
            column, wanted = np.ascontiguousarray(y[:, j]), np.ascontiguousarray(right[:, j])
            reached = self._krylov(wanted, column, target)
            if not reached <= max(target, _LEAST_RESIDUAL):
                return False
            y[:, j] = column
        return True

    def _krylov(self, right: FloatArray, y: FloatArray, target: float) -> float:
        """The same for one reward, in place; the relative change of one more sweep."""
        kept, before = y.copy(), np.inf
        for attempt in range(_RESTARTS + 1):
            swept = y.copy()
            self._sweep(right[:, None], swept[:, None])
            residual = swept - y
            change = float(np.abs(residual).max())
            scale = float(np.abs(y).max()) + float(np.abs(right).max())
            relative = change / scale if scale > 0.0 else 0.0
            if not relative < before:  # it broke down: go on from before by sweeps
                y[:] = kept
                for _ in range(_SWEEPS_BETWEEN):
                    self._sweep(right[:, None], y[:, None])
                before = np.inf
                continue
            if relative <= target or attempt == _RESTARTS:
                return relative
            kept, before = y.copy(), relative
            y += change * self._step(residual / change, 0.3 * target * scale / change)
        return np.inf

    def _step(self, residual: FloatArray, target: float) -> FloatArray:
        """What BiCGStab adds until the residual is at most the target, [members]."""
        if self._is_compiled:
            from ssp_lp.compiled.sweeps import bicgstab, start_bicgstab

            step, state, most = np.zeros_like(residual), start_bicgstab(residual), _KRYLOV_STEPS
            at_once = max(_AT_ONCE // max(self.own.nnz, 1), 1)
            for begin in range(0, most, at_once):
                check_time()
                steps = min(at_once, most - begin)
                taken, ended = bicgstab(*self._own_arrays, residual, target, steps, step, *state)
                self._products += taken
                if ended:
                    break
            return step

        def missed(y: FloatArray) -> FloatArray:
            """By how much y exceeds what the component's own steps make of it."""
            self._products += 1
            return np.asarray(y - self.own @ y)

        system = linalg.LinearOperator(self.own.shape, matvec=missed, dtype=np.float64)
        with np.errstate(all="ignore"):  # a breakdown shows in the residual
            return np.asarray(
                linalg.bicgstab(system, residual, rtol=0.0, atol=target, maxiter=_KRYLOV_STEPS)[0]
            )

    def _narrow(self) -> Solver | None:
        """The component in an order in which it is narrow, if there is one."""
        size = len(self._states)
        widest = int((_BAND_WORK / size) ** 0.5)
        if self._is_compiled:
            from ssp_lp.compiled.sweeps import widest_level

            if widest_level(*self._own_arrays[:2], widest) > widest:
                return None
        order = csgraph.reverse_cuthill_mckee(self.own, symmetric_mode=False)
        place = np.empty(size, dtype=np.int64)
        place[order] = np.arange(size)
        entry = self.own.tocoo()
        width = int(np.abs(place[entry.row] - place[entry.col]).max(initial=0))
        if width > widest:
            return None
        exits = self._leaving / self._departs
        if self._is_compiled:
            return band_solver(self.own, exits, order, width)
        return factor_solver(self.own, exits, order)
