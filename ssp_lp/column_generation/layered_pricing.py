"""The pricing problem on layers of accumulated cost, with any limits, solved by backward sweeps.

Every step has a positive cost, so each layer depends only on later ones. One last layer stands for
all totals beyond the cap; it has cycles, and is solved by policy iteration. One backward sweep from
there prices all layers and evaluates the policy in each row. A *choice*, [layers, nodes], is a
policy: for each node of each layer, the position of the pair taken among the pairs of the node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import TailValues
from ssp_lp.accumulated_cost.sweep import KEPT_VALUES, Sweep, SweepCosts, at_weights
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import FloatArray, IntArray, weighted
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, pricing_weights, required
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.dynamic_programming import bellman
from ssp_lp.dynamic_programming.evaluation import evaluate_policy
from ssp_lp.policies.policy import Policy

_LONG_RUNS = 1e6  # steps beyond the cap from which the rounding of goal probabilities adds up


@dataclass(frozen=True, eq=False)
class OpenEndedPricing(PricingProblem):
    """Minimises weighted totals of cost, failure and rows; see :class:`ExplicitPricing`.

    All steps have a positive cost, and totals are multiples of a unit.
    """

    augmented: OpenEnded
    rows: tuple[tuple[FloatArray, float], ...]  # further rewards: [pairs], at the start
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure
    exact_tails: bool = True  # optimal tails beyond the cap, not the better of two policies

    @property
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and one per row."""
        return 2 + len(self.rows)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """Shape of value functions: [(cap + 1) * nodes + 1], for all layers and the source."""
        return ((self.augmented.cap + 1) * self.augmented.base.n_nodes + 1,)

    @cached_property
    def _beyond(self) -> ExplicitPricing:
        """The pricing problem of the last layer, beyond the cap."""
        rows = tuple(row for row, _ in self.rows)
        return ExplicitPricing(self.augmented.beyond, rows, by_goal=self.by_goal)

    @cached_property
    def sweep(self) -> Sweep:
        """The backward sweeps over the layers."""
        return open_sweep(self.augmented, [row for row, _ in self.rows], by_goal=self.by_goal)

    @cached_property
    def _at_source(self) -> FloatArray:
        """Expected rewards of episodes that end where they begin, [rewards]."""
        layered = self.augmented
        cost = layered.start_charge + layered.shift_of_ends[1]
        ending = -layered.base.start_goal if self.by_goal else layered.base.start_failure
        return np.array([cost, ending, *(at for _, at in self.rows)])

    def first(self) -> Column:
        """Return the column of a policy to the goal that ignores the accumulated cost."""
        return self._swept(self._beyond.first(), None)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Return a column of least priced cost, evaluated exactly."""
        weights = pricing_weights(price)
        return self._swept(self._tail(weights, *warm), weights)

    def reevaluated(self, columns: Sequence[Column]) -> list[Column]:
        """Return columns of a process with fewer layers, re-evaluated for this process.

        In the additional layers the columns act as they did beyond the lower cap.
        """
        first, tails, known = self.sweep.first_pairs, dict[Column | None, Column](), list[Column]()
        for column in columns:
            choice, old = required(column.choice), column.beyond
            last = tails.get(old) or self._beyond.measure(choice[-1] + first)
            tails[old] = last
            more = self.augmented.cap + 1 - len(choice), len(first)
            longer = np.concatenate([choice, np.broadcast_to(choice[-1], more)])
            ahead = ahead_of(self.augmented, required(last.totals))
            figures = self.sweep.measure(longer[:-1], ahead) + self._at_source
            known.append(Column.of_rewards(figures, longer, by_goal=self.by_goal, beyond=last))
        return known

    def true_cost(self, column: Column) -> float | None:
        """Return the exact cost of a column, with the true charge of totals beyond the cap.

        The result is None if the charge is not affine beyond the cap, or if runs are so long that
        rounding errors of their step costs add up.
        """
        layered, last = self.augmented, column.beyond
        if last is None or layered.shift > 0.0 or not layered.is_settled:
            return None
        totals, choice = required(last.totals), required(last.choice)
        goal, failure = 1.0 - totals[:, 1], totals[:, 1]
        if self.by_goal:
            goal, failure = -totals[:, 1], 1.0 + totals[:, 1]
        steps = layered.step_cost(layered.reaching(goal))[:, None]
        ahead = evaluate_policy(self._beyond.dynamics, choice, steps)
        if ahead.runs.max(initial=0.0) > _LONG_RUNS:
            return None
        early = goal / layered.base.survival
        tail = TailValues(goal, failure, early, ahead.values[:, 0], moment=np.zeros_like(goal))
        beyond = np.array(ahead_of(layered, totals))
        beyond[:, :, 0] = layered.charge.beyond(layered.totals.beyond[:, None], tail)
        figures = self.sweep.measure(required(column.choice)[:-1], beyond)
        return float((figures + self._at_source)[0])

    def _swept(self, last: Column, weights: FloatArray | None) -> Column:
        """Return the column that a backward sweep finds, given the policy beyond the cap.

        Args:
            last: the policy of the last layer, with its totals.
            weights: weights of the rewards to minimise, [rewards]; None: all layers take the pairs
                of the last one.
        """
        totals, position = required(last.totals), required(last.choice) - self.sweep.first_pairs
        measures = ahead_of(self.augmented, totals)
        choice, figures = swept(self.sweep, position, weights, totals, measures)
        figures, work = figures + self._at_source, last.work + bellman.Work(1, 1)
        kept: dict[str, Any] = {"work": work, "beyond": last}
        return Column.of_rewards(figures, choice, by_goal=self.by_goal, **kept)

    def _tail(self, weights: FloatArray, *warm: Column | None) -> Column:
        """Return the policy to follow in the last layer, at given weights of the rewards.

        The policy is optimal if ``exact_tails``, or if the cost has weight 0 (phase 1). Otherwise
        it is the better of two: a policy to the goal, and one that is optimal if failing is free.
        """
        if self.exact_tails or weights[0] == 0.0:
            return self._best_beyond(weights, *warm)
        tails = self._fails_early, self._beyond.first()
        return min(tails, key=lambda last: weighted(required(last.totals), weights).sum())

    @cached_property
    def _fails_early(self) -> Column:
        """The policy of the last layer that is optimal at price 0 of failure."""
        return self._beyond.minimise(np.eye(1, self.n_rewards)[0])

    def _best_beyond(self, weights: FloatArray, *warm: Column | None) -> Column:
        """Return an optimal policy of the last layer, one of the warm columns if possible."""
        known = [c.beyond for c in warm if c is not None and c.beyond is not None]
        for last in dict.fromkeys(known):
            if self._beyond.is_best(last, weights):
                return replace(last, work=bellman.Work())
        return self._beyond.minimise(weights, *known)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove the best dual bound at a price, by one backward sweep."""
        return self._proved(pricing_weights(price), self.infinite, best)

    def check(self, price: float | FloatArray, values: FloatArray, *, slack: bool = False) -> Proof:
        """Prove a dual bound from values in the shape of ``value_shape``.

        An infinite value stands for the largest one that the sweep can prove.

        Raises:
            ModelError: values have the wrong shape.
        """
        self.check_shape(values)
        return self._proved(pricing_weights(price), values, None)

    def _proved(self, weights: FloatArray, values: FloatArray, best: Column | None) -> Proof:
        """Return the dual bound that values prove, after lowering them where necessary.

        Args:
            weights: weights of the rewards, [rewards].
            values: near-optimal or infinite values, [states].
            best: a nearly optimal column, which saves work if values are infinite, or None.
        """
        last = self._beyond.lowered(weights, self._asked_beyond(values, weights, best)).rounded
        beyond, price = ahead_of(self.augmented, last), float(weights[1])
        costs = at_weights(self.sweep, weights, beyond, bounds=True)
        floor = -price if self.by_goal else 0.0
        ended = tuple(zip(weights.tolist(), self._at_source.tolist(), strict=True))
        costs = costs._replace(floor=floor, at_start=ended)
        bound, kept = self._lowered(self.sweep, costs, values, last)
        return Proof(price, 0.0 if self.by_goal else price, bound, kept)

    def bound_less_constant(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Return the certified bound at the start minus the amount that every episode pays.

        It is the bound of :meth:`ExplicitPricing.lowered_less`, by one backward sweep.
        """
        layered, base, counted = self.augmented, self.augmented.base, weights.copy()
        counted[1] += ratio
        beyond = self._asked_beyond(values, counted)
        last = self._beyond.lowered_less_constant(weights, ratio, paid, beyond).rounded
        every = np.append(weights, -ratio)
        costs = at_weights(self._less_paid, every, ahead_of(layered, last), bounds=True)
        amounts = [layered.start_charge, *self._at_source[1:].tolist(), base.start_goal]
        ended = tuple(zip(every.tolist(), amounts, strict=True))
        costs = costs._replace(floor=-paid, at_start=ended)
        return self._lowered(self._less_paid, costs, self.infinite, last)[0]  # the best bound

    @cached_property
    def _less_paid(self) -> Sweep:
        """The backward sweeps for :meth:`check_less`, with the goal as one more reward.

        They do not add the constant ``OpenEnded.shift`` to the charge of an episode.
        """
        goal = self.augmented.base.survival * self.augmented.base.gain
        counted = np.append(self.sweep.counted, goal[:, None], axis=1)
        return replace(self.sweep, counted=counted, added=None)

    def _asked_beyond(
        self, values: FloatArray, weights: FloatArray, best: Column | None = None
    ) -> FloatArray:
        """Return the given values of the last layer or, if infinite, those of an optimal policy."""
        self.check_shape(values)
        beyond = values[self.augmented.cap * self.augmented.base.n_nodes : -1]
        if np.isfinite(beyond).all():
            return beyond
        return weighted(required(self._best_beyond(weights, best).totals), weights)

    def _lowered(
        self, sweep: Sweep, costs: SweepCosts, values: FloatArray, last: FloatArray
    ) -> tuple[float, FloatArray]:
        """Return the certified bound at the start, and the lower bounds of all states, [states].

        Args:
            sweep: the backward sweeps.
            costs: weights of the rewards, and lower bounds of the values beyond the cap.
            values: upper limits of the lower bounds, [states].
            last: lower bounds of the values in the last layer, [nodes].
        """
        layered = self.augmented
        given = values[:-1].reshape(layered.cap + 1, layered.base.n_nodes)
        bounds, kept = sweep.bound(costs, given[:-1])
        bound = float(bounds[0])
        if values.size > KEPT_VALUES:
            return bound, np.broadcast_to(np.inf, values.shape)
        return bound, np.concatenate([kept.ravel(), last, [bound]])

    def pulled_back(self, column: Column) -> Policy:
        """Translate the choice of a column to a policy of the model that remembers the cost."""
        chosen = self.augmented.base.pair_offsets[:-1] + required(column.choice)
        return self.augmented.policy(chosen.ravel())


def open_sweep(table: OpenEnded, rows: Sequence[FloatArray], *, by_goal: bool) -> Sweep:
    """Return the backward sweeps over layers that evaluate cost, failure and further rows.

    Args:
        table: the layers and the last layer beyond the cap.
        rows: the further rewards, [pairs] each.
        by_goal: whether minus the goal replaces failure.
    """
    base = table.base
    ending = -base.survival * base.gain if by_goal else base.failure
    on_top = table.shift_of_ends[0] if table.shift else None
    return Sweep(table, np.stack([ending, *rows], axis=1), on_top)


def ahead_of(table: OpenEnded, beyond: FloatArray) -> FloatArray:
    """Return values of the last layer for each layer that a step can reach beyond the cap.

    The shape is [layers, nodes, ...], with equal values in all layers.
    """
    return np.broadcast_to(beyond, (table.base.width - 1, *beyond.shape))


def swept(
    sweep: Sweep,
    last: IntArray,
    weights: FloatArray | None,
    totals: FloatArray,
    measures: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Return the choice of a backward sweep, [layers + 1, nodes], and its totals, [rewards].

    Args:
        sweep: the backward sweeps.
        last: positions of the pairs taken in the last layer, [nodes].
        weights: weights of the rewards to minimise, [rewards]; None: take ``last`` everywhere.
        totals: totals of the last layer that the sweep minimises with, [nodes, rewards].
        measures: exact totals in each layer beyond the cap, [layers, nodes, rewards].
    """
    choice = sweep.empty_choice(sweep.process.cap + 1)
    choice[-1 if weights is not None else slice(None)] = last
    if weights is None:
        return choice, sweep.measure(choice[:-1], measures)
    table = cast("OpenEnded", sweep.process)
    beyond = ahead_of(table, weighted(totals, weights))
    costs = at_weights(sweep, weights, beyond, measures)
    return choice, sweep.minimise(costs, choice[:-1])
