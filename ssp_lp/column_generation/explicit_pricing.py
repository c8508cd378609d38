"""The pricing problem of an explicit process: policy iteration over all its states.

Where a row's price is 0, end components that cost nothing but that row are free in the pricing
problem, and to stay in one for ever would be a policy of less priced cost than any that leaves.
Such policies do not count: their expected total of that row is infinite. What is free is contracted
(``processes.explicit_process``), and policy iteration never finds a policy that stays:

Let v be the values of a policy that leaves, and pi a policy that takes a pair of strictly smaller
``c + P v`` in some states and the first one's pair elsewhere, so that v >= c_pi + P_pi v. If pi had
a closed class, with stationary distribution m, then m (v - c_pi - P_pi v) = -m c_pi <= 0, so that
no pair of the class is a changed one, and the first policy would not leave: pi leaves. And where no
pair is strictly smaller, v <= c_u + P_u v for every pair u, and iterating this along any policy
that leaves shows that v bounds its priced cost from below. In exact numbers this needs no
contraction; in rounded ones a cycle that costs nothing is a gain wherever rounding says so.
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
from ssp_lp.dynamic_programming.bellman import Work
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
    least_constant,
)
from ssp_lp.processes.failure_label import FailureLabelled

LOST = 4.0 * MACHINE_EPSILON
"""What rounding may take of a sum of a few terms, relative to these."""

LARGEST = 1e150
"""Prices and values beyond this are no numbers: products of two such overflow."""

_ROUNDED = 1e-13  # of what every episode pays: less than that is nothing
_UNIT = np.ones(1)
_NONE = Work()


@dataclass(frozen=True, eq=False)
class ExplicitPricing(PricingProblem):
    """Minimises a process's cost at a price of failure, or at a weight of each thing counted.

    A price is the one number of ``PricingProblem``, or, where there are rows beside the failure
    row, the weights of cost, failure and all rows, >= 0, [rewards].
    """

    augmented: FailureLabelled | OpenEnded | LastLayer  # the process, and the way back to the model
    precise: bool = False  # compare pairs in twice the working precision
    rows: tuple[FloatArray, ...] = ()  # [pairs] each: what is counted besides cost and failure
    counted: FloatArray | None = None  # [pairs] in place of the process's cost
    begun_from: IntArray | None = None  # [states] a policy that leaves, where one is known
    by_goal: bool = False  # success, as minus the goal, is counted in place of failing
    _known: dict[bytes, Contraction | None] = field(default_factory=dict)  # by what is priced

    no_gain: ClassVar[float] = 1e-14  # of a value, of another pair at a known policy: rounding

    @property
    def process(self) -> ExplicitProcess:
        """The written-out process of explicit pricing."""
        return self.augmented.process

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the process of explicit pricing."""
        return self.process.dynamics

    @property
    def n_rewards(self) -> int:
        """Number of rewards of explicit pricing: cost, failure and rows."""
        return 2 + len(self.rows)

    @cached_property
    def rewards(self) -> FloatArray:
        """Rewards of each pair in explicit pricing, [pairs, rewards]: cost, failure and rows."""
        process = self.process
        cost = process.cost if self.counted is None else self.counted
        ending = -process.goal if self.by_goal else process.failure
        return np.stack([cost, ending, *self.rows], axis=1)

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy of explicit pricing that leaves from every state, goal first, [states].

        Where there is little time the first policy may be the answer: it keeps off what is risky.
        """
        if self.begun_from is not None:
            return self.begun_from
        process, nearer = self.process, self.augmented.nearer_goal(safely=is_limited())
        return leaving_choice(process.dynamics, process.goal, nearer).astype(np.int32)

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[states]: a value for each state of the explicit process."""
        return (self.process.n_states,)

    def incumbent(self, reached: Any) -> Column | None:
        """The column that explicit pricing's policy iteration had come to when it was stopped."""
        return None if reached is None else self.measure(reached)

    def first(self) -> Column:
        """Explicit pricing's first column: every step comes nearer to the goal, where it can."""
        return self._first

    @cached_property
    def _first(self) -> Column:
        """The column of explicit pricing's leaving policy."""
        return self.measure(self._leaving)

    def minimise(self, price: float | FloatArray, *warm: Column | None) -> Column:
        """Explicit pricing: a column of least priced cost by policy iteration, measured exactly.

        What is free at the price is contracted first: rounding would find policies that stay.
        """
        weights = pricing_weights(price)
        choice, guess = self._begun(weights, warm)
        smaller = self.contracted(weights)
        at = float(weights[1]) if len(weights) == 2 and weights[0] == 1.0 else None
        noise = _noise(weights, warm) if self.by_goal or self.rows else 0.0
        run = partial(iterate_policy, precise=self.precise or None, floor=noise)
        if smaller is None:
            settled = run(self.dynamics, self.rewards, weights, choice, guess)
            found = settled.choice, settled.totals
            return self._column(*found, work=settled.work, found_at=at)
        choice = smaller.begun(self.process, choice).astype(np.int32)
        priced = weighted(self.rewards, weights)[smaller.pairs, None]
        about = None if guess is None else smaller.least(weighted(guess, weights))[:, None]
        try:
            settled = run(smaller.dynamics, priced, _UNIT, choice, about)
        except Stop as stop:
            come_to = stop.choice
            if come_to is not None:
                come_to = smaller.expanded(self.process, come_to)
            raise Stop(come_to) from stop
        return self.measure(smaller.expanded(self.process, settled.choice), settled.work, at)

    def _begun(
        self, weights: FloatArray, warm: Sequence[Column | None]
    ) -> tuple[IntArray, FloatArray | None]:
        """A policy for explicit pricing to start from, [states], and its totals, about."""
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
        """The explicit process without what is free at the weights, kept; None: nothing is."""
        priced = weights != 0.0
        key = priced.tobytes()
        if key not in self._known:
            free = (self.rewards[:, priced] == 0.0).all(axis=1)
            self._known[key] = contract(self.process, free)
        return self._known[key]

    def is_best(self, column: Column, weights: FloatArray) -> bool:
        """Whether no pair gains on a known column of explicit pricing at other weights."""
        values = weighted(required(column.totals), weights)
        cost, held = weighted(self.rewards, weights), required(column.choice)
        backup = self.dynamics.back_up(cost, values, held)
        gain = backup.here - backup.minima
        return not self.precise and bool((gain <= self.no_gain * np.abs(backup.here)).all())

    def measure(
        self, choice: IntArray, work: Work = _NONE, found_at: float | None = None
    ) -> Column:
        """Exact totals of a policy in explicit pricing, by a sparse linear solve.

        Args:
            choice: [states].
            work: what finding it took.
            found_at: a price at which no policy is worth less.
        """
        totals = evaluate_policy(self.dynamics, choice, self.rewards)
        return self._column(choice, totals.values, work=work + Work(1, 0), found_at=found_at)

    def _column(self, choice: IntArray, totals: FloatArray, **more: Any) -> Column:
        """A column of explicit pricing from its choice and its totals."""
        figures = expected(self.process.start, totals)
        return Column.of_figures(figures, choice, by_goal=self.by_goal, totals=totals, **more)

    def prove(self, price: float | FloatArray, best: Column, *, slack: bool = False) -> Proof:
        """Lower bound of explicit pricing by the values of a policy of least priced cost."""
        column = best if best.totals is not None else self.minimise(price, best)
        values = weighted(required(column.totals), pricing_weights(price))
        return self.check(price, values, choice=column.choice)

    def prove_afresh(self, weights: FloatArray, warm: Column) -> Proof:
        """Best lower bound of explicit pricing at weights that nothing has been priced at yet."""
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
        """Lower values, [states], to a checked sub-solution; with a policy of about these values.

        Raises:
            ModelError: values of another shape.
        """
        self.check_shape(values)
        weights = pricing_weights(price)
        bound, price = self.lowered(weights, values, choice), float(weights[1])
        failing = 0.0 if self.by_goal else price
        return Proof(price, failing, bound.at(self.process.start), bound.values)

    def lowered(
        self, weights: FloatArray, values: FloatArray, choice: IntArray | None = None
    ) -> DualBound:
        """Explicit pricing's weighted totals, lowered to a checked sub-solution.

        Args:
            weights: of the rewards, >= 0, [rewards].
            values: near-optimal ones, [states].
            choice: a policy of about these values, which leaves, [states].
        """
        priced = weighted(self.rewards, weights)
        size = weighted(np.abs(self.rewards), np.abs(weights))
        priced -= weighted_rounding(self.rewards, weights) * size  # a bound rounds down
        values = np.where(np.abs(values) <= LARGEST, values, 0.0)  # 0: a bound, if a poor one
        floor = least_constant(self.process, priced) if self.by_goal or self.rows else 0.0
        return bound_of(self.process, self.contracted(weights), priced, values, floor, choice)

    def check_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> float:
        """Explicit pricing's certified bound at the start, less what every episode pays."""
        return self.lowered_less(weights, ratio, paid, values).at(self.process.start)

    def lowered_less(
        self, weights: FloatArray, ratio: float, paid: float, values: FloatArray
    ) -> DualBound:
        """Explicit pricing's checked sub-solution, less what every episode pays.

        ``check`` says the same but for rounding; this is exact where nothing else is paid, and sums
        what is left by itself, without taking one large number from another.

        Args:
            weights: of the rewards, >= 0, without the ratio, [rewards].
            ratio: what failing counts, and success earns here.
            paid: on ending, whatever the end.
            values: lower values of the weighted totals, [states].
        """
        process, cost, counted = self.process, self.augmented.own_cost, weights.copy()
        counted[1] += ratio
        left = costs_less_earned(
            cost, cost + self.rewards[:, 1:] @ weights[1:], ratio * process.goal
        )
        values = values_less_paid(np.where(np.abs(values) <= LARGEST, values, 0.0), paid)
        floor = min(-paid, least_constant(process, left))
        return bound_of(process, self.contracted(counted), left, values, floor)

    def pulled_back(self, column: Column) -> Policy:
        """The policy of a choice of explicit pricing."""
        return self.augmented.policy(required(column.choice))


