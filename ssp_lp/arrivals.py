"""How much mass of a policy's chain arrives at the goal at which total cost, layer after layer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, read_only
from ssp_lp.chain import Chain, reaching
from ssp_lp.dynamic_programming.linear_system import System
from ssp_lp.errors import ModelError
from ssp_lp.process.lattice import common_unit, layers_of

_FIRST_LAYERS = 64
_MOST_WAITING = 50_000_000  # masses kept at once, 400 MB
_MOST_WORK = 3_000_000_000  # moves followed in all, some tens of seconds
_WORK_OF_A_LAYER = 3_000  # moves that could be followed while one layer is begun
_MOSTLY = 0.5  # share of a chain's nodes from which all of its moves are followed


@dataclass(frozen=True, eq=False)
class Prospect:
    """A policy's chain, and what is still to come from each of its nodes."""

    chain: Chain
    alive: BoolArray  # [nodes] before the goal, and able to reach it
    goal: FloatArray  # [nodes] goal probability; 1 at goals
    cost: FloatArray  # [nodes] E[cost from here on; goal]

    @classmethod
    def of(cls, chain: Chain) -> Prospect:
        """Two linear solves on the chain."""
        alive = reaching(chain, chain.goal > 0) & (chain.goal == 0)
        goal = chain.accumulate(chain.per_node(chain.goal[chain.target]), alive) + chain.goal
        paid = chain.per_node(goal[chain.target] * chain.cost)
        return cls(chain, alive, read_only(goal), read_only(chain.accumulate(paid, alive)))


@dataclass(frozen=True, eq=False)
class Live:
    """The parts of one or several chains that can still reach the goal, the goals made one node.

    Moves that lose the goal for good are left out; what they take away is ``lost``.
    """

    start: FloatArray  # [nodes + 1] the goal is last, in all three
    goal: FloatArray  # [nodes + 1]
    cost: FloatArray  # [nodes + 1]
    lost: FloatArray  # [nodes] probability of losing the goal with the next decision
    source: IntArray  # [moves]
    target: IntArray  # [moves]
    probability: FloatArray  # [moves]
    paid: FloatArray  # [moves] cost

    @classmethod
    def of(cls, prospects: Sequence[Prospect], weights: FloatArray) -> Live:
        """Chains side by side, entered with the weights of a lottery."""
        size = sum(int(p.alive.sum()) for p in prospects)
        first, start, ahead, moves = 0, np.zeros(size + 1), np.zeros((3, size + 1)), []
        for prospect, weight in zip(prospects, weights, strict=True):
            chain, alive = prospect.chain, prospect.alive
            reached = chain.goal > 0
            own = slice(first, first + int(alive.sum()))
            number = np.full(chain.n_nodes, size, dtype=np.int64)
            number[alive] = np.arange(own.start, own.stop)
            start[own] = weight * chain.start[alive]
            start[size] += weight * float(chain.start[reached].sum())
            leaves = ~(alive | reached)[chain.target]
            lost = chain.give_up + chain.per_node(leaves.astype(np.float64))
            ahead[:, own] = prospect.goal[alive], prospect.cost[alive], lost[alive]
            kept = alive[chain.source] & ~leaves
            moves.append((number[chain.source[kept]], number[chain.target[kept]],
                          chain.probability[kept], chain.cost[kept]))  # fmt: skip
            first = own.stop
        ahead[0, size] = 1.0
        source, target, probability, paid = map(np.concatenate, zip(*moves, strict=True))
        return cls(start, ahead[0], ahead[1], ahead[2, :-1], source, target, probability, paid)


class FreeMoves:
    """What moves on at no cost before anything is paid: each layer is a chain of its own."""

    def __init__(self, live: Live, free: BoolArray) -> None:
        """Take the moves marked ``free``, [moves], none of which leads to the goal."""
        n = len(live.lost)
        where = (live.source[free], live.target[free])
        inside = sp.csr_array((live.probability[free], where), shape=(n, n))
        inside.sum_duplicates()
        leak = np.bincount(live.source[~free], weights=live.probability[~free], minlength=n)
        self._inside, self._leaving = inside, leak + live.lost
        count, self._component = connected_components(inside, directed=False)
        self._busy = np.zeros(count, dtype=np.bool_)
        self._busy[self._component[where[0]]] = True

    def spread(self, inflow: FloatArray) -> FloatArray:
        """Expected visits within one layer, given what enters it, [nodes].

        Only the components that something enters are solved.
        """
        entered = np.zeros_like(self._busy)
        entered[self._component[np.flatnonzero(inflow)]] = True
        nodes = np.flatnonzero((entered & self._busy)[self._component])
        visits = inflow.copy()
        if nodes.size:
            every = nodes.size == inflow.size
            own = self._inside if every else sp.csr_array(self._inside[nodes][:, nodes])
            visits[nodes] = System(own, self._leaving[nodes]).solve_transposed(inflow[nodes])
        return visits


