"""The process of case M on rows that lie with several ranks, and its pricing problem.

Each rank has the pairs of its own nodes. Policies are improved by sweeps of each rank over its own
nodes, in place, with the ghosts' values exchanged in between; the equations of a policy are solved
by PETSc's Krylov methods. Columns are measured with a bound of their error, and a lower bound is
checked by one backup of all rows, rounding counted against it, as in one process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    BoolArray,
    FloatArray,
    IntArray,
    weighted,
    weighted_rounding,
)
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, pricing_weights, required
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, LeastFailure
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import Stop
from ssp_lp.distributed.part import Part
from ssp_lp.distributed.ranks import Halo, Ranks
from ssp_lp.dynamic_programming.bellman import (
    Backup,
    Moves,
    Work,
    best_pairs,
    chosen_rows,
    exact_sum,
)
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.dual_bound import shortfall
from ssp_lp.dynamic_programming.dynamics import SETTLED, Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, EXACT
from ssp_lp.dynamic_programming.evaluation import EVALUATED, RUN_ACCURACY
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.model.graph import Graph, pairs_into
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Branches, Policy
from ssp_lp.processes.failure_label import FailureLabelled, counting_of, label_failure
from ssp_lp.processes.failure_semantics import Aim, GiveUp, free_pairs, giving_up_states
from ssp_lp.processes.quotient import build_quotient

_STEPS = 200  # of a Krylov method in one run
_RUNS = 12  # of it, each from the residual that the last one left
_FINEST = 1e-8  # relative residual of one run
_STUCK = 0.5  # share of the residual from which a run got nowhere
_GATHERED = 1_000_000  # entries of a policy's rows that may be gathered to be factorised
_CORRECTIONS = 6
_SWEEPS, _EXCHANGED = 20, 4  # sweeps between two evaluations, and between two exchanges
_MOST_ROUNDS = 1_000  # of policy iteration: each improves what the last one left
_SHRUNK = (0.0, *10.0 ** np.arange(-13.0, 0.0))  # shares by which values move to the floor
_DUST = 0.1  # of such a share, by which all values go down
_LEVEL = 1e-12  # of the greatest value: values that differ by less are equal
_LOWERINGS = 160  # of shrunk values, after which a larger share is tried
_LOST = 1e-3  # share of the greatest value by which one may fall in these
_STEEPER = 10.0 ** np.arange(1, 14, 3)  # prices of failure, by the cost, for one that fails least
_SAME = 1e-13  # of failing or not, the rarer: distance of failures that are one
_DUST_OF_ZERO = 1e-14  # of the greatest: a total below it may be what a solver leaves of nothing
_NEVER = np.inf
_NO_WORK = Work()


@dataclass(frozen=True, eq=False, repr=False)
class OwnDecisions(Policy):
    """A policy of a partitioned model: decisions in a rank's own states."""

    model: Part
    positions: IntArray  # [own states] among the actions, GIVE_UP_CODE or UNDECIDED
    figures: FloatArray  # [rewards] as measured

    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """Refused: a rank has the decisions of its own states alone.

        Raises:
            ModelError: always.
        """
        raise ModelError("decisions lie with the ranks: PartitionedPolicy.on(model) joins them")


