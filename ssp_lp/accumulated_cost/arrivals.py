"""How much mass of policies' chains arrives at the goal at which total cost.

The part of the chains that can still reach the goal is followed layer after layer of the costs'
common unit. Where costs have none worth counting in, the sums that occur are followed one by one,
in increasing order. They are whole numbers of a unit all the same, however small: a float means its
shortest decimal, so that two ways to one sum meet in one number, exactly.

A chain of few nodes that is hardly left arrives in millions of layers. One layer is a matrix on the
places where mass can wait, and its powers of two lead to any layer in as many products as the layer
has binary digits. What leaves is carried as data and sums up without a subtraction; the rows of a
power are scaled to what it leaves over, so that the rounding of a probability of staying near 1 is
not raised to the power of the layers.
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
from scipy.sparse.csgraph import connected_components

from ssp_lp.accumulated_cost.totals import common_unit, exact_cost, last_layer, layers_of, totals_of
from ssp_lp.arrays import (
    SAME_TOTAL,
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.errors import ModelError
from ssp_lp.policies.chain import Chain

_FEW = 256  # nodes of which a table of all visits is kept


@dataclass(frozen=True, eq=False)
class LiveChain:
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
    def of(cls, chains: Sequence[Chain], weights: FloatArray) -> LiveChain:
        """The live chain, able to arrive, of a lottery's members side by side."""
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
    """What moves on at no cost before anything is paid: each layer is a chain of its own."""

    def __init__(self, live: LiveChain, free: BoolArray) -> None:
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
        """Expected visits by moves of a live chain within one layer, given what enters it, [nodes].

        Few nodes by a table that holds however hardly a loop is left; of many only the components
        that something enters are solved.
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
        """Expected visits of a live chain within a layer, [nodes entered, nodes]."""
        return self.gathered(np.eye(len(self._leaving)))

    def gathered(self, rewards: FloatArray) -> FloatArray:
        """Expected rewards of all visits of a live chain within one layer, by where it is entered.

        Args:
            rewards: of a visit, [nodes, rewards].
        """
        return System(self._inside, self._leaving).solve_by_reduction(rewards)


MOST_LEVELS = 62
"""Layers are counted up to 2^62, as far as integers of 64 bits go."""

_MOSTLY_STAYS = 0.5
"""Exits up to which what stays is taken from them; above, the subtraction would lose digits."""


class _LayerPower(NamedTuple):
    """2^k layers as one step."""

    onward: FloatArray  # [places, places]
    lands: FloatArray  # [places] probability of having arrived at the goal
    leaves: FloatArray  # [places] probability of having lost it

    def scaled(self) -> _LayerPower:
        """A power of a layer's transition, its rows scaled to what the exits leave."""
        exits, total = self.lands + self.leaves, self.onward.sum(axis=1)
        stays = exits <= _MOSTLY_STAYS
        factor = np.divide(1.0 - exits, total, out=np.ones_like(exits), where=stays)
        return self._replace(onward=self.onward * factor[:, None])

    def doubled(self) -> _LayerPower:
        """A power of a layer's transition, squared: the step of twice as many layers."""
        lands = self.lands + self.onward @ self.lands
        leaves = self.leaves + self.onward @ self.leaves
        return _LayerPower(self.onward @ self.onward, lands, leaves).scaled()


class _LayerPowers:
    """Powers of two of one layer's transition, squared when they are first needed. Mutable.

    Mass waits at places: at a node, some layers ahead. Those of a node follow each other.
    """

    def __init__(
        self, onward: sp.csr_array, lost: FloatArray, free: _FreeMoves | None = None
    ) -> None:
        """Find the places to which moves lead; each node has one without delay.

        Args:
            onward: moves to (layers passed, node), the goal last, [nodes before the goal, columns].
            lost: probability of losing the goal with the next move, likewise, [nodes before it].
            free: moves within a layer; None: there are none.
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
        """Number of places."""
        return len(self.node)

    def _one_layer(self) -> _LayerPower:
        """Mass without delay leaves, the rest comes one layer nearer."""
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
        """What has arrived after some layers, and what waits then.

        Args:
            waiting: mass before the first of them, [places].
            layers: how many, at least 0 and less than 2^62.
        """
        arrived = 0.0
        for k in range(layers.bit_length()):
            if layers >> k & 1:
                level = self._level(k)
                arrived += float(waiting @ level.lands)
                waiting = waiting @ level.onward
        return arrived, waiting

    def until(self, waiting: FloatArray, mass: float) -> int | None:
        """How many layers pass before the one in which the arrivals reach a mass.

        Args:
            waiting: mass before the first layer, [places].
            mass: above 0.

        Returns:
            The layers, or None where 2^62 of them are not enough.
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
        """The transition of ``2^k`` layers."""
        while len(self._levels) <= k:
            self._levels.append(self._levels[-1].doubled() if self._levels else self._one_layer())
        return self._levels[k]


