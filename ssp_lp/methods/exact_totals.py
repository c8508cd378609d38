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
    """Successors, costs and probabilities of a state's action, whatever has been paid."""

    arriving: list[tuple[float, float]]  # mass, and what the step into the goal costs
    failing: float  # mass that fails
    steps: list[tuple[float, int, float]]  # mass, the state that it comes to, and the cost


class _Option(NamedTuple):
    """An action at a place."""

    paid: float  # for mass that arrives beyond the bound, and for what fails
    failing: float  # mass that fails
    onward: list[tuple[float, _Place]]  # mass that goes on, and where

    def value(self) -> float:
        """Lower bound, by exact totals, of the charge from here on."""
        return self.paid + sum(mass * place.value for mass, place in self.onward)


@dataclass(eq=False, slots=True)
class _Place:
    """A state with what has been paid. Mutable: its bound rises."""

    state: int
    paid: float
    value: float  # no policy is worth less from here on
    is_open: bool  # before the bound, so that it may be expanded
    options: list[_Option] | None = None  # None: not expanded
    parents: list[_Place] = field(default_factory=list)


def rises_by_each_step(model: SSP, total: float) -> bool:
    """Whether every step adds to the exact total of a cost paid."""
    ended = model.goal_mask | dead_ends(model)
    going_on = (model.probabilities > 0.0) & ~ended[model.successors]
    return bool(model.costs[going_on].min(initial=np.inf) > _RISING * total)


@dataclass(eq=False)
class ExactTotals:
    """The search at one price: what is late costs 1, and what fails the price. Mutable."""

    model: SSP  # with its true costs
    start: FloatArray  # [states]
    process: LayeredProcess  # of the model with costs rounded down, cut at the same bound
    proof: Proof  # at the price, with its table
    last: float  # total beyond which an arrival is late
    usable: BoolArray | None = None  # pairs that may be used, [model pairs]; None: all
    places: dict[tuple[int, int], _Place] = field(default_factory=dict, init=False)
    actions: dict[int, list[_Action]] = field(default_factory=dict, init=False)  # of states

    def raised(self, enough: float, most: int) -> tuple[float, float, bool]:
        """Raise the start's bound until it is enough, or the value of the best policy.

        Args:
            enough: bound beyond which none is needed.
            most: places after which the search ends.

        Returns:
            A bound of every policy's value at the price; the failure of the policy that seems best;
            and whether that is the best policy, and the bound its value.
        """
        live = np.flatnonzero((self.start > 0.0) & (self._node_of >= 0)).tolist()
        begun = _Option(0.0, 0.0, [(float(self.start[x]), self._place(x, 0.0)) for x in live])
        root = _Place(-1, -1.0, begun.value(), is_open=True, options=[begun])
        for _, place in begun.onward:
            place.parents.append(root)
        constant = self.proof.bound - root.value
        while True:
            check_time()
            tips, failure = self._tips(root)
            bound = constant + root.value
            bound -= _ROUNDING * (abs(bound) + self.proof.price + 1.0)
            if bound > enough or not tips or len(self.places) > most:
                return max(bound, self.proof.bound), failure, not tips
            for place in tips:
                self._expand(place)
            self._raise_bounds(tips)

    def _place(self, state: int, paid: float) -> _Place:
        """Place of a state and an exact total, with the table's bound where it is new."""
        key = state, round(paid / (SAME * self.last))
        if key not in self.places:
            layer = int(paid / self.process.base.unit * (1.0 - SAME))
            cap, node = self.process.cap, int(self._node_of[state])
            row = min(layer - cap, len(self._beyond) - 1)
            value = self.proof.values[layer, node] if layer < cap else self._beyond[row, node]
            self.places[key] = _Place(state, paid, float(value), is_open=layer < cap)
        return self.places[key]

    def _expand(self, place: _Place) -> None:
        """Expand a place of AO*: the exact totals to which each action leads."""
        place.options = []
        for arriving, failing, steps in self._actions(place.state):
            late = sum(mass for mass, cost in arriving if place.paid + cost > self.last)
            onward = [(mass, self._place(to, place.paid + cost)) for mass, to, cost in steps]
            for _, successor in onward:
                successor.parents.append(place)
            place.options.append(_Option(late + self.proof.price * failing, failing, onward))

    def _actions(self, state: int) -> list[_Action]:
        """Actions of a state at any exact total: their successors, costs and probabilities."""
        if state in self.actions:
            return self.actions[state]
        model, usable = self.model, self.usable
        actions = self.actions[state] = []
        for pair in range(model.pair_offsets[state], model.pair_offsets[state + 1]):
            if usable is not None and not usable[pair]:
                continue
            action = _Action([], 0.0, [])
            for outcome in range(*model.outcome_offsets[pair : pair + 2].tolist()):
                mass, to = float(model.probabilities[outcome]), int(model.successors[outcome])
                cost = float(model.costs[outcome])
                if model.goal_mask[to]:
                    action.arriving.append((mass, cost))
                elif self._node_of[to] < 0:
                    action = action._replace(failing=action.failing + mass)
                elif mass > 0.0:
                    action.steps.append((mass, to, cost))
            actions.append(action)
        quotient = self.process.base.quotient
        if self._node_of[state] in quotient.pair_node[quotient.gives_up]:
            actions.append(_Action([], 1.0, []))
        return actions

    def _tips(self, root: _Place) -> tuple[list[_Place], float]:
        """Tips of AO*'s best partial policy, places not expanded yet; and its failure.

        Each expanded place of it has its best option chosen on the way.
        """
        mass, order = {root: 1.0}, [(root.paid, id(root), root)]
        tips, failure, tails = list[_Place](), 0.0, self.process.tails
        late = tails.greatest_goal if self.proof.price > 1.0 else tails.least_goal
        while order:
            place = heappop(order)[2]
            here = mass.pop(place)
            if here <= _LITTLE:
                continue
            if place.options is None:
                if place.is_open:
                    tips.append(place)
                else:
                    failure += here * (1.0 - float(late[self._node_of[place.state]]))
                continue
            best = min(place.options, key=_Option.value)
            failure += here * best.failing
            for share, successor in best.onward:
                if successor not in mass:
                    heappush(order, (successor.paid, id(successor), successor))
                mass[successor] = mass.get(successor, 0.0) + here * share
        return tips, failure

    def _raise_bounds(self, changed: list[_Place]) -> None:
        """Raise AO*'s bounds of expanded places and of what leads to them, the dearest first."""
        order = [(-place.paid, id(place), place) for place in changed]
        heapify(order)
        waiting = set(changed)
        while order:
            place = heappop(order)[2]
            waiting.discard(place)
            options = place.options or ()
            value = min((option.value() for option in options), default=self.proof.price)
            if value > place.value:
                place.value = value
                for parent in place.parents:
                    if parent not in waiting:
                        waiting.add(parent)
                        heappush(order, (-parent.paid, id(parent), parent))

    @property
    def _node_of(self) -> IntArray:
        """Node of each state in the search by exact totals, -1 at goals and dead-ends, [states]."""
        return self.process.base.quotient.node_of

    @cached_property
    def _beyond(self) -> FloatArray:
        """Bounds beyond the exact totals told apart, where it is surely late, [layers, nodes]."""
        return self.process.beyond_bound(self.proof.price, self.proof.price)
