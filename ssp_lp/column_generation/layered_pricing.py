"""The pricing problems of accumulated cost by layers: backward sweeps, nothing written out.

:class:`LayeredPricing` limits failure alone; tails follow beyond the cap. :class:`OpenEndedPricing`
has any rows: every step costs something, so that each layer follows from later ones, and beyond the
cap lies one place with cycles of its own, where policy iteration says what is best; from there one
sweep prices all layers, and measures what the choice takes of each row on the way.

A choice is the position of a pair among those of its node, [layers, nodes], in the smallest
integers that hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.accumulated_cost.sweep import (
    KEPT_VALUES,
    PartOfSweep,
    Priced,
    Sweep,
    at_price,
    at_weights,
)
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import FloatArray, IntArray, weighted
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    pricing_weights,
    required,
)
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.dynamic_programming import bellman
from ssp_lp.dynamic_programming.evaluation import evaluate_policy
from ssp_lp.policies.policy import DeterministicPolicy, Policy

_SAME = 1e-14
"""Relative difference of values below which there is only rounding."""


@dataclass(frozen=True, eq=False)
class LayeredPricing(PricingProblem):
    """Column generation's pricing problem for case S; a choice has [cap, nodes]."""

    process: LayeredProcess
    by_goal: bool = False  # columns count success, as minus the goal, in place of failing

    n_rewards: ClassVar[int] = 2

    def counting_success(self) -> LayeredPricing:
        """The same with success in the columns: both are measured."""
        return replace(self, by_goal=True)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers, nodes]: a value for each node in each priced layer."""
        return self.process.cap, self.process.base.n_nodes

    @cached_property
    def sweep(self) -> Sweep:
        """The sweeps of layered pricing over its process."""
        return Sweep.of_ends(self.process)

    def incumbent(self, reached: Any) -> Column | None:
        """The best column of a layered pricing that was stopped, at a lower price of failure.

        Whoever begins in its last layer as if nothing had been paid does what is best at the price
        less what the layer stands for. None where the charge is another one than the cost itself.
        """
        if not isinstance(reached, PartOfSweep) or reached.layer == self.process.cap:
            return None
        if not self.is_shifted:
            return None
        measures = reached.measures
        if measures is not None:
            measures = self.process.base.start @ measures
            measures[0] -= float(self._paid[reached.layer]) * measures[2]
        swept = Column(0.0, 0.0, 0.0, reached.choice, reached.price)
        return self._begun_in(reached.layer, swept, measures)

    @property
    def covered(self) -> float:
        """The total at the cap: the process is cut there, at whatever price."""
        return float(self._paid[-1]) if self.is_shifted else 0.0

    @cached_property
    def is_shifted(self) -> bool:
        """Whether beginning in a later layer is beginning at a lower price of failure."""
        return self.process.grows_evenly and not self.process.base.by_steps

    @property
    def _paid(self) -> FloatArray:
        """What a price of failure falls by in each layer, [cap]."""
        process = self.process
        return process.totals.values[: process.cap] / process.base.survival

    def _begun_in(self, layer: int, swept: Column, measures: FloatArray | None = None) -> Column:
        """The column of beginning in a layer as if nothing had been paid.

        Args:
            layer: the layer.
            swept: the column of beginning in the first one, as far as its choice is known.
            measures: of the column; None: not known yet.
        """
        if layer == 0 and swept.by_layer is not None:
            return swept
        choice = required(swept.choice)
        if measures is None and swept.by_layer is not None:
            known = swept.by_layer[layer, 1:]
            measures = None if np.isnan(known).any() else known
        price = swept.tail_price - float(self._paid[layer])
        begun = self._process_begun_in(layer)
        within, choice = replace(self, process=begun), choice[layer:]
        if measures is None:
            measures = within.sweep.measure(choice, begun.measures_beyond(price))
        column, policy = within._column(measures, choice, price, 0), begun.policy(choice, price)
        return replace(column, choice=None, policy=policy, swept=swept)

    def beside(self, column: Column, row: FailureRow) -> tuple[Column, ...]:
        """Columns of lower prices, next to the budget, that pricing a column found on its way.

        One sweep prices every policy at its price less what each layer stands for. The best bound
        among these prices lies next to the optimal one.
        """
        rest = column.by_layer
        if rest is None or column.choice is None or not (row.ratio and row.demanded > 0.0):
            return ()
        prices = column.tail_price - self._paid
        rest = rest[:, 0]
        best = int(np.argmax(prices + np.where(rest >= 0.0, rest, rest / row.demanded)))
        nearest = self._begun_in(best, column)
        other = best - 1 if row.breaks(nearest) else best + 1
        if not 0 <= other < len(prices) or prices[other] <= 0.0:
            return ()
        return replace(nearest, found_at=float(prices[best])), self._begun_in(other, column)

    def policy_failing(self, column: Column, failure: float, *, above: bool) -> Policy | None:
        """Policy of a lower price, found on the way, that fails about as often as is asked for.

        How often follows from the slope of the least values by price, whose steps lie between two
        layers.

        Args:
            column: found by pricing, or on its way.
            failure: the nearest one to it is taken.
            above: whether it is to fail more rather than less.
        """
        swept = column.swept or column
        if swept.by_layer is None or swept.choice is None:
            return None
        goal = np.diff(swept.by_layer[:, 0]) / np.diff(self._paid)  # between a layer and the next
        fails = np.maximum.accumulate(1.0 - goal)
        layer = int(np.searchsorted(fails, failure)) + int(above)
        if layer >= len(fails):
            return None
        price = swept.tail_price - float(self._paid[layer])
        return self._process_begun_in(layer).policy(swept.choice[layer:], price)

    def _process_begun_in(self, layer: int) -> LayeredProcess:
        """The process of beginning in a layer as if nothing had been paid."""
        totals = self.process.base.totals(self.process.cap - layer)
        return replace(self.process, totals=totals)

    def first(self) -> Column:
        """Layered pricing's first column: the tail that goes for the goal, from the start on."""
        base, tails = self.process.base, self.process.tails
        if tails.guess is not None:
            guess = tails.guess[0], 1.0, tails.guess[1] + base.start_goal
            return Column(*guess, None, by_goal=self.by_goal)
        nothing_paid = self.process.charge.beyond(np.zeros(base.n_nodes), tails.first)
        cost = float(base.start @ nothing_paid) + self.process.start_charge
        goal = float(base.start @ tails.goal[0])
        failure = float(base.start @ tails.first.failure) + base.start_failure
        policy = DeterministicPolicy(base.quotient.model, tails.decisions[0])
        found = cost, failure, goal + base.start_goal, None
        return Column(*found, policy=policy, by_goal=self.by_goal)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Layered pricing: a column of least ``E[charge; goal] + price * failure``."""
        failure_price = float(pricing_weights(price)[1])
        base, tails, choice = self.process.base, self.process.tails, self.sweep.room_for_choice()
        goal = tails.guess[1] if tails.guess else float(base.start @ tails.goal[0])
        # where no policy probably succeeds success is counted rather than failure
        failing = failure_price if goal + base.start_goal >= 0.5 else 0.0
        begun = np.full((self.process.cap, 4), np.nan) if self.is_shifted else None
        measures = self.sweep.minimise(at_price(self.sweep, failure_price, failing), choice, begun)
        column = self._column(measures, choice, failure_price, self.process.cap)
        if begun is None:
            return column
        prices = failure_price - self._paid
        ended = base.start_goal
        if failing:
            begun[:, 0] -= self._paid * base.start.sum()
            ended = 1.0 - base.start_failure
        begun[:, 0] -= prices * ended
        begun[:, 1] -= self._paid * begun[:, 3]
        return replace(column, by_layer=begun)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice in layered pricing.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        measures = self.sweep.measure(choice, self.process.measures_beyond(tail_price))
        return self._column(measures, choice, tail_price, 0)

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        """The column of a layered choice: its charge, failure and goal from the start."""
        base, work = self.process.base, bellman.Work(backups, self.process.cap)
        cost, failure, goal = totals.tolist()
        failure = max(failure + base.start_failure, 0.0)  # verified: below it lies rounding
        goal = max(goal + base.start_goal, 0.0)
        cost += self.process.start_charge
        return Column(cost, failure, goal, choice, tail_price, work=work, by_goal=self.by_goal)

    def aligned(self, column: Column, price: float) -> Column:
        """A layered column with its tails chosen by this price, measured again."""
        if column.choice is None:
            return column
        here, there = self.process.threshold(column.tail_price), self.process.threshold(price)
        return column if np.array_equal(here, there) else self.measure(column.choice, price)

    def prove(
        self, price: float | FloatArray, best: Column | None = None, *, slack: bool = False
    ) -> Proof:
        """Best lower bound of every column that layered pricing's sweep gives."""
        price = float(pricing_weights(price)[1])
        return self._proof(price, 0.0 if slack else price, self.anything)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower layered values, [cap, nodes], to a checked sub-solution of the pricing problem.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved: then the choice
        behind them is kept, where it can be followed.

        Raises:
            ModelError: values of another shape.
        """
        choice = None
        self.check_shape(values)
        if self.sweep.can_follow and self.sweep.one_pass is None:
            wants_best = all(bool(np.isposinf(layer).all()) for layer in values)
            choice = self.sweep.room_for_choice() if wants_best else None
        return self._proof(price, 0.0 if slack else price, values, choice)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Most of layered pricing's bound that the cap costs: 0 where its tails are optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there. It is no more than what the choice behind
        the latter loses where it gets beyond the cap.

        Args:
            price: of failure.
            slack: as of :meth:`check`.
            proof: what was proved at this price; where its bound is as high, that is all.
        """
        process, failing = self.process, 0.0 if slack else price
        tails = process.beyond_value(price, failing)
        least = process.beyond_bound(price, failing)
        same = tails - least <= _SAME * (np.abs(tails) + np.abs(least))
        lost = np.where(same, 0.0, tails - least)
        if not lost.any():
            return 0.0
        if proof is not None and proof.choice is not None:
            left = self.sweep.mass_beyond(proof.choice)
            most = float((left[: len(lost)] * lost).sum())
            if most <= _SAME * abs(proof.bound):
                return most
        followed = at_price(self.sweep, price, failing)
        reached = float(self.sweep.bound(followed, self.anything)[0][0])
        if proof is not None and reached <= proof.bound:
            return 0.0
        return max(reached - self.prove(price, slack=slack).bound, 0.0)

    def _proof(
        self, price: float, failing: float, values: FloatArray, choice: IntArray | None = None
    ) -> Proof:
        """Lower values layer by layer, from the bound beyond the cap."""
        priced = at_price(self.sweep, price, failing, bounds=True)
        bounds, kept = self.sweep.bound(priced, values, choice)
        work = bellman.Work(self.process.cap, 0)
        return Proof(price, failing, float(bounds[0]), kept, work, choice, by_layer=bounds)

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a layered choice and its tails."""
        return self.process.policy(required(column.choice), column.tail_price)


@dataclass(frozen=True, eq=False)
class OpenEndedPricing(PricingProblem):
    """Minimises weighted totals of cost, failure and rows; see :class:`ExplicitPricing`.

    Nothing in a layer is free, and totals are multiples of a unit.
    """

    augmented: OpenEnded
    precise: bool  # compare pairs beyond the cap in twice the working precision
    rows: tuple[tuple[FloatArray, float], ...]  # what is counted besides: [pairs], and at the start
    by_goal: bool = False  # success, as minus the goal, is counted in place of failing
    exact_tails: bool = True  # beyond the cap the best is done, not the better of two policies

    @property
    def n_rewards(self) -> int:
        """Number of rewards of layered pricing with rows: cost, failure and rows."""
        return 2 + len(self.rows)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers * nodes + 1]: layered values as for the process written out."""
        return ((self.augmented.cap + 1) * self.augmented.n_nodes + 1,)

    @cached_property
    def _beyond(self) -> ExplicitPricing:
        """The pricing problem of the open end beyond the layers."""
        rows = tuple(row for row, _ in self.rows)
        return ExplicitPricing(self.augmented.beyond, self.precise, rows, by_goal=self.by_goal)

    @cached_property
    def sweep(self) -> Sweep:
        """The sweeps of layered pricing with rows."""
        return open_sweep(self.augmented, [row for row, _ in self.rows], by_goal=self.by_goal)

    @cached_property
    def _at_source(self) -> FloatArray:
        """Rewards of an episode before its first step in layered pricing, [rewards]."""
        layered = self.augmented
        cost = layered.start_charge + layered.shift_of_ends[1]
        ending = -layered.base.start_goal if self.by_goal else layered.base.start_failure
        return np.array([cost, ending, *(at for _, at in self.rows)])

    def first(self) -> Column:
        """The policy that leaves the open end, whatever has been paid: nearer to the goal."""
        return self._swept(self._beyond.first(), None)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Layered pricing with rows: a column of least priced cost, measured exactly."""
        weights = pricing_weights(price)
        return self._swept(self._tail(weights, *warm), weights)

    def taken_on(self, columns: Sequence[Column]) -> list[Column]:
        """Columns of fewer layers: in those that are new each follows its tail, as before."""
        first, tails, known = self.sweep.first_pairs, dict[Column | None, Column](), list[Column]()
        for column in columns:
            choice, old = required(column.choice), column.beyond
            last = tails.get(old) or self._beyond.measure(choice[-1] + first)
            tails[old] = last
            more = self.augmented.cap + 1 - len(choice), len(first)
            longer = np.concatenate([choice, np.broadcast_to(choice[-1], more)])
            ahead = ahead_of(self.augmented, required(last.totals))
            figures = self.sweep.measure(longer[:-1], ahead) + self._at_source
            known.append(Column.of_figures(figures, longer, by_goal=self.by_goal, beyond=last))
        return known

    def true_cost(self, column: Column) -> float | None:
        """Cost of a column with all that is paid beyond the cap, where the charge is a line."""
        layered, last = self.augmented, column.beyond
        if last is None or layered.shift > 0.0 or not layered.is_settled:
            return None
        totals, choice = required(last.totals), required(last.choice)
        goal, failure = 1.0 - totals[:, 1], totals[:, 1]
        if self.by_goal:
            goal, failure = -totals[:, 1], 1.0 + totals[:, 1]
        steps = layered.step_cost(layered.reaching(goal))[:, None]
        ahead = evaluate_policy(self._beyond.dynamics, choice, steps).values[:, 0]
        early = goal / layered.base.survival
        tail = TailValues(goal, failure, early, ahead, moment=np.zeros_like(goal))
        beyond = np.array(ahead_of(layered, totals))
        beyond[:, :, 0] = layered.charge.beyond(layered.totals.beyond[:, None], tail)
        figures = self.sweep.measure(required(column.choice)[:-1], beyond)
        return float((figures + self._at_source)[0])

    def _swept(self, last: Column, weights: FloatArray | None) -> Column:
        """A policy with its totals from the start, found layer by layer.

        Args:
            last: what is done beyond the cap, with its totals.
            weights: at which the best is done in each layer, [rewards]; None: always the same.
        """
        totals, position = required(last.totals), required(last.choice) - self.sweep.first_pairs
        measures = ahead_of(self.augmented, totals)
        choice, figures = swept(self.sweep, position, weights, totals, measures)
        figures, work = figures + self._at_source, last.work + bellman.Work(1, 1)
        kept: dict[str, Any] = {"work": work, "beyond": last}
        return Column.of_figures(figures, choice, by_goal=self.by_goal, **kept)

    def _tail(self, weights: FloatArray, *warm: Column | None) -> Column:
        """What is done beyond the cap at some weights: failing early or not, unless it is exact.

        Whether the limits can be kept, where no cost counts, is asked of all policies.
        """
        if self.exact_tails or weights[0] == 0.0:
            return self._best_beyond(weights, *warm)
        tails = self._fails_early, self._beyond.first()
        return min(tails, key=lambda last: weighted(required(last.totals), weights).sum())

    @cached_property
    def _fails_early(self) -> Column:
        """What is cheapest beyond the cap where failing costs nothing."""
        return self._beyond.minimise(np.eye(1, self.n_rewards)[0])

    def _best_beyond(self, weights: FloatArray, *warm: Column | None) -> Column:
        """What is best beyond the cap at some weights: most often what was best before."""
        known = [c.beyond for c in warm if c is not None and c.beyond is not None]
        for last in dict.fromkeys(known):
            if self._beyond.is_best(last, weights):
                return replace(last, work=bellman.Work())
        return self._beyond.minimise(weights, *known)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Best lower bound that layered pricing's sweep with rows gives."""
        return self._proved(pricing_weights(price), self.anything, best)

    def check(self, price: float | FloatArray, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower layered values, [states], to a checked sub-solution; infinite: the best.

        Raises:
            ModelError: values of another shape.
        """
        self.check_shape(values)
        return self._proved(pricing_weights(price), values, None)

    def _proved(self, weights: FloatArray, values: FloatArray, best: Column | None) -> Proof:
        """Lower layered values to a proof; a policy that is best, or about, saves work."""
        last = self._beyond.lowered(weights, self._asked_beyond(values, weights, best)).rounded
        beyond, price = ahead_of(self.augmented, last), float(weights[1])
        priced = at_weights(self.sweep, weights, beyond, bounds=True)
        floor = -price if self.by_goal else 0.0
        ended = tuple(zip(weights.tolist(), self._at_source.tolist(), strict=True))
        priced = priced._replace(floor=floor, at_start=ended)
        bound, kept = self._lowered(self.sweep, priced, values, last)
        return Proof(price, 0.0 if self.by_goal else price, bound, kept)

    def check_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Layered pricing's certified bound at the start, less what every episode pays.

        See :meth:`ExplicitPricing.check_less`.
        """
        layered, base, counted = self.augmented, self.augmented.base, weights.copy()
        counted[1] += ratio
        beyond = self._asked_beyond(values, counted)
        last = self._beyond.lowered_less(weights, ratio, paid, beyond).rounded
        every = np.append(weights, -ratio)
        priced = at_weights(self._less_paid, every, ahead_of(layered, last), bounds=True)
        amounts = [layered.start_charge, *self._at_source[1:].tolist(), base.start_goal]
        ended = tuple(zip(every.tolist(), amounts, strict=True))
        priced = priced._replace(floor=-paid, at_start=ended)
        return self._lowered(self._less_paid, priced, self.anything, last)[0]  # as high as can be

    @cached_property
    def _less_paid(self) -> Sweep:
        """The sweeps of layered pricing that count the goal, too, and nothing on top."""
        goal = self.augmented.base.survival * self.augmented.base.gain
        counted = np.append(self.sweep.counted, goal[:, None], axis=1)
        return replace(self.sweep, counted=counted, on_top=None)

    def _asked_beyond(
        self, values: FloatArray, weights: FloatArray, best: Column | None = None
    ) -> FloatArray:
        """Values of layered pricing beyond the cap; if infinite, those of the best policy."""
        self.check_shape(values)
        beyond = values[self.augmented.cap * self.augmented.n_nodes : -1]
        if np.isfinite(beyond).all():
            return beyond
        return weighted(required(self._best_beyond(weights, best).totals), weights)

    def _lowered(
        self, sweep: Sweep, priced: Priced, values: FloatArray, last: FloatArray
    ) -> tuple[float, FloatArray]:
        """Layered pricing's bound at the start by lowered values, and these, [states].

        Args:
            sweep: over the layers.
            priced: with lower bounds beyond the cap.
            values: not to be exceeded, [states].
            last: the bounds beyond the cap, [nodes].
        """
        layered = self.augmented
        given = values[:-1].reshape(layered.cap + 1, layered.n_nodes)
        bounds, kept = sweep.bound(priced, given[:-1])
        bound = float(bounds[0])
        if values.size > KEPT_VALUES:
            return bound, np.broadcast_to(np.inf, values.shape)
        return bound, np.concatenate([kept.ravel(), last, [bound]])

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a layered choice with an open end."""
        chosen = self.augmented.base.pair_offsets[:-1] + required(column.choice)
        return self.augmented.policy(chosen.ravel())


def open_sweep(table: OpenEnded, rows: Sequence[FloatArray], *, by_goal: bool) -> Sweep:
    """The sweeps over an open-ended table that count failing, or minus the goal, and rows.

    Args:
        table: the layers.
        rows: what is counted besides, [pairs] each.
        by_goal: whether minus the goal is counted.
    """
    base = table.base
    ending = -base.survival * base.gain if by_goal else base.failure
    on_top = table.shift_of_ends[0] if table.shift else None
    return Sweep(table, np.stack([ending, *rows], axis=1), on_top)


def ahead_of(table: OpenEnded, beyond: FloatArray) -> FloatArray:
    """What lies beyond a table's cap, in each layer that a step can reach, [layers, nodes, ...]."""
    return np.broadcast_to(beyond, (table.base.width - 1, *beyond.shape))


def swept(
    sweep: Sweep,
    last: IntArray,
    weights: FloatArray | None,
    totals: FloatArray,
    measures: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """A choice over an open-ended table, [layers + 1, nodes], and its measures, [rewards].

    Args:
        sweep: over the layers.
        last: positions of the pairs that are taken beyond the cap, [nodes].
        weights: at which the best is done in each layer, [rewards]; None: always the same.
        totals: what is counted beyond the cap, at least, [nodes, rewards].
        measures: the same as it is, in each layer there, [layers, nodes, rewards].
    """
    choice = sweep.room_for_choice(sweep.process.cap + 1)
    choice[-1 if weights is not None else slice(None)] = last
    if weights is None:
        return choice, sweep.measure(choice[:-1], measures)
    table = cast("OpenEnded", sweep.process)
    beyond = ahead_of(table, weighted(totals, weights))
    priced = at_weights(sweep, weights, beyond, measures)
    return choice, sweep.minimise(priced, choice[:-1])
