"""Pricing on PETSc: policies' equations by Krylov methods on rows that several ranks share.

Every rank asks for the same solution, as in any program under ``mpiexec``. The first one searches,
as one process does: price rules, master, refinement, proofs, the clock and Ctrl-C are its alone, so
that ranks cannot disagree. The others hold the rows of their own states and do what the first asks
for: the equations of a policy, solved by BiCGStab on a matrix of PETSc's whose rows are partitioned
by state, and Bellman backups of their states. What the equations are solved to is verified by the
first rank as ever (``dynamic_programming.evaluation``), and so are bounds.
"""

from __future__ import annotations

import pickle
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.cargo import Cargo, models_of
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import Backup, best_pairs, chosen_rows
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import EXACT, System
from ssp_lp.errors import ModelError, SolverError, SSPError, optional_module
from ssp_lp.options import Partition
from ssp_lp.problem import Problem
from ssp_lp.solution import Solution

_EXTRA = "distributed"
_STEPS = 200  # of a run of a Krylov method
_RUNS = 3  # of it for each reward between two looks at the time
_FINEST = 1e-8  # relative residual of one run of it; what is left is corrected by the next
_SHARE = 0.1  # of the accuracy that is asked for, which a run goes for
_STUCK = 0.5  # share of the residual from which a run got nowhere
_LET_PASS = 1e-12  # relative residual that will do where nothing gets further
_METHODS = ("bcgs", "gmres")  # the second where the first gets nowhere


@dataclass(frozen=True)
class Petsc:
    """Pricing of case M, with any limits, by the ranks of PETSc.

    ``solve(problem, method=ColumnGeneration(pricing=Petsc()))`` asks for it. Under ``mpiexec -n 4
    python plan.py`` every rank states the same problem and gets the same solution, on its own
    model; without ``mpiexec`` there is one rank. It needs petsc4py and mpi4py. The equations of
    policies, and backups, are shared; the model is held by every rank, and the search on it by the
    first.
    """

    def on_every_rank(self, problem: Problem, solved: Callable[[Partition], Solution]) -> Solution:
        """The solution of a problem, on every rank of PETSc that asks for it.

        Args:
            problem: the same on every rank.
            solved: finds the solution, given what shares the pricing; called on the first rank.

        Raises:
            ModelError: the ranks do not ask for the same.
            SSPError: what the first rank raised, on every rank.
            MissingDependencyError: petsc4py or mpi4py is not installed.
        """
        ranks, cargo = _Ranks.all(), Cargo()
        for place, model in enumerate(models_of([problem])):
            cargo.know(place, model)
        asked = ranks.comm.allgather(repr(problem))
        if len(set(asked)) > 1:
            raise ModelError(f"all ranks of PETSc must ask for the same, not {' and '.join(asked)}")
        if ranks.comm.rank > 0:
            return _unpacked(cargo, ranks.serve())
        answer = b""
        try:
            solution = solved(ranks.partitioned)
            answer = cargo.pack(solution)
        except BaseException as error:
            answer = _packed_error(cargo, error)
            raise
        finally:
            ranks.dismiss(answer)
        return solution


def _packed_error(cargo: Cargo, error: BaseException) -> bytes:
    """An error of PETSc's first rank for the others; of one that cannot be pickled, its words."""
    try:
        return cargo.pack(error)
    except (pickle.PicklingError, AttributeError, TypeError):
        return cargo.pack(SolverError(f"the first rank ended in {type(error).__name__}: {error}"))


def _unpacked(cargo: Cargo, answer: bytes) -> Solution:
    """The solution of PETSc's first rank, or its error, which is raised."""
    found = cargo.unpack(answer)
    if isinstance(found, BaseException):
        raise found
    solution: Solution = found
    return solution


