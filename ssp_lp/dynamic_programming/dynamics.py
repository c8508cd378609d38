"""Dynamics of substochastic processes: transitions, exits and their graph, without costs.

The module also finds policies that leave a process, since only these have finite totals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    IMPROVEMENT,
    FloatArray,
    IntArray,
    concatenated_ranges,
    offsets_of,
    segment_ids,
    sorted_unique,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import pieces
from ssp_lp.dynamic_programming.bellman import Moves, chosen_rows
from ssp_lp.dynamic_programming.chain_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.equations import (
    BY_HEIGHT,
    COMPONENTS,
    DIRECT_STATES,
    EXACTLY_SOLVED,
    StrongComponents,
    System,
    strong_components,
)
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import Graph, nearer_pairs

_KEPT_CHAINS = 4
"""Number of policies whose equations are kept, since layers of accumulated cost reuse a few."""

_KEPT_STATES = 100_000  # most states of equations that are kept
SETTLED = 0.1  # share of the first sweep's changes below which sweeping stops
_BACKWARDS = (
    "policy_improvement.improve_components",
    "policy_improvement.improve_acyclic",
    "equations.evaluate_precisely",
    *COMPONENTS,
    *BY_HEIGHT,
)
_LAYERS = 500  # number of passes over a process that is one layer of many
_SMALL = 48
"""Most states of a component that is solved separately, by dense state reduction."""


Level = tuple[IntArray, IntArray, IntArray, sp.csr_array, FloatArray]
"""States that lead to earlier levels only, [some states]; their pairs, [some pairs]; the offsets of
each state's pairs among these; their rows, [some pairs, states], without self-loops; and the
probability of departing, 0 if a pair only waits, [some pairs]."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Pairs of each state, their transitions, and their probabilities of leaving for good.

    The exits (probabilities of leaving) are stored, since a tiny exit that is computed as ``1 -
    sum`` would be lost to rounding. Transitions and exits are taken as exact, even if they do not
    sum to 1 because of rounding.
    """

    pair_offsets: IntArray  # [states + 1]
    transitions: sp.csr_array  # [pairs, states]
    exits: FloatArray  # [pairs]
    is_reused: bool = False  # whether it is solved many times, as a layer of accumulated cost

    @cached_property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.pair_offsets) - 1

    @cached_property
    def pair_state(self) -> IntArray:
        """State of each pair, [pairs]."""
        return segment_ids(self.pair_offsets)

    @property
    def n_entries(self) -> int:
        """Number of entries of the transitions."""
        return len(self.transitions.indices)

    @cached_property
    def components(self) -> StrongComponents:
        """Strong components of the graph of all pairs, ends first; computed once."""
        rows = self.transitions
        entries = rows.indptr[self.pair_offsets], rows.indices, rows.data
        return strong_components(*entries, by_height=True)

    @cached_property
    def graph(self) -> Graph:
        """The graph of pairs and successors, in the number types of a model's graph."""
        rows = self.transitions
        offsets = self.pair_offsets.astype(np.int64), rows.indptr.astype(np.int64)
        return Graph(*offsets, rows.indices, rows.data)

    @property
    def moves(self) -> Moves:
        """The pairs with their states, rows and exits, to compute advantages."""
        return Moves(self.pair_state, self.transitions, self.exits)

    @cached_property
    def rows(self) -> tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray]:
        """The arrays in the types of compiled loops.

        All integer arrays have 32 bits or, if that does not suffice, 64 bits: numba 0.60 confuses
        tuples of arrays with different integer types.
        """
        rows, most = self.transitions, np.iinfo(np.int32).max
        integer = np.dtype(np.int32 if len(rows.indices) <= most else np.int64)
        offsets, indptr, indices = (
            unsigned(part.astype(integer, copy=False))
            for part in (self.pair_offsets, rows.indptr, rows.indices)
        )
        return offsets, indptr, indices, rows.data, self.exits

    @property
    def is_compiled_backwards(self) -> bool:
        """Whether a backward pass is long enough to run compiled.

        If the process is reused, the passes of many layers count together.
        """
        passes = _LAYERS if self.is_reused else 1
        return accelerated(passes * len(self.transitions.indices), *_BACKWARDS)

    @property
    def is_solved_backwards(self) -> bool:
        """Whether all components are small enough to be solved once, in one backward pass."""
        few = self.n_states <= DIRECT_STATES
        if self.is_compiled_backwards:
            return self.components.largest <= (EXACTLY_SOLVED if few else _SMALL)
        if few and not self.is_reused:
            return False  # analysing the structure would take longer than it saves
        return self.components.largest <= 1

    @cached_property
    def levels(self) -> list[Level]:
        """States by their greatest distance from an end, for dynamics without cycles."""
        return list(_levels_of_dynamics(self))

    def improve_by_sweeps(
        self,
        pair_cost: FloatArray,
        choice: IntArray,
        values: FloatArray,
        floor: float,
        most_sweeps: int,
        *,
        is_sorted_anew: bool,
        states: IntArray | None = None,
    ) -> int:
        """Improve a policy by sweeps, in place, while many states change.

        Args:
            pair_cost: [pairs].
            choice: [states].
            values: values that are at least the policy's, [states].
            floor: greatest gain of a step that counts as 0.
            most_sweeps: number of sweeps at most.
            is_sorted_anew: whether to sort the states by their values before every second sweep.
            states: states to sweep; None: all.

        Returns:
            The number of backups of all states.
        """
        from ssp_lp.compiled.policy_improvement import improve_states

        order = np.arange(self.n_states) if states is None else states
        order, most = order.astype(np.uint32), 0
        for sweep in range(1, most_sweeps + 1):
            if sweep == 1 or (is_sorted_anew and sweep % 2):
                # small values first: changes spread from the ends, then towards them
                order = order[np.argsort(values[order], kind="stable")]
            direction, changed = order if sweep % 2 else np.ascontiguousarray(order[::-1]), 0
            for some in pieces(order.size, self.n_entries):
                changed += improve_states(
                    self.rows, direction[some], pair_cost, IMPROVEMENT, floor,
                    choice.view(np.uint32), values,
                )  # fmt: skip
            most = max(most, changed)
            if changed <= SETTLED * most and sweep > 1:  # one direction may change nothing
                return sweep
        return most_sweeps

    def chain(self, choice: IntArray) -> System:
        """Return the equations of a policy; those of the last few policies are cached.

        Args:
            choice: the policy's pair in each state, [states].
        """
        kept, is_kept = self._chains, self.n_states <= _KEPT_STATES
        key = choice.astype(np.int32, copy=False).tobytes() if is_kept else b""
        if is_kept and key in kept:
            return kept[key]
        chain = System(chosen_rows(self.transitions, choice), self.exits[choice])
        if is_kept:
            if len(kept) >= _KEPT_CHAINS:
                kept.pop(next(iter(kept)))
            kept[key] = chain
        return chain

    def restricted(self, pairs: IntArray) -> Dynamics:
        """Return the dynamics with only some pairs, ascending, at least one for each state."""
        if len(pairs) == len(self.exits):
            return self  # keeps the equations solved so far
        counts = np.bincount(self.pair_state[pairs], minlength=self.n_states)
        return Dynamics(
            pair_offsets=offsets_of(counts).astype(self.pair_offsets.dtype),
            transitions=sp.csr_array(self.transitions[pairs]),
            exits=self.exits[pairs],
        )

    @cached_property
    def _chains(self) -> dict[bytes, System]:
        """Equations of the last few policies, by the bytes of the policy."""
        return {}


