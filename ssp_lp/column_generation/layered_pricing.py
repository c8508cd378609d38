"""Pricing problems of layered processes, solved by backward sweeps over accumulated cost.

- :class:`LayeredPricing` limits failure alone; beyond the cap lie tails in closed form.
- :class:`OpenEndedPricing` has any rows. Every step costs something, so that each layer depends on
  later ones only. Beyond the cap lies one last layer with cycles, solved by policy iteration; one
  sweep from there prices all layers and evaluates the choice in each row.

A choice is the position of a pair among the pairs of its node, [layers, nodes], in the smallest
integer type that holds it.
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
"""Relative difference of values that is rounding."""


@dataclass(frozen=True, eq=False)
class LayeredPricing(PricingProblem):
    """Pricing problem of a layered process with a failure row alone; a choice has [cap, nodes]."""

    process: LayeredProcess
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure

    n_rewards: ClassVar[int] = 2

    def counting_success(self) -> LayeredPricing:
        """Return this pricing problem with minus the goal as second reward."""
        return replace(self, by_goal=True)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[cap, nodes] of the layered process."""
        return self.process.cap, self.process.base.n_nodes

    @cached_property
    def sweep(self) -> Sweep:
        """The backward sweeps over the process."""
        return Sweep.of_ends(self.process)

    def incumbent(self, reached: Any) -> Column | None:
        """Return the column of a stopped sweep, which is optimal at a lower price of failure.

        A policy that begins in the last swept layer with nothing paid is optimal at the price minus
        the layer's total. None if the charge is not the cost itself.
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
        """Price of failure up to which one sweep covers all prices: the last total; 0: none."""
        return float(self._paid[-1]) if self.is_shifted else 0.0

    @cached_property
    def is_shifted(self) -> bool:
        """Whether beginning in a later layer is equivalent to a lower price of failure."""
        return self.process.grows_evenly and not self.process.base.by_steps

    @property
    def _paid(self) -> FloatArray:
        """Reduction of the price of failure in each layer, [cap]."""
        process = self.process
        return process.totals.values[: process.cap] / process.base.survival

    def _begun_in(self, layer: int, swept: Column, measures: FloatArray | None = None) -> Column:
        """Return the column of an episode that begins in a layer with nothing paid.

        Args:
            layer: the layer.
            swept: the column of beginning in the first layer, with its choice from ``layer`` on.
            measures: cost, failure and goal of the column; None: not known yet.
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
        """Return columns at lower prices, next to the budget, found by the column's sweep.

        One sweep solves the pricing problem at its price minus the total of each layer. The best
        dual bound among these prices lies next to the optimal price.
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
        """Return a policy of about this failure, found by a column's sweep at a lower price.

        The failure at each price is the slope of the least value as a function of the price.

        Args:
            column: found by pricing, or by its sweep.
            failure: the policy next to this failure probability is taken.
            above: whether the policy must fail more often rather than less often.
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
        """Return the process of an episode that begins in a layer with nothing paid."""
        totals = self.process.base.totals(self.process.cap - layer)
        return replace(self.process, totals=totals)

    def first(self) -> Column:
        """Return the column of the tail to the goal, followed from the start."""
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
        """Return a column of least ``E[charge; goal] + price * failure``."""
        failure_price = float(pricing_weights(price)[1])
        base, tails, choice = self.process.base, self.process.tails, self.sweep.room_for_choice()
        goal = tails.guess[1] if tails.guess else float(base.start @ tails.goal[0])
        # if success is improbable, use the form cost - price * goal
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
        """Return the column of a choice, with its exact E[cost; goal] and failure.

        Args:
            choice: [cap, nodes].
            tail_price: price of failure at which the tails beyond the cap are chosen.
        """
        measures = self.sweep.measure(choice, self.process.measures_beyond(tail_price))
        return self._column(measures, choice, tail_price, 0)

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        """Return the column of a choice from its totals: charge, failure and goal."""
        base, work = self.process.base, bellman.Work(backups, self.process.cap)
        cost, failure, goal = totals.tolist()
        failure = max(failure + base.start_failure, 0.0)  # a negative value is rounding
        goal = max(goal + base.start_goal, 0.0)
        cost += self.process.start_charge
        return Column(cost, failure, goal, choice, tail_price, work=work, by_goal=self.by_goal)

    def prove(
        self, price: float | FloatArray, best: Column | None = None, *, slack: bool = False
    ) -> Proof:
        """Prove the best dual bound of one sweep."""
        price = float(pricing_weights(price)[1])
        return self._proof(price, 0.0 if slack else price, self.anything)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [cap, nodes], to a checked sub-solution of the pricing problem.

        The sweep starts from the lower bound beyond the cap and subtracts the rounding error of
        every backup. Infinite values give the best bound; the proof then carries its choice, if
        this can be followed.

        Raises:
            ModelError: values have the wrong shape.
        """
        choice = None
        self.check_shape(values)
        if self.sweep.can_follow and self.sweep.one_pass is None:
            wants_best = all(bool(np.isposinf(layer).all()) for layer in values)
            choice = self.sweep.room_for_choice() if wants_best else None
        return self._proof(price, 0.0 if slack else price, values, choice)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return an upper bound of the loss of the dual bound by the cap; 0 if tails are optimal.

        The loss is the difference at the start between the bound with the values of the tail
        policies beyond the cap and the bound with the lower bound there. It is at most the loss of
        the choice of the second bound: mass beyond the cap times the difference there.

        Args:
            price: of failure.
            slack: as in :meth:`check`.
            proof: a proof at this price; if its bound is as high, the loss is 0.
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
        """Lower values layer by layer, starting from the bound beyond the cap."""
        priced = at_price(self.sweep, price, failing, bounds=True)
        bounds, kept = self.sweep.bound(priced, values, choice)
        work = bellman.Work(self.process.cap, 0)
        return Proof(price, failing, float(bounds[0]), kept, work, choice, by_layer=bounds)

    def pulled_back(self, column: Column) -> Policy:
        """Return the cost-aware policy of a column's choice and its tails."""
        return self.process.policy(required(column.choice), column.tail_price)


