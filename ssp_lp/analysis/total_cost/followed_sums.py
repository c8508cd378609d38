"""How a chain's total costs are followed: in layers of a unit, sum by sum, or rounded up.

Where costs have no common unit worth counting in, the sums that occur are followed one by one, in
increasing order. They are whole numbers of a unit all the same, however small: a float means its
shortest decimal, so that two ways to one sum meet in one number, exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from heapq import heappop, heappush
from typing import TypeVar

import numpy as np
import scipy.sparse as sp

from ssp_lp.analysis.total_cost.arrivals import Arrivals
from ssp_lp.analysis.total_cost.live_chain import FreeChainMoves, LiveChain
from ssp_lp.arrays import SAME_TOTAL, FloatArray, IntArray
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import ModelError
from ssp_lp.processes.totals.lattice import common_unit, exact_cost

_FIRST_STEPS = 8  # of the dearest kind
_MOST_SUMS = 50_000  # followed one by one, some seconds
_MOST_SUMS_BESIDE = 5_000  # where a policy has a unit of its own: its chain is the larger
_MOST_KINDS = 64  # of steps by cost
_FINE = 2_000  # units in the mean of costs that are rounded
_MOST_UNITS = 20_000  # in the dearest step
_MOST_WAITING = 10_000_000  # masses kept at once
_EARLY = 2_000  # sums after which some of the runs must have arrived
_SOME = 0.05  # share of those that succeed


class _TooManySumsError(ModelError):
    """A question needs more sums than are followed one by one."""


class FollowedSums:
    """A sweep over the sums of a chain's costs. Mutable: it grows.

    The interface is that of ``Arrivals``, a layer being a multiple of a tiny unit.
    """

    leaps = False

    def __init__(self, live: LiveChain, exact_costs: Mapping[float, Fraction], most: int) -> None:
        """Begin at total cost 0, nothing settled, to follow at most so many sums."""
        self.settled, self._followed, self._most = 0, 0, most
        kinds, kind = np.unique(live.paid, return_inverse=True)
        self.unit = common_unit(kinds, exact_costs)
        exact = [exact_costs.get(c, exact_cost(c)) for c in kinds.tolist()]
        self._steps = [int(c / self.unit) for c in exact]
        self._live, self._size = live, len(live.start)
        goal = self._size - 1
        free = (live.paid == 0.0) & (live.target != goal)
        self._free = FreeChainMoves(live, free) if free.any() else None
        onward = (live.source[~free], kind[~free] * self._size + live.target[~free])
        shape = (goal, len(kinds) * self._size)
        self._onward = sp.csr_array((live.probability[~free], onward), shape=shape)
        nodes = np.flatnonzero(live.start)
        self._pending: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        self._next: list[int] = []
        self._send(0, nodes, live.start[nodes])
        self._layers: list[int] = []
        self._masses: list[float] = []

    @property
    def exhausted(self) -> bool:
        """Whether no sum is left to follow: every atom is known."""
        return not self._next

    def cost_of(self, layers: IntArray) -> FloatArray:
        """Total cost of a followed sum, rounded once, like ``layers``."""
        up, down = self.unit.numerator, self.unit.denominator
        found = [int(layer) * up / down for layer in np.ravel(layers).tolist()]
        return np.array(found, dtype=np.float64).reshape(np.shape(layers))

    def last_layer(self, bound: float | Fraction) -> int:
        """The last sum of at most a bound, which may itself be a sum rounded otherwise."""
        return int(Fraction(bound) * (1 + Fraction(SAME_TOTAL) / 2) // self.unit)

    def atoms(self) -> tuple[IntArray, FloatArray]:
        """Followed sums at which mass arrives, increasing, and how much: [atoms] each."""
        return np.array(self._layers, dtype=object), np.array(self._masses, dtype=np.float64)

    def followed(self, enough: int | None = None) -> Iterator[int]:
        """Follow twice as many sums each time, up to ``enough`` or to the end of the support.

        Yields:
            How many layers are settled; at least once.

        Raises:
            _TooManySumsError: there are too many sums before it.
        """
        yield self.settled
        while not self.exhausted:
            ahead = max(2 * self.settled, _FIRST_STEPS * max(self._steps, default=1), 1)
            self.settle(ahead if enough is None else min(ahead, enough))
            yield self.settled

    def settle(self, layers: int) -> None:
        """Settle all sums below the given layer.

        Raises:
            _TooManySumsError: there are too many sums below it.
            Stop: the time ended.
        """
        while self._next and self._next[0] < layers:
            check_time()
            self._followed += 1
            if not self._are_few:
                raise _TooManySumsError(f"more than {self._followed:,} sums of costs can occur")
            self._settle_one(heappop(self._next))
        self.settled = max(self.settled, layers)

    @property
    def _are_few(self) -> bool:
        """Whether there is hope that the sums come to an end of what is asked."""
        if self._followed <= _EARLY:
            return self._followed <= self._most and len(self._steps) <= _MOST_KINDS
        arrived = float(np.sum(self._masses)) + float(self._live.start[-1])
        goal = float(self._live.start @ self._live.goal)
        return self._followed <= self._most and arrived >= _SOME * goal

    @property
    def frontier(self) -> float:
        """The total cost from which on no sum is settled."""
        return float(self.settled * self.unit)

    def arrived(self, layer: int) -> float:
        """Pr(goal, C lies below the sum), which is settled."""
        known = sum(1 for found in self._layers if found < layer)
        return float(np.sum(self._masses[:known]))

    def remaining(self, layer: int | None = None) -> tuple[float, float]:
        """Of the runs that arrive at sums not settled: Pr(goal), and E[C - frontier; goal]."""
        goal, cost, frontier = 0.0, 0.0, self.settled if layer is None else layer
        for begun, parts in self._pending.items():
            delay = float((begun - frontier) * self.unit)
            for nodes, masses in parts:
                reached = float(masses @ self._live.goal[nodes])
                goal += reached
                cost += delay * reached + float(masses @ self._live.cost[nodes])
        return goal, cost

    def first_reaching(self, mass: float) -> int:
        """Where leaps only: never."""
        raise ModelError(f"no leap to a mass of {mass:g}: sums are followed one by one")

    def _settle_one(self, layer: int) -> None:
        """Settle the least sum that is still followed."""
        parts = self._pending.pop(layer)
        nodes = np.concatenate([part[0] for part in parts])
        masses = np.concatenate([part[1] for part in parts])
        arrived = float(masses[nodes == self._size - 1].sum())
        if arrived > 0.0:
            self._layers.append(layer)
            self._masses.append(arrived)
        found = np.bincount(nodes, weights=masses, minlength=self._size)[:-1]
        visits = found.astype(np.float64)
        if self._free is not None:
            visits = self._free.spread(visits)
        active = np.flatnonzero(visits)
        if active.size == 0:
            return
        moves = self._onward[active]
        share = moves.data * np.repeat(visits[active], np.diff(moves.indptr))
        kind, target = np.divmod(moves.indices.astype(np.int64), self._size)
        for one in np.unique(kind).tolist():
            chosen, ahead = kind == one, layer + self._steps[one]
            self._send(ahead, target[chosen], share[chosen])

    def _send(self, layer: int, nodes: IntArray, masses: FloatArray) -> None:
        """Let mass wait for the sums that steps make of its own."""
        if layer not in self._pending:
            self._pending[layer] = []
            heappush(self._next, layer)
        self._pending[layer].append((nodes, masses))


Sweep = Arrivals | FollowedSums
Answer = TypeVar("Answer")


@dataclass(frozen=True, eq=False)
class Followed:
    """The sweeps over a chain's total cost, each begun when a question needs it."""

    live: LiveChain
    exact_costs: Mapping[float, Fraction]  # float cost -> the fraction meant
    typical: float  # a total cost
    rounded: LiveChain | None  # with costs rounded up to multiples of a unit worth counting in

    def asked(self, question: Callable[[Sweep], Answer]) -> Answer:
        """The answer to a question: exact, or of rounded costs where it needs too many sums."""
        try:
            return question(self._exact)
        except ModelError as error:
            if self.rounded is None and not isinstance(error, _TooManySumsError):
                raise
            return question(self._rounded)

    @cached_property
    def _exact(self) -> Sweep:
        """The sums that costs make as they are, or layers of a common unit."""
        try:
            return Arrivals(self.live, self.exact_costs)
        except ModelError:  # no common unit that is worth counting in
            most = _MOST_SUMS if self.rounded is None else _MOST_SUMS_BESIDE
            return FollowedSums(self.live, self.exact_costs, most)

    @cached_property
    def _rounded(self) -> Arrivals:
        """Every cost rounded up to a multiple of a small unit, the smaller of two."""
        most = max(min(_MOST_UNITS, _MOST_WAITING // len(self.live.start)), 1)
        least = float(self.live.paid.max(initial=0.0)) / most
        unit = Fraction(max(self.typical / _FINE, least))
        if self.rounded is not None:
            counted = Arrivals(self.rounded, self.exact_costs)
            if counted.unit <= unit:
                return counted
        return Arrivals(self.live, {}, unit)


def cost_of(sweep: Sweep, layer: int) -> float:
    """Total cost of a layer or of a followed sum."""
    return float(sweep.cost_of(np.array(layer)))
