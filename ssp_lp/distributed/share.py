"""A rank's rows of a process: what it does to them when the first rank of PETSc says so.

A rank has the rows of a range of states in a row, and numbers its pairs from 0. Of the other states
it knows those that its rows lead to, the ghosts, behind its own: their values come from their
owners (``halo``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    segment_sums,
    weighted,
    weighted_rounding,
)
from ssp_lp.distributed.equations import Improved, OwnEquations
from ssp_lp.distributed.graph_sweeps import approaching
from ssp_lp.distributed.halo import Halo
from ssp_lp.dynamic_programming.bellman import Backup, best_pairs, chosen_rows
from ssp_lp.dynamic_programming.dual_bound import shortfall
from ssp_lp.dynamic_programming.dynamics import SETTLED, Dynamics
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import Graph, nearer_pairs
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.failure_label import FailureLabelled

_EXCHANGED = 4  # sweeps of own states between two exchanges of values


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
        """Take the rows; all ranks of PETSc do so together.

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
        self._comm, self._petsc, self.rewards = comm, petsc, rewards
        rows, bounds = dynamics.transitions, np.array([0, *comm.allgather(end)])
        self.halo = Halo(comm, bounds, rows.indices)
        n, size = self.halo.n_own, self.halo.size
        shape, places = (rows.shape[0], size), self.halo.places(rows.indices)
        offsets = np.full(size + 1, len(rewards), dtype=dynamics.pair_offsets.dtype)
        offsets[: n + 1] = dynamics.pair_offsets[first : end + 1]
        own = sp.csr_array((rows.data, places, rows.indptr), shape=shape)
        self.dynamics = Dynamics(offsets, own, dynamics.exits)
        self._states = np.arange(n, dtype=np.int32)
        self._labelled, self._anew = labelled, anew
        self._equations: OwnEquations | None = None

    def sizes(self) -> tuple[int, int, int]:
        """End of the own states, own pairs, and entries of their rows."""
        return self.halo.end, len(self.rewards), self.dynamics.n_entries

    def labelled_anew(self, discount: float | None) -> Share:
        """The rows of the same question with another discount.

        Raises:
            SolverError: the rank was handed its rows.
        """
        if self._anew is None:
            raise SolverError("rows that were handed out cannot be made anew")
        return self._anew(discount)

    def back_up(self, weights: FloatArray, held: IntArray, values: FloatArray) -> Backup:
        """Bellman backup of the own states; pairs are counted from the first of this rank's.

        Args:
            weights: [rewards].
            held: a pair of each own state, [own states].
            values: [own states].
        """
        values = self.halo.filled(values)
        if not self._states.size:
            return Backup(np.zeros(0), np.zeros(0, dtype=np.int32), np.zeros(0))
        offsets = self.dynamics.pair_offsets[: self.halo.n_own + 1]
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
        both, n = (self.halo.filled(part) for part in (values, low)), self.halo.n_own
        gain, picks = self.dynamics.precise_gains(self._cost(weights), *both)
        return gain[:n], picks[:n]

    def improve_by_sweeps(
        self, weights: FloatArray, rest: tuple[Any, ...], choice: IntArray, values: FloatArray
    ) -> tuple[IntArray, FloatArray, int]:
        """Improve a policy by sweeps of each rank over its own states, with exchanges between.

        Args:
            weights: [rewards].
            rest: floor, sweeps at most, and whether to sort anew, as of ``Dynamics``.
            choice: [own states].
            values: [own states].

        Returns:
            The policy and the values, [own states] each, and the sweeps.
        """
        floor, most, anew = rest
        at_once = most if self._comm.size == 1 else min(most, _EXCHANGED)
        n, cost, changed, sweeps = self.halo.n_own, self._cost(weights), list[int](), 0
        full, values = np.zeros(self.halo.size, dtype=np.int32), self.halo.filled(values)
        full[:n] = choice
        for _ in range(-(-most // at_once)):  # as often on every rank
            before = full.copy()
            sweeps += self.dynamics.improve_by_sweeps(
                cost, full, values, floor, at_once, is_sorted_anew=anew, states=self._states
            )
            self.halo.fill(values)
            changed.append(self._comm.allreduce(int(np.count_nonzero(full != before))))
            if changed[-1] <= SETTLED * max(changed):
                break
        return full[:n], values[:n], sweeps

    def lowered(
        self, weights: FloatArray, floor: float, sweeps: int, values: FloatArray
    ) -> tuple[FloatArray, bool]:
        """Own values lowered by what they exceed their backups by, sweep by sweep.

        Args:
            weights: of the rewards, >= 0, [rewards].
            floor: a constant below which none is lowered.
            sweeps: number of them; the ghosts' values stay.
            values: [own states].

        Returns:
            Own values, [own states], and whether one of them was lowered.
        """
        cost, values, n = self._cost_below(weights), self.halo.filled(values), self.halo.n_own
        for sweep in range(sweeps):
            lack = shortfall(self.dynamics, cost, values)[:n]
            if not lack.any():
                return values[:n], sweep > 0
            below = np.minimum(values[:n] - lack, np.nextafter(values[:n], -np.inf))
            below = np.where(lack > 0.0, below, values[:n])
            values[:n] = np.maximum(below, floor)
        return values[:n], True

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
        nearer = self._approaching(self._known.process.goal > 0.0)
        if self._comm.allreduce(bool((nearer < 0).any())):
            nearer = np.where(nearer >= 0, nearer, self._approaching(self.dynamics.exits > 0.0))
        return nearer.astype(np.int32)

    def positions(self, choice: IntArray) -> IntArray:
        """Positions of the actions that a choice stands for in the own states of the model.

        Args:
            choice: [own states of the process], pairs counted from the first of this rank's.

        Returns:
            Positions among the state's actions, or codes, [own states of the model].

        Raises:
            SolverError: the rank was handed its rows.
        """
        quotient, (first, end) = self._known.quotient, (self.halo.first, self.halo.end)
        model: Any = quotient.model  # a slab
        full = np.zeros(max(quotient.n_nodes, end), dtype=np.int32)
        full[first:end] = choice
        decision = np.full(model.n_states, UNDECIDED, dtype=np.int32)
        live = (quotient.node_of >= first) & (quotient.node_of < end)
        pairs = quotient.pair_at[full[quotient.node_of[live]]]
        decision[live] = np.where(pairs < 0, pairs, pairs - model.pair_offsets[:-1][live])
        own: IntArray = decision[model.own]
        return own

    def clear(self) -> None:
        """Let go of PETSc's objects, as all ranks do."""
        if self._equations is not None:
            self._equations.clear()
        self._equations = None

    def choose(self, choice: IntArray) -> int:
        """Set up the equations of a policy.

        Args:
            choice: pair of each own state, counted from the first of this rank's.

        Returns:
            Entries of the own rows.
        """
        self.clear()
        chain, exits = chosen_rows(self.dynamics.transitions, choice), self.dynamics.exits[choice]
        own = chain, exits, self._order
        self._equations = OwnEquations(self._comm, self._petsc, self.halo, *own)
        return len(chain.indices)

    def advantages(self, kind: str, cost: FloatArray, *vectors: FloatArray) -> Any:
        """Advantages of the own rows of the equations that are set up, of a kind of ``Moves``'s.

        Args:
            kind: the method's name.
            cost: [own states].
            vectors: its other arguments, [own states] each.
        """
        ask = getattr(self._stated.moves, kind)
        return ask(cost, *(self.halo.filled(vector) for vector in vectors))

    def closed(self) -> IntArray:
        """Own states from which the policy of the equations never leaves, [some states]."""
        return self._stated.closed()

    def policy_rows(self) -> tuple[sp.csr_array, FloatArray]:
        """Own rows of the policy of the equations, [own states, all states], and its exits."""
        _, chain, exits = self._stated.moves
        shape = self.halo.n_own, self._comm.allreduce(self.halo.n_own)
        parts = chain.data, self.halo.numbers[chain.indices], chain.indptr
        rows = sp.csr_array(parts, shape=shape, copy=True)  # summed up in place
        rows.sum_duplicates()
        return rows, exits

    def improve(
        self, method: str, accuracy: float, right: FloatArray, guess: FloatArray
    ) -> Improved:
        """Improve solutions of the equations that are set up: see ``OwnEquations``."""
        return self._stated.improve(method, accuracy, right, guess)

    @property
    def _stated(self) -> OwnEquations:
        """The equations that are set up.

        Raises:
            SolverError: there are none.
        """
        if self._equations is None:
            raise SolverError("no equations are set up on the ranks of PETSc")
        return self._equations

    @cached_property
    def _order(self) -> IntArray:
        """Own states in the order of sweeps: nearer to an end, or to another rank, first."""
        rows, n = self.dynamics.transitions, self.halo.n_own
        onward = segment_sums((rows.indices >= n).astype(np.float64), rows.indptr)
        distance = np.zeros(self.halo.size, dtype=np.int32)
        nearer_pairs(self._graph, (self.dynamics.exits > 0.0) | (onward > 0.0), distance=distance)
        return np.argsort(distance[:n], kind="stable").astype(np.int32)

    @property
    def _graph(self) -> Graph:
        """Graph of the states that this rank knows, and the own pairs, made for one search."""
        rows, offsets = self.dynamics.transitions, self.dynamics.pair_offsets
        both = offsets.astype(np.int64), rows.indptr.astype(np.int64)
        return Graph(*both, rows.indices, rows.data)

    def _approaching(self, leaving: BoolArray) -> IntArray:
        """Pairs by which own states come nearer to leaving pairs of any rank, [own states].

        Args:
            leaving: [own pairs].
        """
        n, halo = self.halo.n_own, self.halo
        found = approaching(self._comm, lambda mask: halo.filled(mask[:n]), self._graph, leaving)
        return found[:n]

    def _cost(self, weights: FloatArray) -> FloatArray:
        """Cost of each own pair, [own pairs]."""
        return weighted(self.rewards, weights)

    def _cost_below(self, weights: FloatArray) -> FloatArray:
        """Cost of each own pair for a bound, which rounds down, [own pairs]."""
        cost = self._cost(weights)
        cost -= weighted_rounding(self.rewards, weights) * np.abs(cost)
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