_FIRST_LAYERS = 64
_LAST_LAYER = 2**62  # as good as infinitely many
_NARROW = 100_000  # masses kept at once, up to which sums are not looked for
_MOST_WAITING = 50_000_000  # masses kept at once, 400 MB
_MOST_WORK = 3_000_000_000  # moves followed in all, some tens of seconds
_WORK_OF_A_LAYER = 3_000  # moves that could be followed while one layer is begun
_WORK_OF_PASSING = 10  # the same while a compiled loop passes a layer in which nothing waits
_TOGETHER = 1_000_000  # moves that may be followed between two looks at the time
_MOSTLY = 0.5  # share of a chain's nodes from which all of its moves are followed
_TINY = 5e-324  # the least mass there is
_MOST_PLACES = 800  # of a dense matrix of one layer, of which some sixty powers are kept, 300 MB
_WORK_OF_POWERS = 0.125  # moves that could be followed while powers are taken, per places cubed


class Arrivals:
    """A sweep over the total cost of a chain in layers of a unit, one after the other. Mutable.

    Mass waits for its total. A layer is settled by spreading its mass over the moves that cost
    nothing and sending it on along the others; what is then at the goal is that layer's atom. All
    that is not settled is known exactly from the linear solves of each node's prospects, so the
    tail is never a difference of large numbers.

    Mass waits at (layer, node) in a ring as wide as the costliest step. Where the nodes are few,
    what lies far beyond the settled layers is had from powers of the transition of one layer
    (:attr:`leaps`).

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """

    _number: npt.DTypeLike = np.int64
    _first: int = _FIRST_LAYERS  # layers that are settled at least, once any are

    def __init__(
        self, live: LiveChain, exact_costs: Mapping[float, Fraction], unit: Fraction | None = None
    ) -> None:
        """Begin at total cost 0, nothing settled.

        Args:
            live: the chain.
            exact_costs: float cost -> the fraction meant.
            unit: of which every cost is rounded up to a multiple; None: their common unit.
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
        self._lists: tuple[Any, ...] = ()  # of what waits, and of moves, once loops are compiled

    def _begin(self, live: LiveChain, unit: Fraction, steps: IntArray, block: IntArray) -> None:
        """Begin the sweep over arrivals at total cost 0, no layer settled.

        Args:
            live: the chain.
            unit: of which every cost is a multiple.
            steps: how many each move costs, [moves].
            block: of columns to which each move leads, [moves].
        """
        self.settled, self.unit = 0, unit  # layers 0 .. settled - 1 are
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
        """Total cost of arriving in whole layers, rounded once, like ``layers``."""
        return totals_of(layers, self.unit)

    @property
    def frontier(self) -> float:
        """The total cost from which on arrivals are not settled yet."""
        return float(self.settled * self.unit)

    def atoms(self) -> tuple[IntArray, FloatArray]:
        """Settled layers at which mass arrives, increasing, and how much: [atoms] each."""
        return np.array(self._layers, dtype=self._number), np.array(self._masses, dtype=np.float64)

    def followed(self, enough: int | None = None) -> Iterator[int]:
        """Settle arrivals in twice as many layers each time, up to ``enough`` or the support's end.

        Yields:
            How many layers are settled; at least once.

        Raises:
            ModelError: this would take too long.
        """
        yield self.settled
        while not self.exhausted and (enough is None or self.settled < enough):
            ahead = max(2 * self.settled, self._first)
            self.settle(ahead if enough is None else min(ahead, enough))
            yield self.settled

    @property
    def exhausted(self) -> bool:
        """Whether no arrival is waited for any more: every atom is known."""
        return not self._occupied.any()

    def last_layer(self, bound: float | Fraction) -> int:
        """The last layer of arrivals within a finite total cost, decided in whole numbers."""
        far = float(_LAST_LAYER * self.unit)
        if not isinstance(bound, Rational) and not 0.0 < bound < far:
            return 0 if bound == 0.0 else -1 if bound < 0.0 else _LAST_LAYER
        return min(max(last_layer(bound, self.unit), -1), _LAST_LAYER)

    @with_twin
    def settle(self, layers: int) -> None:
        """Settle the arrivals of all layers below the given number.

        Raises:
            ModelError: this would take too long.
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
        """Whether a step passes so few layers that most of them are reached by arrivals."""
        return self._waiting.size <= _NARROW

    @property
    def leaps(self) -> bool:
        """Whether arrivals in layers that are not settled can be asked for: the places are few.

        So it is after as much work of settling as the powers will take, and not before.
        """
        size = self._powers.size
        few = size <= _MOST_PLACES and not self.exhausted
        return few and self._work >= _WORK_OF_POWERS * size**3

    def arrived(self, layer: int) -> float:
        """Mass that arrives below a layer, Pr(goal, C < layer); it is settled, or :attr:`leaps`."""
        layers, masses = self.atoms()
        arrived = float(masses[np.asarray(layers < layer, dtype=np.bool_)].sum())
        return arrived + self._ahead(layer)[0] if layer > self.settled and self.leaps else arrived

    def first_reaching(self, mass: float) -> int:
        """The layer in which arrivals reach a mass that the settled ones do not; where leaps.

        Raises:
            ModelError: there are more layers before it than can be counted.
        """
        beyond = max(mass - sum(self._masses), _TINY)
        layers = self._powers.until(self._here(), beyond)
        if layers is None:
            raise ModelError(self._too_large("the answer lies too far out"))
        return self.settled + layers

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Arrivals in a layer or later: Pr(goal), and E[C - that layer; goal].

        Args:
            layer: the first that is not settled if left out; a later one where :attr:`leaps`.
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
        """Powers of one layer's transition between the places where mass waits to arrive."""
        return _LayerPowers(self._onward, self._live.lost, self._free)

    def _here(self) -> FloatArray:
        """Mass waiting to arrive before the first layer that is not settled, [places]."""
        rows = (self.settled + self._powers.delay) % self._width
        return np.asarray(self._waiting[rows * self._size + self._powers.node])

    def _ahead(self, layer: int) -> tuple[float, FloatArray]:
        """Mass that arrives from the settled layers to a later one, and what waits, [places]."""
        return self._powers.after(self._here(), layer - self.settled)

    def _to_next(self) -> int | None:
        """Number of layers ahead at which mass next waits to arrive; None: there is none."""
        row = self.settled % self._width
        for begin, part in ((0, self._occupied[row:]), (-row, self._occupied[:row])):
            first = int(np.argmax(part)) if part.size else 0
            if part.size and part[first]:
                return (begin + first) % self._width
        return None

    def _settle_one(self) -> None:
        """Settle the arrivals of one more layer."""
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
        """Settle arrivals of several layers without moves at no cost, in compiled loops."""
        from ssp_lp.compiled.layers import stream_layers

        lists = self._lists
        if not lists:  # where mass waits, layer by layer of the ring
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
        """Count the moves followed for arrivals; ModelError where they are too many."""
        self._work += work
        if self._work > _MOST_WORK:
            raise ModelError(self._too_large("the answer lies too far out"))

    def _send(self, visits: FloatArray, active: IntArray, begin: int) -> None:
        """Send mass on to later arrivals along moves that pay or arrive, into the ring."""
        moves, waiting = self._onward, self._waiting
        if active.size >= _MOSTLY * visits.size:
            active = np.arange(visits.size)
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
        """Why the table of arrivals is too large, as an error says it."""
        return (
            f"the law of success costs takes too large a table: {self._size - 1:,} nodes of the "
            f"policy's chain, {self._width:,} layers of cost {float(self.unit):g} in one step, "
            f"{self.settled:,} layers so far ({reason}); round the costs to a coarser grid when "
            "building the model, or ask for a lower cost or level"
        )


