"""Arrivals: the probability mass of a policy that reaches the goal at each total cost.

A layer is a multiple of the costs' common unit. The mass that can still reach the goal is followed
from layer to layer. If the unit is so small that there are too many layers, only the sums of costs
that occur are followed, in increasing order. A float cost stands for its shortest decimal, so that
every sum is an integer number of units and equal sums are found exactly.

A chain of few nodes that is rarely left may need millions of layers. A matrix then describes how
waiting mass passes one layer, and its powers describe how it passes 2, 4, 8, ... layers. Any number
of layers is passed in as many products as the number has binary digits. The probabilities of
leaving (the goal is reached or lost) are stored beside each matrix and summed without subtraction.
Each row is rescaled so that its sum and its probability of leaving add up to 1. Otherwise the
rounding error of a row sum near 1 would grow with the power.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from heapq import heappop, heappush
from numbers import Rational
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.accumulated_cost.totals import common_unit, exact_cost, last_layer, layers_of, totals_of
from ssp_lp.arrays import SAME_TOTAL, BoolArray, FloatArray, IntArray, concatenated_ranges
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.errors import ModelError
from ssp_lp.policies.chain import Chain

_FEW = 256  # most nodes for a table of all visits


@dataclass(frozen=True, eq=False)
class LiveChain:
    """The parts of chains that can still reach the goal, with one node for all goals.

    Moves that lose the goal for ever are left out; their probability is ``lost``.
    """

    start: FloatArray  # [nodes + 1] here and below, the last entry is the goal
    goal: FloatArray  # [nodes + 1]
    cost: FloatArray  # [nodes + 1]
    lost: FloatArray  # [nodes] probability of losing the goal by the next decision
    source: IntArray  # [moves]
    target: IntArray  # [moves]
    probability: FloatArray  # [moves]
    paid: FloatArray  # [moves] cost

    @classmethod
    def of(cls, chains: Sequence[Chain], weights: FloatArray) -> LiveChain:
        """Return one live chain that has the chains of a lottery's members side by side.

        Args:
            chains: chains of the members.
            weights: weights of the members, [members].
        """
        size = sum(int(chain.alive.sum()) for chain in chains)
        first, start, ahead, moves = 0, np.zeros(size + 1), np.zeros((3, size + 1)), []
        for chain, weight in zip(chains, weights, strict=True):
            alive, reached = chain.alive, chain.goal > 0
            own = slice(first, first + int(alive.sum()))
            number = np.full(chain.n_nodes, size, dtype=np.int64)
            number[alive] = np.arange(own.start, own.stop)
            start[own] = weight * chain.start[alive]
            start[size] += weight * float(chain.start[reached].sum())
            leaves = ~(alive | reached)[chain.target]
            lost = chain.give_up + chain.per_node(leaves.astype(np.float64))
            goal, cost = chain.arriving()
            ahead[:, own] = goal[alive], cost[alive], lost[alive]
            kept = alive[chain.source] & ~leaves
            moves.append((number[chain.source[kept]], number[chain.target[kept]],
                          chain.probability[kept], chain.cost[kept]))  # fmt: skip
            first = own.stop
        ahead[0, size] = 1.0
        source, target, probability, paid = map(np.concatenate, zip(*moves, strict=True))
        return cls(start, ahead[0], ahead[1], ahead[2, :-1], source, target, probability, paid)


class _FreeMoves:
    """The Markov chain of the moves of cost 0 within a layer."""

    def __init__(self, live: LiveChain, free: BoolArray) -> None:
        """Store the moves marked ``free``, [moves], which must not lead to the goal."""
        n = len(live.lost)
        where = (live.source[free], live.target[free])
        inside = sp.csr_array((live.probability[free], where), shape=(n, n))
        inside.sum_duplicates()
        leak = np.bincount(live.source[~free], weights=live.probability[~free], minlength=n)
        self._inside, self._leaving = inside, leak + live.lost
        count, self._component = sp.csgraph.connected_components(inside, directed=False)
        self._busy = np.zeros(count, dtype=np.bool_)
        self._busy[self._component[where[0]]] = True

    def spread(self, inflow: FloatArray) -> FloatArray:
        """Return the expected visits within one layer from the mass that enters it, [nodes].

        For few nodes a table is used, which is accurate even for loops that are hardly left. For
        many nodes only the components that mass enters are solved.
        """
        if inflow.size <= _FEW:
            return np.asarray(inflow @ self._visits)
        entered = np.zeros_like(self._busy)
        entered[self._component[np.flatnonzero(inflow)]] = True
        nodes = np.flatnonzero((entered & self._busy)[self._component])
        visits = inflow.copy()
        if nodes.size:
            own = sp.csr_array(self._inside[nodes][:, nodes])
            visits[nodes] = System(own, self._leaving[nodes]).solve_transposed(inflow[nodes])
        return visits

    @cached_property
    def _visits(self) -> FloatArray:
        """Expected visits within a layer, [nodes entered, nodes]."""
        return self.gathered(np.eye(len(self._leaving)))

    def gathered(self, rewards: FloatArray) -> FloatArray:
        """Return the expected rewards within one layer from each node, [nodes, rewards].

        Args:
            rewards: rewards of a visit, [nodes, rewards].
        """
        return System(self._inside, self._leaving).solve_by_reduction(rewards)


MOST_LEVELS = 62
"""Most layers are 2^62, for 64-bit integers."""

_MOSTLY_STAYS = 0.5
"""Probability of leaving up to which rows are rescaled: 1 minus a greater one loses digits."""


class _LayerPower(NamedTuple):
    """The state of mass after 2^k layers: still waiting, at the goal, or lost.

    Mass waits at the places of :class:`_LayerPowers`.
    """

    onward: FloatArray  # [places, places]
    lands: FloatArray  # [places] probability of having reached the goal
    leaves: FloatArray  # [places] probability of having lost the goal

    def scaled(self) -> _LayerPower:
        """Return the power with rows of ``onward`` rescaled so that all probabilities sum to 1."""
        exits, total = self.lands + self.leaves, self.onward.sum(axis=1)
        stays = exits <= _MOSTLY_STAYS
        factor = np.divide(1.0 - exits, total, out=np.ones_like(exits), where=stays)
        return self._replace(onward=self.onward * factor[:, None])

    def doubled(self) -> _LayerPower:
        lands = self.lands + self.onward @ self.lands
        leaves = self.leaves + self.onward @ self.leaves
        return _LayerPower(self.onward @ self.onward, lands, leaves).scaled()


class _LayerPowers:
    """Effects of passing 1, 2, 4, ... layers, computed when needed. Mutable.

    Mass waits at places. A place is a node and a delay: the number of layers to pass before the
    mass moves on from the node. Places are sorted by node, then by delay.
    """

    def __init__(
        self, onward: sp.csr_array, lost: FloatArray, free: _FreeMoves | None = None
    ) -> None:
        """List the places: each node with delay 0 and the delays with which moves reach it.

        Args:
            onward: moves to (layers passed, node), the goal last, [nodes before the goal, columns].
            lost: probability of losing the goal by the next move, [nodes before the goal].
            free: moves within a layer, or None.
        """
        self._onward, self._lost, self._free = onward, lost, free
        dearest = np.ones(len(lost) + 1, dtype=np.int64)  # layers that a move to a node passes
        columns = onward.indices.astype(np.int64)
        np.maximum.at(dearest, columns % len(dearest), columns // len(dearest))
        self.node = np.repeat(np.arange(len(dearest)), dearest)
        self.delay = concatenated_ranges(np.zeros_like(dearest), dearest)
        self._levels: list[_LayerPower] = []

    @property
    def size(self) -> int:
        return len(self.node)

    def _one_layer(self) -> _LayerPower:
        """Return the effect of passing a layer: mass of delay 0 moves, other delays fall by 1."""
        n_nodes = len(self._lost) + 1
        columns = np.append((self.delay + 1) * n_nodes + self.node, n_nodes - 1)
        leaving = np.hstack([self._onward[:, columns].toarray(), self._lost[:, None]])
        leaving = leaving if self._free is None else self._free.gathered(leaving)
        waits, first = np.flatnonzero(self.delay > 0), np.flatnonzero(self.delay == 0)
        onward = np.zeros((self.size, self.size))
        lands, leaves = np.zeros(self.size), np.zeros(self.size)
        onward[waits, waits - 1], begin = 1.0, first[:-1]
        onward[begin], lands[begin], leaves[begin] = leaving[:, :-2], leaving[:, -2], leaving[:, -1]
        lands[first[-1]] = 1.0  # at the goal
        return _LayerPower(onward, lands, leaves).scaled()

    def after(self, waiting: FloatArray, layers: int) -> tuple[float, FloatArray]:
        """Return the mass that has arrived after some layers, and the waiting mass, [places].

        Args:
            waiting: waiting mass before the first layer, [places].
            layers: number of layers, at least 0 and less than 2^62.
        """
        arrived = 0.0
        for k in range(layers.bit_length()):
            if layers >> k & 1:
                level = self._level(k)
                arrived += float(waiting @ level.lands)
                waiting = waiting @ level.onward
        return arrived, waiting

    def until(self, waiting: FloatArray, mass: float) -> int | None:
        """Return the number of layers before the one that raises the arrived mass to ``mass``.

        Args:
            waiting: mass before the first layer, [places].
            mass: above 0.

        Returns:
            The number of layers, or None if 2^62 are not enough.
        """
        k = 0
        while float(waiting @ self._level(k).lands) < mass:
            k += 1
            if k > MOST_LEVELS:
                return None
        layers, arrived = 0, 0.0
        for j in reversed(range(k)):
            level = self._level(j)
            more = arrived + float(waiting @ level.lands)
            if more < mass:
                layers, arrived, waiting = layers + (1 << j), more, waiting @ level.onward
        return layers

    def _level(self, k: int) -> _LayerPower:
        """Return the effect of passing ``2^k`` layers."""
        while len(self._levels) <= k:
            self._levels.append(self._levels[-1].doubled() if self._levels else self._one_layer())
        return self._levels[k]


_FIRST_LAYERS = 64
_LAST_LAYER: int = 2**MOST_LEVELS  # practically infinite
_NARROW = 100_000  # most waiting masses for layers rather than sums
_MOST_WAITING = 50_000_000  # most waiting masses, 400 MB
_MOST_WORK = 3_000_000_000  # most moves followed in all, some tens of seconds
_WORK_OF_A_LAYER = 3_000  # overhead of starting one layer, in moves
_WORK_OF_PASSING = 10  # overhead of passing an empty layer in a compiled loop, in moves
_TOGETHER = 1_000_000  # most moves between two checks of the time
_MOST_PLACES = 800  # most places for dense powers, some sixty of which take 300 MB
_WORK_OF_POWERS = 0.125  # work of the powers, in moves per places cubed


class Arrivals:
    """A forward sweep over the total cost of a chain, in layers of a unit. Mutable.

    Mass waits at (layer, node); the layer is the cost paid so far. The layers are settled in
    increasing order: the mass of a layer is spread over the moves of cost 0, and then sent along
    the other moves to later layers. The mass that is at the goal when a layer is settled is the
    probability of this total cost. Waiting mass is stored in a ring buffer, which has a row for
    each layer that the most expensive move passes.

    Linear solves give the goal probability and the expected cost from each node. The remaining
    probability and cost of unsettled mass are computed from these, not as differences of large
    numbers. If there are few nodes, powers of a matrix lead to layers far beyond the settled ones
    (:attr:`leaps`).

    Raises:
        ModelError: the costs have no common unit, or one step passes too many layers.
    """

    _number: npt.DTypeLike = np.int64
    _first: int = _FIRST_LAYERS  # number of layers that are settled first

    def __init__(
        self, live: LiveChain, exact_costs: Mapping[float, Fraction], unit: Fraction | None = None
    ) -> None:
        """Start at total cost 0, with no layer settled.

        Args:
            live: the chain.
            exact_costs: float cost -> the fraction that it stands for.
            unit: unit to whose multiples all costs are rounded up; None: their common unit.
        """
        paid = live.paid
        flat = paid.size > 0 and float(paid.min()) == float(paid.max())
        distinct = paid[:1] if flat else np.unique(paid)
        if unit is None:
            unit = common_unit(distinct, exact_costs)
            self._steps = layers_of(distinct, unit, exact_costs)
        else:
            self._steps = np.ceil(distinct / float(unit) * (1.0 - SAME_TOTAL)).astype(np.int64)
        self._work, self._width = 0, int(self._steps.max(initial=0)) + 1
        if self._width * len(live.start) > _MOST_WAITING:
            self.settled, self.unit, self._size = 0, unit, len(live.start)
            raise ModelError(self._too_large("one step passes too many layers"))
        step = self._steps[np.searchsorted(distinct, paid)]
        self._begin(live, unit, step, step)
        self._waiting = np.zeros(self._width * self._size)
        self._waiting[: self._size] = live.start
        self._occupied = np.arange(self._width) == 0
        self._lists: tuple[Any, ...] = ()  # of waiting mass, and moves, for compiled loops

    def _begin(self, live: LiveChain, unit: Fraction, steps: IntArray, block: IntArray) -> None:
        """Start the sweep at total cost 0, with no layer settled.

        Args:
            live: the chain.
            unit: unit of all costs.
            steps: cost of each move in units, [moves].
            block: block of matrix columns for each move: its cost in units, or the index of its
                cost among the distinct costs, [moves].
        """
        self.settled, self.unit = 0, unit  # layers 0 .. settled - 1 are settled
        self._live, self._size = live, len(live.start)
        goal = self._size - 1
        free = np.asarray(steps == 0, dtype=np.bool_) & (live.target != goal)
        self._free = _FreeMoves(live, free) if free.any() else None
        onward = live.source[~free], (block * self._size + live.target)[~free]
        shape = goal, (int(block.max(initial=0)) + 1) * self._size
        self._onward = sp.csr_array((live.probability[~free], onward), shape=shape)
        self._layers: list[int] = []
        self._masses: list[float] = []

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Return the total cost of layers, rounded once, in the shape of ``layers``."""
        return totals_of(layers, self.unit)

    @property
    def frontier(self) -> float:
        """Total cost of the first layer that is not settled."""
        return float(self.settled * self.unit)

    def atoms(self) -> tuple[IntArray, FloatArray]:
        """Return the settled layers with arrivals, increasing, and their masses, [atoms] each."""
        return np.array(self._layers, dtype=self._number), np.array(self._masses, dtype=np.float64)

    def followed(self, enough: int | None = None) -> Iterator[int]:
        """Settle layers, twice as many each time, up to ``enough`` or the end of the support.

        Yields:
            The number of settled layers, at least once.

        Raises:
            ModelError: it would take too long.
        """
        yield self.settled
        while not self.exhausted and (enough is None or self.settled < enough):
            ahead = max(2 * self.settled, self._first)
            self.settle(ahead if enough is None else min(ahead, enough))
            yield self.settled

    @property
    def exhausted(self) -> bool:
        """Whether no mass is waiting, so that every atom is known."""
        return not self._occupied.any()

    def last_layer(self, bound: float | Fraction) -> int:
        """Return the last layer whose total cost is at most ``bound``, computed in integers."""
        far = float(_LAST_LAYER * self.unit)
        if not isinstance(bound, Rational) and not 0.0 < bound < far:
            return 0 if bound == 0.0 else -1 if bound < 0.0 else _LAST_LAYER
        return min(max(last_layer(bound, self.unit), -1), _LAST_LAYER)

    @with_twin
    def settle(self, layers: int) -> None:
        """Settle all layers below the given number.

        Raises:
            ModelError: it would take too long.
            Stop: the time ended.
        """
        while self.settled < layers:
            check_time()
            if self._lists or (
                self._free is None and accelerated(_TOGETHER, "layers.stream_layers")
            ):
                few = max(_TOGETHER // max(self._onward.nnz, 1), 1)
                self._settle_together(min(layers - self.settled, few))
                continue
            ahead = self._to_next()
            if ahead is None or self.settled + ahead >= layers:
                self.settled = layers
            else:
                self.settled += ahead
                self._settle_one()

    @property
    def is_narrow(self) -> bool:
        """Whether a step passes so few layers that most layers have arrivals."""
        return self._waiting.size <= _NARROW

    @property
    def leaps(self) -> bool:
        """Whether unsettled layers can be reached by powers of a matrix.

        The matrix must have few rows, and settling must have taken as much work as the powers
        will take.
        """
        size = self._powers.size
        few = size <= _MOST_PLACES and not self.exhausted
        return few and self._work >= _WORK_OF_POWERS * size**3

    def arrived(self, layer: int) -> float:
        """Return Pr(goal, C < r), with the total cost r of a layer.

        The layer must be settled, unless :attr:`leaps` is true.
        """
        layers, masses = self.atoms()
        arrived = float(masses[np.asarray(layers < layer, dtype=np.bool_)].sum())
        return arrived + self._ahead(layer)[0] if layer > self.settled and self.leaps else arrived

    def first_reaching(self, mass: float) -> int:
        """Return the first layer up to which the arrivals sum to a mass; it must be unsettled.

        :attr:`leaps` must be true.

        Raises:
            ModelError: the layer lies beyond 2^62 layers.
        """
        beyond = max(mass - sum(self._masses), float(np.finfo(np.float64).tiny))
        layers = self._powers.until(self._here(), beyond)
        if layers is None:
            raise ModelError(self._too_large("the requested cost is too high"))
        return self.settled + layers

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Return Pr(goal, C >= r) and E[C - r; goal, C >= r], where r is the total cost of a layer.

        Args:
            layer: the layer; None: the first one that is not settled. For a later one :attr:`leaps`
                must be true.
        """
        if layer is None:
            occupied = np.flatnonzero(self._waiting)
            row, node = np.divmod(occupied, self._size)
            ahead, delay = self._waiting[occupied], (row - self.settled) % self._width
        else:
            ahead, node, delay = self._ahead(layer)[1], self._powers.node, self._powers.delay
        goal = ahead * self._live.goal[node]
        cost = self.cost_of(delay) * goal + ahead * self._live.cost[node]
        return float(goal.sum()), float(cost.sum())

    @cached_property
    def _powers(self) -> _LayerPowers:
        return _LayerPowers(self._onward, self._live.lost, self._free)

    def _here(self) -> FloatArray:
        """Return the mass that waits now, before the first unsettled layer, [places]."""
        rows = (self.settled + self._powers.delay) % self._width
        return np.asarray(self._waiting[rows * self._size + self._powers.node])

    def _ahead(self, layer: int) -> tuple[float, FloatArray]:
        """Return the mass arriving before a later layer, and the mass waiting there, [places]."""
        return self._powers.after(self._here(), layer - self.settled)

    def _to_next(self) -> int | None:
        """Return the number of layers to the next waiting mass, or None if no mass waits."""
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

    def _settle_together(self, layers: int) -> None:
        """Settle several layers in compiled loops; there must be no moves of cost 0."""
        from ssp_lp.compiled.layers import stream_layers

        lists = self._lists
        if not lists:  # linked lists of the waiting mass in each layer of the ring
            places = np.flatnonzero(self._waiting)
            heads, links = np.full(self._width, -1), np.full(self._waiting.size, -1, dtype=np.int32)
            row = places // self._size
            links[places[1:]] = np.where(row[1:] == row[:-1], places[:-1], -1)
            heads[row] = places
            moves = self._onward
            rows = moves.indptr.astype(np.int64), moves.indices.astype(np.int64), moves.data
            lists = heads, links, *rows
        run: Callable[..., int] = stream_layers
        arrived = np.zeros(layers)
        followed = run(self._waiting, *lists, self.settled % self._width, arrived)
        self._lists, self._occupied = lists, lists[0] >= 0
        reached = np.flatnonzero(arrived)
        self._layers += (self.settled + reached).tolist()
        self._masses += arrived[reached].tolist()
        self.settled += layers
        passed = layers * _WORK_OF_PASSING + len(reached) * _WORK_OF_A_LAYER
        self._count(int(followed) + passed)

    def _count(self, work: int) -> None:
        """Count the moves followed; raise ModelError if they are too many."""
        self._work += work
        if self._work > _MOST_WORK:
            raise ModelError(self._too_large("too many layers would have to be followed"))

    def _send(self, visits: FloatArray, active: IntArray, begin: int) -> None:
        """Send visits along moves that cost something or reach the goal, into the ring buffer.

        Args:
            visits: visits of the layer, [nodes before the goal].
            active: nodes with visits, increasing.
            begin: position of the layer in the waiting mass.
        """
        moves, waiting = self._onward, self._waiting
        first = moves.indptr[active].astype(np.int64)
        counts = moves.indptr[active + 1] - first
        self._count(int(counts.sum()) + _WORK_OF_A_LAYER)
        if counts.sum() < waiting.size:
            taken = concatenated_ranges(first, counts)
            share = moves.data[taken] * np.repeat(visits[active], counts)
            place = (moves.indices[taken].astype(np.int64) + begin) % waiting.size
            np.add.at(waiting, place, share)
            return
        sent, turn = moves[active].T @ visits[active], waiting.size - begin
        waiting[begin:] += sent[:turn]
        waiting[:begin] += sent[turn:]

    def _too_large(self, reason: str) -> str:
        """Return the message for a table that would be too large, with the reason."""
        return (
            f"the distribution of the cost given success takes too large a table ({reason}): "
            f"{self._size - 1:,} nodes of the policy's chain times {self._width:,} layers of cost "
            f"{float(self.unit):g}, of which {self.settled:,} are computed. Round the costs to a "
            "coarser grid when building the model, or ask for a lower cost or level"
        )


_FIRST_STEPS = 8  # sums settled first, in the most expensive steps
_MOST_STEPS = 64  # most distinct step costs
_EARLY = 0.5  # share of the sums after which ``_SOME`` of the mass must have arrived
_SOME = 0.05  # share of the successes
_COARSE_TOO = 3  # most sums, coarse ones included, as a multiple of the exact ones
UNLIKELY = 1e-17  # share of the successes, or of a sum, that is below rounding


class TooManySumsError(ModelError):
    """Too many sums to follow them one by one."""


class SumArrivals(Arrivals):
    """Arrivals at sums of costs: layers of a tiny unit, of which few have waiting mass.

    Likely sums are followed exactly. Mass at an unlikely sum is rounded up to the next multiple of
    a coarse unit, where it joins other mass. The limit below which a sum counts as unlikely rises
    with the number of sums followed.
    """

    _number = object
    leaps = False

    def __init__(
        self,
        live: LiveChain,
        exact_costs: Mapping[float, Fraction],
        coarse: Fraction,
        most: int,
        rarest: float = UNLIKELY,
    ) -> None:
        """Start at total cost 0, with no layer settled.

        Args:
            live: the chain.
            exact_costs: float cost -> the fraction that it stands for.
            coarse: unit to whose multiples unlikely sums are rounded up.
            most: most sums that are followed exactly.
            rarest: a sum is unlikely if its share of the successes is below a limit. This limit
                rises from ``UNLIKELY``, which is below rounding, to ``rarest`` when ``most`` sums
                have been followed. If ``rarest`` exceeds ``UNLIKELY``, all later sums are rounded
                up.
        """
        distinct, step = np.unique(live.paid, return_inverse=True)
        unit = common_unit(distinct, exact_costs)
        self._followed, self._most, self._rarest = 0, most, rarest
        self._end = most if rarest == UNLIKELY else _COARSE_TOO * most
        self._coarse = max(int(coarse / unit), 1)
        self._units = [int(exact_cost(c, exact_costs) / unit) for c in distinct.tolist()]
        self._first = max(_FIRST_STEPS * max(self._units, default=1), 1)
        self._begin(live, unit, np.array(self._units, dtype=object)[step], step)
        self._arrived, self._goal = float(live.start[-1]), float(live.start @ live.goal)
        columns = self._onward.indices.astype(np.int64)
        self._leads = *np.divmod(columns, self._size), self._onward.data  # step, node, probability
        nodes = np.flatnonzero(live.start)
        self._pending: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        self._next: list[int] = []
        self._queue_mass(0, nodes, live.start[nodes])

    @property
    def exhausted(self) -> bool:
        """Whether no mass is waiting, so that every atom is known."""
        return not self._next

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Return the total costs of sums given in units, in the shape of ``layers``."""
        up, down = self.unit.numerator, self.unit.denominator
        totals = [int(layer) * up / down for layer in np.ravel(layers).tolist()]
        return np.array(totals, dtype=np.float64).reshape(np.shape(layers))

    def last_layer(self, bound: float | Fraction) -> int:
        """Return the last layer whose total cost is at most a bound, up to rounding."""
        return int(Fraction(bound) * (1 + Fraction(SAME_TOTAL) / 2) // self.unit)

    def settle(self, layers: int) -> None:
        """Settle all sums below the given layer.

        Raises:
            TooManySumsError: there are too many sums below it.
            Stop: the time limit was reached.
        """
        while self._next and self._next[0] < layers:
            check_time()
            layer = self._next[0]
            if layer % self._coarse and self._is_unlikely(self._pending[layer]):
                ahead = layer + self._coarse - layer % self._coarse
                for nodes, masses in self._pending.pop(heappop(self._next)):
                    self._queue_mass(ahead, nodes, masses)
                continue
            self._followed += 1
            if not self._may_be_exhausted:
                raise TooManySumsError(f"more than {self._followed:,} sums of costs can occur")
            self._settle_sum(heappop(self._next))
        self.settled = max(self.settled, layers)

    def _is_unlikely(self, parts: list[tuple[IntArray, FloatArray]]) -> bool:
        """Return whether a sum is unlikely, so that it is rounded up.

        Args:
            parts: nodes and masses that wait at the sum.
        """
        if self._followed >= self._most:
            return self._end > self._most
        arriving = sum(float(masses @ self._live.goal[nodes]) for nodes, masses in parts)
        share = UNLIKELY * math.pow(self._rarest / UNLIKELY, self._followed / self._most)
        return arriving <= share * self._goal

    @property
    def _may_be_exhausted(self) -> bool:
        """Whether the sweep may go on: few sums so far, or enough mass that reached the goal."""
        if self._followed <= _EARLY * self._most:
            return self._followed <= self._end and len(self._units) <= _MOST_STEPS
        return self._followed <= self._end and self._arrived >= _SOME * self._goal

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Return Pr(goal, C >= r) and E[C - r; goal, C >= r]; r is the total cost of a layer."""
        goal, cost, frontier = 0.0, 0.0, self.settled if layer is None else layer
        for begun, parts in self._pending.items():
            delay = float((begun - frontier) * self.unit)
            for nodes, masses in parts:
                reached = float(masses @ self._live.goal[nodes])
                goal += reached
                cost += delay * reached + float(masses @ self._live.cost[nodes])
        return goal, cost

    def _settle_sum(self, layer: int) -> None:
        """Settle the least sum with waiting mass; the sum is ``layer`` units."""
        parts = self._pending.pop(layer)
        nodes = np.concatenate([part[0] for part in parts])
        masses = np.concatenate([part[1] for part in parts])
        arrived = float(masses[nodes == self._size - 1].sum())
        if arrived > 0.0:
            self._layers.append(layer)
            self._masses.append(arrived)
            self._arrived += arrived
        visits = np.bincount(nodes, weights=masses, minlength=self._size)[:-1].astype(np.float64)
        if self._free is not None:
            visits = self._free.spread(visits)
        active = np.flatnonzero(visits)
        first = self._onward.indptr[active].astype(np.int64)
        counts = self._onward.indptr[active + 1] - first
        taken = concatenated_ranges(first, counts)
        step, target, share = (part[taken] for part in self._leads)
        share = share * np.repeat(visits[active], counts)
        for one in np.unique(step).tolist():
            chosen, ahead = step == one, layer + self._units[one]
            self._queue_mass(ahead, target[chosen], share[chosen])

    def _queue_mass(self, layer: int, nodes: IntArray, masses: FloatArray) -> None:
        """Add waiting mass at a layer."""
        if layer not in self._pending:
            self._pending[layer] = []
            heappush(self._next, layer)
        self._pending[layer].append((nodes, masses))


def cost_of(sweep: Arrivals, layer: int) -> float:
    """Return the total cost of a layer or sum."""
    return float(sweep.cost_of(np.array(layer)))