def costs_less_earned(own: FloatArray, costs: FloatArray, earned: FloatArray) -> FloatArray:
    """Costs of explicit pricing less what is earned, rounded down where a sum was, [pairs].

    Args:
        own: the only part of the costs that is exact by itself, [pairs].
        costs: [pairs].
        earned: non-negative, [pairs].
    """
    left = costs - earned
    summed = (left != own) & (left != -earned)
    return np.asarray(left - np.where(summed, LOST * (np.abs(costs) + earned), 0.0))


def values_less_paid(values: FloatArray, paid: float) -> FloatArray:
    """Explicit pricing's values less what all episodes pay, 0 where that is rounding, [states]."""
    left = values - paid
    return np.where(np.abs(left) <= _ROUNDED * paid, 0.0, left)


def _noise(weights: FloatArray, columns: Sequence[Column | None]) -> float:
    """Gain in explicit pricing that is none: the rounding of costs that earnings cancel.

    Args:
        weights: of the rewards, [rewards].
        columns: known ones, of which the first that is measured tells the size of what is added.
    """
    measured = (column for column in columns if column is not None)
    known = next((column for column in measured if len(column.figures) == len(weights)), None)
    if known is None or not (known.figures * weights < 0.0).any():
        return 0.0
    return LOST * float(np.abs(known.figures) @ np.abs(weights))
