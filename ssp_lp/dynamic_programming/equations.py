"""The equations of a policy, ``x = reward + chain @ x``, solved along the structure of its chain.

The chain's strong components are solved ends first: a single state by substitution, a small or
narrow component by state reduction without subtractions, a large one by sweeps, then by a Krylov
method preconditioned by them, then by sparse factors (``chain_solvers``). State reduction is
accurate relative to each entry, whatever the condition number (Grassmann, Taksar and Heyman 1985).
``evaluate_chain`` checks the results of all other methods.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from weakref import proxy

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray, offsets_of, unsigned
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import Moves
from ssp_lp.dynamic_programming.chain_solvers import (
    HOLDS_MASS,
    Iteration,
    LargeComponent,
    Solver,
    dense_solver,
    departures,
    equations,
    factor_solver,
    factorised,
    reduction_solver,
)
from ssp_lp.errors import SolverError

_ELIMINATION = ("equations.solve_by_elimination",)

COMPONENTS = "graphs._search_components", "graphs._sort_by_component"
"""The compiled loops that find strong components."""

BY_HEIGHT = ("graphs._number_by_height",)
"""The compiled loop that sorts strong components."""

_DENSE_STATES = 40
"""Most states for which a dense solve costs less than setting up a sparse one."""

DIRECT_STATES = 1_000
"""Most states for which one sparse factorisation costs less than analysing the structure."""

EXACTLY_SOLVED = 256
"""Most states of a component for which a compiled dense reduction is the fastest method."""

_KEPT_ENTRIES = 10_000_000  # most entries of reduced components that are kept, 80 MB
EXACT = 4e-15  # relative residual: a few units in the last place of the totals
_NOBODY = np.zeros(0, dtype=np.int64)


class System:
    """Equations of a substochastic chain, given by its transitions and its exits."""

    def __init__(self, matrix: sp.csr_array, exits: FloatArray) -> None:
        """Set up the equations.

        Args:
            matrix: probabilities of going on, [states, states].
            exits: probabilities of leaving for good, [states].
        """
        self.matrix, self.exits, self.size = matrix, exits, len(exits)
        self.products = 0  # passes over the matrix
        self.kept_runs: FloatArray | None = None  # checked run lengths, see ``evaluate_chain``
        self._large: dict[int, LargeComponent] = {}
        self._reductions: dict[int, tuple[sp.csr_array, Solver]] = {}

    def __reduce__(self) -> tuple[type[System], tuple[sp.csr_array, FloatArray]]:
        """Return the constructor with its arguments, for copies and pickles without factors."""
        return System, (self.matrix, self.exits)

    @property
    def n_entries(self) -> int:
        """Number of entries of the matrix."""
        return len(self.matrix.indices)

    @cached_property
    def components(self) -> StrongComponents:
        """Strong components of the chain, ends first."""
        check_time()
        return strong_components(self.matrix.indptr, self.matrix.indices, self.matrix.data)

    @property
    def is_solved_exactly(self) -> bool:
        """Whether no component is large, so that the equations are solved exactly."""
        return self.components.largest <= EXACTLY_SOLVED

    @property
    def is_solved_reward_by_reward(self) -> bool:
        """Whether the equations are solved by slow iterations, once for each reward."""
        return any(block.is_solved_reward_by_reward for block in self._large.values())

    @cached_property
    def moves(self) -> Moves:
        """The chain as a process with one pair in each state: pair k is that of state k."""
        return Moves(np.arange(self.size, dtype=np.int32), self.matrix, self.exits)

    @cached_property
    def closed(self) -> IntArray:
        """States of strong components that the chain never leaves, ascending."""
        strong, rows = self.components, self.matrix
        left = np.zeros(strong.n_components, dtype=np.bool_)
        left[strong.label[self.exits > 0.0]] = True
        if not left.all():
            own = strong.label.repeat(rows.indptr[1:] - rows.indptr[:-1])
            left[own[(strong.label[rows.indices] != own) & (rows.data > 0.0)]] = True
        return (~left[strong.label]).nonzero()[0] if not left.all() else _NOBODY

    @with_twin
    def solve(
        self, rewards: FloatArray, guess: FloatArray | None = None, accuracy: float = EXACT
    ) -> FloatArray:
        """Solve the policy's equations: expected total rewards from each state.

        Args:
            rewards: [states] or [states, rewards].
            guess: warm start of the iterative methods, in the shape of ``rewards``.
            accuracy: relative residual of the iterative methods; other methods are always exact.

        Returns:
            Totals, of the shape of ``rewards``.

        Raises:
            SolverError: the chain never leaves some states, or no method converges.
        """
        if self.size == 0 or len(self.matrix.indices) == 0:
            if (self.exits <= 0.0).any():
                raise SolverError(HOLDS_MASS)
            return rewards / (self.exits if rewards.ndim == 1 else self.exits[:, None])
        columns = rewards.reshape(self.size, -1)
        self.products += 1
        if self.size <= DIRECT_STATES and not accelerated(len(self.matrix.indices), *_ELIMINATION):
            return self._factors(columns).reshape(rewards.shape)
        x = np.zeros(columns.shape) if guess is None else guess.reshape(columns.shape).copy()
        for first, last in self._runs:
            check_time()
            if last - first == 1 and self.components.sizes[first] > EXACTLY_SOLVED:
                self.products += self._block(first).solve(columns, x, accuracy)
            else:
                self._solve_small(first, last, columns, x)
        return x.reshape(rewards.shape)

    @with_twin
    def solve_by_reduction(self, rewards: FloatArray) -> FloatArray:
        """Solve the equations without any subtraction, for chains that are hardly left.

        Raises:
            SolverError: the chain never leaves some states, or a component is too large.
        """
        columns, x = rewards.reshape(self.size, -1), np.zeros((self.size, rewards[0].size))
        is_compiled = accelerated(len(self.matrix.indices), *_ELIMINATION)
        for first, last in self._runs_above(_DENSE_STATES if is_compiled else 0):
            check_time()
            states = self.components.members(first)
            if is_compiled and states.size <= _DENSE_STATES:
                self._solve_compiled(first, last, columns, x)
            elif states.size > DIRECT_STATES:
                LargeComponent(self.matrix, self.exits, states).reduce(columns, x)
            else:
                rows, solver = self._reduced(first)
                x[states] = solver(columns[states] + rows @ x)
        return x.reshape(rewards.shape)

    def _reduced(self, c: int) -> tuple[sp.csr_array, Solver]:
        """Return a component's rows and its solver by state reduction; cached if it is small."""
        if c not in self._reductions:
            states = self.components.members(c)
            rows, beyond = sp.csr_array(self.matrix[states]), np.ones(self.size)
            beyond[states] = 0.0
            leaving = self.exits[states] + rows @ beyond
            reduced = rows, reduction_solver(rows[:, states].toarray(), leaving)
            if self.size * min(self.components.largest, DIRECT_STATES) > _KEPT_ENTRIES:
                return reduced
            self._reductions[c] = reduced
        return self._reductions[c]

    def solve_transposed(self, inflow: FloatArray) -> FloatArray:
        """Solve the transposed equations: expected visits of each state for a given inflow.

        Raises:
            SolverError: the chain never leaves some states.
        """
        if self.size == 0:
            return inflow.copy()
        visits = np.empty_like(inflow)
        if self.components.largest > EXACTLY_SOLVED:
            escape, order, iteration = self._transposed_iteration
            found = np.zeros((self.size, 1))
            if iteration.solve(inflow[order, None], found, EXACT):
                visits[order] = found[:, 0] / escape[order]
                return visits
        order, factors = self._transposed_factors
        visits[order] = factors.solve(inflow[order], "T")  # type: ignore[call-overload]
        return visits

    @cached_property
    def _transposed_factors(self) -> tuple[IntArray, sp.linalg.SuperLU]:
        """Order of the states, and sparse factors for the transposed equations."""
        if self.components.largest > EXACTLY_SOLVED:
            return self.moves.owner, factorised(equations(self.matrix, self.exits))
        order = self.components.order
        return order, factorised(equations(self.matrix, self.exits, order), in_order=True)

    @cached_property
    def _transposed_iteration(self) -> tuple[FloatArray, IntArray, Iteration]:
        """Probabilities of departing, [states], order of the states, and iterative solution.

        The unknowns of the iteration are the expected numbers of departures from the states, in
        this order.
        """
        strong, (row, column, data, escape) = self.components, departures(self.matrix, self.exits)
        order, place = strong.order[::-1], np.empty(self.size, dtype=np.int32)
        place[order] = np.arange(self.size)
        to_from = place[column], place[row]
        own = sp.csr_array((data / escape[row], to_from), shape=self.matrix.shape)
        large = (strong.sizes > EXACTLY_SOLVED).nonzero()[0].tolist()

        weak = proxy(self)  # a reference cycle would keep large arrays until garbage collection

        def direct_work() -> float:
            """Return the work of direct solutions of all large components."""
            return float(sum(weak._block(c).direct_work for c in large))

        return escape, order, Iteration(own, direct_work)

    @cached_property
    def _runs(self) -> list[tuple[int, int]]:
        """Ranges of components that are solved together: small ones, or a single large one."""
        return self._runs_above(EXACTLY_SOLVED)

    def _runs_above(self, few: int) -> list[tuple[int, int]]:
        """Return ranges of components of at most ``few`` states, and larger ones one by one."""
        sizes = self.components.sizes
        large = (sizes > few).nonzero()[0].tolist()
        runs, begin = [], 0
        for c in large:
            if c > begin:
                runs.append((begin, c))
            runs.append((c, c + 1))
            begin = c + 1
        if begin < len(sizes):
            runs.append((begin, len(sizes)))
        return runs

    @cached_property
    def _factors(self) -> Solver:
        """Solver of all equations together, by LU factors."""
        if self.size <= _DENSE_STATES:
            return dense_solver(self.matrix, self.exits)
        return factor_solver(self.matrix, self.exits)

    def _solve_small(self, first: int, last: int, rewards: FloatArray, x: FloatArray) -> None:
        """Solve a range of small components, in place."""
        if accelerated(len(self.matrix.indices), *_ELIMINATION):
            self._solve_compiled(first, last, rewards, x)
            return
        strong = self.components
        states = strong.order[strong.offsets[first] : strong.offsets[last]]
        rows = self.matrix[states]
        x[states] = 0.0
        beyond = rewards[states] + rows @ x
        if (first, last) not in self._kept:
            inside = np.ones(self.size)
            inside[states] = 0.0
            leaving = self.exits[states] + rows @ inside
            own = sp.csr_array(rows[:, states])
            self._kept[first, last] = factorised(equations(own, leaving), in_order=True).solve
        x[states] = self._kept[first, last](beyond)

    @cached_property
    def _kept(self) -> dict[tuple[int, int], Solver]:
        return {}

    def _solve_compiled(self, first: int, last: int, rewards: FloatArray, x: FloatArray) -> None:
        """Solve a range of components by compiled elimination, in place."""
        from ssp_lp.compiled.equations import solve_by_elimination

        strong, rows = self.components, self.matrix
        stuck = solve_by_elimination(
            unsigned(rows.indptr), unsigned(rows.indices), rows.data, self.exits,
            unsigned(self.moves.owner),
            unsigned(strong.order), strong.offsets, first, last,
            int(strong.sizes[first:last].max(initial=1)), rewards, x,
        )  # fmt: skip
        if stuck >= 0:
            raise SolverError(HOLDS_MASS)

    def _block(self, c: int) -> LargeComponent:
        """Return a large component's equations, with their solvers."""
        if c not in self._large:
            self._large[c] = LargeComponent(self.matrix, self.exits, self.components.members(c))
        return self._large[c]


