"""How much mass of a policy's chain arrives at the goal at which total cost, layer after layer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import cached_property
from numbers import Rational
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.total_cost.layer_powers import LayerPlaces, LayerPowers
from ssp_lp.analysis.total_cost.live_chain import FreeChainMoves, LiveChain
from ssp_lp.arrays import SAME_TOTAL, FloatArray, IntArray, concatenated_ranges
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import ModelError
from ssp_lp.processes.totals.lattice import common_unit, last_layer, layers_of, totals_of

_FIRST_LAYERS = 64
_LAST_LAYER = 2**62  # as good as infinitely many
_MOST_WAITING = 50_000_000  # masses kept at once, 400 MB
_MOST_WORK = 3_000_000_000  # moves followed in all, some tens of seconds
_WORK_OF_A_LAYER = 3_000  # moves that could be followed while one layer is begun
_TOGETHER = 1_000_000  # moves that may be followed between two looks at the time
_MOSTLY = 0.5  # share of a chain's nodes from which all of its moves are followed
_TINY = 5e-324  # the least mass there is
_MOST_PLACES = 800  # of a dense matrix of one layer, of which some sixty powers are kept, 300 MB
_WORK_OF_POWERS = 0.125  # moves that could be followed while powers are taken, per places cubed


class Arrivals:
    """A sweep over the total cost in whole layers of the costs' common unit. Mutable: it grows.

    Mass waits at (layer, node) in a ring as wide as the costliest step. A layer is settled by
    spreading its mass over the moves that cost nothing and sending it on along the others; what
    is then at the goal is that layer's atom. All that is not settled is known exactly from the
    linear solves of each node's prospects, so the tail is never a difference of large numbers.
    Where the nodes are few, what lies far beyond the settled layers is had from powers of the
    transition of one layer (:attr:`leaps`).

    Raises:
        ModelError: the costs have no common unit that gives a sane number of layers.
    """

    def __init__(
        self, live: LiveChain, exact_costs: Mapping[float, Fraction], unit: Fraction | None = None
    ) -> None:
        """Begin at total cost 0, nothing settled.

        Args:
            live: the chain.
            exact_costs: float cost -> the fraction meant.
            unit: of which every cost is rounded up to a multiple; None: their common unit.
        """
        self.settled = 0  # layers 0 .. settled - 1 are
        self._work = 0
        paid = live.paid
        flat = paid.size > 0 and float(paid.min()) == float(paid.max())
        distinct = paid[:1] if flat else np.unique(paid)
        if unit is None:
            self.unit = common_unit(distinct, exact_costs)
            self._steps = layers_of(distinct, self.unit, exact_costs)
        else:
            self.unit = unit
            self._steps = np.ceil(distinct / float(unit) * (1.0 - SAME_TOTAL)).astype(np.int64)
        self._width = int(self._steps.max(initial=0)) + 1
        self._live, self._size = live, len(live.start)
        if self._width * self._size > _MOST_WAITING:
            raise ModelError(self._too_large("one step passes too many layers"))
        step = self._steps[np.searchsorted(distinct, paid)]
        goal = self._size - 1
        free = (step == 0) & (live.target != goal)
        self._free = FreeChainMoves(live, free) if free.any() else None
        onward = (live.source[~free], (step * self._size + live.target)[~free])
        shape = (goal, self._width * self._size)
        self._onward = sp.csr_array((live.probability[~free], onward), shape=shape)
        self._waiting = np.zeros(shape[1])
        self._waiting[: self._size] = live.start
        self._occupied = np.arange(self._width) == 0
        self._lists: tuple[Any, ...] = ()  # of what waits, and of moves, once loops are compiled
        self._layers: list[int] = []
        self._masses: list[float] = []

    @property
    def exhausted(self) -> bool:
        """Whether no arrival is waited for any more: every atom is known."""
        return not self._occupied.any()

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Total cost of whole layers, rounded once, like ``layers``."""
        return totals_of(layers, self.unit)

    def last_layer(self, bound: float | Fraction) -> int:
        """The last layer of a total cost of at most a finite bound, decided in whole numbers."""
        far = float(_LAST_LAYER * self.unit)
        if not isinstance(bound, Rational) and not 0.0 < bound < far:
            return 0 if bound == 0.0 else -1 if bound < 0.0 else _LAST_LAYER
        return min(max(last_layer(bound, self.unit), -1), _LAST_LAYER)

    def atoms(self) -> tuple[IntArray, FloatArray]:
        """Settled layers at which mass arrives, increasing, and how much: [atoms] each."""
        return np.array(self._layers, dtype=np.int64), np.array(self._masses, dtype=np.float64)

    def settle(self, layers: int) -> None:
        """Settle all layers below the given number.

        Raises:
            ModelError: this would take too long.
            Stop: the time ended.
        """
        while self.settled < layers:
            check_time()
            if self._lists or (self._free is None and accelerated(_TOGETHER)):
                few = max(_TOGETHER // max(self._onward.nnz, 1), 1)
                self._settle_together(min(layers - self.settled, few))
                continue
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

    @property
    def leaps(self) -> bool:
        """Whether layers that are not settled can be asked for: the places are few.

        So it is after as much work of settling as the powers will take, and not before.
        """
        size = self._places.size
        few = size <= _MOST_PLACES and not self.exhausted
        return few and self._work >= _WORK_OF_POWERS * size**3

    def arrived(self, layer: int) -> float:
        """Pr(goal, C lies below the layer); the layer is settled, or :attr:`leaps`."""
        layers, masses = self.atoms()
        known = float(masses[layers < layer].sum())
        return known + self._ahead(layer)[0] if layer > self.settled and self.leaps else known

    def first_reaching(self, mass: float) -> int:
        """The layer in which the arrivals reach a mass that the settled ones do not; where leaps.

        Raises:
            ModelError: there are more layers before it than can be counted.
        """
        beyond = max(mass - sum(self._masses), _TINY)
        layers = self._powers.until(self._here(), beyond)
        if layers is None:
            raise ModelError(self._too_large("the answer lies too far out"))
        return self.settled + layers

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Of the runs that arrive at a layer or later: Pr(goal), and E[C - that layer; goal].

        Args:
            layer: the first that is not settled if left out; a later one where :attr:`leaps`.
        """
        if layer is None:
            occupied = np.flatnonzero(self._waiting)
            row, node = np.divmod(occupied, self._size)
            ahead, delay = self._waiting[occupied], (row - self.settled) % self._width
        else:
            ahead, node, delay = self._ahead(layer)[1], self._places.node, self._places.delay
        goal = ahead * self._live.goal[node]
        cost = self.cost_of(delay) * goal + ahead * self._live.cost[node]
        return float(goal.sum()), float(cost.sum())

    @cached_property
    def _places(self) -> LayerPlaces:
        """Where mass that will arrive can wait: at each node, until its dearest step has passed."""
        dearest = np.zeros(self._size, dtype=np.int64)
        columns = self._onward.indices.astype(np.int64)
        np.maximum.at(dearest, columns % self._size, columns // self._size)
        return LayerPlaces.upto(dearest)

    @cached_property
    def _powers(self) -> LayerPowers:
        """The transition of one layer and its powers."""
        lost = self._live.lost[:, None]
        chosen = self._places.columns(self._size)
        later = self._onward[:, np.append(chosen, self._size - 1)].toarray()
        leaving = np.hstack([later, lost])
        return self._places.powers(leaving if self._free is None else self._free.gathered(leaving))

    def _here(self) -> FloatArray:
        """What waits before the first layer that is not settled, [places]."""
        rows = (self.settled + self._places.delay) % self._width
        return np.asarray(self._waiting[rows * self._size + self._places.node])

    def _ahead(self, layer: int) -> tuple[float, FloatArray]:
        """What arrives from the settled layers to a later one, and what waits then, [places]."""
        return self._powers.after(self._here(), layer - self.settled)

    def _to_next(self) -> int | None:
        """How many layers ahead the next one is at which mass may wait; None: there is none."""
        row = self.settled % self._width
        for begin, part in ((0, self._occupied[row:]), (-row, self._occupied[:row])):
            first = int(np.argmax(part)) if part.size else 0
            if part.size and part[first]:
                return (begin + first) % self._width
        return None

    def _settle_one(self) -> None:
        """Settle one more layer: what arrives there is known."""
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
        """Settle several layers, none of which has moves that cost nothing, in compiled loops."""
        from ssp_lp.compiled.streaming import stream_layers

        if not self._lists:  # where mass waits, layer by layer of the ring
            places = np.flatnonzero(self._waiting)
            heads, links = np.full(self._width, -1), np.full(self._waiting.size, -1, dtype=np.int32)
            row = places // self._size
            links[places[1:]] = np.where(row[1:] == row[:-1], places[:-1], -1)
            heads[row] = places
            moves = self._onward
            rows = moves.indptr.astype(np.int64), moves.indices.astype(np.int64), moves.data
            self._lists = heads, links, *rows
        run: Callable[..., int] = stream_layers
        arrived = np.zeros(layers)
        followed = run(self._waiting, *self._lists, self.settled % self._width, arrived)
        self._occupied = self._lists[0] >= 0
        reached = np.flatnonzero(arrived)
        self._layers += (self.settled + reached).tolist()
        self._masses += arrived[reached].tolist()
        self.settled += layers
        self._count(int(followed) + layers * _WORK_OF_A_LAYER)

    def _count(self, work: int) -> None:
        """Count what has been followed; ModelError where it is too much."""
        self._work += work
        if self._work > _MOST_WORK:
            raise ModelError(self._too_large("the answer lies too far out"))

    def _send(self, visits: FloatArray, active: IntArray, begin: int) -> None:
        """Send visits on along the moves that pay or arrive, into the ring that begins here."""
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
