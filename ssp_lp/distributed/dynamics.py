"""Dynamics of a process whose rows PETSc's ranks hold: every product with them is an order.

What an order takes and brings back are vectors over states. Rewards are named by how they are made
of those that the ranks hold, [held, rewards], and the cost of pairs likewise, [held].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.compiled.deadline import check_time
from ssp_lp.distributed.equations import SWEEPS
from ssp_lp.distributed.ranks import Ranks
from ssp_lp.dynamic_programming.bellman import Backup
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import EXACT, System
from ssp_lp.errors import SolverError

_STUCK = 0.5  # share of the residual from which a run got nowhere
_LET_PASS = 1e-12  # relative residual that will do where nothing gets further
_GATHERED = 1_000_000  # entries of a policy's rows that one rank takes, where it is hardly left
_LEAST_SCALE = 1e-300  # of a solution that is 0
_UNSOLVED = "neither sweeps nor PETSc's Krylov methods solve the equations of a policy"
_METHODS = (SWEEPS, "bcgs", "gmres")  # each where those before it get nowhere
_LOWERED = 4  # times that each rank lowers its values between two exchanges
_SHRUNK = (0.0, *10.0 ** np.arange(-13.0, 0.0))  # shares by which values are moved to the floor
_DUST = 0.1  # of such a share, by which all values go down
_LOWERINGS = 40  # exchanges of lowered values, after which a larger share is tried
_FIRST_LOWERINGS = 3  # the same where no share is taken off
_LOST = 1e-3  # share of the greatest value by which one may fall in these


@dataclass(frozen=True, eq=False)
class PartitionedDynamics(Dynamics):
    """Dynamics whose rows PETSc's ranks share, by state; pairs are numbered from rank to rank.

    All of a policy's equations are solved at once, and no component of the process by itself.
    """

    few: ClassVar[int] = 0  # totals on PETSc never show that a policy never leaves
    ranks: Ranks = field(kw_only=True)
    bounds: IntArray = field(kw_only=True)  # [ranks + 1] first state of each rank, and the end
    pair_bounds: IntArray = field(kw_only=True)  # [ranks + 1] likewise, of the pairs
    entries: int = field(kw_only=True)  # of all rows
    supply: Callable[[], Sequence[tuple[Any, ...]]] | None = field(kw_only=True, default=None)
    """What the ranks take to hold these rows; None: they hold them."""

    @classmethod
    def held_by(cls, ranks: Ranks) -> PartitionedDynamics:
        """The dynamics of the rows that the ranks of PETSc hold."""
        ends, pairs, entries = np.array(ranks.order("sizes")).T
        shared = cls._of(ranks, offsets(ends, of_ends=True), offsets(pairs), int(entries.sum()))
        ranks.held_by = shared
        return shared

    @classmethod
    def handed_out(cls, ranks: Ranks, pricing: ExplicitPricing) -> PartitionedDynamics:
        """The dynamics of a pricing problem, with rows to be handed out, entries balanced.

        Args:
            ranks: to whom.
            pricing: its process and its rewards, which the first rank has.
        """
        whole, rewards, size = pricing.process.dynamics, pricing.rewards, ranks.comm.size
        rows, first_pair = whole.transitions, whole.pair_offsets
        ends = rows.indptr[first_pair]
        wanted = np.linspace(0, ends[-1], size + 1)[1:-1]
        bounds = np.concatenate([[0], np.searchsorted(ends, wanted), [whole.n_states]])
        pair_bounds = first_pair[bounds].astype(np.int64)

        def supply() -> list[tuple[Any, ...]]:
            """Each rank's rows, rewards and states."""
            parts = []
            for first, end, a, b in zip(
                bounds[:-1], bounds[1:], pair_bounds[:-1], pair_bounds[1:], strict=True
            ):
                own = np.clip(first_pair, a, b) - a
                part = Dynamics(own.astype(first_pair.dtype), rows[a:b], whole.exits[a:b])
                parts.append((part, rewards[a:b], int(first), int(end)))
            return parts

        return cls._of(ranks, bounds, pair_bounds, int(rows.nnz), supply=supply)

    @classmethod
    def _of(
        cls, ranks: Ranks, bounds: IntArray, pair_bounds: IntArray, entries: int, **more: Any
    ) -> PartitionedDynamics:
        """Dynamics on PETSc without any rows of their own."""
        n_states = int(bounds[-1])
        nothing = sp.csr_array((0, n_states)), np.zeros(0)
        sizes: dict[str, Any] = {"bounds": bounds, "pair_bounds": pair_bounds, "entries": entries}
        no_pairs = np.zeros(n_states + 1, dtype=np.int64)
        return cls(no_pairs, nothing[0], nothing[1], ranks=ranks, **sizes, **more)

    @property
    def is_solved_backwards(self) -> bool:
        """Never, of dynamics on PETSc."""
        return False

    @property
    def is_compiled_backwards(self) -> bool:
        """Never, of dynamics on PETSc."""
        return False

    @property
    def n_entries(self) -> int:
        """Number of probabilities in all rows of the dynamics on PETSc."""
        return self.entries

    def order(
        self, name: str, shared: tuple[Any, ...] = (), own: Sequence[tuple[Any, ...]] | None = None
    ) -> list[Any]:
        """Have the ranks of PETSc do something with the rows of these dynamics, by rank."""
        ranks = self.ranks
        if ranks.held_by is not self:
            if self.supply is None:
                raise SolverError("the ranks of PETSc have let go of these rows")
            ranks.order("take", own=self.supply())
            ranks.held_by = self
        return ranks.order(name, shared, own)

    def by_state(self, array: Any) -> list[Any]:
        """An array over the states of the dynamics, cut for the ranks of PETSc."""
        return [array[a:b] for a, b in pairwise(self.bounds)]

    def own_pairs(self, choice: IntArray) -> list[IntArray]:
        """A policy of the dynamics cut for the ranks of PETSc, each counting its own pairs."""
        return [own - a for own, a in zip(self.by_state(choice), self.pair_bounds, strict=False)]

    def whole_choice(self, parts: Sequence[IntArray]) -> IntArray:
        """A policy of the dynamics from what the ranks of PETSc chose of their own pairs."""
        counted = [part + a for part, a in zip(parts, self.pair_bounds, strict=False)]
        return np.concatenate(counted).astype(np.int32)

    def back_up(self, pair_cost: FloatArray, values: FloatArray, held: IntArray) -> Backup:
        """Bellman backup of the dynamics on PETSc, each rank's states by itself."""
        own = list(zip(self.own_pairs(held), self.by_state(values), strict=True))
        parts = self.order("back_up", (pair_cost,), own)
        return Backup(
            np.concatenate([part.minima for part in parts]),
            self.whole_choice([part.choice for part in parts]),
            np.concatenate([part.here for part in parts]),
        )

    def taken(self, rewards: FloatArray, choice: IntArray) -> FloatArray:
        """Rewards of a policy's pairs in the dynamics on PETSc, [states] or [states, rewards]."""
        own = [(pairs,) for pairs in self.own_pairs(choice)]
        return np.concatenate(self.order("taken", (rewards,), own))

    def precise_gains(
        self, pair_cost: FloatArray, values: FloatArray, low: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Gain of each state's best pair of the dynamics on PETSc: see ``Dynamics``."""
        own = list(zip(self.by_state(values), self.by_state(low), strict=True))
        parts = self.order("precise_gains", (pair_cost,), own)
        picks = self.whole_choice([pick for _, pick in parts])
        return np.concatenate([gain for gain, _ in parts]), picks

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
        """Improve a policy of the dynamics on PETSc, in place: see ``Dynamics``."""
        rest = floor, most_sweeps, is_sorted_anew
        own = list(zip(self.own_pairs(choice), self.by_state(values), strict=True))
        parts = self.order("improve_by_sweeps", (pair_cost, rest), own)
        choice[:] = self.whole_choice([part[0] for part in parts])
        values[:] = np.concatenate([part[1] for part in parts])
        return int(max(part[2] for part in parts))

    def approach(self) -> IntArray:
        """A policy of the dynamics on PETSc that leaves, towards the goal first, [states]."""
        return self.whole_choice(self.order("approach"))

    def lower_bound(self, weights: FloatArray, values: FloatArray) -> DualBound:
        """Values of the dynamics on PETSc lowered to a checked sub-solution.

        They are moved towards the floor by a share, the least that will do: a step that costs has
        that share of its cost to spare then. Where nothing is paid values are lowered to those
        ahead, in the end to the least of all that lead to each other. All go down a little besides,
        by a smaller share of the greatest: what is free is not left with the dust of its equations,
        of which such sweeps take a part at a time without end.

        Args:
            weights: of the rewards, >= 0, [rewards].
            values: near-optimal ones, [states].
        """
        constant = min(self.order("greatest_constant", (weights,)))
        floor = 0.0
        if np.isfinite(constant):
            floor = max(0.0, constant - 4.0 * MACHINE_EPSILON * abs(constant))
        values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
        greatest = float(np.abs(values).max(initial=0.0))
        for share in _SHRUNK:
            shrunk = floor + (1.0 - share) * (values - floor) - share * _DUST * greatest
            lowered = np.maximum(shrunk, floor)
            least = lowered - _LOST * greatest
            for _ in range(_LOWERINGS if share else _FIRST_LOWERINGS):
                own = [(part,) for part in self.by_state(lowered)]
                parts = self.order("lowered", (weights, floor, _LOWERED), own)
                if not any(is_lowered for _, is_lowered in parts):
                    return DualBound(lowered, np.zeros_like(lowered))
                lowered = np.concatenate([own for own, _ in parts])
                if (lowered < least).any():
                    break
        nothing = np.zeros_like(values)
        return DualBound(nothing + floor, nothing)

    def _chain(self, choice: IntArray) -> System:
        """The equations of a policy in the dynamics on PETSc."""
        return PartitionedSystem(self, choice)


class PartitionedMoves:
    """The chain of equations that PETSc's ranks hold, as far as advantages are asked of it."""

    def __init__(self, system: PartitionedSystem) -> None:
        """Know whose chain it is."""
        self._system = system

    def precise_advantages(
        self, cost: FloatArray, high: FloatArray, low: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Advantages in twice the precision of a chain on PETSc: see ``Moves``."""
        return self._both("precise_advantages", cost, high, low)

    def safe_advantages(self, cost: FloatArray, values: FloatArray) -> FloatArray:
        """Advantages of a chain on PETSc that are never too high: see ``Moves``."""
        return np.concatenate(self._system.advantages("safe_advantages", cost, values))

    def advantage_bounds(
        self, cost: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds of advantages of a chain on PETSc: see ``Moves``."""
        return self._both("advantage_bounds", cost, values)

    def _both(self, *asked: Any) -> tuple[FloatArray, FloatArray]:
        """Two vectors over the states of a chain on PETSc."""
        low, high = zip(*self._system.advantages(*asked), strict=True)
        return np.concatenate(low), np.concatenate(high)


class PartitionedSystem(System):
    """Equations of a chain that PETSc's ranks hold and solve together."""

    def __init__(self, dynamics: PartitionedDynamics, choice: IntArray) -> None:
        """State the equations.

        Args:
            dynamics: of which the chain is a policy's.
            choice: the policy, [states].
        """
        super().__init__(sp.csr_array((0, dynamics.n_states)), np.zeros(0))
        self._dynamics, self._choice, self._entries = dynamics, choice, 0
        self._is_slow = False  # whether sweeps contract slowly

    @property
    def size(self) -> int:
        """Number of states of the equations on PETSc."""
        return self._dynamics.n_states

    @property
    def n_entries(self) -> int:
        """Number of probabilities in the equations on PETSc."""
        self._choose()
        return self._entries

    @property
    def is_solved_exactly(self) -> bool:
        """Never: equations on PETSc are iterated."""
        return False

    @property
    def is_solved_reward_by_reward(self) -> bool:
        """Whether the equations on PETSc took a Krylov method, which takes as long for each."""
        return self._is_slow

    @property
    def moves(self) -> Any:
        """The chain of the equations on PETSc, as far as advantages are asked of it."""
        return PartitionedMoves(self)

    @property
    def closed(self) -> IntArray:
        """States from which the chain on PETSc never leaves, [some states]."""
        self._choose()
        starts = self._dynamics.bounds
        found = self._dynamics.order("closed")
        return np.concatenate([own + start for own, start in zip(found, starts, strict=False)])

    def advantages(self, kind: str, cost: FloatArray, *vectors: FloatArray) -> list[Any]:
        """Advantages of the chain on PETSc, by rank.

        Args:
            kind: a method of ``Moves``.
            cost: [states].
            vectors: its other arguments, [states] each.
        """
        self._choose()
        own = list(zip(*map(self._dynamics.by_state, (cost, *vectors)), strict=True))
        return self._dynamics.order("advantages", (kind,), own)

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
        for method in _METHODS[1:] if self._is_slow else _METHODS:
            before, is_open = np.full_like(missed, np.inf), np.ones(missed.size, dtype=np.bool_)
            while (missed <= _STUCK * before)[is_open].any():
                check_time()
                own = list(zip(rights, dynamics.by_state(x), strict=True))
                parts, before = dynamics.order("improve", (method, accuracy), own), missed
                x = np.concatenate([part.x for part in parts])
                missed = parts[0].missed / np.maximum(parts[0].scale, _LEAST_SCALE)
                self.products += parts[0].products
                is_open = ~(missed <= accuracy)
                if not is_open.any():
                    return x.reshape(rewards.shape)
                if not np.isfinite(missed).all():
                    break
            if (missed <= _LET_PASS).all():
                return x.reshape(rewards.shape)
            self._is_slow = True
        raise SolverError(_UNSOLVED)

    def solve_by_reduction(self, rewards: FloatArray) -> FloatArray:
        """Solve the equations on PETSc without any subtraction, gathered on the first rank.

        Raises:
            SolverError: there are too many of them, or as of ``System``.
        """
        self._choose()
        if self._entries > _GATHERED:
            raise SolverError(_UNSOLVED)
        chains, exits = zip(*self._dynamics.order("policy_rows"), strict=True)
        whole = System(sp.csr_array(sp.vstack(chains)), np.concatenate(exits))
        return whole.solve_by_reduction(rewards)

    def _choose(self) -> None:
        """Have the ranks of PETSc set up these equations, unless they have."""
        dynamics, ranks = self._dynamics, self._dynamics.ranks
        if ranks.held_by is dynamics and ranks.chosen is self:
            return
        ranks.chosen = None
        own = [(pairs,) for pairs in dynamics.own_pairs(self._choice)]
        self._entries = sum(dynamics.order("choose", (), own))
        ranks.chosen = self


def offsets(numbers: IntArray, *, of_ends: bool = False) -> IntArray:
    """Where the parts of PETSc's ranks begin, and the end, by their sizes or ends, [ranks + 1]."""
    ends = numbers if of_ends else np.cumsum(numbers)
    return np.concatenate([[0], ends]).astype(np.int64)
