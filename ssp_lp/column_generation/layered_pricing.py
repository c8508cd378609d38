"""The pricing problems of accumulated cost by layers: backward sweeps, nothing written out.

:class:`LayeredPricing` limits failure alone; tails follow beyond the cap. :class:`OpenEndedPricing`
has any rows: every step costs something, so that each layer follows from later ones, and beyond the
cap lies one place with cycles of its own, where policy iteration says what is best; from there one
sweep prices all layers, and measures what the choice takes of each row on the way.

A choice is the position of a pair among those of its node, [layers, nodes], in the smallest
integers that hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import fsum
from typing import Any, ClassVar, Protocol

import numpy as np

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.accumulated_cost.sweep import KEPT_VALUES, LayerMass, LayerRows, PartOfSweep, Sweep
from ssp_lp.accumulated_cost.totals import Window
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, least_integer_type, weighted
from ssp_lp.column_generation import explicit_pricing
from ssp_lp.column_generation.column import (
    Column,
    PricingProblem,
    Proof,
    pricing_weights,
    required,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import backward
from ssp_lp.dynamic_programming import bellman
from ssp_lp.dynamic_programming.bellman import PairCost, SparseRows
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.policies.policy import DeterministicPolicy, Policy

_SAME = 1e-14
"""Share of a bound below which there is only rounding."""


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
        return Sweep(self.process)

    def incumbent(self, reached: Any) -> Column | None:
        """The best column of a layered pricing that was stopped, at a lower price of failure.

        Whoever begins in its last layer as if nothing had been paid does what is best at the price
        less what the layer stands for. None where the charge is another one than the cost itself.
        """
        process, base = self.process, self.process.base
        if not isinstance(reached, PartOfSweep) or reached.layer == process.cap:
            return None
        if not process.grows_evenly or base.by_steps:
            return None
        paid = float(process.totals.values[reached.layer]) / base.survival
        begun = replace(process, totals=base.totals(process.cap - reached.layer))
        within, choice = replace(self, process=begun), reached.choice[reached.layer :]
        price = reached.price - paid
        if reached.measures is None:
            measures = within.sweep.follow(choice, price)
        else:
            measures = base.start @ reached.measures
            measures[0] -= paid * measures[2]
        policy = begun.policy(choice, price)
        return replace(within._column(measures, choice, price, 0), choice=None, policy=policy)

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
        measures = self.sweep.minimise(failure_price, failing, choice)
        return self._column(measures, choice, failure_price, self.process.cap)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice in layered pricing.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        return self._column(self.sweep.measure(choice, tail_price), choice, tail_price, 0)

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
        failing = 0.0 if slack else price
        lost = self.sweep.lost_beyond(price, failing)
        if not lost.any():
            return 0.0
        if proof is not None and proof.choice is not None:
            left = self.sweep.mass_beyond(proof.choice)
            most = float((left[: len(lost)] * lost).sum())
            if most <= _SAME * abs(proof.bound):
                return most
        beyond = self.process.beyond_value(price, failing)
        reached = float(self.sweep.bound(price, failing, self.anything, beyond, None)[0][0])
        if proof is not None and reached <= proof.bound:
            return 0.0
        return max(reached - self.prove(price, slack=slack).bound, 0.0)

    def _proof(
        self, price: float, failing: float, values: FloatArray, choice: IntArray | None = None
    ) -> Proof:
        """Lower values layer by layer, from the bound beyond the cap."""
        beyond = self.process.beyond_bound(price, failing)
        bounds, kept = self.sweep.bound(price, failing, values, beyond, choice)
        work = bellman.Work(self.process.cap, 0)
        return Proof(price, failing, float(bounds[0]), kept, work, choice, by_layer=bounds)

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a layered choice and its tails."""
        return self.process.policy(required(column.choice), column.tail_price)


