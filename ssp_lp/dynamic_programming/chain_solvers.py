"""Solvers of a chain's equations: iteration, reduction of a band, sparse factors, or dense LU.

A large strong component is solved iteratively as long as that takes less work than a direct
solution. Gauss-Seidel sweeps are best if runs leave the component soon. If they converge too
slowly, BiCGStab follows, with a sweep as its preconditioner. Both stop after the estimated work of
a direct solution, so that the total is at most about twice the work of the better choice.

The direct solution depends on the component. If its matrix is a narrow band in some order of the
states, the states are eliminated one by one without subtractions (state reduction). Otherwise
sparse LU factors are computed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from weakref import proxy

import numpy as np
import scipy
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray, offsets_of, unsigned
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.errors import SolverError

HOLDS_MASS = "a policy stays in the process for ever from some states"


Solver = Callable[[FloatArray], FloatArray]

_MOST_STATES = 200_000
"""Most states of a chain for sparse factors: those of a larger chain may exceed the memory."""

_BAND_WORK = 6e8
"""Number of states times the squared bandwidth: about a second of compiled reduction."""

_BANDED = 4.0  # most work of a reduction, in multiples of the work of sparse factors
_MOST_BAND_WORK = 1e10  # most work of a reduction if no other method is precise enough
_MOST_SWEEPS = 300  # most sweeps of one run
_TRIAL = 6  # sweeps over which the contraction is measured
_CONTRACTION = 0.7  # greatest factor per sweep; slower components use other methods
_KRYLOV_STEPS = 400
_AT_ONCE = 10_000_000  # entries of steps between two checks of the time
_RESTARTS = 8
_SWEEPS_BETWEEN = 20  # sweeps after a breakdown of a Krylov run
_LEAST_RESIDUAL = 1e-12
"""Relative residual at which BiCGStab's result is accepted: later corrections reduce it."""

_LITTLE_WORK = 1e6
"""Multiplications of a direct solution that take as long as the calls around a Krylov method."""

_FACTOR_STATE, _FACTOR_BLOCK = 2_000.0, 0.1
"""Work of sparse factors, as measured: for each state, and for each multiplication of dense
separators, of which several run at once."""

_BLOCK = 32  # states that are eliminated together
_DEAR = 200  # passes for one reward above which the others are computed only when needed
_ENTRY = 2.0  # multiplications of a direct solution that take as long as an entry of a sweep


_ELIMINATION = "equations.eliminate_states", "equations.solve_eliminated"
_KRYLOV = "equations.bicgstab", "equations._square_in_sweep"