class _Equations:
    """Equations ``x = right + rows @ x`` of a policy, solved by all ranks together."""

    def __init__(self, process: PartitionedProcess, choice: IntArray, order: IntArray) -> None:
        """State them; PETSc has the own nodes in an order of sweeps, ends first.

        Args:
            process: of which it is a policy.
            choice: [own nodes].
            order: own nodes in that order.
        """
        halo, dynamics = process.halo, process.dynamics
        n, self._halo, self._order, self.choice = halo.n_own, halo, order, choice
        rows = chosen_rows(dynamics.transitions, choice)
        self.moves = Moves(np.arange(n, dtype=np.int32), rows, dynamics.exits[choice])
        self._kept: list[Any] = []  # objects of PETSc's, which all ranks destroy together
        self.products = 0

    @cached_property
    def graph(self) -> Graph:
        """The policy's steps among known nodes, as a graph."""
        rows, n = self.moves.transitions, self._halo.n_own
        offsets = np.append(np.arange(n + 1), np.full(self._halo.size - n, n))
        return Graph(offsets, rows.indptr.astype(np.int64), rows.indices, rows.data)

    @property
    def closed(self) -> BoolArray:
        """Own nodes from which the policy never leaves, [own nodes]."""
        leaves = np.zeros(self._halo.size, dtype=np.bool_)
        leaves[: self._halo.n_own] = self.moves.exits > 0.0
        return ~self._halo.reaching(self.graph, leaves)[: self._halo.n_own]

    def clear(self) -> None:
        """Destroy PETSc's objects, as all ranks do."""
        for one in self._kept:
            one.destroy()
        self._kept = []
        vars(self).pop("_matrix", None)

    @cached_property
    def _matrix(self) -> tuple[Any, Any, Any]:
        """PETSc's matrix of the equations, and two vectors."""
        halo, order, petsc = self._halo, self._order, self._halo.ranks.petsc
        place = np.empty(halo.n_own)
        place[order] = np.arange(halo.n_own)
        numbers = halo.filled(halo.first + place).astype(petsc.IntType)
        rows, shape = self.moves.transitions, (halo.n_own, halo.n_all)
        step = sp.csr_array((rows.data, numbers[rows.indices], rows.indptr), shape=shape)[order]
        # PETSc keeps the last of duplicates: scipy adds them up
        rows = sp.csr_array(sp.eye(*shape, k=halo.first, format="csr")) - step
        csr = rows.indptr.astype(petsc.IntType), rows.indices.astype(petsc.IntType), rows.data
        size = (halo.n_own, halo.n_all)
        matrix = petsc.Mat().createAIJ(size=(size, size), csr=csr, comm=halo.ranks.comm)
        x, right = matrix.createVecs()
        self._kept += [matrix, x, right]
        return matrix, x, right

    def _solver(self, method: str) -> Any:
        """PETSc's solver of the equations: a Krylov method, or factors of all rows gathered."""
        ksp = self._halo.ranks.petsc.KSP().create(self._halo.ranks.comm)
        ksp.setOperators(self._matrix[0])
        ksp.setType(method)
        direct = "redundant" if self._halo.ranks.comm.size > 1 else "lu"
        ksp.getPC().setType(direct if method == "preonly" else "bjacobi")
        if method != "preonly":
            ksp.setPCSide(self._halo.ranks.petsc.PC.Side.RIGHT)  # so that the true residual is what is told
        ksp.setTolerances(rtol=_FINEST, atol=0.0, max_it=_STEPS)
        ksp.setOptionsPrefix("ssp_lp_")
        ksp.setFromOptions()
        self._kept.append(ksp)
        return ksp

    @cached_property
    def _methods(self) -> tuple[str, ...]:
        """Methods of solution, each where those before it get nowhere."""
        entries = float(self._halo.ranks.total(len(self.moves.transitions.indices)))
        if self._halo.n_all <= DIRECT_STATES:
            return ("preonly",)
        return ("bcgs", "gmres", *(["preonly"] if entries <= _GATHERED else []))

    def solve(self, right: FloatArray, guess: FloatArray, accuracy: float = EXACT) -> FloatArray:
        """Return the solution of the equations to a relative residual; 0 where nothing is paid.

        Args:
            right: [own nodes].
            guess: where to begin, likewise.
            accuracy: greatest residual, relative to the solution, that is enough.

        Raises:
            SolverError: no method comes near to it.
        """
        ranks, x = self._halo.ranks, np.where(np.isfinite(guess), guess, 0.0)
        if not ranks.any(right.any()):
            return np.zeros_like(right)
        missed, residual = self._missed(right, x)
        for method in self._methods:
            if missed <= accuracy:
                break
            solver = self._solver(method)
            for _ in range(_RUNS):
                _, step, left = self._matrix
                left.array = residual[self._order]
                solver.setTolerances(rtol=max(_FINEST, min(0.1 * accuracy / missed, 0.1)))
                solver.solve(left, step)
                self.products += 2 * solver.getIterationNumber()
                better = x.copy()
                better[self._order] += step.array
                before, (now, rest) = missed, self._missed(right, better)
                if not now < before:  # or it broke down, and is no number
                    break
                x, missed, residual = better, now, rest
                if missed <= accuracy or missed > _STUCK * before:
                    break
        if missed > max(accuracy, 1e-9) or ranks.any(not np.isfinite(x).all()):
            raise SolverError("PETSc's solvers do not come near to the totals of a policy")
        dust = _DUST_OF_ZERO * float(ranks.greatest(np.abs(x).max(initial=0.0)))
        if ranks.any(((x != 0.0) & (np.abs(x) <= dust)).any()):
            paid = np.zeros(self._halo.size, dtype=np.bool_)
            paid[: self._halo.n_own] = right != 0.0
            x[~self._halo.reaching(self.graph, paid)[: self._halo.n_own]] = 0.0
        return x

    def runs(self, guess: FloatArray) -> FloatArray:
        """Return run lengths: twice these are at least the expected steps, [own nodes].

        Raises:
            SolverError: some nodes are never left, or no solver comes near.
        """
        ranks, half = self._halo.ranks, np.full(self._halo.n_own, -0.5)
        for accuracy in (RUN_ACCURACY, _FINEST, EXACT):
            runs = self.solve(np.ones_like(half), guess, accuracy)
            ahead = self.moves.safe_advantages(half, self._halo.filled(-runs))
            if not ranks.any((ahead < 0.0).any() or (runs < 0.0).any()):
                return runs
        raise SolverError(HOLDS_MASS)

    def verified(
        self, right: FloatArray, guess: FloatArray, longest: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return a reward's totals as sums of two numbers, to a bounded error, [own nodes] each.

        Args:
            right: the reward of each node's pair, [own nodes].
            guess: about the totals, likewise.
            longest: the greatest run length of all ranks.

        Raises:
            SolverError: no solver comes near enough.
        """
        filled, greatest = self._halo.filled, self._halo.ranks.greatest
        x = self.solve(right, guess)
        low, scale = np.zeros_like(x), float(greatest(np.abs(x).max(initial=0.0)))
        sides = self.moves.advantage_bounds(right, filled(x))
        missed = max(float(greatest(np.abs(side).max(initial=0.0))) for side in sides)
        for _ in range(_CORRECTIONS):
            if 2.0 * longest * missed <= EVALUATED * scale:
                return x, low
            off, rounding = self.moves.precise_advantages(right, filled(x), filled(low))
            missed = float(greatest((np.abs(off) + rounding).max(initial=0.0)))
            if 2.0 * longest * missed > EVALUATED * scale:
                x, low = exact_sum(x, low + self.solve(off, np.zeros_like(x)))
        raise SolverError("the totals of a policy cannot be verified: runs are too long")

    def _missed(self, right: FloatArray, x: FloatArray) -> tuple[float, FloatArray]:
        """Return the residual relative to the greatest size, and the residual, [own nodes]."""
        rows = self.moves.transitions
        residual = right - x + rows @ self._halo.filled(x)
        sizes = [np.abs(part).max(initial=0.0) for part in (residual, x, right)]
        missed, *scale = self._halo.ranks.greatest(sizes).tolist()
        return missed / max(*scale, 1e-300), residual


@dataclass(frozen=True, eq=False)
class PartitionedProcess(PricingProblem):
    """The process of case M on the rows of all ranks; what it is made of here are a rank's own."""

    labelled: FailureLabelled
    halo: Halo  # over the nodes of the process
    rewards: FloatArray  # [own pairs, rewards] cost, failure, rows
    at_once: FloatArray  # [rewards] of what begins in goals and dead-ends
    start: FloatArray  # [own nodes]
    by_goal: bool = False
    asks_for_ends: bool = False  # whether ends other than the goal count, or nobody may give up
    stays: IntArray | None = None  # [own states] a pair that stays where staying is free, or -1
    ends_at: float = _NEVER  # on the clock of the first rank
    kept: Callable[[Any, FloatArray, Column], None] | None = None  # told of each found column
    earlier: list[Column] = field(default_factory=list)  # columns of an earlier run

    @property
    def ranks(self) -> Ranks:
        """The ranks that share the process."""
        return self.halo.ranks

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the known nodes; ghosts have no pairs."""
        return self.labelled.process.dynamics

    @property
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and rows."""
        return self.rewards.shape[1]

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[own nodes]: a rank has the values of its own nodes."""
        return (self.halo.n_own,)

    @cached_property
    def graph(self) -> Graph:
        """The known nodes and the own pairs, as a graph."""
        rows, offsets = self.dynamics.transitions, self.dynamics.pair_offsets
        both = offsets.astype(np.int64), rows.indptr.astype(np.int64)
        return Graph(*both, rows.indices, rows.data)

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy that leaves from every node, towards the goal first, [own nodes]."""
        nearer = self.halo.approaching(self.graph, self.labelled.process.goal > 0.0)
        if self.ranks.any((nearer < 0).any()):
            leaving = self.halo.approaching(self.graph, self.dynamics.exits > 0.0)
            nearer = np.where(nearer >= 0, nearer, leaving)
        return nearer

    def first(self) -> Column:
        """The column of a policy that goes for the goal."""
        return self._first

    @cached_property
    def _first(self) -> Column:
        """The column of the leaving policy."""
        return self.measured(self._leaving)

    def incumbent(self, reached: Any) -> Column | None:
        """The column of the policy that policy iteration had come to when the time ended."""
        if reached is None:
            return None
        equations = self._leaving_equations(reached, np.zeros(self.halo.n_own))
        return self._measured(equations, np.zeros((self.halo.n_own, self.n_rewards + 1)))

    def check_time(self, reached: IntArray | None = None) -> None:
        """Raise Stop on all ranks when the time is over by the clock of the first.

        Raises:
            Stop: with the policy so far, [own nodes].
        """
        if self.ends_at < _NEVER and self.ranks.any(
            self.ranks.comm.rank == 0 and time.perf_counter() > self.ends_at
        ):
            raise Stop(reached)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """A column of least priced cost by policy iteration, measured with a bound of its error.

        Raises:
            Stop: the time ended, with the policy so far.
        """
        weights = self._weights(price)
        known = [column for column in (*warm, *self.earlier) if column is not None]
        known = [one for one in known if one.totals is not None and one.by_goal == self.by_goal]
        known.sort(key=lambda column: float(weights @ column.figures))
        cost, sizes = weighted(self.rewards, weights), np.abs(weights)
        noise = 0.0
        if known and (known[0].figures * weights < 0.0).any():  # earnings cancel costs
            noise = 4.0 * MACHINE_EPSILON * float(np.abs(known[0].figures) @ sizes)
        choice, totals = self._begun(weights, known[:2])
        values, work = weighted(totals[:, :-1], weights), Work()
        for _ in range(_MOST_ROUNDS):
            self.check_time(choice)
            choice = self._swept(cost, choice, values, noise)
            equations = self._leaving_equations(choice, values)
            choice, values = equations.choice, equations.solve(cost[equations.choice], values)
            backup = self._backup(cost, values, choice)
            better = backup.here - backup.minima > IMPROVEMENT * np.abs(backup.here) + noise
            work += Work(1 + _SWEEPS, equations.products)
            if not self.ranks.any(better.any()):
                break
            equations.clear()
            choice = np.where(better, backup.choice, choice).astype(np.int32)
        totals[:, 0] = np.where(weights[0] > 0.0, values - totals[:, 1:-1] @ weights[1:], 0.0)
        choice = self._giving_up(equations)  # what costs nothing at these weights may cost a limit
        if self.ranks.any((choice != equations.choice).any()):
            equations.clear()
            equations = self._leaving_equations(choice, values)
        column = self._measured(equations, totals, work)
        if self.kept is not None:
            self.kept(self, weights, column)
        return column

    def _weights(self, price: float | FloatArray) -> FloatArray:
        """Weights of all rewards at a price of failure, or at weights."""
        weights = pricing_weights(price)
        return np.append(weights, np.zeros(self.n_rewards - len(weights)))

    def _begun(
        self, weights: FloatArray, known: list[Column]
    ) -> tuple[IntArray, FloatArray]:
        """A policy to begin with, and about its totals, [own nodes, rewards and steps].

        In each node that of the known columns which is worth less from there.
        """
        if not known:
            first = self._first
            return required(first.choice).copy(), required(first.totals).copy()
        columns = [*known, self._first]
        totals = np.stack([required(column.totals) for column in columns])
        values = np.stack([weighted(part[:, :-1], weights) for part in totals])
        best = np.argmin(values, axis=0)
        nodes = np.arange(self.halo.n_own)
        choices = np.stack([required(column.choice) for column in columns])
        return choices[best, nodes], totals[best, nodes]

    def _swept(
        self, cost: FloatArray, choice: IntArray, values: FloatArray, noise: float
    ) -> IntArray:
        """Improve a policy by sweeps of each rank over its own nodes, and its values in place.

        Args:
            cost: [own pairs].
            choice: [own nodes].
            values: of no better policy, [own nodes].
            noise: gain that is none.
        """
        n, entries = self.halo.n_own, len(self.dynamics.transitions.indices)
        if self.ranks.any(not accelerated(entries, "policy_improvement.improve_states")):
            return choice  # there are other rounds
        at_once, changed = _SWEEPS if self.ranks.comm.size == 1 else _EXCHANGED, [0.0]
        full, known = np.zeros(self.halo.size, dtype=np.int32), self.halo.filled(values)
        full[:n] = choice
        for _ in range(_SWEEPS // at_once):
            before = full.copy()
            self.dynamics.improve_by_sweeps(
                cost, full, known, noise, at_once, is_sorted_anew=True, states=np.arange(n)
            )
            known = self.halo.filled(known)
            changed.append(float(self.ranks.total(np.count_nonzero(full != before))))
            if changed[-1] <= SETTLED * max(changed):
                break
        values[:] = known[:n]
        return full[:n]

    def _leaving_equations(self, choice: IntArray, values: FloatArray) -> _Equations:
        """The equations of a policy; nodes that it never leaves take the pairs of one that does.

        Args:
            choice: [own nodes].
            values: about its values, small ones near the ends, [own nodes].
        """
        order = np.argsort(values, kind="stable").astype(np.int32)
        equations = _Equations(self, choice, order)
        if not self.ranks.any((closed := equations.closed).any()):
            return equations
        return _Equations(self, np.where(closed, self._leaving, choice).astype(np.int32), order)

    def _backup(self, cost: FloatArray, values: FloatArray, held: IntArray) -> Backup:
        """Bellman backup of the own nodes."""
        known, n = self.halo.filled(values), self.halo.n_own
        if n == 0:
            return Backup(np.zeros(0), np.zeros(0, dtype=np.int32), np.zeros(0))
        offsets = self.dynamics.pair_offsets[: n + 1]
        return best_pairs(offsets, self.dynamics.transitions, cost, known, held)

    def measured(self, choice: IntArray) -> Column:
        """The column of a policy, [own nodes]: its totals with a bound of their error.

        Raises:
            SolverError: it never leaves some nodes, or no solver comes near to its totals.
        """
        guess = np.zeros((self.halo.n_own, self.n_rewards + 1))
        order = np.arange(self.halo.n_own, dtype=np.int32)
        return self._measured(_Equations(self, choice, order), guess)

    def _measured(
        self, equations: _Equations, guess: FloatArray, work: Work = _NO_WORK
    ) -> Column:
        """The column of the policy whose equations are stated.

        Args:
            equations: of the policy.
            guess: about its totals, [own nodes, rewards and steps].
            work: what finding it took.
        """
        choice, totals, ranks = equations.choice, np.empty_like(guess), self.ranks
        totals[:, -1] = runs = equations.runs(guess[:, -1])
        longest = float(ranks.greatest(runs.max(initial=0.0)))
        figures = np.empty(self.n_rewards)
        for k in range(self.n_rewards):
            right = np.ascontiguousarray(self.rewards[choice, k])
            x, low = equations.verified(right, guess[:, k], longest)
            figures[k] = ranks.total(self.start @ x + self.start @ low)
            totals[:, k] = x
        equations.clear()
        work += Work(1, equations.products)
        return Column.of_figures(
            figures + self.at_once, choice, by_goal=self.by_goal, totals=totals, work=work
        )

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Lower bound of every column's priced value, by the values of a best policy."""
        column = best if best.totals is not None else self.minimise(price, best)
        totals = required(column.totals)[:, :-1]
        return self.check(price, weighted(totals, self._weights(price)))

    def prove_afresh(self, weights: FloatArray, warm: Column) -> Proof:
        """Best lower bound at weights that nothing has been priced at yet, while there is time."""
        try:
            warm = self.minimise(weights, warm)
        except Stop:
            pass
        return self.prove(weights, warm)

    def check(
        self, price: float | FloatArray, values: FloatArray, *, slack: bool = False
    ) -> Proof:
        """Lower values to a checked sub-solution; each rank has those of its own nodes.

        Raises:
            ModelError: values of another shape.
        """
        self.check_shape(values)
        weights = self._weights(price)
        values = self._lowered(weights, values)
        parts, begun = self.start * values, weights * self.at_once
        total, size, terms = self.ranks.total([parts.sum(), np.abs(parts).sum(), len(parts)])
        rounding = (terms + 2.0) * size + (len(begun) + 2.0) * (size + np.abs(begun).sum())
        bound = float(total + begun.sum() - MACHINE_EPSILON * rounding)
        failing = 0.0 if self.by_goal else float(weights[1])
        return Proof(float(weights[1]), failing, bound, values)

    def _lowered(self, weights: FloatArray, values: FloatArray) -> FloatArray:
        """Values lowered to a sub-solution that a backup of all rows confirms, [own nodes].

        They are moved towards a constant that is one by a share, the least that will do: a step
        that costs has that share of its cost to spare then. Where nothing is paid values are
        lowered to those ahead. All go down a little besides, so that what is free is not left with
        the dust of its equations, of which such sweeps take a part at a time without end.
        """
        halo, dynamics, greatest = self.halo, self.dynamics, self.ranks.greatest
        cost = weighted(self.rewards, weights)
        size = weighted(np.abs(self.rewards), np.abs(weights))
        cost -= weighted_rounding(self.rewards, weights) * size  # a bound rounds down
        leaves = dynamics.exits > 0.0
        constant = -float(greatest(-(cost[leaves] / dynamics.exits[leaves]).min(initial=np.inf)))
        constant -= 4.0 * MACHINE_EPSILON * abs(constant)
        if self.ranks.any((cost[~leaves] < 0.0).any()):
            raise SolverError("a step that does not end gains something: nothing bounds its total")
        floor = constant if np.isfinite(constant) else 0.0
        values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
        most = float(greatest(np.abs(values).max(initial=0.0)))
        values = self._levelled((size == 0.0) & ~leaves, values, _LEVEL * most)
        for share in _SHRUNK:
            lowered = floor + (1.0 - share) * (values - floor) - share * _DUST * most
            lowered = np.maximum(lowered, floor)
            least = lowered - _LOST * most
            for _ in range(_LOWERINGS if share else 1 + len(_SHRUNK)):
                lack = shortfall(dynamics, cost, halo.filled(lowered))[: halo.n_own]
                if not self.ranks.any(lack.any()):
                    return lowered
                below = np.minimum(lowered - lack, np.nextafter(lowered, -np.inf))
                lowered = np.maximum(np.where(lack > 0.0, below, lowered), floor)
                if self.ranks.any((lowered < least).any()):
                    break
        return np.full_like(values, floor)

    def _levelled(self, free: BoolArray, values: FloatArray, dust: float) -> FloatArray:
        """Values made equal, the least of all, where free steps lead among equal ones but for dust.

        Among such states no value may exceed another one: sweeps would lower them without end.

        Args:
            free: pairs that cost nothing and end nowhere, [own pairs].
            values: [own nodes].
            dust: difference that is none.
        """
        if not self.ranks.any(free.any()):
            return values
        rows, home = sp.csr_array(self.dynamics.transitions[free]), self.dynamics.pair_state[free]
        known = self.halo.filled(values)
        while True:
            ahead, lowered = known[rows.indices], known.copy()
            if ahead.size:
                least, most = (f.reduceat(ahead, rows.indptr[:-1]) for f in (np.minimum, np.maximum))
                level = np.maximum(most, known[home]) - np.minimum(least, known[home]) <= dust
                np.minimum.at(lowered, home[level], least[level])
            lowered = self.halo.filled(lowered)
            if not self.ranks.any((lowered != known).any()):
                return lowered[: self.halo.n_own]
            known = lowered

    def pulled_back(self, column: Column) -> Policy:
        """The decisions that a column takes in the rank's own states of the model."""
        model, quotient = self.labelled.quotient.model, self.labelled.quotient
        own = slice(0, int(model.own.sum()))
        node, positions = quotient.node_of[own], np.full(own.stop, UNDECIDED, dtype=np.int32)
        live = node >= 0
        pair = quotient.pair_at[required(column.choice)[node[live]]]
        if self.stays is not None:  # to stay where that is free needs no leave to give up
            stays = self.stays[live]
            pair = np.where((pair == GIVE_UP_CODE) & (stays >= 0), stays, pair)
        first = model.pair_offsets[:-1][own][live]
        positions[live] = np.where(pair < 0, pair, pair - first)
        return OwnDecisions(model, positions, column.figures)

    @cached_property
    def _exits(self) -> IntArray:
        """The pair of each own node that gives up; -1: nobody may there, [own nodes]."""
        quotient, n = self.labelled.quotient, self.halo.n_own
        first = quotient.pair_offsets[:n]
        return np.where(quotient.gives_up[first], first, -1) if n else np.zeros(0, dtype=np.int32)

    def _giving_up(self, equations: _Equations) -> IntArray:
        """A policy that gives up where it has failed, [own nodes].

        It has failed where it cannot come to the goal any more by its own steps, if it may give up
        there; where ends are asked for, or nobody may give up, only where it stays for ever and
        nothing is counted.
        """
        choice, process = equations.choice, self.labelled.process
        leads = np.zeros(self.halo.size, dtype=np.bool_)
        leads[: self.halo.n_own] = process.goal[choice] > 0.0
        if self.asks_for_ends:
            paid = (self.rewards[choice] != 0.0).any(axis=1)
            leads[: self.halo.n_own] = paid | (self.dynamics.exits[choice] > 0.0)
        lost = ~self.halo.reaching(equations.graph, leads)[: self.halo.n_own]
        return np.where(lost & (self._exits >= 0), self._exits, choice).astype(np.int32)

    def completed(self, decision: IntArray) -> IntArray:
        """The choice of a policy's decisions, which gives up where it has failed, [own nodes].

        Args:
            decision: pair of the part or a code, [own states].

        Raises:
            ModelError: there is no decision in a state that is reached, giving up is not allowed
                there, or the policy stays where that costs something.
        """
        quotient, n = self.labelled.quotient, self.halo.n_own
        live = quotient.node_of[: len(decision)] >= 0
        exits, taken = self._exits, decision[live]
        choice = np.where(taken >= 0, quotient.places[np.maximum(taken, 0)], -1)
        choice = np.where(taken == GIVE_UP_CODE, exits, choice).astype(np.int32)
        names = quotient.model.states
        places = np.flatnonzero(live)
        order = np.arange(n, dtype=np.int32)

        def refuse(nodes: BoolArray, words: str) -> IntArray:
            """Take pairs of the leaving policy in nodes, which must not be reached."""
            filled = np.where(nodes, self._leaving, choice).astype(np.int32)
            graph, ends = _Equations(self, filled, order).graph, np.zeros(self.halo.size, np.bool_)
            ends[:n] = nodes
            if self.ranks.any(ends.any()):
                reached = self.halo.reaching(graph, ends)[:n] & (self.start > 0.0)
                named = [repr(names[places[k]]) for k in np.flatnonzero(nodes)[:1]]
                named = [name for some in self.ranks.comm.allgather(named) for name in some]
                if self.ranks.any(reached.any()):
                    raise ModelError(f"the policy {words} in state {named[0]}, or another one that "
                                     "it reaches")  # fmt: skip
            return filled

        choice = refuse(choice < 0, "has no decision, or gives up where it may not,")
        choice = self._giving_up(_Equations(self, choice, order))
        closed = _Equations(self, choice, order).closed
        return refuse(closed, "stays for ever where that is no giving up")


def partitioned_process(compiled: CompiledExplicit, **more: Any) -> PartitionedProcess:
    """State the process of a compiled problem of case M on a part of its model.

    Where one may stay for ever at no cost anyone may give up: nothing is collapsed there. All ranks
    make theirs together.

    Args:
        compiled: the problem.
        more: fields of the process.
    """
    part: Any = compiled.model
    semantics, discount, own = compiled.semantics, compiled.discount, part.own
    exits, free = giving_up_states(part, semantics.give_up), np.zeros(part.n_states, dtype=np.bool_)
    stays = None
    if discount is None:
        pairs = free_pairs(part, semantics.aim, compiled.side, compiled.objective)
        graph, acting = part.graph, np.diff(part.pair_offsets) > 0
        ended = part.goal_mask | part.facts["hopeless_states"] | ~acting
        free = part.halo.staying(graph, pairs, ended)
        staying = np.flatnonzero(pairs & free[part.pair_state] & ~pairs_into(graph, ~free))
        stays = np.full(part.n_states, -1)
        stays[part.pair_state[staying[::-1]]] = staying[::-1]
        stays = np.where(exits, -1, stays)[own]
    quotient = build_quotient(part, exits=(exits | free) & own)
    quotient = replace(quotient, merged=free)
    start = np.where(own, compiled.start, 0.0)
    begun = np.where(quotient.node_of >= 0, start, 0.0)
    labelled = label_failure(part, begun, semantics, discount, quotient=quotient)
    counting = counting_of(labelled, start, semantics, discount)
    cost, entering = labelled.own_cost, counting.cost(part)[1]
    dead, goal = (float(start[mask].sum()) for mask in (quotient.dead, part.goal_mask))
    aims = {Aim.GREATEST_GOAL: dead, Aim.LEAST_GOAL: goal}
    at_once = [aims.get(semantics.aim, entering + semantics.penalty * dead), dead]
    ending = labelled.process.failure
    if compiled.by_goal:
        ending, at_once[1] = -labelled.process.goal, -goal
        if semantics.aim is Aim.GREATEST_GOAL:
            cost, at_once[0] = -labelled.process.goal, -goal
    rows = [row.at(counting) for row in compiled.side]
    if compiled.objective is not None:
        cost, at_once[0] = compiled.objective.at(counting)
    live = quotient.node_of >= 0
    places = np.flatnonzero(live)
    n_own = int(np.count_nonzero(live & own))
    halo = _halo_of_nodes(part.halo, live, n_own, places)
    return PartitionedProcess(
        labelled,
        halo,
        np.stack([cost, ending, *(row for row, _ in rows)], axis=1),
        part.halo.ranks.total([*at_once, *(there for _, there in rows)]),
        labelled.process.start[:n_own],
        compiled.by_goal,
        compiled.wants_ends or semantics.give_up is GiveUp.DEAD_ENDS,
        stays,
        **more,
    )


def _halo_of_nodes(states: Halo, live: BoolArray, n_own: int, places: IntArray) -> Halo:
    """The halo of the live states of a part."""
    first = int(np.sum(states.ranks.comm.allgather(n_own)[: states.ranks.comm.rank]))
    numbers = np.zeros(len(live))
    numbers[places[:n_own]] = first + np.arange(n_own)
    numbers = states.filled(numbers).astype(np.int64)
    return Halo(states.ranks, n_own, numbers[places[n_own:]])


@dataclass(frozen=True, eq=False)
class CompiledPartitioned(CompiledExplicit):
    """Case M compiled on parts of a model."""

    more: dict[str, Any] = field(kw_only=True, default_factory=dict)  # fields of the process

    is_whole = False  # another question is labelled in place of this one

    def pricing(self) -> PartitionedProcess:  # type: ignore[override]
        """The pricing problem, with a price for each row."""
        return self._priced

    @cached_property
    def _priced(self) -> PartitionedProcess:
        """The process, stated once."""
        return partitioned_process(self, **self.more)

    def least_failure(self) -> LeastFailure:
        """The cheapest of the policies that fail least, by a price of failure at which it does.

        What attains the least of ``cost + price * failure`` and fails least is the cheapest of all
        that do. Where no price is steep enough: one that fails least, whatever it costs.
        """
        pricing = self.pricing()
        cost, failure = np.eye(2, pricing.n_rewards)
        safest = pricing.minimise(failure)
        least = safest.failure + _SAME * max(min(safest.failure, 1.0 - safest.failure), 0.0)
        proved, column = pricing.prove(failure, safest).bound, safest
        proved = min(max(proved + float(self.by_goal), 0.0), safest.failure)
        for steep in _STEEPER:
            cheaper = pricing.minimise(cost + steep * max(safest.cost, 1.0) * failure, column)
            if cheaper.failure <= least:
                column = cheaper
                break
        return LeastFailure(pricing.policy(column), column, 0.0, proved)

    def failure_at_least(self, discount: float | None) -> float:
        """The least failure of all policies, for an error."""
        if discount == self.discount:
            return self.least_failure().column.failure
        other = CompiledPartitioned(self.model, self.start, self.semantics, discount)
        return other.least_failure().column.failure

    def settled(self, *known: Column) -> CompiledPartitioned:
        """The compiled problem with the least failure as its budget, where that is no less.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding.
        """
        if self.budget is None or not self.limits_failure:
            return self
        least = self.least.column.failure
        return self if self.budget > least else replace(self, budget=least)

    def refined(self, price: float) -> None:
        """Nothing: the process truncates nothing, and is evaluated as finely as it can be."""
        return
