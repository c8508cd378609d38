"""The pricing problem of an explicit process, solved by policy iteration.

A policy *leaves* if it ends every run, by the goal or by failure. If the price of a row is 0, an
end component that adds only to that row is free: staying in it for ever would have a lower priced
cost than any policy that leaves. Policies that stay are excluded, because their expected total of
that row is infinite. In exact arithmetic, policy iteration that starts at a policy that leaves
never finds a policy that stays:

- Let v be the values of a policy that leaves. Let pi be a policy that takes a pair of strictly
  smaller ``c + P v`` in some states, and the first policy's pair elsewhere: v >= c_pi + P_pi v.
- Suppose that pi has a closed class, with stationary distribution m. Then m (v - c_pi - P_pi v) =
  -m c_pi <= 0, so no pair of the class was changed, and the first policy would stay in it, too.
  This is a contradiction, so pi leaves.
- If no pair is strictly smaller, v <= c_u + P_u v for every pair u. Iterating this along any policy
  that leaves shows that v is a lower bound of its priced cost.

In floating point, rounding can make a free cycle look like an improvement. Free end components are
therefore contracted to one state each (``processes.explicit_process``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from ssp_lp.accumulated_cost.written_out import LastLayer, OpenEnded
from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    expected,
    weighted,
    weighted_rounding,
)
from ssp_lp.column_generation.column import (
    Column,
    PricingProblem,
    Proof,
    pricing_weights,
    required,
)
from ssp_lp.compiled.deadline import Stop, is_limited
from ssp_lp.dynamic_programming.bellman import Work, best_pairs
from ssp_lp.dynamic_programming.dual_bound import DualBound
from ssp_lp.dynamic_programming.dynamics import Dynamics, leaving_choice
from ssp_lp.dynamic_programming.equations import DIRECT_STATES
from ssp_lp.dynamic_programming.evaluation import evaluate_policy
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy, switched
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.explicit_process import (
    Contraction,
    ExplicitProcess,
    bound_of,
    contract,
)
from ssp_lp.processes.failure_label import LabelledProcess

LOST = 4.0 * MACHINE_EPSILON
"""Relative rounding error of a sum of a few terms."""

LARGEST = 1e150
"""Prices and values beyond this count as infinite: products of two of them overflow."""

_ROUNDED = 1e-13  # relative to the amount that every episode pays: smaller values are rounding
_UNIT = np.ones(1)
_NONE = Work()


@dataclass(frozen=True, eq=False)
class ExplicitPricing(PricingProblem):
    """Minimises the cost of a process at a price of failure, or at a weight of each reward.

    The argument ``price`` is a price of failure or an array of weights: of cost, failure and all
    further rows, >= 0, [rewards].
    """

    augmented: LabelledProcess | OpenEnded | LastLayer  # the process, and its map to the model
    rows: tuple[FloatArray, ...] = ()  # [pairs] each: the rewards after cost and failure
    counted: FloatArray | None = None  # [pairs] replaces the cost of the process
    initial_choice: IntArray | None = None  # [states] a known policy that leaves
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure
    _known: dict[bytes, Contraction | None] = field(default_factory=dict)  # by the weights' support

    no_gain: ClassVar[float] = 1e-14  # relative improvement by another pair that is rounding

    @cached_property
    def process(self) -> ExplicitProcess:
        """The explicit process."""
        return self.augmented.process

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the process."""
        return self.process.dynamics

    @property
    def n_rewards(self) -> int:
        """Number of rewards: cost, failure and one per row."""
        return 2 + len(self.rows)

    @cached_property
    def rewards(self) -> FloatArray:
        """Rewards of each pair, [pairs, rewards]: cost, failure and rows."""
        process = self.process
        cost = process.cost if self.counted is None else self.counted
        ending = -process.goal if self.by_goal else process.failure
        return np.stack([cost, ending, *self.rows], axis=1)

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy that ends every run, at the goal where possible, [states].

        If there is a time limit, the policy avoids dead-ends, because it may become the answer.
        """
        if self.initial_choice is not None:
            return self.initial_choice
        process, nearer = self.process, self.augmented.nearer_goal(safely=is_limited())
        return leaving_choice(process.dynamics, process.goal, nearer).astype(np.int32)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """Shape of value functions: [states] of the explicit process."""
        return (self.process.n_states,)

    def incumbent(self, reached: Any) -> Column | None:
        """Return the column of the policy at which policy iteration was stopped."""
        return None if reached is None else self.measure(reached)

    def first(self) -> Column:
        """Return the column of a policy that takes a shortest way to the goal where possible."""
        return self._first

    @cached_property
    def _first(self) -> Column:
        """The column of :attr:`_leaving`, the policy from which a first pricing call starts."""
        return self.measure(self._leaving)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Return a column of least priced cost, by policy iteration, evaluated exactly.

        End components that are free at the price are contracted first. Otherwise rounding could
        lead to policies that stay in them for ever.
        """
        weights = pricing_weights(price)
        choice, guess = self._initial_policy(weights, warm)
        smaller = self.contracted(weights)
        at = float(weights[1]) if len(weights) == 2 and weights[0] == 1.0 else None
        noise = _noise(weights, warm) if self.by_goal or self.rows else 0.0
        run = partial(iterate_policy, floor=noise)
        if smaller is None:
            settled = run(self.dynamics, self.rewards, weights, choice, guess)
            found = settled.choice, settled.totals
            return self._column(*found, work=settled.work, found_at=at)
        choice = smaller.contracted_policy(self.process, choice).astype(np.int32)
        priced = weighted(self.rewards, weights)[smaller.pairs, None]
        about = None if guess is None else smaller.least(weighted(guess, weights))[:, None]
        try:
            settled = run(smaller.dynamics, priced, _UNIT, choice, about)
        except Stop as stop:
            come_to = stop.choice
            if come_to is not None:
                come_to = smaller.expanded_policy(self.process, come_to)
            raise Stop(come_to) from stop
        return self.measure(smaller.expanded_policy(self.process, settled.choice), settled.work, at)

    def _initial_policy(
        self, weights: FloatArray, warm: Sequence[Column | None]
    ) -> tuple[IntArray, FloatArray | None]:
        """Return a policy from which policy iteration starts, and its approximate totals.

        Args:
            weights: weights of the rewards, [rewards].
            warm: known columns, whose policies are combined.

        Returns:
            The policy, [states], and totals, [states, rewards], or None.
        """
        columns = [c for c in warm if c is not None and c.choice is not None]
        if not columns:
            return self._leaving, None
        dynamics = self.dynamics
        is_quick = dynamics.n_states <= DIRECT_STATES or dynamics.is_solved_backwards
        if is_quick or any(c.totals is None for c in columns):
            return required(columns[0].choice), columns[0].totals
        columns.append(self._first)
        totals = [required(column.totals) for column in columns]
        choice, follows = switched(
            dynamics,
            [required(column.choice) for column in columns],
            [weighted(total, weights) for total in totals],
        )
        if not follows.any():
            return choice, totals[0]
        return choice, np.stack(totals)[follows, np.arange(len(choice))]

    def contracted(self, weights: FloatArray) -> Contraction | None:
        """Return the contraction of the end components that are free at weights; None if none are.

        Contractions are cached by the set of nonzero weights.
        """
        priced = weights != 0.0
        key = priced.tobytes()
        if key not in self._known:
            free = (self.rewards[:, priced] == 0.0).all(axis=1)
            self._known[key] = contract(self.process, free)
        return self._known[key]

    def is_best(self, column: Column, weights: FloatArray) -> bool:
        """Return whether a column is optimal at other weights: no pair improves its values."""
        values = weighted(required(column.totals), weights)
        cost, held = weighted(self.rewards, weights), required(column.choice)
        dynamics = self.dynamics
        backup = best_pairs(dynamics.pair_offsets, dynamics.transitions, cost, values, held)
        gain = backup.current_values - backup.minima
        return bool((gain <= self.no_gain * np.abs(backup.current_values)).all())

    def measure(
        self, choice: IntArray, work: Work = _NONE, found_at: float | None = None
    ) -> Column:
        """Return the column of a policy, evaluated by a sparse linear solve.

        Args:
            choice: pair of each state, [states].
            work: the work of finding the policy.
            found_at: a price of failure at which the policy is optimal, or None.
        """
        totals = evaluate_policy(self.dynamics, choice, self.rewards)
        return self._column(choice, totals.values, work=work + Work(1, 0), found_at=found_at)

    def _column(self, choice: IntArray, totals: FloatArray, **more: Any) -> Column:
        """Return the column of a choice with known totals, [states, rewards]."""
        figures = expected(self.process.start, totals)
        return Column.of_rewards(figures, choice, by_goal=self.by_goal, totals=totals, **more)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Prove a dual bound from the values of ``best``, a policy of least priced cost."""
        column = best if best.totals is not None else self.minimise(price, best)
        values = weighted(required(column.totals), pricing_weights(price))
        return self.check(price, values, choice=column.choice)

    def minimise_and_prove(self, weights: FloatArray, warm: Column) -> Proof:
        """Minimise at new weights and prove the dual bound there."""
        values = weighted(required(self.minimise(weights, warm).totals), weights)
        return self.check(weights, values)

    def check(
        self,
        price: float | FloatArray,
        values: FloatArray,
        *,
        slack: bool = False,
        choice: IntArray | None = None,
    ) -> Proof:
        """Prove a dual bound from a given value function.

        The values are lowered until no backup decreases them: then they bound the priced cost of
        every policy from below.

        Args:
            price: price of failure, or the weight of each reward, [rewards].
            values: near-optimal values, [states].
            slack: has no effect here.
            choice: a policy of about these values, which may save work, [states].

        Raises:
            ModelError: values have the wrong shape.
        """
        self.check_shape(values)
        weights = pricing_weights(price)
        bound, price = self.lowered(weights, values, choice), float(weights[1])
        failing = 0.0 if self.by_goal else price
        return Proof(price, failing, bound.at(self.process.start), bound.values)

    def lowered(
        self, weights: FloatArray, values: FloatArray, choice: IntArray | None = None
    ) -> DualBound:
        """Return checked lower bounds of the weighted totals of every policy, near given values.

        Args:
            weights: weights of the rewards, >= 0, [rewards].
            values: near-optimal values, [states].
            choice: a policy of about these values that ends every run, [states], or None.
        """
        priced = weighted(self.rewards, weights)
        size = weighted(np.abs(self.rewards), np.abs(weights))
        priced -= weighted_rounding(self.rewards, weights) * size  # a bound rounds down
        values = np.where(np.abs(values) <= LARGEST, values, 0.0)  # 0 is a weak bound
        return bound_of(self.process, self.contracted(weights), priced, values, choice=choice)

    def bound_less_constant(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Return the bound of :meth:`lowered_less` at the start of the process."""
        return self.lowered_less_constant(weights, ratio, paid, values).at(self.process.start)

    def lowered_less_constant(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> DualBound:
        """Return checked lower bounds of the weighted totals minus a constant.

        The constant, ``paid``, is the amount that every episode pays when it ends. Up to rounding,
        the result is that of :meth:`lowered` minus ``paid``. To avoid cancellation, the difference
        is summed over the steps: a reward of success replaces the price of failure ``ratio``.

        Args:
            weights: weights of the rewards, >= 0, without the ratio, [rewards].
            ratio: price of failure due to the ratio of case S.
            paid: amount that every episode pays at its end.
            values: lower bounds of the weighted totals, including ``ratio``, [states].
        """
        process, cost, counted = self.process, self.augmented.own_cost, weights.copy()
        counted[1] += ratio
        left = costs_less_earnings(
            cost, cost + self.rewards[:, 1:] @ weights[1:], ratio * process.goal
        )
        values = values_less_constant(np.where(np.abs(values) <= LARGEST, values, 0.0), paid)
        return bound_of(process, self.contracted(counted), left, values)

    def pulled_back(self, column: Column) -> Policy:
        """Translate the choice of a column to a policy on the states of the model."""
        return self.augmented.policy(required(column.choice))


def costs_less_earnings(own: FloatArray, costs: FloatArray, earned: FloatArray) -> FloatArray:
    """Return ``costs - earned``, [pairs], rounded down where the difference is not exact.

    Args:
        own: costs before any price was added, and thus without rounding, [pairs].
        costs: priced costs, [pairs].
        earned: reward of reaching the goal, >= 0, [pairs].
    """
    left = costs - earned
    summed = (left != own) & (left != -earned)
    return np.asarray(left - np.where(summed, LOST * (np.abs(costs) + earned), 0.0))


def values_less_constant(values: FloatArray, paid: float) -> FloatArray:
    """Return ``values - paid``, [states], with differences of rounding size set to 0."""
    left = values - paid
    return np.where(np.abs(left) <= _ROUNDED * paid, 0.0, left)


def _noise(weights: FloatArray, columns: Sequence[Column | None]) -> float:
    """Return the largest improvement of a priced cost that may be due to rounding.

    It is positive only if weighted rewards of both signs cancel.

    Args:
        weights: weights of the rewards, [rewards].
        columns: known columns; the first with all rewards gives the size of the summands.
    """
    measured = (column for column in columns if column is not None)
    known = next((column for column in measured if len(column.rewards) == len(weights)), None)
    if known is None or not (known.rewards * weights < 0.0).any():
        return 0.0
    return LOST * float(np.abs(known.rewards) @ np.abs(weights))