class LargeComponent:
    """Equations ``y = rhs + own @ y`` of one component.

    Each equation is divided by the probability of departing from its state, so that ``own`` has no
    self-loops.
    """

    def __init__(self, matrix: sp.csr_array, exits: FloatArray, states: IntArray) -> None:
        """Extract the component from its chain.

        Args:
            matrix: transitions of the whole chain, [states, states].
            exits: exits of the whole chain, [states].
            states: the members, in the order in which they are swept.
        """
        self._chain, self._states = matrix, states
        self._place = np.full(matrix.shape[0], -1, dtype=np.int32)
        self._place[states] = np.arange(len(states), dtype=np.int32)
        self._own, self._departs, self._leaving = on_departing(matrix, exits, states, self._place)
        self._direct: Solver | None = None
        weak = proxy(self)  # a reference cycle would keep large arrays until garbage collection
        self._iteration = Iteration(self._own, lambda: weak.direct_work)

    @property
    def is_solved_reward_by_reward(self) -> bool:
        """Whether BiCGStab took many passes for a single reward."""
        return self._iteration.dearest > _DEAR

    @cached_property
    @with_twin
    def direct_work(self) -> float:
        """Multiplications of a direct solution, as a band or by sparse factors."""
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
        """Order of the states in which the matrix is a narrow band, and the bandwidth."""
        order = sp.csgraph.reverse_cuthill_mckee(self._own, symmetric_mode=False)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        entry = self._own.tocoo()
        return order, int(np.abs(place[entry.row] - place[entry.col]).max(initial=0))

    def solve(self, rewards: FloatArray, x: FloatArray, accuracy: float) -> int:
        """Solve the component's equations in place, given the totals of its successors.

        Args:
            rewards: rewards of the whole chain, [states, rewards].
            x: totals of the whole chain, [states, rewards]; a guess for the members.
            accuracy: relative residual.

        Returns:
            The number of passes over the component's matrix.

        Raises:
            SolverError: no method converges.
        """
        rhs, y, before = self._rhs(rewards, x), x[self._states], self._iteration.products
        if self._direct is None and not self._iteration.solve(rhs, y, accuracy):
            self._direct = self._direct_solver()
        x[self._states] = y if self._direct is None else self._direct(rhs)
        return max(self._iteration.products - before, 1)

    def reduce(self, rewards: FloatArray, x: FloatArray) -> None:
        """Solve the equations in place by state reduction, without any subtraction.

        Args:
            rewards: rewards of the whole chain, [states, rewards].
            x: totals of the whole chain; written for the members, [states, rewards].

        Raises:
            SolverError: the component is not narrow enough, or numba is missing.
        """
        order, width = self._band
        is_compiled = accelerated(_MOST_BAND_WORK, *_ELIMINATION)  # there is no numpy twin
        if not is_compiled or len(order) * width**2 > _MOST_BAND_WORK:
            hint = "try a discount" if is_compiled else "install numba, pip install '.[fast]'"
            raise SolverError(
                "a policy leaves the process too rarely to compute its totals in double "
                f"precision: {hint}"
            )
        exits, rhs = self._leaving / self._departs, self._rhs(rewards, x)
        x[self._states] = band_solver(self._own, exits, order, width)(rhs)

    @property
    def _arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The chain's arrays in the types of compiled loops."""
        return unsigned(self._chain.indptr), unsigned(self._chain.indices), self._chain.data

    @with_twin
    def _rhs(self, rewards: FloatArray, x: FloatArray) -> FloatArray:
        """Compute the right side from rewards and totals outside the component.

        [members, rewards]; divided by the probabilities of departing.
        """
        if not accelerated(self._own.nnz, "equations.gather_outside"):
            outside = np.where((self._place < 0)[:, None], x, 0.0)
            beyond = rewards[self._states] + self._chain[self._states] @ outside
            return np.asarray(beyond / self._departs[:, None])
        from ssp_lp.compiled.equations import gather_outside

        rhs = np.empty((len(self._states), rewards.shape[1]))
        run, states = gather_outside(self._own.nnz), unsigned(self._states)
        run(*self._arrays, states, self._place, self._departs, rewards, x, rhs)
        return rhs

    @with_twin
    def _direct_solver(self) -> Solver:
        """Build the direct solver: reduction of a band if narrow, otherwise sparse factors."""
        exits = self._leaving / self._departs
        if self.direct_work <= _BAND_WORK:
            order, width = self._band
            if len(order) * width**2 <= min(_BAND_WORK, _BANDED * self.direct_work):
                if accelerated(len(order) * width**2, *_ELIMINATION):
                    return band_solver(self._own, exits, order, width)
                return factor_solver(self._own, exits, order)
        return factor_solver(self._own, exits)


