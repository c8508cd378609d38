"""A rank's rows of a policy's equations, which all ranks of PETSc solve together.

Each rank sweeps its rows in place (Gauss-Seidel), in an order that has the ends first, and all hear
of the values at their borders after each sweep. Where that contracts slowly PETSc's Krylov methods
take over, on a matrix whose rows are shared by state, each rank's own half factorised.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.distributed.graph_sweeps import reaching
from ssp_lp.distributed.halo import Halo
from ssp_lp.dynamic_programming.bellman import Moves
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS, Iteration, on_departing
from ssp_lp.dynamic_programming.equations import EXACT
from ssp_lp.errors import SolverError, optional_module
from ssp_lp.model.graph import Graph

SWEEPS = "sweeps"  # the first way to solve the equations; others are PETSc's Krylov methods
_STEPS = 200  # of a run of a Krylov method
_RUNS = 3  # of it for each reward between two looks at the time
_FINEST = 1e-8  # relative residual of one run of it; what is left is corrected by the next
_SHARE = 0.1  # of the accuracy that is asked for, which a run goes for
_AGAIN = 2  # sweeps, after what is next to nothing was taken for nothing
_PASSES = 8  # over the rows in search of what leaves, after which the graph is searched


class Improved(NamedTuple):
    """What a rank of PETSc has of better solutions of a policy's equations."""

    x: FloatArray  # [own states, rewards]
    missed: FloatArray  # [rewards] the greatest residual, over all ranks; infinite: it is slow
    scale: FloatArray  # [rewards] the greatest size of solution or right-hand side, likewise
    products: int


class SharedSweeps(Iteration):
    """Sweeps of equations whose rows are shared by several ranks, which all take as many."""

    most_sweeps = 40  # between two looks at the time

    def __init__(self, own: sp.csr_array, halo: Halo, order: IntArray, comm: Any) -> None:
        """Take the rows.

        Args:
            own: rows of the own states in the order in which they are swept; columns are these and
                the ghosts behind them, [own states, states].
            halo: the ghosts.
            order: the own states in that order.
            comm: of mpi4py.
        """
        super().__init__(own, lambda: np.inf)
        self._halo, self._order, self._comm = halo, order, comm

    def greatest(self, *numbers: float) -> tuple[float, ...]:
        """The greatest of each number over all ranks of the sweeps."""
        found, own = np.empty(len(numbers)), np.array(numbers)
        self._comm.Allreduce(own, found, op=optional_module("mpi4py.MPI", "distributed").MAX)
        return tuple(found.tolist())

    def fill(self, y: FloatArray) -> None:
        """Bring in place what the other ranks' sweeps have made of the ghosts' values."""
        if self._comm.size == 1:
            return
        n = len(self._order)
        values = np.empty_like(y)
        values[self._order] = y[:n]
        self._halo.fill(values)
        y[n:] = values[n:]

    def sweep(self, right: FloatArray, y: FloatArray) -> tuple[float, float]:
        """One of the shared sweeps, in place: greatest change and greatest size, of all ranks."""
        self.fill(y)
        change, size = self.greatest(*super().sweep(right, y))
        return change, size


