"""A rank's rows of a process: what it does to them when the first rank of PETSc says so.

Vectors over states are whole on every rank, rows and what is counted at pairs are nowhere: a rank
has those of a range of states in a row, and numbers its pairs from 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, segment_sums, weighted
from ssp_lp.column_generation.explicit_pricing import pricing_rounding
from ssp_lp.distributed.graph_sweeps import approaching, on_any, reaching
from ssp_lp.dynamic_programming.bellman import Backup, Moves, best_pairs, chosen_rows
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dual_bound import shortfall
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import Graph
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.failure_label import FailureLabelled

_STEPS = 200  # of a run of a Krylov method
_RUNS = 3  # of it for each reward between two looks at the time
_FINEST = 1e-8  # relative residual of one run of it; what is left is corrected by the next
_SHARE = 0.1  # of the accuracy that is asked for, which a run goes for


class Improved(NamedTuple):
    """What a rank of PETSc has of better solutions of a policy's equations."""

    x: FloatArray  # [own states, rewards]
    missed: FloatArray  # [rewards] the greatest residual, over all ranks
    scale: FloatArray  # [rewards] the greatest size of solution or right-hand side, likewise
    products: int


class Share:
    """A rank's rows of a process, with rewards, and what it does with them.

    What is minimised is named by a weight of each reward: a cost is what these make of the rank's
    own rewards.
    """

    def __init__(
        self,
        comm: Any,
        petsc: Any,
        dynamics: Dynamics,
        rewards: FloatArray,
        first: int,
        end: int,
        labelled: FailureLabelled | None = None,
        anew: Callable[[float | None], Share] | None = None,
    ) -> None:
        """Take the rows.

        Args:
            comm: of mpi4py.
            petsc: the module.
            dynamics: all states, and the pairs of the own ones.
            rewards: [own pairs, rewards].
            first: number of the first of the own states.
            end: number of the state behind the last of them.
            labelled: the rank's part of the process, where that knows the model.
            anew: makes the rows of the same question with another discount.
        """
        self._comm, self._petsc, self.dynamics, self.rewards = comm, petsc, dynamics, rewards
        self._own, self._states = slice(first, end), np.arange(first, end, dtype=np.int32)
        self._labelled, self._anew = labelled, anew
        self._solvers: dict[str, Any] = {}
        self._moves: Any = None  # the chain of the equations that are set up
        self._kept: list[Any] = []  # objects of PETSc's, which are destroyed by all ranks at once

    def sizes(self) -> tuple[int, int, int]:
        """End of the own states, own pairs, and entries of their rows."""
        return self._own.stop, len(self.rewards), len(self.dynamics.transitions.indices)

    def labelled_anew(self, discount: float | None) -> Share:
        """The rows of the same question with another discount.

        Raises:
            SolverError: the rank was handed its rows.
        """
        if self._anew is None:
            raise SolverError("rows that were handed out cannot be made anew")
        return self._anew(discount)

    def back_up(self, weights: FloatArray, values: FloatArray, held: IntArray) -> Backup:
        """Bellman backup of the own states; pairs are counted from the first of this rank's."""
        if not self._states.size:
            return Backup(np.zeros(0), np.zeros(0, dtype=np.int32), np.zeros(0))
        offsets = self.dynamics.pair_offsets[self._own.start : self._own.stop + 1]
        return best_pairs(offsets, self.dynamics.transitions, self._cost(weights), values, held)

    def taken(self, weights: FloatArray, choice: IntArray) -> FloatArray:
        """Own rewards of a policy's pairs, weighted, [own states] or [own states, sums].

        Args:
            weights: [rewards] or [rewards, sums].
            choice: [own states].
        """
        own = self.rewards[choice]
        if weights.ndim == 1:
            return weighted(own, weights)
        return np.stack([weighted(own, column) for column in weights.T], axis=1)

    def precise_gains(
        self, weights: FloatArray, values: FloatArray, low: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Gain of each own state's best pair in twice the working precision, and that pair."""
        gain, picks = self.dynamics.precise_gains(self._cost(weights), values, low)
        return gain[self._own], picks[self._own]

    def improve_by_sweeps(
        self, weights: FloatArray, values: FloatArray, rest: tuple[Any, ...], choice: IntArray
    ) -> tuple[IntArray, FloatArray, int]:
        """Improve a policy in the own states by sweeps; the others' values stay.

        Args:
            weights: [rewards].
            values: [states].
            rest: floor, sweeps at most, and whether to sort anew, as of ``Dynamics``.
            choice: [own states].

        Returns:
            The policy and the values, [own states] each, and how many states changed.
        """
        floor, most, anew = rest
        full, values = np.zeros(len(values), dtype=np.int32), values.copy()
        full[self._own] = choice
        self.dynamics.improve_by_sweeps(
            self._cost(weights), full, values, floor, most,
            is_sorted_anew=anew, states=self._states,
        )  # fmt: skip
        own = full[self._own]
        return own, values[self._own], int(np.count_nonzero(own != choice))

    def lowered(
        self, weights: FloatArray, values: FloatArray, floor: float, sweeps: int
    ) -> tuple[FloatArray, bool]:
        """Own values lowered by what they exceed their backups by, sweep by sweep.

        Args:
            weights: of the rewards, >= 0, [rewards].
            values: [states].
            floor: a constant below which none is lowered.
            sweeps: number of them.

        Returns:
            Own values, [own states], and whether one of them was lowered.
        """
        cost, values, own = self._cost_below(weights), values.copy(), self._own
        for sweep in range(sweeps):
            lack = shortfall(self.dynamics, cost, values)[own]
            if not lack.any():
                return values[own], sweep > 0
            below = np.minimum(values[own] - lack, np.nextafter(values[own], -np.inf))
            below = np.where(lack > 0.0, below, values[own])
            values[own] = np.maximum(below, floor)
        return values[own], True

    def greatest_constant(self, weights: FloatArray) -> float:
        """The greatest constant that the own pairs' costs of ending allow as a bound."""
        cost, exits = self._cost_below(weights), self.dynamics.exits
        leaves = exits > 0.0
        return float((cost[leaves] / exits[leaves]).min(initial=np.inf))

    def approach(self) -> IntArray:
        """Pairs by which own states come nearer to the goal, or to leaving anyhow, [own states].

        Raises:
            SolverError: the rank was handed its rows.
        """
        graph, exits = self._graph, self.dynamics.exits
        nearer = approaching(self._comm, graph, self._known.process.goal > 0.0)
        if self._any(nearer[self._own] < 0):
            anyhow = approaching(self._comm, graph, exits > 0.0)
            nearer = np.where(nearer >= 0, nearer, anyhow)
        return nearer[self._own].astype(np.int32)

    def positions(self, choice: IntArray) -> IntArray:
        """Positions of the actions that a choice stands for in the own states of the model.

        Args:
            choice: [own states of the process], pairs counted from the first of this rank's.

        Returns:
            Positions among the state's actions, or codes, [own states of the model].

        Raises:
            SolverError: the rank was handed its rows.
        """
        quotient = self._known.quotient
        model: Any = quotient.model  # a slab
        full = np.zeros(max(quotient.n_nodes, self.dynamics.n_states), dtype=np.int32)
        full[self._own] = choice
        decision = np.full(model.n_states, UNDECIDED, dtype=np.int32)
        live = quotient.node_of >= 0
        live[live] = np.isin(quotient.node_of[live], self._states)
        pairs = quotient.pair_at[full[quotient.node_of[live]]]
        decision[live] = np.where(pairs < 0, pairs, pairs - model.pair_offsets[:-1][live])
        own: IntArray = decision[model.own]
        return own

    def clear(self) -> None:
        """Let go of PETSc's objects, as all ranks do."""
        for one in self._kept:
            one.destroy()
        self._kept, self._solvers, self._moves = [], {}, None

    def choose(self, choice: IntArray) -> int:
        """Set up the equations of a policy, seen on departing only: ``x - step @ x = right``.

        Args:
            choice: pair of each own state, counted from the first of this rank's.

        Returns:
            Entries of the own rows.

        Raises:
            SolverError: some state is never left.
        """
        self.clear()
        n, n_states = len(self._states), self.dynamics.n_states
        chain, exits = chosen_rows(self.dynamics.transitions, choice), self.dynamics.exits[choice]
        self._moves = Moves(self._states, chain, exits)
        lengths = np.diff(chain.indptr)
        data = np.where(chain.indices == np.repeat(self._states, lengths), 0.0, chain.data)
        self._departs = exits + segment_sums(data, chain.indptr)
        if self._any(self._departs <= 0.0):
            raise SolverError(HOLDS_MASS)
        data /= -np.repeat(self._departs, lengths)
        # the diagonal comes first in each row; PETSc keeps the last of duplicates: scipy adds up
        indptr = (chain.indptr + np.arange(n + 1)).astype(np.int32)
        others = np.ones(len(data) + n, dtype=np.bool_)
        others[indptr[:-1]] = False
        columns, numbers = np.empty(len(others), dtype=np.int32), np.ones(len(others))
        columns[indptr[:-1]], columns[others], numbers[others] = self._states, chain.indices, data
        del others, data
        rows = sp.csr_array((numbers, columns, indptr), shape=(n, n_states))
        rows.sum_duplicates()
        parts, layout = (rows.indptr, rows.indices, rows.data), ((n, n_states), (n, n_states))
        self._matrix = self._petsc.Mat().createAIJ(size=layout, csr=parts, comm=self._comm)
        del rows, parts, columns, numbers
        self._x, self._right = self._matrix.createVecs()
        self._left, self._step = self._right.duplicate(), self._x.duplicate()
        self._kept = [self._matrix, self._x, self._right, self._left, self._step]
        return len(chain.indices)

    def advantages(self, kind: str, vectors: tuple[FloatArray, ...], cost: FloatArray) -> Any:
        """Advantages of the own rows of the equations that are set up, of a kind of ``Moves``'s."""
        return getattr(self._moves, kind)(cost, *vectors)

    def closed(self, choice: IntArray) -> IntArray:
        """Own states from which a policy never leaves, [some states].

        Args:
            choice: pair of each own state, counted from the first of this rank's.
        """
        chain, n_states = chosen_rows(self.dynamics.transitions, choice), self.dynamics.n_states
        before = np.clip(np.arange(n_states + 1) - self._own.start, 0, len(self._states))
        graph = Graph(before, chain.indptr.astype(np.int64), chain.indices, chain.data)
        ends = np.zeros(n_states, dtype=np.bool_)
        ends[self._own] = self.dynamics.exits[choice] > 0.0
        found = reaching(self._comm, graph, on_any(self._comm, ends))
        return self._states[~found[self._own]]

    def improve(
        self, method: str, accuracy: float, right: FloatArray, guess: FloatArray
    ) -> Improved:
        """Improve solutions of the equations by a few runs of a Krylov method each.

        Each run begins with the residual that the last one left. All ranks see the same residuals,
        so that they end together.

        Args:
            method: of PETSc's, "bcgs" or "gmres".
            accuracy: greatest residual, relative to the solution, that is enough.
            right: [own states, rewards].
            guess: where to begin, like ``right``.
        """
        k = right.shape[1]
        found, products = Improved(guess.copy(), np.empty(k), np.empty(k), 0), 0
        solver = self._solver(method)
        finest = max(_SHARE * accuracy, _FINEST)
        solver.setTolerances(rtol=finest, atol=0.0, max_it=_STEPS)
        for j in range(k):
            self._right.array, self._x.array = right[:, j] / self._departs, guess[:, j]
            missed, scale = self._residual()
            for _ in range(_RUNS):
                if missed <= accuracy * scale:
                    break
                solver.solve(self._left, self._step)
                self._x.axpy(1.0, self._step)
                products += 2 * solver.getIterationNumber()
                before, (missed, scale) = missed, self._residual()
                if not missed < before:  # nan: it broke down
                    self._x.array = found.x[:, j]
                    missed, scale = self._residual()
                    break
                found.x[:, j] = self._x.array
            found.missed[j], found.scale[j] = missed, scale
        return found._replace(products=products)

    def _residual(self) -> tuple[float, float]:
        """The greatest residual of what was found, and the greatest size of it, over all ranks."""
        self._matrix.mult(self._x, self._left)
        self._left.aypx(-1.0, self._right)
        infinity = self._petsc.NormType.NORM_INFINITY
        sizes = self._x.norm(infinity), self._right.norm(infinity)
        return float(self._left.norm(infinity)), float(max(sizes))

    def _solver(self, method: str) -> Any:
        """Krylov method for the equations as they stand, own rows half factorised."""
        if method not in self._solvers:
            solver = self._petsc.KSP().create(self._comm)
            solver.setOperators(self._matrix)
            solver.setType(method)
            solver.getPC().setType("bjacobi")
            self._solvers[method] = solver
            self._kept.append(solver)
        return self._solvers[method]

    def _cost(self, weights: FloatArray) -> FloatArray:
        """Cost of each own pair, [own pairs]."""
        return weighted(self.rewards, weights)

    def _cost_below(self, weights: FloatArray) -> FloatArray:
        """Cost of each own pair for a bound, which rounds down, [own pairs]."""
        cost = self._cost(weights)
        cost -= pricing_rounding(self.rewards, weights) * np.abs(cost)
        return cost

    @property
    def _known(self) -> FailureLabelled:
        """The rank's part of a process that knows its model.

        Raises:
            SolverError: the rank was handed its rows.
        """
        if self._labelled is None:
            raise SolverError("rows that were handed out do not know their model")
        return self._labelled

    @property
    def _graph(self) -> Graph:
        """Graph of all states and the own pairs, made for one search."""
        rows, offsets = self.dynamics.transitions, self.dynamics.pair_offsets
        both = offsets.astype(np.int64), rows.indptr.astype(np.int64)
        return Graph(*both, rows.indices, rows.data)

    def _any(self, wrong: BoolArray) -> bool:
        """Whether something is wrong on any rank of PETSc."""
        return any(self._comm.allgather(bool(wrong.any())))