class Iteration:
    """An iterative solution of equations ``y = rhs + own @ y``."""

    def __init__(self, own: sp.csr_array, direct_work: Callable[[], float]) -> None:
        """Set up the iteration for a chain's totals, or for the visits of its states.

        Args:
            own: the matrix in the order of sweeps, without a diagonal, [members, members].
            direct_work: returns the approximate multiplications of a direct solution.
        """
        self.own, self._direct_work = own, direct_work
        self.products = 0  # passes over the matrix
        self.dearest = 1  # most passes that one reward has taken, an estimate for the next ones

    @property
    def _passes_left(self) -> int:
        """Number of passes left until a direct solution would have been cheaper."""
        work = self._direct_work()
        most = work / (_ENTRY * max(self.own.nnz, 1)) if work > _LITTLE_WORK else 0.0
        return max(int(most) - self.products, 0)

    def solve(self, rhs: FloatArray, y: FloatArray, accuracy: float) -> bool:
        """Solve in place by sweeps or BiCGStab; return false if a direct solution is faster.

        Args:
            rhs: [members, rewards].
            y: a guess, [members, rewards].
            accuracy: relative residual.

        Raises:
            SolverError: the totals overflow.
        """
        if self._swept(rhs, y, accuracy):
            return True
        missed = rhs + self.own @ y - y
        poor = np.greater(*(np.abs(x.T, order="C").max(axis=1) for x in (missed, rhs)))
        if poor.any():  # the residual of 0 is smaller than the guess's
            y[:, poor] = 0.0
            if self._swept(rhs, y, accuracy):
                return True
        expected = rhs.shape[1] * self.dearest
        return expected <= self._passes_left and self._by_krylov(rhs, y, accuracy)

    @cached_property
    def _own_arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The matrix's arrays in the types of compiled loops."""
        return unsigned(self.own.indptr), unsigned(self.own.indices), self.own.data

    @with_twin
    def sweep(self, rhs: FloatArray, y: FloatArray) -> tuple[float, float]:
        """Sweep once, in place; return the greatest change and the greatest absolute value.

        Args:
            rhs: [members, rewards].
            y: [members, rewards].
        """
        check_time()
        self.products += 1
        if accelerated(self.own.nnz, "equations.sweep"):
            from ssp_lp.compiled.equations import sweep

            swept: tuple[float, float] = sweep(*self._own_arrays, rhs, y)
            return swept
        ahead = rhs + self.own @ y
        change = float(np.abs(ahead - y).max(initial=0.0))
        y[:] = ahead
        return change, float(np.abs(ahead).max(initial=0.0))

    def _swept(self, rhs: FloatArray, y: FloatArray, target: float) -> bool:
        """Sweep in place while the changes shrink fast; return whether the target is met.

        Args:
            rhs: [members, rewards].
            y: [members, rewards].
            target: a relative change that is small enough.

        Raises:
            SolverError: the totals overflow.
        """
        changes, most = list[float](), float(np.abs(rhs).max(initial=0.0))
        while len(changes) <= _MOST_SWEEPS:
            change, size = self.sweep(rhs, y)
            relative = change / (size + most) if size + most > 0 else 0.0
            if relative <= target:
                return True
            if not np.isfinite(relative):
                raise SolverError("the totals of a policy overflow: scale the costs down")
            judged = len(changes) >= _TRIAL
            if judged and relative > _CONTRACTION**_TRIAL * changes[-_TRIAL]:
                return False
            changes.append(relative)
        return False

    def _by_krylov(self, rhs: FloatArray, y: FloatArray, target: float) -> bool:
        """Solve for each reward by BiCGStab, in place; return whether all met the target."""
        for j in range(rhs.shape[1]):
            before = self.products
            column, wanted = np.ascontiguousarray(y[:, j]), np.ascontiguousarray(rhs[:, j])
            reached = self._krylov(wanted, column, target)
            self.dearest = max(self.dearest, self.products - before)
            if not reached <= max(target, _LEAST_RESIDUAL):
                return False
            y[:, j] = column
        return True

    def _krylov(self, rhs: FloatArray, y: FloatArray, target: float) -> float:
        """Solve for one reward by BiCGStab, in place.

        Returns:
            The relative change that one more sweep would make.
        """
        kept, before = y.copy(), np.inf
        for attempt in range(_RESTARTS + 1):
            swept = y.copy()
            self.sweep(rhs[:, None], swept[:, None])
            residual = swept - y
            change = float(np.abs(residual).max())
            scale = float(np.abs(y).max()) + float(np.abs(rhs).max())
            relative = change / scale if scale > 0.0 else 0.0
            if not relative < before:  # it broke down: sweep from the last iterate
                y[:] = kept
                for _ in range(_SWEEPS_BETWEEN):
                    self.sweep(rhs[:, None], y[:, None])
                before = np.inf
                continue
            if relative <= target or attempt == _RESTARTS or self._passes_left == 0:
                return relative
            kept, before = y.copy(), relative
            y += change * self._step(residual / change, 0.3 * target * scale / change)
        return np.inf

    @with_twin
    def _step(self, residual: FloatArray, target: float) -> FloatArray:
        """Return a correction by BiCGStab that reduces the residual to at most ``target``."""
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
            self.products += 1
            return np.asarray(y - self.own @ y)

        system = sp.linalg.LinearOperator(self.own.shape, matvec=missed, dtype=np.float64)
        with np.errstate(all="ignore"):  # a breakdown shows in the residual
            return np.asarray(
                sp.linalg.bicgstab(system, residual, rtol=0.0, atol=target, maxiter=most)[0]
            )