def _levels_of_dynamics(dynamics: Dynamics) -> Iterator[Level]:
    """Yield the states level by level, from those without successors."""
    home, entry = dynamics.pair_state, dynamics.transitions.tocoo()
    away = (home[entry.row] != entry.col) & (entry.data > 0.0)
    shape = dynamics.transitions.shape
    moving = sp.csr_array((entry.data[away], (entry.row[away], entry.col[away])), shape=shape)
    before = moving.tocsc()
    owner = np.repeat(home, np.diff(moving.indptr))  # state of each entry, duplicates summed
    waiting = np.bincount(owner, minlength=dynamics.n_states)
    states: IntArray = np.flatnonzero(waiting == 0)
    while states.size:
        begin = dynamics.pair_offsets[states]
        counts = dynamics.pair_offsets[states + 1] - begin
        pairs = concatenated_ranges(begin, counts)
        rows = sp.csr_array(moving[pairs])
        escape = dynamics.exits[pairs] + np.asarray(rows.sum(axis=1)).ravel()
        yield states, pairs, offsets_of(counts), rows, escape
        first = before.indptr[states]
        entering = before.indices[concatenated_ranges(first, before.indptr[states + 1] - first)]
        owners = home[entering]
        waiting -= np.bincount(owners, minlength=dynamics.n_states)
        states = sorted_unique(owners[waiting[owners] == 0])