@dataclass(frozen=True, eq=False)
class StrongComponents:
    """Strong components, each after the components that it leads to: ends first."""

    label: IntArray  # [states] component of each state
    order: IntArray  # [states] the states, component by component
    offsets: IntArray  # [components + 1] position of each component in the order

    @property
    def n_components(self) -> int:
        """Number of strong components."""
        return len(self.offsets) - 1

    @cached_property
    def sizes(self) -> IntArray:
        """Number of states of each component, [components]."""
        return np.diff(self.offsets)

    @cached_property
    def largest(self) -> int:
        """Number of states of the largest component."""
        return int(self.sizes.max(initial=0))

    def members(self, component: int) -> IntArray:
        """Return the states of a component."""
        return self.order[self.offsets[component] : self.offsets[component + 1]]


@with_twin
def strong_components(
    indptr: IntArray, indices: IntArray, data: FloatArray, *, by_height: bool = False
) -> StrongComponents:
    """Find the strong components of a matrix in topological order (Tarjan 1972).

    Args:
        indptr: offsets of each state's entries, [states + 1].
        indices: successors, [entries].
        data: probabilities; entries of 0 are no edges, [entries].
        by_height: whether compiled loops sort components by their greatest number of steps to an
            end, for ordered passes.
    """
    n = len(indptr) - 1
    if accelerated(len(indices), *COMPONENTS, *(BY_HEIGHT if by_height else ())):
        from ssp_lp.compiled.graphs import order_components

        label, order, count = order_components(indptr, indices, data, by_height=by_height)
        return StrongComponents(label, order, offsets_of(np.bincount(label, minlength=count)))
    graph = sp.csr_array((data, indices, indptr), shape=(n, n))
    edges: sp.csr_array = graph.copy()  # scipy needs edges without duplicates and zeros
    edges.sum_duplicates()
    edges.eliminate_zeros()
    label = sp.csgraph.connected_components(edges, connection="strong")[1]
    entry = edges.tocoo()
    if (label[entry.row] < label[entry.col]).any():  # scipy does not document the order
        raise SolverError("scipy lists strong components in no topological order: install numba")
    order = np.argsort(label, kind="stable").astype(np.int32)
    return StrongComponents(label, order, offsets_of(np.bincount(label)))