def dense_solver(matrix: sp.csr_array, exits: FloatArray) -> Solver:
    """Build a solver for few states, by dense LU factors with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].

    Raises:
        SolverError: some state is never left; the solver may raise it as well.
    """
    system = -matrix.toarray()
    np.fill_diagonal(system, 0.0)
    escape = exits - system.sum(axis=1)
    if (escape <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    np.fill_diagonal(system, escape)

    def solve(rewards: FloatArray) -> FloatArray:
        """Return the totals of rewards, refined once."""
        try:
            x = np.linalg.solve(system, rewards)
            return np.asarray(x + np.linalg.solve(system, rewards - system @ x))
        except np.linalg.LinAlgError as error:
            raise SolverError(HOLDS_MASS) from error

    return solve


def factor_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None) -> Solver:
    """Build a solver by sparse LU factors with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].
        order: order of the states; None: one with little fill-in.

    Raises:
        SolverError: there are too many states, or some are never left.
    """
    size = len(exits)
    if size > _MOST_STATES and order is None:
        raise SolverError(
            f"{size:,} states that reach each other under a policy are too many for a direct "
            "solver: try a discount"
        )
    system = equations(matrix, exits, order)
    factors = factorised(system, in_order=order is not None)

    def solve(rhs: FloatArray) -> FloatArray:
        """Return the totals for a right side, in the shape of ``rhs``, refined once."""
        ordered = rhs if order is None else rhs[order]
        solution = factors.solve(ordered)
        solution = solution + factors.solve(ordered - system @ solution)
        return _solved_in_place(solution, order)

    return solve


def band_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray, width: int) -> Solver:
    """Build a solver by compiled state reduction, without subtractions, for a narrow band.

    Args:
        matrix: without self-loops, [states, states].
        exits: [states].
        order: order of the states in which the matrix is a narrow band.
        width: greatest distance of a state and its successor in that order.

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

    def solve(rhs: FloatArray) -> FloatArray:
        """Return the totals for a right side, in the shape of ``rhs``."""
        ordered = rhs[order]
        solve_eliminated(*band, ordered, size)
        return _solved_in_place(ordered, order)

    return solve


def _solved_in_place(ordered: FloatArray, order: IntArray | None) -> FloatArray:
    """Reorder results from the solver's order of the states to the original one."""
    if order is None:
        return np.asarray(ordered)
    result = np.empty_like(ordered)
    result[order] = ordered
    return result


@with_twin
def on_departing(
    chain: sp.csr_array, exits: FloatArray, states: IntArray, position: IntArray
) -> tuple[sp.csr_array, FloatArray, FloatArray]:
    """Return a component's moves, divided by the probability of departing from the state.

    Args:
        chain: transitions of the whole chain, [states, states].
        exits: exits of the whole chain, [states].
        states: the members, in the order in which they are swept, [members].
        position: position of each state among the members; -1 elsewhere, [states].

    Returns:
        The divided moves, without self-loops, [members, members]; the probability of departing,
        and the probability of leaving the component at once, [members] each.

    Raises:
        SolverError: some state is never departed from.
    """
    size = len(states)
    if not accelerated(chain.nnz, "equations.gather_inside"):
        rows = chain[states]
        leaving = exits[states] + rows @ (position < 0).astype(np.float64)
        entry = rows.tocoo()
        kept = position[entry.col] >= 0
        parts = entry.data[kept], (entry.row[kept], position[entry.col[kept]])
        row, column, data, escape = departures(sp.csr_array(parts, shape=(size, size)), leaving)
        shared = sp.csr_array((data / escape[row], (row, column)), shape=(size, size))
        return shared, escape, leaving
    from ssp_lp.compiled.equations import gather_inside

    members, begin = unsigned(states), chain.indptr
    indptr = offsets_of(np.diff(begin)[states]).astype(np.int32)
    indices, data = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1])
    escape, leaving = np.empty(size), np.empty(size)
    for some in pieces(size, len(indices)):
        gather_inside(len(indices))(
            unsigned(begin), unsigned(chain.indices), chain.data, exits, members[some], position,
            unsigned(indptr)[some.start : some.stop + 1], unsigned(indices), data,
            escape[some], leaving[some],
        )  # fmt: skip
    return sp.csr_array((data, indices, indptr), shape=(size, size)), escape, leaving


