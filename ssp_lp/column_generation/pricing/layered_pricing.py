"""The pricing problem of the accumulated-cost process: one backward sweep over its layers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type
from ssp_lp.column_generation.pricing.layer_bounds import (
    bound_free_steps,
    priced_layers,
    summed_layers,
)
from ssp_lp.column_generation.pricing.layer_choices import (
    best_of_layer,
    best_with_measures,
    is_acyclic,
    measures_of_layer,
)
from ssp_lp.column_generation.pricing.one_pass import OnePass, one_pass
from ssp_lp.column_generation.pricing.pricing_problem import Column, Proof, required
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import STOPS, Stop, check_time, heed
from ssp_lp.dynamic_programming.bellman import Work, safe_minima
from ssp_lp.dynamic_programming.leaving import approach_leaving
from ssp_lp.errors import ModelError
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.layered.layered_process import LayeredProcess
from ssp_lp.processes.totals.levels import Window

_BELOW_EVERY_VALUE = 1e-6
"""No value is below minus the price; a floor this much lower leaves room to count rounding."""

_KEPT_VALUES = 25_000_000
"""Largest table of checked values that is kept, nodes x layers: 0.2 GB. Of a larger one only the
shape is: infinite values ask for the best that can be proved, which one more sweep gives."""


@dataclass(frozen=True, eq=False)
class LayeredPricing:
    """Column generation's pricing problem for case S; the process is never written out.

    A choice is the position of a pair among those of its node, [cap, nodes], in the smallest
    integers that hold it.
    """

    process: LayeredProcess

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers, nodes]."""
        return self.process.cap, self.process.base.n_nodes

    def incumbent(self, reached: Any) -> Column | None:
        """What half a sweep is worth: see ``_cut_short``."""
        return reached() if callable(reached) else None

    def first(self) -> Column:
        """The first tail, which goes for the goal, followed from the start."""
        base, tails = self.process.base, self.process.tails
        nothing_paid = self.process.charge.beyond(np.zeros(base.n_nodes), tails.first)
        cost = float(base.start @ nothing_paid) + self.process.start_charge
        goal = float(base.start @ tails.goal[0])
        failure = float(base.start @ tails.first.failure) + base.start_failure
        policy = DeterministicPolicy(base.quotient.model, tails.decisions[0])
        return Column(cost, failure, goal + base.start_goal, None, policy=policy)

    def minimise(self, failure_price: float, *warm: Column | None) -> Column:
        """A policy of least ``E[charge; goal] + failure_price * failure``, measured exactly."""
        base = self.process.base
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty(self.value_shape, dtype=least_integer_type(most))
        failing = failure_price if self._likely else 0.0
        owed = failing * base.failure - (failure_price - failing) * base.survival * base.gain
        if self._one_pass is not None:
            beyond = self._tail_values(failure_price, failing)
            measures = np.stack(self.process.beyond(failure_price), axis=-1)
            totals = self._one_pass.minimise(owed, beyond, measures, choice)
            return self._column(totals, choice, failure_price, self.process.cap)
        totals = self._swept_down(failure_price, failing, owed, choice)
        return self._column(totals, choice, failure_price, self.process.cap)

    def _swept_down(
        self, price: float, failing: float, owed: FloatArray, choice: IntArray
    ) -> FloatArray:
        """Layer by layer the best choice, which is written, and its measures from the first.

        Raises:
            Stop: with a function that gives what had been swept by then as a column.
        """
        base, priced = self.process.base, priced_layers(self.process, owed)
        ahead = self.process.window(self._tail_values(price, failing))
        measured = self._measures_beyond(price)
        totals, inner = np.zeros((base.n_nodes, 3)), self._first_choice
        reached = self.process.cap
        try:
            for layer in reversed(range(self.process.cap)):
                check_time()
                cost, charge = priced(layer), self.process.charged(layer)
                if self._acyclic and accelerated(base.later.nnz):
                    windows, position = (ahead.flat, measured.flat), choice[layer]
                    values, found = best_with_measures(base, cost, charge, windows, position)
                else:
                    inner, values = best_of_layer(base, cost, ahead.flat, inner)
                    choice[layer] = inner - base.pair_offsets[:-1]
                    found = measures_of_layer(base, inner, charge, measured.flat)
                ahead.push(values)
                measured.push(found)
                reached, totals = layer, found
        except STOPS as stop:
            heed(stop)
            raise Stop(partial(self._cut_short, totals, choice, price, reached)) from stop
        return totals

    def _cut_short(
        self, totals: FloatArray, choice: IntArray, price: float, reached: int
    ) -> Column | None:
        """What a sweep that got down to a layer found: the best policy at a lower price of failure.

        Whoever begins in that layer as if nothing had been paid does what is best at the price
        less what the layer stands for. None where the charge is another one than the cost itself.

        Args:
            totals: measures from that layer on, [nodes, 3].
            choice: [cap, nodes], of which the layers from that one on are written.
            price: of failure.
            reached: the layer.
        """
        process = self.process
        if not process.grows_evenly or process.ladder is not None or reached == process.cap:
            return None
        paid = float(process.levels.totals[reached]) / process.base.survival
        begun = replace(process, cap=process.cap - reached)
        found = replace(self, process=begun)._column(totals, choice[:0], price - paid, 0)
        cost = found.cost - paid * (found.goal - process.base.start_goal)
        policy = begun.policy(choice[reached:], price - paid)
        return replace(found, cost=cost, choice=None, policy=policy)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice, by a backward sweep.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        base = self.process.base
        if self._one_pass is not None:
            measures = np.stack(self.process.beyond(tail_price), axis=-1)
            return self._column(self._one_pass.measure(measures, choice), choice, tail_price, 0)
        measured, totals = self._measures_beyond(tail_price), np.zeros((base.n_nodes, 3))
        for layer in reversed(range(self.process.cap)):
            check_time()
            chosen = base.pair_offsets[:-1] + choice[layer]
            charge = self.process.charged(layer)
            totals = measures_of_layer(base, chosen, charge, measured.flat)
            measured.push(totals)
        return self._column(totals, choice, tail_price, 0)

    def _measures_beyond(self, tail_price: float) -> Window:
        """The measures of the tails beyond the layers."""
        return self.process.window(np.stack(self.process.beyond(tail_price), axis=-1))

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        base, work = self.process.base, Work(backups, self.process.cap)
        cost, failure, goal = (base.start @ totals).tolist()
        failure = max(failure + base.start_failure, 0.0)  # verified: below it lies rounding
        goal = max(goal + base.start_goal, 0.0)
        cost += self.process.start_charge
        return Column(cost, failure, goal, choice, tail_price, work=work)

    def aligned(self, column: Column, price: float) -> Column:
        """The column with its tails chosen by this price, measured again."""
        if column.choice is None:
            return column
        here, there = self.process.threshold(column.tail_price), self.process.threshold(price)
        return column if np.array_equal(here, there) else self.measure(column.choice, price)

    def prove(self, price: float, best: Column | None = None, *, slack: bool = False) -> Proof:
        """The best lower bound of every policy that a sweep gives; none is needed for it."""
        return self.check(price, self._anything, slack=slack)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [cap, nodes], to a checked sub-solution.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved.

        Raises:
            ModelError: values of another shape.
        """
        failing = 0.0 if slack else price
        if values.shape != self.value_shape:
            raise ModelError(f"a value function of shape {self.value_shape} is needed")
        return self._swept(price, failing, values, self.process.beyond_bound(price, failing))

    def tail_loss(self, price: float, *, slack: bool = False, proved: float = -np.inf) -> float:
        """How much of the bound the cap costs: 0 where the tails are proved to be optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there.

        Args:
            price: of failure.
            slack: as of :meth:`check`.
            proved: a bound that was proved at this price; where it is as high, that is all.
        """
        failing = 0.0 if slack else price
        reached = self._swept(
            price, failing, self._anything, self._tail_values(price, failing)
        ).bound
        if reached <= proved:
            return 0.0
        return max(reached - self.check(price, self._anything, slack=slack).bound, 0.0)

    def _swept(self, price: float, failing: float, values: FloatArray, beyond: FloatArray) -> Proof:
        """Lower values layer by layer, from what is given beyond the cap."""
        base, success = self.process.base, price - failing
        owed, saved = failing * base.failure, success * base.survival * base.gain
        floor = -(success - self.process.charge.lowest) * (1.0 + _BELOW_EVERY_VALUE)
        if self._one_pass is not None:
            given = np.maximum(np.nan_to_num(values, nan=floor, posinf=np.inf), floor)
            checked = self._one_pass.lowest(owed, saved, given, beyond)
            return self._proof(price, failing, checked[0], checked)
        summed = summed_layers(self.process, owed, saved)
        kept = np.empty(values.shape) if values.size <= _KEPT_VALUES else self._anything
        window, inner = self.process.window(beyond), self._first_choice
        lowest = np.zeros(base.n_nodes)
        for layer in reversed(range(self.process.cap)):
            check_time()
            given = np.maximum(np.nan_to_num(values[layer], nan=floor, posinf=np.inf), floor)
            if self._acyclic:
                sums = base.pair_offsets, base.later, *summed(layer)
                lowest = np.minimum(safe_minima(*sums, window.flat), given)
            else:
                lowest, inner = bound_free_steps(
                    base, summed(layer), window.flat, given, inner, floor
                )
            if kept.flags.writeable:
                kept[layer] = lowest
            window.push(lowest)
        return self._proof(price, failing, lowest, kept)

    def _proof(
        self, price: float, failing: float, lowest: FloatArray, checked: FloatArray
    ) -> Proof:
        """The bound that values of the first layer give, [nodes]; all of them are kept."""
        base = self.process.base
        ended = failing * base.start_failure, -(price - failing) * base.start_goal
        parts = np.append(base.start * lowest, (*ended, self.process.start_charge))
        loss = (np.count_nonzero(parts) - 1.0) * MACHINE_EPSILON * float(np.abs(parts).sum())
        bound = float(parts.sum()) - max(float(loss), 0.0)
        kept = checked if checked.size <= _KEPT_VALUES else self._anything
        return Proof(price, failing, bound, kept, Work(self.process.cap, 0))

    @cached_property
    def _one_pass(self) -> OnePass | None:
        return one_pass(self.process)

    @cached_property
    def _anything(self) -> FloatArray:
        """Values that ask for the best that can be proved, [cap, nodes]."""
        return np.broadcast_to(np.inf, self.value_shape)

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.process.policy(required(column.choice), column.tail_price)

    @cached_property
    def _acyclic(self) -> bool:
        """Whether every step between states costs something, so that layers need no solving."""
        return is_acyclic(self.process.base)

    @cached_property
    def _likely(self) -> bool:
        """Whether some policy probably succeeds; else success is counted rather than failure."""
        base, tails = self.process.base, self.process.tails
        return float(base.start @ tails.goal[0]) + base.start_goal >= 0.5

    @cached_property
    def _first_choice(self) -> IntArray:
        """A choice by which each layer is left."""
        base = self.process.base
        leaving = (base.gain > 0) | (base.failure > 0) | (np.diff(base.later.indptr) > 0)
        return approach_leaving(base.instant_dynamics, leaving)

    def _tail_values(self, price: float, failing: float) -> FloatArray:
        """Values of the tails beyond the cap, [layers, nodes]."""
        cost, failure, goal = self.process.beyond(price)
        return cost + failing * failure - (price - failing) * goal
