"""Solvers of a chain's equations: iterated, reduced as a band, by factors, or densely.

A large strong component is iterated for as long as that takes less than solving it directly. Sweeps
are best where it is left soon; where they contract too slowly, BiCGStab takes a sweep as its
preconditioner. Either goes on until it has taken as much work as a direct solution would, as far as
that can be foreseen: so no choice costs more than about twice the best one. Solved directly, a
component that is narrow in some order is reduced state by state without subtractions; others take
sparse factors.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import ClassVar
from weakref import proxy

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular
from scipy.sparse import csgraph, linalg

from ssp_lp.arrays import (
    FloatArray,
    IntArray,
    offsets_of,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.errors import SolverError

HOLDS_MASS = "a policy's chain holds mass for ever: from some states it is never left"


Solver = Callable[[FloatArray], FloatArray]

_MOST_STATES = 200_000
"""States above which sparse factors may exceed memory."""

_BAND_WORK = 6e8
"""States times the square of the bandwidth: about a second of compiled reduction."""

_BANDED = 4.0  # times the work of sparse factors that are worth a reduction without subtractions
_MOST_BAND_WORK = 1e10  # the same where nothing else is precise enough
_TRIAL = 6  # sweeps over which the contraction is judged
_CONTRACTION = 0.7  # per sweep; slower components are left to other methods
_KRYLOV_STEPS = 400
_AT_ONCE = 10_000_000  # entries of steps between two looks at the time
_RESTARTS = 8
_SWEEPS_BETWEEN = 20  # where a Krylov run broke down
_LEAST_RESIDUAL = 1e-12
"""Relative residual of a Krylov method that is let pass: what is missed is corrected later."""

_LITTLE_WORK = 1e6
"""Multiplications of a direct solution that take as long as the calls around a Krylov method."""

_FACTOR_STATE, _FACTOR_BLOCK = 2_000.0, 0.1
"""Work of sparse factors, as measured: for each state, and for each multiplication of dense
separators, of which several run at once."""

_BLOCK = 32  # states that are taken out together
_DEAR = 200  # passes for a reward from which the others are left out until they are needed
_ENTRY = 2.0  # multiplications of a direct solution that take as long as an entry of a sweep


_ELIMINATION = "equations.eliminate_states", "equations.solve_eliminated"
_KRYLOV = "equations.bicgstab", "equations._square_in_sweep"


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
        self._place = np.full(matrix.shape[0], -1, dtype=np.int32)
        self._place[states] = np.arange(len(states), dtype=np.int32)
        self._own, self._departs, self._leaving = on_departing(matrix, exits, states, self._place)
        self._direct: Solver | None = None
        weak = proxy(self)  # in a ring of references large arrays would wait for its collection
        self._iteration = Iteration(self._own, lambda: weak.direct_work)

    @property
    def is_solved_reward_by_reward(self) -> bool:
        """Whether the component's Krylov solver took long for each reward by itself."""
        return self._iteration.dearest > _DEAR

    @cached_property
    @with_twin
    def direct_work(self) -> float:
        """Multiplications of a direct solver of the component, as a band or by sparse factors."""
        size = len(self._states)
        if not accelerated(self._own.nnz, "equations.work_of_levels"):
            return float(size) * self._band[1] ** 2
        from ssp_lp.compiled.equations import work_of_levels

        own = self._own
        width: int
        dissection: float
        width, dissection = work_of_levels(unsigned(own.indptr), unsigned(own.indices))
        factors = _FACTOR_STATE * size + _FACTOR_BLOCK * dissection
        return min(float(size) * width**2, factors if size <= _MOST_STATES else np.inf)

    @cached_property
    def _band(self) -> tuple[IntArray, int]:
        """An order in which the large component is a narrow band, and how wide."""
        order = csgraph.reverse_cuthill_mckee(self._own, symmetric_mode=False)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        entry = self._own.tocoo()
        return order, int(np.abs(place[entry.row] - place[entry.col]).max(initial=0))

    def solve(self, rewards: FloatArray, x: FloatArray, accuracy: float) -> int:
        """Solve a large component's equations, in place, given the totals of all it leads to.

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
        """Solve a large component's equations by reduction without any subtraction.

        Raises:
            SolverError: the component is not narrow enough, or numba is missing.
        """
        order, width = self._band
        is_compiled = accelerated(_MOST_BAND_WORK, *_ELIMINATION)  # numpy has no twin of it
        if not is_compiled or len(order) * width**2 > _MOST_BAND_WORK:
            hint = "" if is_compiled else "; numba reduces it: pip install '.[fast]'"
            raise SolverError(
                "a policy's totals could not be verified: its chain is left too seldom for double "
                f"precision{hint}"
            )
        exits, right = self._leaving / self._departs, self._right(rewards, x)
        x[self._states] = band_solver(self._own, exits, order, width)(right)

    @property
    def _arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The chain's arrays as the compiled solvers of a large component read them."""
        return unsigned(self._chain.indptr), unsigned(self._chain.indices), self._chain.data

    @with_twin
    def _right(self, rewards: FloatArray, x: FloatArray) -> FloatArray:
        """Right side for a component's solver, on departing, [members, rewards]."""
        if not accelerated(self._own.nnz, "equations.from_beyond"):
            outside = np.where((self._place < 0)[:, None], x, 0.0)
            beyond = rewards[self._states] + self._chain[self._states] @ outside
            return np.asarray(beyond / self._departs[:, None])
        from ssp_lp.compiled.equations import from_beyond

        right = np.empty((len(self._states), rewards.shape[1]))
        run, states = from_beyond(self._own.nnz), unsigned(self._states)
        run(*self._arrays, states, self._place, self._departs, rewards, x, right)
        return right

    @with_twin
    def _direct_solver(self) -> Solver:
        """Direct solver of the component: reduced as a band if narrow, else sparse factors."""
        exits = self._leaving / self._departs
        if self.direct_work <= _BAND_WORK:
            order, width = self._band
            if len(order) * width**2 <= min(_BAND_WORK, _BANDED * self.direct_work):
                if accelerated(len(order) * width**2, *_ELIMINATION):
                    return band_solver(self._own, exits, order, width)
                return factor_solver(self._own, exits, order)
        return factor_solver(self._own, exits)