class OwnEquations:
    """A rank's rows of a policy's equations ``x = reward + step @ x``."""

    def __init__(
        self,
        comm: Any,
        petsc: Any,
        halo: Halo,
        chain: sp.csr_array,
        exits: FloatArray,
        order: IntArray,
    ) -> None:
        """State them.

        Args:
            comm: of mpi4py.
            petsc: the module.
            halo: the ghosts.
            chain: the policy's rows, [own states, own states and ghosts].
            exits: [own states].
            order: the own states, those that are nearer to an end first.
        """
        self._comm, self._petsc, self._halo, self._order = comm, petsc, halo, order
        self.moves = Moves(np.arange(halo.n_own, dtype=np.int32), chain, exits)
        self._solvers: dict[str, Any] = {}
        self._kept: list[Any] = []  # objects of PETSc's, which are destroyed by all ranks at once

    def clear(self) -> None:
        """Let go of PETSc's objects, as all ranks do."""
        for one in self._kept:
            one.destroy()
        self._kept, self._solvers = [], {}

    @cached_property
    def _sweeps(self) -> SharedSweeps:
        """The equations to be swept."""
        rows, departs = self._rows_in_order
        if self._any(departs <= 0.0):
            raise SolverError(HOLDS_MASS)
        return SharedSweeps(rows, self._halo, self._order, self._comm)

    @cached_property
    def _rows_in_order(self) -> tuple[sp.csr_array, FloatArray]:
        """Rows in the order of sweeps, seen on departing only, and the probabilities of that."""
        _, chain, exits = self.moves
        place = np.arange(self._halo.size, dtype=np.int32)
        place[self._order] = np.arange(len(self._order), dtype=np.int32)
        try:
            rows, departs, _ = on_departing(chain, exits, self._order, place)
        except SolverError:  # which the ranks have to raise together
            return sp.csr_array((len(self._order), self._halo.size)), np.zeros(len(self._order))
        return rows, departs

    def closed(self) -> IntArray:
        """Own states from which the policy never leaves, [some states]."""
        _, chain, exits = self.moves
        leaves = self._halo.filled(exits > 0.0)
        marks = accelerated(len(chain.indices), "graphs.mark_leading")
        if all(self._comm.allgather(marks)):  # on all ranks alike, however few rows one has
            leaves = self._marked_leaving(leaves)
        if self._any(~leaves):
            n_ghosts = self._halo.size - len(exits)
            offsets = np.append(np.arange(len(exits) + 1), np.full(n_ghosts, len(exits)))
            graph = Graph(offsets, chain.indptr.astype(np.int64), chain.indices, chain.data)
            leaves = reaching(self._comm, self._told, graph, leaves)
        return np.flatnonzero(~leaves[: len(exits)])

    def _marked_leaving(self, leaves: BoolArray) -> BoolArray:
        """States that passes over the equations' rows find to lead to one that leaves, [states]."""
        from ssp_lp.compiled.graphs import mark_leading

        _, chain, _ = self.moves
        arrays = unsigned(chain.indptr), unsigned(chain.indices), chain.data
        waiting = self._order[~leaves[self._order]]
        for _ in range(_PASSES):
            mark_leading(*arrays, unsigned(waiting), leaves)
            waiting = np.ascontiguousarray(waiting[~leaves[waiting]][::-1])
            leaves = self._told(leaves)
            if not self._comm.allreduce(waiting.size):
                break
        return leaves

    def _told(self, mask: BoolArray) -> BoolArray:
        """What is known of the states of the equations, the ghosts' by their owners, [states]."""
        return self._halo.filled(mask[: self._halo.n_own])

    def improve(
        self, method: str, accuracy: float, right: FloatArray, guess: FloatArray
    ) -> Improved:
        """Improve solutions of the equations; all ranks see the same residuals and end together.

        Args:
            method: sweeps, or one of PETSc's.
            accuracy: greatest residual, relative to the solution, that is enough.
            right: [own states, rewards].
            guess: where to begin, like ``right``.

        Raises:
            SolverError: some state is never left.
        """
        run = self._swept if method == SWEEPS else partial(self._iterated, method)
        found = run(accuracy, right, guess)
        if accuracy <= EXACT and (found.missed <= accuracy * found.scale).all():
            return found._replace(x=self._without_dust(right, found.x))
        return found

    def _swept(self, accuracy: float, right: FloatArray, guess: FloatArray) -> Improved:
        """Solutions improved by sweeps while they contract well."""
        sweeps, y = self._sweeps, self._known(guess)
        before, departs = sweeps.products, self._rows_in_order[1]
        missed = sweeps.change_left(right[self._order] / departs[:, None], y, accuracy)
        ones = np.ones(right.shape[1])
        return Improved(self._own(y), missed * ones, ones, sweeps.products - before)

    def _without_dust(self, right: FloatArray, x: FloatArray) -> FloatArray:
        """Solutions without what methods leave of a guess where nothing is to be had.

        What is far below the greatest is worked out once more as if it were nothing.
        """
        y, departs = self._known(x), self._rows_in_order[1]
        sizes, paid = (
            np.array(self._sweeps.greatest(*np.abs(part).max(axis=0, initial=0.0)))
            for part in (x, right)
        )
        y[np.abs(y) <= np.where(paid > 0.0, EXACT * sizes, np.inf)] = 0.0
        for _ in range(_AGAIN):
            self._sweeps.sweep(right[self._order] / departs[:, None], y)
        return self._own(y)

    def _known(self, x: FloatArray) -> FloatArray:
        """Values of own states in the order of sweeps, with room for the ghosts behind them."""
        y = np.zeros((self._halo.size, x.shape[1]))
        y[: len(x)] = x[self._order]
        return y

    def _own(self, y: FloatArray) -> FloatArray:
        """Values of own states from those in the order of sweeps, [own states, rewards]."""
        x = np.empty((len(self._order), y.shape[1]))
        x[self._order] = y[: len(x)]
        return x

    def _iterated(
        self, method: str, accuracy: float, right: FloatArray, guess: FloatArray
    ) -> Improved:
        """Solutions improved by a few runs of a Krylov method each.

        Each run begins with the residual that the last one left.
        """
        k = right.shape[1]
        found, products = Improved(guess.copy(), np.empty(k), np.empty(k), 0), 0
        solver, (_, x, rights, left, step, departs) = self._solver(method), self._matrix
        finest = max(_SHARE * accuracy, _FINEST)
        solver.setTolerances(rtol=finest, atol=0.0, max_it=_STEPS)
        for j in range(k):
            rights.array, x.array = right[:, j] / departs, guess[:, j]
            missed, scale = self._residual()
            for _ in range(_RUNS):
                if missed <= accuracy * scale:
                    break
                solver.solve(left, step)
                x.axpy(1.0, step)
                products += 2 * solver.getIterationNumber()
                before, (missed, scale) = missed / scale, self._residual()
                if not missed < before * scale:  # nan: it broke down
                    x.array = found.x[:, j]
                    missed, scale = self._residual()
                    break
                found.x[:, j] = x.array
            found.missed[j], found.scale[j] = missed, scale
        return found._replace(products=products)

    def _residual(self) -> tuple[float, float]:
        """The greatest residual of what was found, and the greatest size of it, over all ranks."""
        matrix, x, right, left, *_ = self._matrix
        matrix.mult(x, left)
        left.aypx(-1.0, right)
        infinity = self._petsc.NormType.NORM_INFINITY
        return float(left.norm(infinity)), float(max(x.norm(infinity), right.norm(infinity)))

    @cached_property
    def _matrix(self) -> tuple[Any, Any, Any, Any, Any, FloatArray]:
        """PETSc's matrix, four vectors, and the probabilities of departing from own states."""
        (step, departs), halo, order = self._rows_in_order, self._halo, self._order
        n, n_states = halo.n_own, self._comm.allreduce(halo.n_own)
        numbers, place = halo.numbers, np.argsort(order)
        numbers[:n] = numbers[order]
        step = sp.csr_array((step.data, numbers[step.indices], step.indptr), shape=(n, n_states))
        # PETSc keeps the last of duplicates: scipy adds them up
        rows = sp.csr_array(sp.eye(n, n_states, k=halo.first, format="csr")) - step[place]
        parts, layout = (rows.indptr, rows.indices, rows.data), ((n, n_states), (n, n_states))
        matrix = self._petsc.Mat().createAIJ(size=layout, csr=parts, comm=self._comm)
        x, right = matrix.createVecs()
        left, change = right.duplicate(), x.duplicate()
        self._kept += [matrix, x, right, left, change]
        return matrix, x, right, left, change, departs[place]

    def _solver(self, method: str) -> Any:
        """Krylov method for the equations as they stand, own rows half factorised."""
        if method not in self._solvers:
            matrix, solver = self._matrix[0], self._petsc.KSP().create(self._comm)
            solver.setOperators(matrix)
            solver.setType(method)
            solver.getPC().setType("bjacobi")
            self._solvers[method] = solver
            self._kept.append(solver)
        return self._solvers[method]

    def _any(self, wrong: BoolArray) -> bool:
        """Whether something is wrong with the equations on any rank of PETSc."""
        return bool(self._comm.allreduce(bool(wrong.any())))