def departures(
    matrix: sp.csr_array, exits: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return a chain's moves to other states, and the probability of departing from each state.

    The probability of departing is a sum of moves and exit, since 1 - p would lose digits.

    Args:
        matrix: transitions; the first columns are the states, [states, columns].
        exits: [states].

    Returns:
        Rows, columns and probabilities of the moves, [moves] each; departures, [states].

    Raises:
        SolverError: some state is never departed from.
    """
    entry = matrix.tocoo()
    away = (entry.row != entry.col) & (entry.data > 0.0)
    row, column, data = entry.row[away], entry.col[away], entry.data[away]
    escape = exits + np.bincount(row, weights=data, minlength=len(exits))
    if (escape <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    return row, column, data, escape


def equations(
    matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None
) -> sp.csc_array:
    """Build the matrix ``I - chain``, whose diagonal is the probability of departing.

    Args:
        matrix: [states, states].
        exits: [states].
        order: states in the order of the rows and columns; None: as they are.

    Raises:
        SolverError: some state is never departed from.
    """
    n, (row, column, data, escape) = len(exits), departures(matrix, exits)
    place = np.arange(n)
    if order is not None:
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
    row, column = place[row], place[column]
    return sp.csc_array(
        (
            np.concatenate([escape, -data]),
            (np.concatenate([place, row]), np.concatenate([place, column])),
        ),
        shape=(n, n),
    )


def factorised(system: sp.csc_array, *, in_order: bool = False) -> sp.linalg.SuperLU:
    """Compute sparse LU factors.

    Args:
        system: the matrix.
        in_order: whether to keep its order of states, which must be topological.

    Raises:
        SolverError: the matrix is singular.
    """
    order = "NATURAL" if in_order else "MMD_AT_PLUS_A"
    try:
        factors: sp.linalg.SuperLU = sp.linalg.splu(
            system,  # type: ignore[call-overload]
            permc_spec=order,
            diag_pivot_thresh=0.0,  # diagonally dominant by rows: no pivoting
            options={"SymmetricMode": not in_order},  # fill-in as the order predicts
        )
        return factors
    except RuntimeError as error:
        raise SolverError(HOLDS_MASS) from error


def reduction_solver(dense: FloatArray, outflow: FloatArray) -> Solver:
    """Build a direct solver by state reduction, with a small relative error in every entry.

    A state is eliminated by redirecting its inflow to its successors (Grassmann, Taksar and Heyman
    1985). The probability of departing is summed, never computed as 1 - p. States are eliminated in
    blocks, whose effect on all other states is one product of matrices.

    Args:
        dense: probabilities among the states, [states, states]; overwritten.
        outflow: probabilities of leaving for good, [states]; overwritten.

    Raises:
        SolverError: some states are never left.
    """
    escape = np.empty_like(outflow)
    for end in range(len(outflow), 0, -_BLOCK):
        begin = max(end - _BLOCK, 0)
        for i in range(end - 1, begin - 1, -1):
            escape[i] = outflow[i] + dense[i, :i].sum()
            if escape[i] <= 0.0:
                raise SolverError(HOLDS_MASS)
            dense[i, :i] /= escape[i]
            outflow[i] /= escape[i]
            weight = dense[begin:i, i]
            dense[begin:i, :i] += np.outer(weight, dense[i, :i])
            outflow[begin:i] += weight * outflow[i]
            dense[:begin, begin:i] += np.outer(dense[:begin, i], dense[i, begin:i])
        into = dense[:begin, begin:end]
        dense[:begin, :begin] += into @ dense[begin:end, :begin]
        outflow[:begin] += into @ outflow[begin:end]
    factors = np.negative(dense, out=dense)
    np.fill_diagonal(factors, escape)

    def solve(rewards: FloatArray) -> FloatArray:
        """Return the totals of rewards; all terms have one sign, so that no digits cancel."""
        entered = scipy.linalg.solve_triangular(factors, rewards)
        return np.asarray(
            scipy.linalg.solve_triangular(factors, entered, lower=True, unit_diagonal=True)
        )

    return solve
