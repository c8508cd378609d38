"""Equations ``y = right + own @ y``, iterated for as long as that takes less than solving directly.

Sweeps are best where a chain is left soon; where they contract too slowly, BiCGStab takes a sweep
as its preconditioner. Either goes on until it has taken as much work as a direct solution would, as
far as that can be foreseen: so no choice costs more than about twice the best one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray, unsigned
from ssp_lp.compiled.deadline import check_time
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

_LITTLE_WORK = 1e6
"""Multiplications of a direct solution that take as long as the calls around a Krylov method."""

_ENTRY = 2.0  # multiplications of a direct solution that take as long as an entry of a sweep


class Iteration:
    """Equations ``y = right + own @ y`` whose iteration converges."""

    def __init__(
        self, own: sp.csr_array, direct_work: Callable[[], float], *, is_compiled: bool
    ) -> None:
        """Iterate the equations of a chain seen on departing only, or those of its visits.

        Args:
            own: in the order in which it is swept, without a diagonal, [members, members].
            direct_work: about the multiplications of a direct solution.
            is_compiled: run compiled loops.
        """
        self.own, self._is_compiled, self._direct_work = own, is_compiled, direct_work
        self.products = 0  # passes over the matrix

    @property
    def _passes_left(self) -> int:
        """How many more passes take less, with those before, than a direct solution."""
        work = self._direct_work()
        most = work / (_ENTRY * max(self.own.nnz, 1)) if work > _LITTLE_WORK else 0.0
        return max(int(most) - self.products, 0)

    def solve(self, right: FloatArray, y: FloatArray, accuracy: float) -> bool:
        """Solve in place by what converges; false where a direct solution takes less.

        Args:
            right: [members, rewards].
            y: a guess, [members, rewards].
            accuracy: relative residual.

        Raises:
            SolverError: the totals overflow.
        """
        if self._swept(right, y, accuracy):
            return True
        missed = right + self.own @ y - y
        poor = np.greater(*(np.abs(x.T, order="C").max(axis=1) for x in (missed, right)))
        if poor.any():  # the guess misses by more than 0 does
            y[:, poor] = 0.0
            if self._swept(right, y, accuracy):
                return True
        return self._passes_left > 0 and self._by_krylov(right, y, accuracy)

    @cached_property
    def _own_arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The arrays of the matrix, as compiled sweeps read them."""
        return unsigned(self.own.indptr), unsigned(self.own.indices), self.own.data

    def _sweep(self, right: FloatArray, y: FloatArray) -> tuple[float, float]:
        """One sweep in place: the greatest change and the greatest size."""
        check_time()
        self.products += 1
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
            if relative <= target or attempt == _RESTARTS or self._passes_left == 0:
                return relative
            kept, before = y.copy(), relative
            y += change * self._step(residual / change, 0.3 * target * scale / change)
        return np.inf

    def _step(self, residual: FloatArray, target: float) -> FloatArray:
        """What BiCGStab adds until the residual is at most the target, [members]."""
        most = min(_KRYLOV_STEPS, self._passes_left // 2 + 1)
        if self._is_compiled:
            from ssp_lp.compiled.sweeps import bicgstab, start_bicgstab

            step, state = np.zeros_like(residual), start_bicgstab(residual)
            at_once = max(_AT_ONCE // max(self.own.nnz, 1), 1)
            for begin in range(0, most, at_once):
                check_time()
                steps = min(at_once, most - begin)
                taken, ended = bicgstab(*self._own_arrays, residual, target, steps, step, *state)
                self.products += taken
                if ended:
                    break
            return step

        def missed(y: FloatArray) -> FloatArray:
            """By how much y exceeds what the component's own steps make of it."""
            self.products += 1
            return np.asarray(y - self.own @ y)

        system = linalg.LinearOperator(self.own.shape, matvec=missed, dtype=np.float64)
        with np.errstate(all="ignore"):  # a breakdown shows in the residual
            return np.asarray(
                linalg.bicgstab(system, residual, rtol=0.0, atol=target, maxiter=most)[0]
            )