class Arrivals:
    """A sweep over the total cost in whole layers of the costs' common unit. Mutable: it grows.

    Mass waits at (layer, node) in a ring as wide as the costliest step. A layer is settled by
    spreading its mass over the moves that cost nothing and sending it on along the others; what
    is then at the goal is that layer's atom. All that is not settled is known exactly from the
    linear solves of each node's prospects, so the tail is never a difference of large numbers.

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """

    def __init__(self, live: Live, exact_costs: Mapping[float, Fraction]) -> None:
        """Begin at total cost 0, nothing settled."""
        self.settled = 0  # layers 0 .. settled - 1 are
        self._work = 0
        paid = live.paid
        flat = paid.size > 0 and float(paid.min()) == float(paid.max())
        distinct = paid[:1] if flat else np.unique(paid)
        self.unit = common_unit(distinct, exact_costs)
        self._steps = layers_of(distinct, self.unit, exact_costs)
        self._width = int(self._steps.max(initial=0)) + 1
        self._live, self._size = live, len(live.start)
        if self._width * self._size > _MOST_WAITING:
            raise ModelError(self._too_large("one step passes too many layers"))
        step = np.rint(paid / float(self.unit)).astype(np.int64)
        goal = self._size - 1
        free = (step == 0) & (live.target != goal)
        self._free = FreeMoves(live, free) if free.any() else None
        onward = (live.source[~free], (step * self._size + live.target)[~free])
        shape = (goal, self._width * self._size)
        self._onward = sp.csr_array((live.probability[~free], onward), shape=shape)
        self._waiting = np.zeros(shape[1])
        self._waiting[: self._size] = live.start
        self._occupied = np.arange(self._width) == 0
        self._layers: list[int] = []
        self._masses: list[float] = []

    @property
    def exhausted(self) -> bool:
        """Whether nothing waits any more: every atom is known."""
        return not self._occupied.any()

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Total cost of whole layers, rounded once, like ``layers``."""
        return np.asarray(layers * float(self.unit.numerator) / float(self.unit.denominator))

    def atoms(self) -> tuple[IntArray, FloatArray]:
        """Settled layers at which mass arrives, increasing, and how much: [atoms] each."""
        return np.array(self._layers, dtype=np.int64), np.array(self._masses, dtype=np.float64)

    def settle(self, layers: int) -> None:
        """Settle all layers below the given number.

        Raises:
            ModelError: this would take too long.
        """
        while self.settled < layers:
            ahead = self._to_next()
            if ahead is None or self.settled + ahead >= layers:
                self.settled = layers
            else:
                self.settled += ahead
                self._settle_one()

    def followed(self, enough: int | None = None) -> Iterator[int]:
        """Settle twice as many layers each time, up to ``enough`` or to the end of the support.

        Yields:
            How many layers are settled; at least once.

        Raises:
            ModelError: this would take too long.
        """
        yield self.settled
        while not self.exhausted:
            ahead = max(2 * self.settled, _FIRST_LAYERS)
            self.settle(ahead if enough is None else min(ahead, enough))
            yield self.settled

    @property
    def frontier(self) -> float:
        """The total cost from which on nothing is settled."""
        return float(self.cost_of(np.array(self.settled)))

    def remaining(self) -> tuple[float, float]:
        """Of the runs that arrive at an unsettled layer: Pr(goal), and E[C - settled; goal]."""
        waiting = self._waiting.reshape(self._width, self._size)
        ahead = (np.arange(self._width) - self.settled) % self._width
        goal = waiting @ self._live.goal
        cost = self.cost_of(ahead) * goal + waiting @ self._live.cost
        return float(goal.sum()), float(cost.sum())

    def _to_next(self) -> int | None:
        """How many layers ahead the next one is at which mass may wait; None: there is none."""
        row = self.settled % self._width
        for begin, part in ((0, self._occupied[row:]), (-row, self._occupied[:row])):
            first = int(np.argmax(part)) if part.size else 0
            if part.size and part[first]:
                return (begin + first) % self._width
        return None

    def _settle_one(self) -> None:
        row, size = self.settled % self._width, self._size
        here = self._waiting[row * size : (row + 1) * size]
        visits = here[:-1].copy()
        here[:-1] = 0.0
        self._occupied[row] = False
        if self._free is not None:
            visits = self._free.spread(visits)
        active = np.flatnonzero(visits)
        if active.size:
            self._send(visits, active, row * size)
            self._occupied[(self.settled + self._steps[self._steps > 0]) % self._width] = True
        if here[-1] > 0.0:
            self._layers.append(self.settled)
            self._masses.append(float(here[-1]))
            here[-1] = 0.0
        self.settled += 1

    def _send(self, visits: FloatArray, active: IntArray, begin: int) -> None:
        """Send visits on along the moves that pay or arrive, into the ring that begins here."""
        moves, waiting = self._onward, self._waiting
        if active.size < _MOSTLY * visits.size:
            moves, visits = moves[active], visits[active]
        self._count(moves.nnz)
        if moves.nnz < waiting.size:
            share = moves.data * np.repeat(visits, np.diff(moves.indptr))
            np.add.at(waiting, (moves.indices.astype(np.int64) + begin) % waiting.size, share)
            return
        sent, turn = moves.T @ visits, waiting.size - begin
        waiting[begin:] += sent[:turn]
        waiting[:begin] += sent[turn:]

    def _count(self, moves: int) -> None:
        self._work += moves + _WORK_OF_A_LAYER
        if self._work > _MOST_WORK:
            raise ModelError(self._too_large("the answer lies too far out"))

    def _too_large(self, reason: str) -> str:
        return (
            f"the law of success costs takes too large a table: {self._size - 1:,} nodes of the "
            f"policy's chain, {self._width:,} layers of cost {float(self.unit):g} in one step, "
            f"{self.settled:,} layers so far ({reason}); round the costs to a coarser grid when "
            "building the model, or ask for a lower cost or level"
        )