class Iteration:
    """Equations ``y = right + own @ y`` whose iteration converges."""

    most_sweeps: ClassVar[int] = 300  # of one run of them

    def __init__(self, own: sp.csr_array, direct_work: Callable[[], float]) -> None:
        """Iterate the equations of a chain seen on departing only, or those of its visits.

        Args:
            own: in the order in which it is swept, without a diagonal, [members, members].
            direct_work: about the multiplications of a direct solution.
        """
        self.own, self._direct_work = own, direct_work
        self.products = 0  # passes over the matrix
        self.dearest = 1  # passes that one reward has taken: the next ones will take as many

    @property
    def _passes_left(self) -> int:
        """Passes that an iterative solver has left before a direct one would have been cheaper."""
        work = self._direct_work()
        most = work / (_ENTRY * max(self.own.nnz, 1)) if work > _LITTLE_WORK else 0.0
        return max(int(most) - self.products, 0)

    def solve(self, right: FloatArray, y: FloatArray, accuracy: float) -> bool:
        """Solve in place by the iterative solver that converges; false: a direct one takes less.

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
        expected = right.shape[1] * self.dearest
        return expected <= self._passes_left and self._by_krylov(right, y, accuracy)

    @cached_property
    def _own_arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The arrays of the matrix, as the iterative solver's compiled sweeps read them."""
        return unsigned(self.own.indptr), unsigned(self.own.indices), self.own.data

    @with_twin
    def sweep(self, right: FloatArray, y: FloatArray) -> tuple[float, float]:
        """One sweep of the iterative solver, in place: greatest change and greatest size.

        Args:
            right: [members, rewards].
            y: of the members, and of what else the rows lead to, which stays, [columns, rewards].
        """
        check_time()
        self.products += 1
        if accelerated(self.own.nnz, "equations.sweep"):
            from ssp_lp.compiled.equations import sweep

            swept: tuple[float, float] = sweep(*self._own_arrays, right, y)
            return swept
        own = y[: len(right)]
        ahead = right + self.own @ y
        change = float(np.abs(ahead - own).max(initial=0.0))
        own[:] = ahead
        return change, float(np.abs(ahead).max(initial=0.0))

    def greatest(self, *numbers: float) -> tuple[float, ...]:
        """The greatest of each number over all who share the iterative solver: here, itself."""
        return numbers

    def change_left(self, right: FloatArray, y: FloatArray, target: float) -> float:
        """Relative change of the last sweep of the iterative solver, while they contract well.

        Args:
            right: as :meth:`sweep` takes it.
            y: improved in place, likewise.
            target: a change that is small enough.

        Returns:
            Infinity where they contract slowly.

        Raises:
            SolverError: the totals overflow.
        """
        changes, relative = list[float](), np.inf
        (most,) = self.greatest(float(np.abs(right).max(initial=0.0)))
        while len(changes) <= self.most_sweeps:
            change, size = self.sweep(right, y)
            relative = change / (size + most) if size + most > 0 else 0.0
            if relative <= target:
                break
            if not np.isfinite(relative):
                raise SolverError("a policy's totals overflow")
            judged = len(changes) >= _TRIAL
            if judged and relative > _CONTRACTION**_TRIAL * changes[-_TRIAL]:
                return np.inf
            changes.append(relative)
        return relative

    def _swept(self, right: FloatArray, y: FloatArray, target: float) -> bool:
        """Sweeps of the iterative solver while they contract well; whether the target is met."""
        return self.change_left(right, y, target) <= target

    def _by_krylov(self, right: FloatArray, y: FloatArray, target: float) -> bool:
        """BiCGStab, the iterative solver for each reward; whether all met the target."""
        for j in range(right.shape[1]):
            before = self.products
            column, wanted = np.ascontiguousarray(y[:, j]), np.ascontiguousarray(right[:, j])
            reached = self._krylov(wanted, column, target)
            self.dearest = max(self.dearest, self.products - before)
            if not reached <= max(target, _LEAST_RESIDUAL):
                return False
            y[:, j] = column
        return True

    def _krylov(self, right: FloatArray, y: FloatArray, target: float) -> float:
        """BiCGStab on one reward, in place; the relative change of one more sweep."""
        kept, before = y.copy(), np.inf
        for attempt in range(_RESTARTS + 1):
            swept = y.copy()
            self.sweep(right[:, None], swept[:, None])
            residual = swept - y
            change = float(np.abs(residual).max())
            scale = float(np.abs(y).max()) + float(np.abs(right).max())
            relative = change / scale if scale > 0.0 else 0.0
            if not relative < before:  # it broke down: go on from before by sweeps
                y[:] = kept
                for _ in range(_SWEEPS_BETWEEN):
                    self.sweep(right[:, None], y[:, None])
                before = np.inf
                continue
            if relative <= target or attempt == _RESTARTS or self._passes_left == 0:
                return relative
            kept, before = y.copy(), relative
            y += change * self._step(residual / change, 0.3 * target * scale / change)
        return np.inf

    @with_twin
    def _step(self, residual: FloatArray, target: float) -> FloatArray:
        """Correction of the iterative solver BiCGStab to a residual of at most the target."""
        most = min(_KRYLOV_STEPS, self._passes_left // 2 + 1)
        if accelerated(most * self.own.nnz, *_KRYLOV):
            from ssp_lp.compiled.equations import bicgstab, start_bicgstab

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


def dense_solver(matrix: sp.csr_array, exits: FloatArray) -> Solver:
    """Solve the equations of a few states by dense LU with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].

    Raises:
        SolverError: some state is never left; also when solving, where that shows only then.
    """
    system = -matrix.toarray()
    np.fill_diagonal(system, 0.0)
    departs = exits - system.sum(axis=1)
    if (departs <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    np.fill_diagonal(system, departs)

    def solve(rewards: FloatArray) -> FloatArray:
        """Totals of these rewards, refined once."""
        try:
            x = np.linalg.solve(system, rewards)
            return np.asarray(x + np.linalg.solve(system, rewards - system @ x))
        except np.linalg.LinAlgError as error:
            raise SolverError(HOLDS_MASS) from error

    return solve


def factor_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None) -> Solver:
    """Solve the equations of a chain by sparse factors with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].
        order: states in the order to be kept; None: in one that fills in little.

    Raises:
        SolverError: there are too many states, or they are never left.
    """
    size = len(exits)
    if size > _MOST_STATES and order is None:
        raise SolverError(
            f"no method solves the equations of a policy on {size:,} states that hang together; a "
            "discount may help"
        )
    system = equations(matrix, exits, order)
    factors = factorised(system, in_order=order is not None)

    def solve(right: FloatArray) -> FloatArray:
        """The totals of a right side, refined once, like ``right``."""
        ordered = right if order is None else right[order]
        solution = factors.solve(ordered)
        solution = solution + factors.solve(ordered - system @ solution)
        return _solved_in_place(solution, order)

    return solve


def band_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray, width: int) -> Solver:
    """Solve the equations of a narrow chain, reduced state by state without subtractions.

    Compiled.

    Args:
        matrix: without self-loops, [states, states].
        exits: [states].
        order: states in the order in which the chain is narrow.
        width: greatest distance of two states that a move joins in that order.

    Raises:
        SolverError: the chain is never left.
    """
    from ssp_lp.compiled.equations import eliminate_states, solve_eliminated

    entry, size = matrix.tocoo(), len(exits)
    place = np.empty(size, dtype=np.int64)
    place[order] = np.arange(size)
    flat = np.zeros(size * (2 * width + 1))
    np.add.at(flat, place[entry.row] * 2 * width + width + place[entry.col], entry.data)
    band = flat, 2 * width, width, np.maximum(np.arange(size) - width, 0)
    if not eliminate_states(*band, exits[order], size):
        raise SolverError(HOLDS_MASS)

    def solve(right: FloatArray) -> FloatArray:
        """The totals of a right side, like ``right``."""
        ordered = right[order]
        solve_eliminated(*band, ordered, size)
        return _solved_in_place(ordered, order)

    return solve