def without_self_loops(
    rows: sp.csr_array, owner: IntArray, leak: FloatArray
) -> tuple[sp.csr_array, FloatArray]:
    """Remove self-loops by conditioning each row on departing from its state.

    All other entries are divided by the probability of departing, so that no total changes. This
    probability is the sum of these entries, since 1 - p would lose digits in slow loops.

    Args:
        rows: [rows, states], without duplicates.
        owner: the state that each row belongs to, [rows].
        leak: mass of each row that leaves ``rows``, [rows].

    Returns:
        The rows without self-loops, divided by the probability of departing, and this
        probability, [rows]. A row that never departs is returned unchanged, with probability 1.
    """
    entry = rows.tocoo()
    away = entry.col != owner[entry.row]
    escape = leak + np.bincount(entry.row[away], weights=entry.data[away], minlength=rows.shape[0])
    kept = away | (escape[entry.row] == 0)
    escape = np.where(escape == 0, 1.0, escape)
    loops = np.zeros(rows.shape[0], dtype=np.bool_)
    loops[entry.row[~away]] = True
    escape = np.where(loops, escape, 1.0)  # rows without a self-loop depart for sure
    scaled = entry.data[kept] / escape[entry.row[kept]]
    return sp.csr_array((scaled, (entry.row[kept], entry.col[kept])), shape=rows.shape), escape


def leaving_choice(
    dynamics: Dynamics, goal: FloatArray, to_goal: IntArray | None = None
) -> IntArray:
    """Find a policy that leaves the process from every state, by the goal if possible, [states].

    Args:
        dynamics: the process.
        goal: probability of reaching the goal by each pair, [pairs].
        to_goal: known pairs that lead nearer to the goal, -1 if none, [states].
    """
    to_goal = nearer_pairs(dynamics.graph, goal > 0.0) if to_goal is None else to_goal
    if to_goal.min(initial=0) >= 0:
        return to_goal
    return np.where(to_goal >= 0, to_goal, nearer_pairs(dynamics.graph, dynamics.exits > 0.0))


def leaving_chain(
    dynamics: Dynamics, choice: IntArray, before: IntArray | None
) -> tuple[System, IntArray]:
    """Return the chain of a policy that leaves the process from every state, and this policy.

    If the given policy never leaves the process from some states, these states take the pairs of
    the policy before instead.

    Args:
        dynamics: the process.
        choice: the policy, [states].
        before: the policy before the last improvement, or None.

    Raises:
        SolverError: the pairs of the policy before do not leave the process either.
    """
    system = dynamics.chain(choice)
    while (closed := system.closed).size:
        if before is None or np.array_equal(choice[closed], before[closed]):
            raise SolverError(HOLDS_MASS)
        choice = choice.copy()
        choice[closed] = before[closed]
        system = dynamics.chain(choice)
    return system, choice
