"""The pricing problem of the accumulated-cost process: one backward sweep over its layers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Final

import numpy as np

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.accumulated_cost.sweep import (
    OnePass,
    best_of_layer,
    bound_free_steps,
    follow_choice,
    is_acyclic,
    mass_beyond,
    measures_backwards,
    measures_of_layer,
    one_pass,
    priced_layers,
    room_for_choice,
    summed_layers,
)
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.column_generation.column import Column, Proof, required
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import STOPS, Stop, check_time, end_with_incumbent
from ssp_lp.dynamic_programming.bellman import Work, safe_minima
from ssp_lp.dynamic_programming.dynamics import approach_leaving
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import Policy
from ssp_lp.policies.stationary import DeterministicPolicy

_NOBODY: IntArray = np.zeros(0, dtype=np.int64)


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
        """The first tail, which goes for the goal, followed from the start; or a guess at that."""
        base, tails = self.process.base, self.process.tails
        if tails.guess is not None:
            return Column(tails.guess[0], 1.0, tails.guess[1] + base.start_goal, None)
        nothing_paid = self.process.charge.beyond(np.zeros(base.n_nodes), tails.first)
        cost = float(base.start @ nothing_paid) + self.process.start_charge
        goal = float(base.start @ tails.goal[0])
        failure = float(base.start @ tails.first.failure) + base.start_failure
        policy = DeterministicPolicy(base.quotient.model, tails.decisions[0])
        return Column(cost, failure, goal + base.start_goal, None, policy=policy)

    def minimise(self, failure_price: float, *warm: Column | None) -> Column:
        """A policy of least ``E[charge; goal] + failure_price * failure``, measured exactly."""
        base = self.process.base
        choice = room_for_choice(self.process)
        failing = failure_price if self._likely else 0.0
        owed = failing * base.failure - (failure_price - failing) * base.survival * base.gain
        if self._one_pass is not None:
            beyond = self.process.beyond_value(failure_price, failing)
            measures = self.process.measures_beyond(failure_price)
            totals = self._one_pass.minimise(owed, beyond, measures, choice)
            return self._column(base.start @ totals, choice, failure_price, self.process.cap)
        found = self._swept_down(failure_price, failing, owed, choice)
        return self._column(found, choice, failure_price, self.process.cap)

    def _swept_down(
        self, price: float, failing: float, owed: FloatArray, choice: IntArray
    ) -> FloatArray:
        """Layer by layer the best choice, which is written; its charge, failure and goal.

        Args:
            price: of failure.
            failing: what failing counts (see ``_likely``).
            owed: what that adds to the cost of each pair, [pairs].
            choice: written, [cap, nodes].

        Raises:
            Stop: with a function that gives what had been swept by then as a column.
        """
        process, base = self.process, self.process.base
        priced = priced_layers(process, owed)
        inner = self._first_choice if not self._acyclic else _NOBODY
        ahead = process.window(self.process.beyond_value(price, failing))
        measured = None
        if not self._can_follow:
            measured = process.window(process.measures_beyond(price))
        totals, reached = np.zeros((0, 3)), process.cap
        try:
            for layer in reversed(range(process.cap)):
                check_time()
                inner, values = best_of_layer(base, priced(layer), ahead.flat, inner)
                found = totals
                if measured is not None:
                    found = measures_of_layer(base, inner, process.charged(layer), measured.flat)
                    measured.push(found)
                choice[layer] = inner - base.pair_offsets[:-1]
                ahead.push(values)
                reached, totals = layer, found
            return self._followed(choice, price) if measured is None else base.start @ totals
        except STOPS as stop:
            end_with_incumbent(stop)
            raise Stop(partial(self._cut_short, totals, choice, price, reached)) from stop

    def _cut_short(
        self, totals: FloatArray, choice: IntArray, price: float, reached: int
    ) -> Column | None:
        """What a sweep that got down to a layer found: the best policy at a lower price of failure.

        Whoever begins in that layer as if nothing had been paid does what is best at the price
        less what the layer stands for. None where the charge is another one than the cost itself.

        Args:
            totals: measures from that layer on, [nodes, 3]; no nodes: a choice can be followed.
            choice: [cap, nodes], of which the layers from that one on are written.
            price: of failure.
            reached: the layer.
        """
        process, base = self.process, self.process.base
        if not process.grows_evenly or base.by_steps or reached == process.cap:
            return None
        paid = float(process.totals.values[reached]) / base.survival
        begun = replace(process, totals=base.totals(process.cap - reached))
        within, swept = replace(self, process=begun), choice[reached:]
        found = base.start @ totals if len(totals) else within._followed(swept, price - paid)
        if len(totals):
            found[0] -= paid * found[2]
        policy = begun.policy(swept, price - paid)
        return replace(within._column(found, swept, price - paid, 0), choice=None, policy=policy)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        start = self.process.base.start
        if self._one_pass is not None:
            measures = self.process.measures_beyond(tail_price)
            totals = self._one_pass.measure(measures, choice)
            return self._column(start @ totals, choice, tail_price, 0)
        if self._can_follow:
            return self._column(self._followed(choice, tail_price), choice, tail_price, 0)
        beyond = self.process.measures_beyond(tail_price)
        totals = measures_backwards(self.process, choice, beyond)
        return self._column(start @ totals, choice, tail_price, 0)

    def _followed(self, choice: IntArray, tail_price: float) -> FloatArray:
        """Charge, failure and goal of a choice, [cap, nodes], found forwards."""
        return follow_choice(self.process, choice, self.process.beyond(tail_price))

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        """A choice with its charge, failure and goal from the start."""
        base, work = self.process.base, Work(backups, self.process.cap)
        cost, failure, goal = totals.tolist()
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
        failing = 0.0 if slack else price
        beyond = self.process.beyond_bound(price, failing)
        return self._bounded(price, failing, self._anything, beyond)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [cap, nodes], to a checked sub-solution.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved: then the choice
        behind them is kept, where it can be followed.

        Raises:
            ModelError: values of another shape.
        """
        failing, choice = 0.0 if slack else price, None
        if values.shape != self.value_shape:
            raise ModelError(f"a value function of shape {self.value_shape} is needed")
        if self._can_follow and self._one_pass is None:
            asked = all(bool(np.isposinf(layer).all()) for layer in values)
            choice = room_for_choice(self.process) if asked else None
        beyond = self.process.beyond_bound(price, failing)
        return replace(self._bounded(price, failing, values, beyond, choice), choice=choice)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """How much of the bound the cap costs, at most: 0 where the tails are proved to be optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there. It is no more than what the choice behind
        the latter loses where it gets beyond the cap.

        Args:
            price: of failure.
            slack: as of :meth:`check`.
            proof: what was proved at this price; where its bound is as high, that is all.
        """
        failing = 0.0 if slack else price
        lost = lost_beyond(self.process, price, failing)
        if not lost.any():
            return 0.0
        if proof is not None and proof.choice is not None:
            left = mass_beyond(self.process, proof.choice)
            most = float((left[: len(lost)] * lost).sum())
            if most <= SAME * abs(proof.bound):
                return most
        beyond = self.process.beyond_value(price, failing)
        reached = self._bounded(price, failing, self._anything, beyond).bound
        if proof is not None and reached <= proof.bound:
            return 0.0
        return max(reached - self.prove(price, slack=slack).bound, 0.0)

    def _bounded(
        self,
        price: float,
        failing: float,
        values: FloatArray,
        beyond: FloatArray,
        choice: IntArray | None = None,
    ) -> Proof:
        """Lower values layer by layer, from what is given beyond the cap."""
        first = _NOBODY if self._acyclic or self._one_pass is not None else self._first_choice
        given = values, beyond, self._one_pass, first
        return bound_layers(self.process, price, failing, *given, choice)

    @property
    def _anything(self) -> FloatArray:
        """Values that ask for the best that can be proved, [cap, nodes]."""
        return np.broadcast_to(np.inf, self.value_shape)

    @cached_property
    def _one_pass(self) -> OnePass | None:
        return one_pass(self.process)

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.process.policy(required(column.choice), column.tail_price)

    @cached_property
    def _acyclic(self) -> bool:
        """Whether every step between states costs something, so that layers need no solving."""
        return is_acyclic(self.process.base)

    @property
    def _can_follow(self) -> bool:
        """Whether a choice can be followed forwards, in compiled loops."""
        return self._acyclic and accelerated(self.process.base.later.nnz)

    @cached_property
    def _likely(self) -> bool:
        """Whether some policy probably succeeds; else success is counted rather than failure."""
        base, tails = self.process.base, self.process.tails
        goal = tails.guess[1] if tails.guess else float(base.start @ tails.goal[0])
        return goal + base.start_goal >= 0.5

    @cached_property
    def _first_choice(self) -> IntArray:
        """A choice by which each layer is left."""
        base = self.process.base
        leaving = (base.gain > 0) | (base.failure > 0) | (np.diff(base.later.indptr) > 0)
        return approach_leaving(base.instant_dynamics, leaving)