class Neighbours(Protocol):
    """Ranks that sweep other nodes of the same layers, at the same time."""

    @property
    def size(self) -> int:
        """Number of nodes that are known: the own ones first, then neighbours' ghosts."""

    def filled(self, own: FloatArray) -> FloatArray:
        """Values of own nodes, [nodes, ...], with those of neighbours', [known nodes, ...]."""

    def gather(self, values: FloatArray) -> None:
        """Add up, in place, what was sent to own nodes; to neighbours' there is nothing then."""


@dataclass(frozen=True, eq=False)
class OpenSweeps:
    """Backward sweeps over the layers of an open-ended table: of all nodes, or of a rank's own.

    A rank knows some nodes of its neighbours, too.
    """

    layered: OpenEnded
    rows: tuple[FloatArray, ...]  # [pairs] each: what is counted besides cost and failure
    later: SparseRows  # [pairs, layers ahead * known nodes]
    own: slice  # the nodes that are swept
    neighbours: Neighbours | None = None  # who know the others; None: all nodes are swept
    follows: bool = False  # mass is followed forwards, in compiled loops
    by_goal: bool = False  # success, as minus the goal, is counted in place of failing

    @property
    def pair_offsets(self) -> IntArray:
        """Offsets of the pairs of each swept node in a layer, [nodes + 1]."""
        return self.layered.base.pair_offsets[self.own.start : self.own.stop + 1]

    @property
    def n_nodes(self) -> int:
        """Number of nodes that are swept."""
        return len(self.pair_offsets) - 1

    @cached_property
    def start(self) -> FloatArray:
        """Start mass of the swept nodes, 0 at others, [known nodes]."""
        known = self.n_nodes if self.neighbours is None else self.neighbours.size
        start = np.zeros(known)
        start[: self.n_nodes] = self.layered.base.start[self.own]
        return start

    def _told(self, values: FloatArray) -> FloatArray:
        """Values of swept nodes, [nodes, ...], with those of all known ones, [known nodes, ...]."""
        return values if self.neighbours is None else self.neighbours.filled(values)

    @cached_property
    def counted(self) -> FloatArray:
        """Failure and rows of each pair of a swept layer, [pairs, rewards - 1]."""
        base = self.layered.base
        ending = -base.survival * base.gain if self.by_goal else base.failure
        return np.stack([ending, *self.rows], axis=1)

    def charged(self, layer: int) -> PairCost:
        """Charges of arriving from a swept layer with the shift, [pairs]."""
        charge, shift = self.layered.charged(layer), self.layered.shift_of_ends[0]
        return charge if self.layered.shift == 0.0 else PairCost(charge.total + shift)

    def best(self, last: IntArray, values: FloatArray, weights: FloatArray) -> IntArray:
        """Sweep for the best pairs at some weights.

        Args:
            last: position of the pair that is taken beyond the cap, [nodes].
            values: what all that lies beyond is worth at least, [nodes].
            weights: of the rewards, [rewards].

        Returns:
            The choice, [layers + 1, nodes], the last layer for all beyond.
        """
        window, owed, offsets = self._window(values), self.counted @ weights[1:], self.pair_offsets
        costs = self._by_layer(weights[0], lambda charged: weights[0] * charged + owed)
        choice = self.always(last)
        for layer in backward(self.layered.cap):
            rows = offsets, self.later, costs(layer), window.flat
            backup = bellman.best_pairs(*rows)
            window.push(self._told(backup.minima))
            choice[layer] = backup.choice - offsets[:-1]
        return choice

    def always(self, last: IntArray) -> IntArray:
        """The choice that is the same in all swept layers and beyond, [layers + 1, nodes]."""
        most = int(np.diff(self.pair_offsets).max(initial=1))
        same = np.broadcast_to(last, (self.layered.cap + 1, len(last)))
        return same.astype(least_integer_type(most))

    def measured(self, choice: IntArray, totals: FloatArray) -> FloatArray:
        """Totals of a choice from the start of the swept nodes on, by a sweep, [rewards].

        Args:
            choice: [layers + 1, nodes].
            totals: beyond the cap, in each layer that a step can reach, [layers, nodes, rewards].
        """
        return self._followed(choice, totals) if self.follows else self._summed(choice, totals)

    def _summed(self, choice: IntArray, totals: FloatArray) -> FloatArray:
        """Totals of a choice by a sweep backwards."""
        told, offsets = [self._told(layer) for layer in totals], self.pair_offsets
        window = Window(np.stack(told) if told else totals)
        for layer in backward(self.layered.cap):
            chosen, charged = offsets[:-1] + choice[layer], self.charged(layer)
            here = np.empty(totals.shape[1:])
            here[:, 0], here[:, 1:] = charged.total[chosen], self.counted[chosen]
            here += bellman.chosen_product(self.later, chosen, window.flat)
            window.push(self._told(here))
        return np.asarray(self.start[: self.n_nodes] @ here)

    def _followed(self, choice: IntArray, totals: FloatArray) -> FloatArray:
        """Totals of a choice by a sweep of its mass forwards, only from where it comes to."""
        base, offsets, sums = self.layered.base, self.pair_offsets, list[list[float]]()
        counted = base.gain, base.failure, base.survival
        rows = LayerRows(self.later, offsets, *counted, self.start)
        mass = LayerMass(rows, self.layered.totals)
        for layer in range(self.layered.cap):
            here = self._gathered(mass.here)
            chosen = offsets[:-1] + choice[layer] if self.rows else offsets[:0]
            limited = [float(here @ row[chosen]) for row in self.rows]
            paid, failed, reached = mass.follow(choice[layer], self.charged(layer)).tolist()
            sums.append([paid, -reached if self.by_goal else failed, *limited])
        for left, each in zip(mass.left, totals, strict=False):
            sums.append((self._gathered(left) @ each).tolist())
        return np.array([fsum(each) for each in zip(*sums, strict=True)])

    def _gathered(self, mass: FloatArray) -> FloatArray:
        """Mass of the swept nodes, with what others have sent to them, [nodes]."""
        if self.neighbours is not None:
            self.neighbours.gather(mass)
        return mass[: self.n_nodes]

    def _by_layer(
        self, weight: float, summed: Callable[[FloatArray], FloatArray]
    ) -> Callable[[int], PairCost]:
        """Costs of the pairs of each swept layer; those that grow evenly are summed up once.

        Args:
            weight: of what arriving is charged.
            summed: the cost of a charge, with what is counted besides, [pairs] -> [pairs].
        """
        layered = self.layered
        even, totals = layered.charged(0), layered.totals.values
        if even.slope is None:
            return lambda layer: PairCost(summed(self.charged(layer).total))
        cost = PairCost(summed(even.fixed), weight * even.slope)
        return lambda layer: replace(cost, factor=float(totals[layer]))

    def priced(self, weights: FloatArray) -> Callable[[int], PairCost]:
        """Priced costs of the pairs of each swept layer, rounded down, [pairs]."""
        owed, size = self.counted @ weights[1:], np.abs(self.counted) @ np.abs(weights[1:])
        lost = explicit_pricing.pricing_rounding(self.counted, weights[1:]) * size

        def summed(charged: FloatArray) -> FloatArray:
            """A charge with the priced rows."""
            cost = weights[0] * charged
            both = (cost != 0.0) & (owed != 0.0)
            return np.asarray(
                cost + owed - (lost + both * explicit_pricing.LOST * (np.abs(cost) + size))
            )

        return self._by_layer(weights[0] * (1.0 - explicit_pricing.LOST), summed)

    def priced_less(self, weights: FloatArray, ratio: float) -> Callable[[int], PairCost]:
        """The same less what every episode pays on ending: a ratio, and the shift."""
        base, owed = self.layered.base, self.counted @ weights[1:]
        earned = ratio * base.survival * base.gain

        def cost_in(layer: int) -> PairCost:
            """Those of a layer."""
            own = self.layered.own_cost_from(layer)
            return PairCost(explicit_pricing.costs_less_earned(own, own + owed, earned))

        return cost_in

    def lowered(
        self, lowest: FloatArray, priced: Callable[[int], PairCost]
    ) -> Iterator[tuple[int, FloatArray]]:
        """Sweep for lower bounds of all policies' values; what is sent back is a ceiling.

        Args:
            lowest: of what lies beyond the cap, [nodes].
            priced: what the pairs of a layer cost at least, [pairs].

        Yields:
            A layer and its bounds, [nodes], which may be lowered in place.
        """
        window = self._window(lowest)
        for layer in backward(self.layered.cap):
            cost = priced(layer)
            size = np.abs(cost.fixed)
            sums = cost, size, size, window.flat
            lowest = bellman.safe_minima(self.pair_offsets, self.later, *sums)
            yield layer, lowest
            window.push(self._told(lowest))

    def _window(self, last: FloatArray) -> Window:
        """Values of the layers ahead of the last swept one, the open end's."""
        reached, told = self.layered.base.width - 1, self._told(last)
        return Window(np.broadcast_to(told, (reached, *told.shape)))