_FIRST_STEPS = 8  # of the dearest kind
_MOST_STEPS = 64  # of steps by cost
_EARLY = 0.5  # of the sums, after which some of the runs must have arrived
_SOME = 0.05  # share of those that succeed
_COARSE_TOO = 3  # times the sums that are followed, with those of a coarse unit
_UNLIKELY = 1e-17  # share of those that succeed, less than rounding, by a sum that is unlikely


class TooManySumsError(ModelError):
    """A question needs more sums than are followed one by one."""


class FollowedSums(Arrivals):
    """Arrivals in layers of a tiny unit, of which only those at which mass waits are looked at.

    Likely sums are followed as they are. Mass that waits at an unlikely one goes on from the next
    multiple of a coarse unit, where it meets that of others: the more sums have been followed, the
    likelier one must be.
    """

    _number = object
    leaps = False

    def __init__(
        self,
        live: LiveChain,
        exact_costs: Mapping[float, Fraction],
        coarse: Fraction,
        most: int,
        rarest: float = _UNLIKELY,
    ) -> None:
        """Begin at total cost 0, nothing settled.

        Args:
            live: the chain.
            exact_costs: float cost -> the fraction meant.
            coarse: cost of which unlikely sums are rounded up to a multiple.
            most: sums that are followed.
            rarest: share of those that succeed up to which the last of them is unlikely; beyond it
                all are, unless none but the rarest may be rounded.
        """
        distinct, step = np.unique(live.paid, return_inverse=True)
        unit = common_unit(distinct, exact_costs)
        self._followed, self._most, self._rarest = 0, most, rarest
        self._end = most if rarest == _UNLIKELY else _COARSE_TOO * most
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
        """Whether no sum of costs is left to arrive at: every atom is known."""
        return not self._next

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Total cost of a followed sum at which mass arrives, rounded once, like ``layers``."""
        up, down = self.unit.numerator, self.unit.denominator
        totals = [int(layer) * up / down for layer in np.ravel(layers).tolist()]
        return np.array(totals, dtype=np.float64).reshape(np.shape(layers))

    def last_layer(self, bound: float | Fraction) -> int:
        """The last followed sum of at most a bound, which may itself be a sum rounded otherwise."""
        return int(Fraction(bound) * (1 + Fraction(SAME_TOTAL) / 2) // self.unit)

    def settle(self, layers: int) -> None:
        """Settle the arrivals at all sums of costs below the given layer.

        Raises:
            TooManySumsError: there are too many sums below it.
            Stop: the time ended.
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
        """Whether so little of what arrives comes by a sum that it is not followed by itself."""
        if self._followed >= self._most:
            return self._end > self._most
        arriving = sum(float(masses @ self._live.goal[nodes]) for nodes, masses in parts)
        share = _UNLIKELY * math.pow(self._rarest / _UNLIKELY, self._followed / self._most)
        return arriving <= share * self._goal

    @property
    def _may_be_exhausted(self) -> bool:
        """Whether there is hope that the followed sums of costs come to an end."""
        if self._followed <= _EARLY * self._most:
            return self._followed <= self._end and len(self._units) <= _MOST_STEPS
        return self._followed <= self._end and self._arrived >= _SOME * self._goal

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Arrivals at sums not settled: Pr(goal), and E[C - frontier; goal]."""
        goal, cost, frontier = 0.0, 0.0, self.settled if layer is None else layer
        for begun, parts in self._pending.items():
            delay = float((begun - frontier) * self.unit)
            for nodes, masses in parts:
                reached = float(masses @ self._live.goal[nodes])
                goal += reached
                cost += delay * reached + float(masses @ self._live.cost[nodes])
        return goal, cost

    def _settle_sum(self, layer: int) -> None:
        """Settle the arrivals at the least sum that is still followed."""
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
        """Let mass wait to arrive at the sums that steps make of its own."""
        if layer not in self._pending:
            self._pending[layer] = []
            heappush(self._next, layer)
        self._pending[layer].append((nodes, masses))


def cost_of(sweep: Arrivals, layer: int) -> float:
    """Total cost of a layer or of a followed sum."""
    return float(sweep.cost_of(np.array(layer)))