@dataclass(frozen=True, eq=False)
class OpenEndedPricing(PricingProblem):
    """Minimises weighted totals of cost, failure and rows; see :class:`ExplicitPricing`.

    No pair of a layer is free, and totals are multiples of a unit.
    """

    augmented: OpenEnded
    precise: bool  # compare pairs beyond the cap in twice the working precision
    rows: tuple[tuple[FloatArray, float], ...]  # further rewards: [pairs], at the start
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure
    exact_tails: bool = True  # optimal tails beyond the cap, not the better of two policies

    @property
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and one per row."""
        return 2 + len(self.rows)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[(cap + 1) * nodes + 1], as of the process written out."""
        return ((self.augmented.cap + 1) * self.augmented.n_nodes + 1,)

    @cached_property
    def _beyond(self) -> ExplicitPricing:
        """The pricing problem of the last layer, beyond the cap."""
        rows = tuple(row for row, _ in self.rows)
        return ExplicitPricing(self.augmented.beyond, self.precise, rows, by_goal=self.by_goal)

    @cached_property
    def sweep(self) -> Sweep:
        """The backward sweeps over the layers."""
        return open_sweep(self.augmented, [row for row, _ in self.rows], by_goal=self.by_goal)

    @cached_property
    def _at_source(self) -> FloatArray:
        """Rewards of an episode before its first step, [rewards]."""
        layered = self.augmented
        cost = layered.start_charge + layered.shift_of_ends[1]
        ending = -layered.base.start_goal if self.by_goal else layered.base.start_failure
        return np.array([cost, ending, *(at for _, at in self.rows)])

    def first(self) -> Column:
        """Return the column of the policy that leaves the last layer, followed in all layers."""
        return self._swept(self._beyond.first(), None)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Return a column of least priced cost, evaluated exactly."""
        weights = pricing_weights(price)
        return self._swept(self._tail(weights, *warm), weights)

    def taken_on(self, columns: Sequence[Column]) -> list[Column]:
        """Return columns of fewer layers, evaluated here: their tails fill the new layers."""
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
        """Return the cost with the exact charge beyond the cap; None: it is not affine there."""
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
        """Return the column that the sweep finds in front of a tail.

        Args:
            last: the tail beyond the cap, with its totals.
            weights: of the rewards that the layers minimise, [rewards]; None: follow the tail.
        """
        totals, position = required(last.totals), required(last.choice) - self.sweep.first_pairs
        measures = ahead_of(self.augmented, totals)
        choice, figures = swept(self.sweep, position, weights, totals, measures)
        figures, work = figures + self._at_source, last.work + bellman.Work(1, 1)
        kept: dict[str, Any] = {"work": work, "beyond": last}
        return Column.of_figures(figures, choice, by_goal=self.by_goal, **kept)

    def _tail(self, weights: FloatArray, *warm: Column | None) -> Column:
        """Return the tail at the weights: optimal if exact, else the better of two policies.

        With weight 0 of the cost (phase 1: feasibility) it is always optimal.
        """
        if self.exact_tails or weights[0] == 0.0:
            return self._best_beyond(weights, *warm)
        tails = self._fails_early, self._beyond.first()
        return min(tails, key=lambda last: weighted(required(last.totals), weights).sum())

    @cached_property
    def _fails_early(self) -> Column:
        """The tail of least cost at price 0 of failure."""
        return self._beyond.minimise(np.eye(1, self.n_rewards)[0])

    def _best_beyond(self, weights: FloatArray, *warm: Column | None) -> Column:
        """Return an optimal tail at the weights, a known one if possible."""
        known = [c.beyond for c in warm if c is not None and c.beyond is not None]
        for last in dict.fromkeys(known):
            if self._beyond.is_best(last, weights):
                return replace(last, work=bellman.Work())
        return self._beyond.minimise(weights, *known)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove the best dual bound of one sweep."""
        return self._proved(pricing_weights(price), self.anything, best)

    def check(self, price: float | FloatArray, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [states], to a checked sub-solution; infinite values give the best.

        Raises:
            ModelError: values have the wrong shape.
        """
        self.check_shape(values)
        return self._proved(pricing_weights(price), values, None)

    def _proved(self, weights: FloatArray, values: FloatArray, best: Column | None) -> Proof:
        """Return the proof of lowered values; a (nearly) optimal policy saves work."""
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
        """Return the certified bound at the start minus the amount that every episode pays.

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
        return self._lowered(self._less_paid, priced, self.anything, last)[0]  # the best bound

    @cached_property
    def _less_paid(self) -> Sweep:
        """The sweeps with the goal as a further reward, and without the shift of ends."""
        goal = self.augmented.base.survival * self.augmented.base.gain
        counted = np.append(self.sweep.counted, goal[:, None], axis=1)
        return replace(self.sweep, counted=counted, on_top=None)

    def _asked_beyond(
        self, values: FloatArray, weights: FloatArray, best: Column | None = None
    ) -> FloatArray:
        """Return the values beyond the cap; if infinite, those of an optimal policy."""
        self.check_shape(values)
        beyond = values[self.augmented.cap * self.augmented.n_nodes : -1]
        if np.isfinite(beyond).all():
            return beyond
        return weighted(required(self._best_beyond(weights, best).totals), weights)

    def _lowered(
        self, sweep: Sweep, priced: Priced, values: FloatArray, last: FloatArray
    ) -> tuple[float, FloatArray]:
        """Return the bound at the start and the lowered values behind it, [states].

        Args:
            sweep: over the layers.
            priced: with lower bounds beyond the cap.
            values: upper limits of the lowered values, [states].
            last: lower bounds beyond the cap, [nodes].
        """
        layered = self.augmented
        given = values[:-1].reshape(layered.cap + 1, layered.n_nodes)
        bounds, kept = sweep.bound(priced, given[:-1])
        bound = float(bounds[0])
        if values.size > KEPT_VALUES:
            return bound, np.broadcast_to(np.inf, values.shape)
        return bound, np.concatenate([kept.ravel(), last, [bound]])

    def pulled_back(self, column: Column) -> Policy:
        """Return the cost-aware policy of a column's choice."""
        chosen = self.augmented.base.pair_offsets[:-1] + required(column.choice)
        return self.augmented.policy(chosen.ravel())


def open_sweep(table: OpenEnded, rows: Sequence[FloatArray], *, by_goal: bool) -> Sweep:
    """Return the sweeps over an open-ended table that count failure (or minus the goal) and rows.

    Args:
        table: the layers.
        rows: the further rewards, [pairs] each.
        by_goal: whether minus the goal replaces failure.
    """
    base = table.base
    ending = -base.survival * base.gain if by_goal else base.failure
    on_top = table.shift_of_ends[0] if table.shift else None
    return Sweep(table, np.stack([ending, *rows], axis=1), on_top)


def ahead_of(table: OpenEnded, beyond: FloatArray) -> FloatArray:
    """Repeat values beyond the cap for each layer that a step can reach, [layers, nodes, ...]."""
    return np.broadcast_to(beyond, (table.base.width - 1, *beyond.shape))


def swept(
    sweep: Sweep,
    last: IntArray,
    weights: FloatArray | None,
    totals: FloatArray,
    measures: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Return a choice over an open-ended table, [layers + 1, nodes], and its totals, [rewards].

    Args:
        sweep: over the layers.
        last: positions of the pairs taken beyond the cap, [nodes].
        weights: of the rewards that the layers minimise, [rewards]; None: take ``last`` everywhere.
        totals: lower bounds of the totals beyond the cap, [nodes, rewards].
        measures: exact totals in each layer there, [layers, nodes, rewards].
    """
    choice = sweep.room_for_choice(sweep.process.cap + 1)
    choice[-1 if weights is not None else slice(None)] = last
    if weights is None:
        return choice, sweep.measure(choice[:-1], measures)
    table = cast("OpenEnded", sweep.process)
    beyond = ahead_of(table, weighted(totals, weights))
    priced = at_weights(sweep, weights, beyond, measures)
    return choice, sweep.minimise(priced, choice[:-1])
