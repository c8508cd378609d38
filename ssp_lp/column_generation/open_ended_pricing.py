"""The pricing problem of the open-ended process with rows: a sweep over layers, never written out.

Every step costs something, so that each layer of accumulated cost follows from later ones. Beyond
the cap lies one place with cycles of its own, where policy iteration says what is best; from there
one backward sweep prices all layers, and measures what the choice takes of each row on the way. A
choice is the position of a pair among those of its node, [layers, nodes], in the smallest integers
that hold it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.accumulated_cost.sweep import KEPT_VALUES
from ssp_lp.accumulated_cost.totals import Window
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import MACHINE_EPSILON, TIED, FloatArray, IntArray, least_integer_type, weighted
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, required
from ssp_lp.column_generation.explicit_pricing import (
    LOST,
    ExplicitPricing,
    less_paid,
    pricing_rounding,
    pricing_weights,
    rest_of,
)
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    Work,
    best_pairs,
    chosen_product,
    safe_minima,
)
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.policies.policy import Policy


@dataclass(frozen=True, eq=False)
class OpenEndedPricing(PricingProblem):
    """Minimises weighted totals of cost, failure and rows; see :class:`ExplicitPricing`.

    Nothing in a layer is free, and totals are multiples of a unit.
    """

    augmented: OpenEnded
    precise: bool  # compare pairs beyond the cap in twice the working precision
    rows: tuple[tuple[FloatArray, float], ...]  # what is counted besides: [pairs], and at the start

    @property
    def n_rewards(self) -> int:
        """Cost, failure and rows."""
        return 2 + len(self.rows)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers * nodes + 1], as for the process written out."""
        return ((self.augmented.cap + 1) * self.augmented.n_nodes + 1,)

    @cached_property
    def _beyond(self) -> ExplicitPricing:
        """The pricing problem of what lies beyond the cap."""
        rows = tuple(row for row, _ in self.rows)
        return ExplicitPricing(self.augmented.beyond, self.precise, rows)

    @cached_property
    def _counted(self) -> FloatArray:
        """Failure and rows of each pair of a layer, [pairs, rewards - 1]."""
        return np.stack([self.augmented.base.failure, *(row for row, _ in self.rows)], axis=1)

    @cached_property
    def _at_source(self) -> FloatArray:
        """What an episode is charged and counted before its first step, [rewards]."""
        layered = self.augmented
        cost = layered.charges.at_start + layered.shift_of_ends[1]
        return np.array([cost, layered.base.start_failure, *(at for _, at in self.rows)])

    def _cost_from(self, layer: int) -> FloatArray:
        """Charges of arriving from a layer with the shift, [pairs]."""
        return self.augmented.own_cost_from(layer) + self.augmented.shift_of_ends[0]

    @cached_property
    def _first(self) -> Column:
        """The column of the policy that leaves the open end, whatever has been paid."""
        first = self._beyond.first()
        last = required(first.choice) - self.augmented.base.pair_offsets[:-1]
        return self._swept(first, lambda charged, ahead: last)

    def first(self) -> Column:
        """A policy that comes nearer to the goal with every step it takes, where it can."""
        return self._first

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """A policy of least priced cost, measured exactly."""
        weights, base = pricing_weights(price), self.augmented.base
        owed = self._counted @ weights[1:]
        last = self._beyond.minimise(weights, *map(self._last, warm))
        values = self._window(weighted(required(last.totals), weights))

        def best(charged: FloatArray, totals: FloatArray | None) -> IntArray:
            """The best position of each node in a layer, from the totals of the layer after it."""
            if totals is not None:
                values.push(weighted(totals, weights))
            cost = PairCost(weights[0] * charged + owed)
            backup = best_pairs(base.pair_offsets, base.later, cost, values.flat, tied=TIED)
            return np.asarray(backup.choice - base.pair_offsets[:-1])

        return self._swept(last, best)

    def _last(self, column: Column | None) -> Column | None:
        """What a column does beyond the cap."""
        if column is None or column.choice is None:
            return None
        choice = self.augmented.base.pair_offsets[:-1] + column.choice[-1]
        return Column(0.0, 0.0, 0.0, choice.astype(np.int32))

    def _swept(
        self, last: Column, position_of: Callable[[FloatArray, FloatArray | None], IntArray]
    ) -> Column:
        """A policy with its totals from the start, found layer by layer.

        Args:
            last: what is done beyond the cap, with its totals.
            position_of: the position of each node's pair in a layer, [nodes], from the charges of
                arriving from it, [pairs], and the totals of the layer after it, None for those
                beyond the cap.
        """
        layered, base = self.augmented, self.augmented.base
        most = int(np.diff(base.pair_offsets).max(initial=1))
        choice = np.empty((layered.cap + 1, base.n_nodes), dtype=least_integer_type(most))
        choice[-1] = required(last.choice) - base.pair_offsets[:-1]
        totals, window = None, self._window(required(last.totals))
        for layer in reversed(range(layered.cap)):
            check_time()
            charged = self._cost_from(layer)
            choice[layer] = position_of(charged, totals)
            chosen = base.pair_offsets[:-1] + choice[layer]
            totals = np.empty((base.n_nodes, self.n_rewards))
            totals[:, 0], totals[:, 1:] = charged[chosen], self._counted[chosen]
            totals += chosen_product(base.later, chosen, window.flat)
            window.push(totals)
        begun = required(last.totals) if totals is None else totals
        cost, failure, *rows = (base.start @ begun + self._at_source).tolist()
        failure = min(max(failure, 0.0), 1.0)  # verified: beyond it lies rounding
        work = last.work + Work(1, 1)
        return Column(cost, failure, 1.0 - failure, choice, work=work, rows=tuple(rows))

    def _window(self, last: FloatArray) -> Window:
        """The layers ahead of the last one below the cap, all of them beyond it."""
        reached = self.augmented.base.width - 1  # layers, counted from the next one
        return Window(np.broadcast_to(last, (reached, *last.shape)))

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove the best lower bound that a sweep gives."""
        return self.check(price, np.broadcast_to(np.inf, self.value_shape))

    def prove_afresh(self, weights: FloatArray, warm: Column) -> Proof:
        """Prove the best lower bound at weights that nothing has been priced at yet."""
        return self.prove(weights, warm)

    def check(self, price: float | FloatArray, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [states], to a checked sub-solution; infinite ones ask for the best.

        Raises:
            ModelError: values of another shape.
        """
        weights = pricing_weights(price)
        owed, at_source = self._counted @ weights[1:], float(self._at_source @ weights)
        lost = pricing_rounding(self._counted, weights[1:]) * owed

        def priced(layer: int) -> FloatArray:
            """Priced costs of a layer's pairs, rounded down, [pairs]."""
            cost = weights[0] * self._cost_from(layer)
            both = (cost != 0.0) & (owed != 0.0)
            return np.asarray(cost + owed - (lost + both * LOST * (np.abs(cost) + owed)))

        last = self._beyond.lowered(weights, self._asked_beyond(values, weights))
        bound, kept = self._lowered(last, priced, values, at_source)
        return Proof(float(weights[1]), float(weights[1]), bound, kept)

    def check_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """A certified bound of the weighted totals less what every episode pays, at the start.

        See :meth:`ExplicitPricing.check_less`.
        """
        base, counted = self.augmented.base, weights.copy()
        counted[1] += ratio
        earned, owed = ratio * base.survival * base.gain, self._counted @ weights[1:]
        begun, earned_at_once = float(self._at_source @ weights), ratio * base.start_goal
        shift = self.augmented.shift_of_ends[1]
        summed = begun + shift + earned_at_once
        at_source = begun - shift - earned_at_once - LOST * summed

        def left(layer: int) -> FloatArray:
            """What a layer's pairs cost beside what is paid on ending, rounded down, [pairs]."""
            own = self.augmented.own_cost_from(layer)
            return rest_of(own, own + owed, earned)

        asked = self._asked_beyond(values, counted)
        last = self._beyond.lowered_less(weights, ratio, paid, asked)
        return self._lowered(last, left, less_paid(values, paid), at_source, -paid)[0]

    def _asked_beyond(self, values: FloatArray, weights: FloatArray) -> FloatArray:
        """The values beyond the cap; where they ask for the best, those of the best policy."""
        self.check_shape(values)
        asked = values[self.augmented.cap * self.augmented.n_nodes : -1]
        if np.isfinite(asked).all():
            return asked
        return weighted(required(self._beyond.minimise(weights).totals), weights)

    def _lowered(
        self,
        beyond: DualBound,
        priced: Callable[[int], FloatArray],
        values: FloatArray,
        at_source: float,
        floor: float = 0.0,
    ) -> tuple[float, FloatArray]:
        """The bound at the start that values give when lowered to a sub-solution, and these.

        Args:
            beyond: of what lies beyond the cap.
            priced: what the pairs of a layer cost at least, [pairs].
            values: not to be exceeded, [states].
            at_source: what is paid before the first step.
            floor: a constant that is known to be a sub-solution.
        """
        layered, base, n = self.augmented, self.augmented.base, self.augmented.n_nodes
        given, lowest = values[:-1].reshape(layered.cap + 1, n), beyond.rounded
        window = self._window(lowest)
        is_kept = values.size <= KEPT_VALUES
        kept = np.empty(values.shape) if is_kept else np.broadcast_to(np.inf, values.shape)
        if is_kept:
            kept[layered.cap * n : -1] = lowest
        for layer in reversed(range(layered.cap)):
            check_time()
            cost = priced(layer)
            size = np.abs(cost)
            lowest = safe_minima(
                base.pair_offsets, base.later, PairCost(cost), size, size, window.flat
            )
            asked = np.nan_to_num(given[layer], nan=floor, posinf=np.inf)
            lowest = np.minimum(lowest, np.maximum(asked, floor))
            window.push(lowest)
            if is_kept:
                kept[layer * n : (layer + 1) * n] = lowest
        entries = np.flatnonzero(base.start)
        parts = base.start[entries] * lowest[entries]
        terms = entries.size + self.n_rewards  # each of these is rounded once at the start
        loss = terms * MACHINE_EPSILON * (float(np.abs(parts).sum()) + abs(at_source))
        exact = entries.size == 1 and float(base.start[entries[0]]) == 1.0 and at_source == 0.0
        bound = float(parts.sum()) + at_source - (0.0 if exact else loss)
        if is_kept:
            kept[-1] = bound
        return bound, kept

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a choice."""
        chosen = self.augmented.base.pair_offsets[:-1] + required(column.choice)
        return self.augmented.policy(chosen.ravel())