@dataclass(frozen=True, eq=False)
class OpenEndedPricing(PricingProblem):
    """Minimises weighted totals of cost, failure and rows; see :class:`ExplicitPricing`.

    Nothing in a layer is free, and totals are multiples of a unit.
    """

    augmented: OpenEnded
    precise: bool  # compare pairs beyond the cap in twice the working precision
    rows: tuple[tuple[FloatArray, float], ...]  # what is counted besides: [pairs], and at the start
    by_goal: bool = False  # success, as minus the goal, is counted in place of failing

    @property
    def n_rewards(self) -> int:
        """Number of rewards of layered pricing with rows: cost, failure and rows."""
        return 2 + len(self.rows)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers * nodes + 1]: layered values as for the process written out."""
        return ((self.augmented.cap + 1) * self.augmented.n_nodes + 1,)

    @cached_property
    def _beyond(self) -> explicit_pricing.ExplicitPricing:
        """The pricing problem of the open end beyond the layers."""
        rows = tuple(row for row, _ in self.rows)
        how = self.augmented.beyond, self.precise, rows
        return explicit_pricing.ExplicitPricing(*how, by_goal=self.by_goal)

    @cached_property
    def sweeps(self) -> OpenSweeps:
        """The sweeps of layered pricing with rows."""
        base, rows = self.augmented.base, tuple(row for row, _ in self.rows)
        follows = accelerated(base.later.nnz, "layers.follow_layer")
        every_node = self.augmented, rows, base.later, slice(0, base.n_nodes)
        return OpenSweeps(*every_node, follows=follows, by_goal=self.by_goal)

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
        return self._swept(self._best_beyond(weights, *warm), weights)

    def _best_beyond(self, weights: FloatArray, *warm: Column | None) -> Column:
        """What is best beyond the cap at some weights, by what is known of layered columns."""
        return self._beyond.minimise(weights, *map(self._last, warm))

    def _last(self, column: Column | None) -> Column | None:
        """The choice of a layered column beyond the cap."""
        if column is None or column.choice is None:
            return None
        choice = self.augmented.base.pair_offsets[:-1] + column.choice[-1]
        return Column(0.0, 0.0, 0.0, choice.astype(np.int32))

    def _swept(self, last: Column, weights: FloatArray | None) -> Column:
        """A policy with its totals from the start, found layer by layer.

        Args:
            last: what is done beyond the cap, with its totals.
            weights: at which the best is done in each layer, [rewards]; None: always the same.
        """
        base, own = self.augmented.base, required(last.totals)
        position = required(last.choice) - base.pair_offsets[:-1]
        totals = np.broadcast_to(own, (base.width - 1, *own.shape))
        if weights is None:
            choice = self.sweeps.always(position)
        else:
            choice = self.sweeps.best(position, weighted(own, weights), weights)
        figures = self.sweeps.measured(choice, totals) + self._at_source
        work = last.work + bellman.Work(1, 1)
        return Column.of_figures(figures, choice, by_goal=self.by_goal, work=work)

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
        asked = self._asked_beyond(values, weights, best)
        last = self._beyond.lowered(weights, asked)
        at_source = float(self._at_source @ weights)
        priced, price = self.sweeps.priced(weights), float(weights[1])
        floor = -price if self.by_goal else 0.0
        bound, kept = self._lowered(last, priced, values, at_source, floor)
        return Proof(price, 0.0 if self.by_goal else price, bound, kept)

    def check_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Layered pricing's certified bound at the start, less what every episode pays.

        See :meth:`ExplicitPricing.check_less`.
        """
        base, counted = self.augmented.base, weights.copy()
        counted[1] += ratio
        begun, earned_at_once = float(self._at_source @ weights), ratio * base.start_goal
        shift = self.augmented.shift_of_ends[1]
        summed = begun + shift + earned_at_once
        at_source = begun - shift - earned_at_once - explicit_pricing.LOST * summed
        values_beyond = self._asked_beyond(values, counted)
        last = self._beyond.lowered_less(weights, ratio, paid, values_beyond)
        left = self.sweeps.priced_less(weights, ratio)
        return self._lowered(
            last, left, explicit_pricing.values_less_paid(values, paid), at_source, -paid
        )[0]

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
        self,
        beyond: DualBound,
        priced: Callable[[int], PairCost],
        values: FloatArray,
        at_source: float,
        floor: float = 0.0,
    ) -> tuple[float, FloatArray]:
        """Layered pricing's bound at the start by lowered values, and these.

        Args:
            beyond: of what lies beyond the cap.
            priced: what the pairs of a layer cost at least, [pairs].
            values: not to be exceeded, [states].
            at_source: what is paid before the first step.
            floor: a constant that is known to be a sub-solution.
        """
        layered, n = self.augmented, self.augmented.n_nodes
        given, lowest = values[:-1].reshape(layered.cap + 1, n), beyond.rounded
        is_kept = values.size <= KEPT_VALUES
        kept = np.empty(values.shape) if is_kept else np.broadcast_to(np.inf, values.shape)
        if is_kept:
            kept[layered.cap * n : -1] = lowest
        for layer, lowest in self.sweeps.lowered(lowest, priced):  # noqa: B020 (the last is used)
            ceiling = np.nan_to_num(given[layer], nan=floor, posinf=np.inf)
            np.minimum(lowest, np.maximum(ceiling, floor), out=lowest)
            if is_kept:
                kept[layer * n : (layer + 1) * n] = lowest
        bound = self._at_start(lowest[np.flatnonzero(layered.base.start)], at_source)
        if is_kept:
            kept[-1] = bound
        return bound, kept

    def _at_start(self, lowest: FloatArray, at_source: float) -> float:
        """Layered pricing's bound at the start by those where it has mass, [some nodes]."""
        start = self.augmented.base.start
        shares = start[start != 0.0]
        parts = shares * lowest
        terms = parts.size + self.n_rewards  # each of these is rounded once at the start
        loss = terms * MACHINE_EPSILON * (float(np.abs(parts).sum()) + abs(at_source))
        exact = parts.size == 1 and float(shares[0]) == 1.0 and at_source == 0.0
        return float(parts.sum()) + at_source - (0.0 if exact else loss)

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a layered choice with an open end."""
        chosen = self.augmented.base.pair_offsets[:-1] + required(column.choice)
        return self.augmented.policy(chosen.ravel())