class _Ranks:
    """The ranks of PETSc's world, of which the first gives orders.

    An order is the name of what a rank does with the rows that it holds, and the arguments of each
    rank; what each makes of it comes back to the first.
    """

    def __init__(self, comm: Any, petsc: Any) -> None:
        """Know the ranks.

        Args:
            comm: of mpi4py.
            petsc: the module.
        """
        self.comm, self._petsc = comm, petsc
        self._share: _Share | None = None
        self._known: dict[int, PartitionedDynamics] = {}
        self.held_by: PartitionedDynamics | None = None  # whose rows the ranks hold
        self.chosen: PartitionedSystem | None = None  # whose equations they have set up

    @classmethod
    def all(cls) -> _Ranks:
        """All ranks of PETSc.

        Raises:
            MissingDependencyError: petsc4py or mpi4py is not installed.
        """
        world = optional_module("mpi4py.MPI", _EXTRA).COMM_WORLD
        optional_module("petsc4py", _EXTRA).init([])
        return cls(world, optional_module("petsc4py.PETSc", _EXTRA))

    def partitioned(self, dynamics: Dynamics) -> PartitionedDynamics:
        """The dynamics with their rows handed out to the ranks, by state, entries balanced."""
        known = self._known.get(id(dynamics))
        if known is None:
            rows, offsets, size = dynamics.transitions, dynamics.pair_offsets, self.comm.size
            ends = rows.indptr[offsets]
            wanted = np.linspace(0, ends[-1], size + 1)[1:-1]
            bounds = np.concatenate([[0], np.searchsorted(ends, wanted), [dynamics.n_states]])
            own = {
                name: getattr(dynamics, name) for name in ("pair_offsets", "transitions", "exits")
            }
            shared = PartitionedDynamics(**own, ranks=self, bounds=bounds, original=dynamics)
            self._known[id(dynamics)] = known = shared
        return known

    def order(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Have every rank of PETSc do something with its rows; what they make of it, by rank.

        Raises:
            SSPError: as of one of them.
        """
        own = self.comm.scatter([(name, given) for given in arguments])
        made = self.comm.gather(self._done(*own))
        for one in made:
            if isinstance(one, SSPError):
                raise one
        return list(made)

    def dismiss(self, answer: bytes) -> None:
        """Tell the other ranks of PETSc the answer, after which they take no orders."""
        self.comm.scatter([("answer", answer)] * self.comm.size)
        self._take(None)

    def serve(self) -> bytes:
        """Do what the first rank of PETSc orders, until there is an answer."""
        while True:
            name, given = self.comm.scatter(None)
            if name == "answer":
                self._take(None)
                answer: bytes = given
                return answer
            self.comm.gather(self._done(name, given))

    def _take(self, share: _Share | None) -> None:
        """Hold other rows, or none; all ranks of PETSc let go of its objects together."""
        if self._share is not None:
            self._share.clear()
        self._share = share

    def _done(self, name: str, given: tuple[Any, ...]) -> Any:
        """What this rank of PETSc makes of an order; an error ends all ranks, unless it is ours."""
        try:
            if name == "take":
                return self._take(_Share(self.comm, self._petsc, *given))
            return getattr(self._share, name)(*given)
        except SSPError as error:
            return error
        except Exception:
            if self.comm.size == 1:
                raise
            traceback.print_exc()
            sys.stderr.flush()
            self.comm.Abort(1)
            raise


@dataclass(frozen=True, eq=False)
class PartitionedDynamics(Dynamics):
    """Dynamics whose rows PETSc's ranks share: policies' equations and backups are theirs.

    All of a policy's equations are solved at once, and no component of the process by itself.
    """

    ranks: _Ranks = field(kw_only=True)
    bounds: IntArray = field(kw_only=True)  # [ranks + 1] first state of each rank, and the end
    original: Dynamics = field(kw_only=True)  # kept, for it is known by its identity

    @property
    def is_solved_backwards(self) -> bool:
        """Never, of dynamics on PETSc."""
        return False

    @property
    def is_compiled_backwards(self) -> bool:
        """Never, of dynamics on PETSc."""
        return False

    @cached_property
    def pair_bounds(self) -> IntArray:
        """First pair of each rank of PETSc, and the end, [ranks + 1]."""
        return self.pair_offsets[self.bounds]

    def by_state(self, array: Any) -> list[Any]:
        """An array over the states of the dynamics, cut for the ranks of PETSc."""
        return [array[a:b] for a, b in pairwise(self.bounds)]

    def back_up(self, pair_cost: FloatArray, values: FloatArray, held: IntArray) -> Backup:
        """Bellman backup of the dynamics on PETSc, each rank's states by itself."""
        self.hand_out()
        bounds = self.pair_bounds
        costs = [pair_cost[a:b] for a, b in pairwise(bounds)]
        held_by = [own - first for own, first in zip(self.by_state(held), bounds, strict=False)]
        given = [(cost, values, own) for cost, own in zip(costs, held_by, strict=True)]
        parts = self.ranks.order("back_up", given)
        choices = [part.choice + first for part, first in zip(parts, bounds, strict=False)]
        return Backup(
            np.concatenate([part.minima for part in parts]),
            np.concatenate(choices).astype(np.int32),
            np.concatenate([part.here for part in parts]),
        )

    def hand_out(self) -> None:
        """Give the ranks of PETSc their rows of the dynamics, unless they hold these."""
        ranks, bounds = self.ranks, self.pair_bounds
        if ranks.held_by is self:
            return
        given = [
            (self.pair_offsets[first : end + 1] - self.pair_offsets[first], self.transitions[a:b],
             self.exits[a:b], int(first))
            for first, end, a, b in zip(
                self.bounds[:-1], self.bounds[1:], bounds[:-1], bounds[1:], strict=True
            )
        ]  # fmt: skip
        ranks.order("take", given)
        ranks.held_by, ranks.chosen = self, None

    def _chain(self, choice: IntArray) -> System:
        """The equations of a policy in the dynamics on PETSc."""
        rows = chosen_rows(self.transitions, choice)
        return PartitionedSystem(rows, self.exits[choice], self, choice)


class PartitionedSystem(System):
    """Equations of a chain that PETSc's ranks solve together."""

    def __init__(
        self,
        matrix: sp.csr_array,
        exits: FloatArray,
        dynamics: PartitionedDynamics,
        choice: IntArray,
    ) -> None:
        """State the equations.

        Args:
            matrix: probabilities of going on, [states, states].
            exits: probabilities of leaving for good, [states].
            dynamics: of which the chain is a policy's.
            choice: the policy, [states].
        """
        super().__init__(matrix, exits)
        self._dynamics, self._choice = dynamics, choice

    @property
    def is_solved_exactly(self) -> bool:
        """Never: equations on PETSc are iterated."""
        return False

    @property
    def is_solved_reward_by_reward(self) -> bool:
        """Always: equations on PETSc take as long for each reward."""
        return True

    def solve(
        self, rewards: FloatArray, guess: FloatArray | None = None, accuracy: float = EXACT
    ) -> FloatArray:
        """Solve the policy's equations on PETSc: see ``System.solve``.

        Raises:
            SolverError: the chain holds mass for ever, or no method gets anywhere.
        """
        if self.size == 0:
            return rewards.copy()
        self._choose()
        dynamics, right = self._dynamics, rewards.reshape(self.size, -1)
        x = np.zeros(right.shape) if guess is None else guess.reshape(right.shape)
        rights, missed = dynamics.by_state(right), np.full(right.shape[1], np.inf)
        for method in _METHODS:
            before, is_open = np.full_like(missed, np.inf), np.ones(missed.size, dtype=np.bool_)
            while (missed <= _STUCK * before)[is_open].any():
                check_time()
                given = [
                    (method, accuracy, *own)
                    for own in zip(rights, dynamics.by_state(x), strict=True)
                ]
                parts, before = dynamics.ranks.order("improve", given), missed
                x = np.concatenate([part.x for part in parts])
                missed, scale = parts[0].missed, parts[0].scale
                self.products += parts[0].products
                is_open = ~(missed <= accuracy * scale)
                if not is_open.any():
                    return x.reshape(rewards.shape)
            if (missed <= _LET_PASS * scale).all():
                return x.reshape(rewards.shape)
        raise SolverError("PETSc's Krylov methods do not solve the equations of a policy")

    def _choose(self) -> None:
        """Have the ranks of PETSc set up these equations, unless they have."""
        dynamics, ranks = self._dynamics, self._dynamics.ranks
        dynamics.hand_out()
        if ranks.chosen is self:
            return
        ranks.chosen = None
        own = zip(dynamics.by_state(self._choice), dynamics.pair_bounds, strict=False)
        ranks.order("choose", [(choice - first,) for choice, first in own])
        ranks.chosen = self


class _Improved(NamedTuple):
    """What a rank of PETSc has of better solutions of a policy's equations."""

    x: FloatArray  # [own states, rewards]
    missed: FloatArray  # [rewards] the greatest residual, over all ranks
    scale: FloatArray  # [rewards] the greatest size of solution or right-hand side, likewise
    products: int


class _Share:
    """A rank's rows of a process: what it does to them when the first rank of PETSc says so."""

    def __init__(
        self,
        comm: Any,
        petsc: Any,
        offsets: IntArray,
        transitions: sp.csr_array,
        exits: FloatArray,
        first: int,
    ) -> None:
        """Take the rows.

        Args:
            comm: of mpi4py.
            petsc: the module.
            offsets: [own states + 1] pairs of each, counted from the first of them.
            transitions: [own pairs, states].
            exits: [own pairs].
            first: number of the first of the states.
        """
        self._comm, self._petsc = comm, petsc
        self._offsets, self._transitions, self._exits = offsets, transitions, exits
        self._states = first + np.arange(len(offsets) - 1)
        self._solvers: dict[str, Any] = {}
        self._kept: list[Any] = []  # objects of PETSc's, which are destroyed by all ranks at once

    def back_up(self, pair_cost: FloatArray, values: FloatArray, held: IntArray) -> Backup:
        """Bellman backup of the own states; pairs are counted from the first of this rank's."""
        if not len(self._states):
            return Backup(np.zeros(0), np.zeros(0, dtype=np.int32), np.zeros(0))
        return best_pairs(self._offsets, self._transitions, pair_cost, values, held)

    def clear(self) -> None:
        """Let go of PETSc's objects, as all ranks do."""
        for one in self._kept:
            one.destroy()
        self._kept, self._solvers = [], {}

    def choose(self, choice: IntArray) -> None:
        """Set up the equations of a policy, seen on departing only: ``x - step @ x = right``.

        Args:
            choice: pair of each own state, counted from the first of this rank's.

        Raises:
            SolverError: some state is never left.
        """
        self.clear()
        n, n_states = len(self._states), self._transitions.shape[1]
        entry = self._transitions[choice].tocoo()
        away = entry.col != self._states[entry.row]
        row, column, data = entry.row[away], entry.col[away], entry.data[away]
        self._departs = self._exits[choice] + np.bincount(row, weights=data, minlength=n)
        if self._any(self._departs <= 0.0):
            raise SolverError(HOLDS_MASS)
        own = np.arange(n)
        # PETSc keeps the last of duplicates: scipy adds them up
        rows = sp.csr_array(
            (
                np.concatenate([np.ones(n), -data / self._departs[row]]),
                (np.concatenate([own, row]), np.concatenate([self._states, column])),
            ),
            shape=(n, n_states),
        )
        rows.sum_duplicates()
        parts = rows.indptr.astype(np.int32), rows.indices.astype(np.int32), rows.data
        layout = (n, n_states), (n, n_states)
        self._matrix = self._petsc.Mat().createAIJ(size=layout, csr=parts, comm=self._comm)
        self._x, self._right = self._matrix.createVecs()
        self._left, self._step = self._right.duplicate(), self._x.duplicate()
        self._kept = [self._matrix, self._x, self._right, self._left, self._step]

    def improve(
        self, method: str, accuracy: float, right: FloatArray, guess: FloatArray
    ) -> _Improved:
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
        found, products = _Improved(guess.copy(), np.empty(k), np.empty(k), 0), 0
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

    def _any(self, wrong: BoolArray) -> bool:
        """Whether something is wrong on any rank of PETSc."""
        return any(self._comm.allgather(bool(wrong.any())))