def _solved_in_place(ordered: FloatArray, order: IntArray | None) -> FloatArray:
    """A solver's results in the order of the states, from that in which it worked."""
    if order is None:
        return np.asarray(ordered)
    result = np.empty_like(ordered)
    result[order] = ordered
    return result


@with_twin
def on_departing(
    chain: sp.csr_array, exits: FloatArray, states: IntArray, place: IntArray
) -> tuple[sp.csr_array, FloatArray, FloatArray]:
    """Rows of some states of a chain for a solver, seen on departing only.

    Args:
        chain: probabilities of going on, [states, columns].
        exits: of the whole chain, [states].
        states: whose rows they are, in the order in which they are swept, [members].
        place: where each column stands among those of the result, -1: it is left out, [columns];
            the members stand first, in their order.

    Returns:
        Moves by departing, [members, places]; the probability of departing, and what of it is left
        out, [members] each.

    Raises:
        SolverError: some state is never departed from.
    """
    size, width = len(states), int(place.max(initial=-1)) + 1
    if not accelerated(chain.nnz, "equations.gather_inside"):
        rows = chain[states]
        leaving = exits[states] + rows @ (place < 0).astype(np.float64)
        entry = rows.tocoo()
        kept = place[entry.col] >= 0
        parts = entry.data[kept], (entry.row[kept], place[entry.col[kept]])
        row, column, data, departs = departures(sp.csr_array(parts, shape=(size, width)), leaving)
        shared = sp.csr_array((data / departs[row], (row, column)), shape=(size, width))
        return shared, departs, leaving
    from ssp_lp.compiled.equations import gather_inside

    members, begin = unsigned(states), chain.indptr
    indptr = offsets_of(np.diff(begin)[states]).astype(np.int32)
    indices, data = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1])
    departs, leaving = np.empty(size), np.empty(size)
    for some in pieces(size, len(indices)):
        gather_inside(len(indices))(
            unsigned(begin), unsigned(chain.indices), chain.data, exits, members[some], place,
            unsigned(indptr)[some.start : some.stop + 1], unsigned(indices), data,
            departs[some], leaving[some],
        )  # fmt: skip
    return sp.csr_array((data, indices, indptr), shape=(size, width)), departs, leaving