_BELOW_EVERY_VALUE = 1e-6
"""No value is below minus the price; a floor this much lower leaves room to count rounding."""


_KEPT_VALUES = 25_000_000
"""Largest table of checked values that is kept, nodes x layers: 0.2 GB. Of a larger one only the
shape is: infinite values ask for the best that can be proved, which one more sweep gives."""


SAME: Final = 1e-14
"""Relative difference of values, and share of a bound, below which there is only rounding."""


def lost_beyond(process: LayeredProcess, price: float, failing: float) -> FloatArray:
    """How much more the tails are worth than the lower bound beyond the cap, [layers, nodes].

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts: the price, or 0 with minus the price for success.
    """
    tails, least = process.beyond_value(price, failing), process.beyond_bound(price, failing)
    return np.where(tails - least > SAME * (np.abs(tails) + np.abs(least)), tails - least, 0.0)


def bound_layers(
    process: LayeredProcess,
    price: float,
    failing: float,
    values: FloatArray,
    beyond: FloatArray,
    whole: OnePass | None,
    first: IntArray,
    choice: IntArray | None = None,
) -> Proof:
    """A lower bound of every policy's value, by a sweep that counts its rounding against itself.

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts: the price, or 0 with minus the price for success.
        values: are not exceeded, [cap, nodes].
        beyond: lower bounds beyond the cap, [layers beyond, nodes].
        whole: a compiled pass over all layers, where the process is small.
        first: pairs to begin with where a layer has free steps, [nodes].
        choice: written by compiled loops where there are none: whose values these are, as
            positions among the pairs of each node, [cap, nodes].
    """
    base, success = process.base, price - failing
    owed, saved = failing * base.failure, success * base.survival * base.gain
    floor = -(success - process.charge.lowest) * (1.0 + _BELOW_EVERY_VALUE)
    is_kept = values.size <= _KEPT_VALUES
    kept = np.empty(values.shape) if is_kept else np.broadcast_to(np.inf, values.shape)
    begun, sizes = np.zeros(process.cap), np.zeros(process.cap)  # of the start, by layer
    entries = np.flatnonzero(base.start)
    shares = base.start[entries]
    if whole is not None:
        for some, bounds in whole.lowest(owed, saved, values, floor, beyond):
            begun[some] = bounds[:, entries] @ shares
            sizes[some] = np.abs(bounds[:, entries]) @ shares
            if is_kept:
                kept[some] = bounds
        return _proof_of_layers(process, price, failing, begun, sizes, kept)
    summed, window, inner = summed_layers(process, owed, saved), process.window(beyond), first
    for layer in reversed(range(process.cap)):
        check_time()
        given, asked = values[layer], bool(np.isposinf(values[layer]).all())
        if not asked:
            given = np.maximum(np.nan_to_num(given, nan=floor, posinf=np.inf), floor)
        if is_acyclic(base):
            position = None if choice is None else choice[layer]
            sums = *summed(layer), window.flat
            lowest = safe_minima(base.pair_offsets, base.later, *sums, position)
            lowest = lowest if asked else np.minimum(lowest, given)
        else:
            lowest, inner = bound_free_steps(base, summed(layer), window.flat, given, inner, floor)
        begun[layer] = lowest[entries] @ shares
        sizes[layer] = np.abs(lowest[entries]) @ shares
        if is_kept:
            kept[layer] = lowest
        window.push(lowest)
    return _proof_of_layers(process, price, failing, begun, sizes, kept)


def _proof_of_layers(
    process: LayeredProcess,
    price: float,
    failing: float,
    begun: FloatArray,
    sizes: FloatArray,
    kept: FloatArray,
) -> Proof:
    """The bounds that values give at the start, whatever the layer in which it lies.

    Args:
        process: the process.
        price: of failure.
        failing: what failing counts.
        begun: values at the start, [layers].
        sizes: sums of their parts' magnitudes, [layers].
        kept: the values, [layers, nodes], or infinite.
    """
    base = process.base
    ended = [failing * base.start_failure, -(price - failing) * base.start_goal]
    ended.append(process.start_charge)
    terms = max(int(np.count_nonzero(base.start)) + int(np.count_nonzero(ended)) - 1, 0)
    loss = terms * MACHINE_EPSILON * (sizes + float(np.abs(ended).sum()))
    bounds = begun + sum(ended) - loss
    bound = float(bounds[0]) if len(bounds) else sum(ended)
    return Proof(price, failing, bound, kept, Work(process.cap, 0), by_layer=bounds)
