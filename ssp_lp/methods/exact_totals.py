"""Lower bounds at a price of failure by exact totals, where a table of rounded ones leaves a gap.

A table over a lattice bounds what every policy is worth from each state at each total. Where the
law of the total cost has few large atoms, as a quantile's does on a model whose steps mostly go as
planned, the optimum is one of the totals themselves, and a smaller unit only comes near to it.
From the start few (state, total) are reached by policies that may be best. So they are told apart
one by one: best-first search for a policy (AO*: Martelli and Montanari 1978, Nilsson 1980) with the
table as its heuristic. Where every step costs something totals rise, and the places that are
reached form a graph without cycles. What is not expanded has the table's bound, so that the bound
of the start is one whenever the search ends, and no less than the table's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.column_generation.column import Proof
from ssp_lp.compiled.deadline import check_time
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends

SAME = 1e-12
"""Relative distance of totals that are one: bounds hold for totals that much smaller."""

_RISING = 1e-9  # of the total in question: a step that adds more cannot lead back
_LITTLE = 1e-13  # mass that comes to a place which is not worth looking at
_ROUNDING = 1e-12  # of the price and what is late: far above the rounding of a sum of probabilities


class _Action(NamedTuple):
    """What an action of a state does, whatever has been paid."""

    arriving: list[tuple[float, float]]  # mass, and what the step into the goal costs
    failing: float  # mass that fails
    steps: list[tuple[float, int, float]]  # mass, the state that it comes to, and the cost


class _Option(NamedTuple):
    """An action at a place."""

    late: float  # mass that arrives beyond the bound
    failing: float  # mass that fails
    onward: list[_Part]  # where the rest goes on


@dataclass(eq=False, slots=True)
class _Place:
    """A state with what has been paid. Mutable: its bound rises."""

    state: int
    paid: float
    value: float  # no policy is worth less from here on
    is_open: bool  # before the bound, so that it may be expanded
    options: list[_Option] | None = None  # None: not expanded
    parents: list[_Place] = field(default_factory=list)


_Part = tuple[float, _Place]
"""Mass, and where it is."""


@dataclass(frozen=True, eq=False)
class Bounded:
    """What a search came to."""

    bound: float  # of every policy's value at the price
    failure: float  # of the policy that seems best
    finished: bool  # whether that is the best policy, and the bound its value


def rises_by_each_step(model: SSP, total: float) -> bool:
    """Whether every step adds to the cost paid what is told apart before a total."""
    ended = model.goal_mask | dead_ends(model)
    going_on = (model.probabilities > 0.0) & ~ended[model.successors]
    return bool(model.costs[going_on].min(initial=np.inf) > _RISING * total)


@dataclass(frozen=True, eq=False)
class ExactTotals:
    """The search at one price: what is late costs 1, and what fails the price."""

    model: SSP  # with its true costs
    start: FloatArray  # [states]
    process: LayeredProcess  # of the model with costs rounded down, cut at the same bound
    proof: Proof  # at the price, with its table
    last: float  # total beyond which an arrival is late
    usable: BoolArray | None = None  # pairs that may be used, [model pairs]; None: all

    def raised(self, enough: float, most: int) -> Bounded:
        """Raise the start's bound until it is enough, or the value of the best policy.

        Args:
            enough: bound beyond which none is needed.
            most: places after which the search ends.
        """
        places, roots, constant = dict[tuple[int, int], _Place](), list[_Part](), self.proof.bound
        for state in np.flatnonzero((self.start > 0.0) & (self._node_of >= 0)).tolist():
            roots.append((float(self.start[state]), self._place(places, state, 0.0)))
            constant -= roots[-1][0] * roots[-1][1].value
        while True:
            check_time()
            tips, failure = self._tips(roots)
            bound = constant + sum(mass * place.value for mass, place in roots)
            bound -= _ROUNDING * (abs(bound) + self.proof.price + 1.0)
            if bound > enough or not tips or len(places) > most:
                return Bounded(max(bound, self.proof.bound), failure, not tips)
            for place in tips:
                self._expand(places, place)
            self._raise_bounds(tips)

    def _place(self, places: dict[tuple[int, int], _Place], state: int, paid: float) -> _Place:
        """The place of a state and a total, with the table's bound where it is new."""
        key = state, round(paid / self._same)
        if key not in places:
            layer = int(paid / self._unit * (1.0 - SAME))
            cap, node = self.process.cap, int(self._node_of[state])
            row = min(layer - cap, len(self._beyond) - 1)
            value = self.proof.values[layer, node] if layer < cap else self._beyond[row, node]
            places[key] = _Place(state, paid, float(value), is_open=layer < cap)
        return places[key]

    def _expand(self, places: dict[tuple[int, int], _Place], place: _Place) -> None:
        """Find what a place leads to by each of its actions."""
        place.options = []
        for arriving, failing, steps in self._actions(place.state):
            late = sum(mass for mass, cost in arriving if place.paid + cost > self.last)
            onward = [(mass, self._place(places, to, place.paid + c)) for mass, to, c in steps]
            for _, reached in onward:
                reached.parents.append(place)
            place.options.append(_Option(late, failing, onward))

    def _actions(self, state: int) -> list[_Action]:
        """What each action of a state does at any total."""
        if state in self._known:
            return self._known[state]
        model, found = self.model, list[_Action]()
        for pair in range(model.pair_offsets[state], model.pair_offsets[state + 1]):
            if self.usable is not None and not self.usable[pair]:
                continue
            begin, end = model.outcome_offsets[pair : pair + 2].tolist()
            arriving, failing, steps = (
                list[tuple[float, float]](),
                0.0,
                list[tuple[float, int, float]](),
            )
            for outcome in range(begin, end):
                mass, to = float(model.probabilities[outcome]), int(model.successors[outcome])
                cost = float(model.costs[outcome])
                if model.goal_mask[to]:
                    arriving.append((mass, cost))
                elif self._node_of[to] < 0:
                    failing += mass
                elif mass > 0.0:
                    steps.append((mass, to, cost))
            found.append(_Action(arriving, failing, steps))
        if self._gives_up[self._node_of[state]]:
            found.append(_Action([], 1.0, []))
        self._known[state] = found
        return found

    def _tips(self, roots: list[_Part]) -> tuple[list[_Place], float]:
        """Places to which the policy that seems best comes and that were not expanded; its failure.

        Each expanded place of it has its best option chosen on the way.
        """
        mass, order = dict[_Place, float](), list[tuple[float, int, _Place]]()
        tips, failure = list[_Place](), 0.0

        def sent(parts: list[_Part], share: float) -> None:
            """Send mass on to places."""
            for part, place in parts:
                if place not in mass:
                    heappush(order, (place.paid, id(place), place))
                mass[place] = mass.get(place, 0.0) + share * part

        sent(roots, 1.0)
        while order:
            place = heappop(order)[2]
            here = mass.pop(place)
            if here <= _LITTLE:
                continue
            if place.options is None:
                if place.is_open:
                    tips.append(place)
                else:
                    failure += here * float(self._failing_late[self._node_of[place.state]])
                continue
            best = min(place.options, key=self._value)
            failure += here * best.failing
            sent(best.onward, here)
        return tips, failure

    def _raise_bounds(self, changed: list[_Place]) -> None:
        """Raise the bounds of expanded places and of whatever leads to them, the dearest first."""
        order = [(-place.paid, id(place), place) for place in changed]
        heapify(order)
        waiting = set(changed)
        while order:
            place = heappop(order)[2]
            waiting.discard(place)
            value = min(map(self._value, place.options or ()), default=self.proof.price)
            if value > place.value:
                place.value = value
                for parent in place.parents:
                    if parent not in waiting:
                        waiting.add(parent)
                        heappush(order, (-parent.paid, id(parent), parent))

    def _value(self, option: _Option) -> float:
        """A lower bound of an option's value."""
        onward = sum(mass * place.value for mass, place in option.onward)
        return option.late + self.proof.price * option.failing + onward

    @property
    def _node_of(self) -> IntArray:
        """Node of each state, -1 at goals and dead-ends, [states]."""
        return self.process.base.quotient.node_of

    @cached_property
    def _unit(self) -> float:
        """Cost of a layer."""
        return self.process.base.unit

    @cached_property
    def _same(self) -> float:
        """Difference of totals that are one."""
        return SAME * self.last

    @cached_property
    def _known(self) -> dict[int, list[_Action]]:
        """The actions of states, kept."""
        return {}

    @cached_property
    def _gives_up(self) -> BoolArray:
        """Nodes where a policy may fail at once, [nodes]."""
        quotient = self.process.base.quotient
        found = np.zeros(quotient.n_nodes, dtype=np.bool_)
        found[quotient.pair_node[quotient.gives_up]] = True
        return found

    @cached_property
    def _beyond(self) -> FloatArray:
        """Bounds from what is surely late, [layers, nodes]."""
        return self.process.beyond_bound(self.proof.price, self.proof.price)

    @cached_property
    def _failing_late(self) -> FloatArray:
        """How a policy fails that is surely late, where it is best, [nodes]."""
        tails = self.process.tails
        return 1.0 - (tails.greatest_goal if self.proof.price > 1.0 else tails.least_goal)