def departures(
    matrix: sp.csr_array, exits: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Moves of a chain to other states, and the probability of departing, summed, never 1 - p.

    Args:
        matrix: [states, columns], of which the states come first.
        exits: [states].

    Returns:
        From where, where to, and how likely, [moves] each; and [states].

    Raises:
        SolverError: some state is never departed from.
    """
    entry = matrix.tocoo()
    away = (entry.row != entry.col) & (entry.data > 0.0)
    row, column, data = entry.row[away], entry.col[away], entry.data[away]
    departs = exits + np.bincount(row, weights=data, minlength=len(exits))
    if (departs <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    return row, column, data, departs


def equations(
    matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None
) -> sp.csc_array:
    """Matrix of a direct solver: ``I - chain``, its diagonal summed from what departs.

    Args:
        matrix: [states, states].
        exits: [states].
        order: states in the order of the rows and columns; None: as they are.

    Raises:
        SolverError: some state is never departed from.
    """
    n, (row, column, data, departs) = len(exits), departures(matrix, exits)
    place = np.arange(n)
    if order is not None:
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
    row, column = place[row], place[column]
    return sp.csc_array(
        (
            np.concatenate([departs, -data]),
            (np.concatenate([place, row]), np.concatenate([place, column])),
        ),
        shape=(n, n),
    )


def factorised(system: sp.csc_array, *, in_order: bool = False) -> linalg.SuperLU:
    """Sparse factors for a direct solver; in the given order where that is topological.

    Raises:
        SolverError: the matrix is singular.
    """
    order = "NATURAL" if in_order else "MMD_AT_PLUS_A"
    try:
        factors: linalg.SuperLU = linalg.splu(
            system,  # type: ignore[call-overload]
            permc_spec=order,
            diag_pivot_thresh=0.0,  # diagonally dominant by rows: no pivot is needed
            options={"SymmetricMode": not in_order},  # fill in as the order foresees
        )
        return factors
    except RuntimeError as error:
        raise SolverError(HOLDS_MASS) from error


def reduction_solver(inner: FloatArray, leaving: FloatArray) -> Solver:
    """Direct solver by state reduction: totals with relative accuracy in every entry.

    Grassmann, Taksar and Heyman (1985): a state is taken out by sending what would enter it to
    where it goes next; the probability of departing is summed, never formed as 1 - p. States are
    taken out in blocks, whose effect on all others is one product of matrices.

    Args:
        inner: probabilities among the states, [states, states]; overwritten.
        leaving: probabilities of leaving for good, [states]; overwritten.

    Raises:
        SolverError: some states are never left.
    """
    departs = np.empty_like(leaving)
    for end in range(len(leaving), 0, -_BLOCK):
        begin = max(end - _BLOCK, 0)
        for i in range(end - 1, begin - 1, -1):
            departs[i] = leaving[i] + inner[i, :i].sum()
            if departs[i] <= 0.0:
                raise SolverError(HOLDS_MASS)
            inner[i, :i] /= departs[i]
            leaving[i] /= departs[i]
            weight = inner[begin:i, i]
            inner[begin:i, :i] += np.outer(weight, inner[i, :i])
            leaving[begin:i] += weight * leaving[i]
            inner[:begin, begin:i] += np.outer(inner[:begin, i], inner[i, begin:i])
        into = inner[:begin, begin:end]
        inner[:begin, :begin] += into @ inner[begin:end, :begin]
        leaving[:begin] += into @ leaving[begin:end]
    factors = np.negative(inner, out=inner)
    np.fill_diagonal(factors, departs)

    def solve(rewards: FloatArray) -> FloatArray:
        """Totals of these rewards: entries below 0 off the diagonal add, and nothing cancels."""
        entered = solve_triangular(factors, rewards)
        return np.asarray(solve_triangular(factors, entered, lower=True, unit_diagonal=True))

    return solve
