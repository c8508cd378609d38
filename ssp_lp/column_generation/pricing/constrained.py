"""The pricing problem of a process with several rows: policy iteration at a price for each of them.

Where a row's price is 0, end components that cost nothing but that row are free in the pricing
problem, and to stay in one for ever would be a policy of less priced cost than any that leaves.
Such policies do not count: their expected total of that row is infinite. What is free is contracted
(``processes.contraction``), and policy iteration never finds a policy that stays:

Let v be the values of a policy that leaves, and pi a policy that takes a pair of strictly smaller
``c + P v`` in some states and the first one's pair elsewhere, so that v >= c_pi + P_pi v. If pi had
a closed class, with stationary distribution m, then m (v - c_pi - P_pi v) = -m c_pi <= 0, so that
no pair of the class is a changed one, and the first policy would not leave: pi leaves. And where no
pair is strictly smaller, v <= c_u + P_u v for every pair u, and iterating this along any policy
that leaves shows that v bounds its priced cost from below. In exact numbers this needs no
contraction; in rounded ones a cycle that costs nothing is a gain wherever rounding says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, expected, weighted
from ssp_lp.dynamic_programming.deadline import NEVER, Deadline
from ssp_lp.dynamic_programming.linear_systems.totals import evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration.approach import leaving_choice
from ssp_lp.dynamic_programming.policy_iteration.improvement import improve
from ssp_lp.dynamic_programming.policy_iteration.settled import Settled
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.contraction import Contraction, bound_of, contract
from ssp_lp.processes.explicit import ExplicitProcess

LARGEST = 1e150
"""Prices and values beyond this are no numbers: products of two such overflow."""

_ROUNDED = 1e-13  # of what every episode pays: less than that is nothing
_LOST = 4.0 * MACHINE_EPSILON  # of the terms of a sum
_UNIT = np.ones(1)
_NONE = Work()


@dataclass(frozen=True, eq=False)
class Point:
    """A deterministic policy with its exact expected totals from the start."""

    figures: FloatArray  # [rewards] cost, failure, secondary costs
    choice: IntArray  # [states] pair of the process
    totals: FloatArray  # [states, rewards] the same from each state: a warm start
    work: Work  # what finding it took

    def worth(self, weights: FloatArray) -> float:
        """Its totals, weighted, [rewards]."""
        return float(self.figures @ weights)


@dataclass(frozen=True, eq=False)
class Checked:
    """A certified lower bound of the weighted totals of every policy that leaves."""

    bound: float  # at the start
    values: FloatArray  # [states] the checked sub-solution behind it
    work: Work


class _Augmentation(Protocol):
    """A process with its way back to the model."""

    @property
    def process(self) -> ExplicitProcess:
        """The process."""
        ...

    def nearer_goal(self) -> IntArray | None:
        """A pair of each state by which it may come nearer to the goal, or -1; None: unknown."""
        ...

    def policy(self, choice: IntArray) -> Policy:
        """One pair of each state of the process as a policy on the model."""
        ...


@dataclass(frozen=True, eq=False)
class ConstrainedPricing:
    """Minimises and measures weighted totals of several rewards of a process."""

    augmented: _Augmentation
    rewards: FloatArray  # [pairs, rewards] cost, failure, secondary costs
    precise: bool = False  # compare pairs in twice the working precision
    _known: dict[bytes, Contraction | None] = field(default_factory=dict)  # by what is counted

    @property
    def process(self) -> ExplicitProcess:
        """The process that is minimised over."""
        return self.augmented.process

    @cached_property
    def _first(self) -> IntArray:
        """A policy that leaves, towards the goal where it can, [states]."""
        process = self.process
        nearer = self.augmented.nearer_goal()
        return leaving_choice(process.dynamics, process.goal, nearer).astype(np.int32)

    def first(self) -> Point:
        """A policy that comes nearer to the goal with every step it takes, where it can."""
        return self._measured(self._first, None, Work())

    def minimise(
        self, weights: FloatArray, warm: Point | None = None, deadline: Deadline = NEVER
    ) -> Point:
        """A policy of least weighted totals, measured exactly.

        What is free at the weights is contracted first: rounding would find policies that stay.

        Args:
            weights: of the rewards, >= 0, [rewards].
            warm: a policy to start from.
            deadline: looked at inside every loop.

        Raises:
            OutOfTimeError: the deadline passed.
        """
        smaller, choice = self._contracted(weights), self._first if warm is None else warm.choice
        guess = None if warm is None else weighted(warm.totals, weights)
        if smaller is None:
            settled = self._improved(self.process, weights, choice, guess, deadline)
            found = settled.choice
        else:
            begun = smaller.begun(self.process, choice).astype(np.int32)
            guess = None if guess is None else smaller.least(guess)
            settled = self._improved(smaller, weights, begun, guess, deadline)
            found = smaller.expanded(self.process, settled.choice)
        if warm is not None and np.array_equal(found, warm.choice):
            return replace(warm, work=settled.work)
        return self._measured(found, None if warm is None else warm.totals, settled.work)

    def _improved(
        self,
        process: ExplicitProcess | Contraction,
        weights: FloatArray,
        choice: IntArray,
        guess: FloatArray | None,
        deadline: Deadline,
    ) -> Settled:
        """Policy iteration on the process, or on what is left of it."""
        priced = weighted(self.rewards, weights)
        priced = priced if isinstance(process, ExplicitProcess) else priced[process.pairs]
        return improve(
            process.dynamics,
            priced[:, None],
            _UNIT,
            choice,
            None if guess is None else guess[:, None],
            precise=self.precise,
            deadline=deadline,
        )

    def _contracted(self, weights: FloatArray) -> Contraction | None:
        """The process without what is free at the weights, kept; None where nothing is."""
        counted = weights > 0.0
        key = counted.tobytes()
        if key not in self._known:
            free = (self.rewards[:, counted] == 0.0).all(axis=1)
            self._known[key] = contract(self.process, free)
        return self._known[key]

    def _measured(self, choice: IntArray, guess: FloatArray | None, work: Work) -> Point:
        system = self.process.dynamics.chain(choice)
        first = None if guess is None else system.solve(self.rewards[choice], guess)
        totals = evaluate_chain(system, self.rewards[choice], first).values
        spent = work + Work(0, system.products)
        return Point(expected(self.process.start, totals), choice, totals, spent)

    def prove(self, weights: FloatArray, best: Point) -> Checked:
        """Prove a lower bound from the values of a policy of least weighted totals."""
        best = self.minimise(weights, best)
        return self.check(weights, weighted(best.totals, weights), best.work)

    def check(self, weights: FloatArray, values: FloatArray, work: Work = _NONE) -> Checked:
        """Lower values, [states], to a checked sub-solution at the weights, [rewards].

        What is free at the weights is contracted first (see ``processes.contraction``).

        Raises:
            ModelError: values of another shape.
        """
        process, priced = self.process, weighted(self.rewards, weights)
        if values.shape != (process.n_states,):
            raise ModelError(f"a value function of shape ({process.n_states},) is needed")
        priced -= _LOST * np.where((self.rewards * weights > 0.0).sum(axis=1) > 1, priced, 0.0)
        values = np.where(np.abs(values) <= LARGEST, values, 0.0)  # 0: a bound, if a poor one
        checked = bound_of(process, self._contracted(weights), priced, values)
        return Checked(checked.at(process.start), checked.values, work)

    def check_less(
        self, weights: FloatArray, ratio: float, cost: FloatArray, paid: float, values: FloatArray
    ) -> float:
        """A certified bound of the weighted totals less what every episode pays, at the start.

        ``check`` says the same but for rounding; this is exact where nothing else is paid, and sums
        what is left by itself, without taking one large number from another.

        Args:
            weights: of the rewards, >= 0, without the ratio, [rewards].
            ratio: what failing counts, and success earns here.
            cost: the first reward without what every episode pays, [pairs].
            paid: on ending, whatever the end.
            values: lower values of the weighted totals, [states].
        """
        process, counted = self.process, weights.copy()
        counted[1] += ratio
        beside = cost + self.rewards[:, 1:] @ weights[1:]
        left = beside - ratio * process.goal
        summed = (left != cost) & (left != -ratio * process.goal)
        left -= np.where(summed, _LOST * (np.abs(beside) + ratio * process.goal), 0.0)
        values = np.where(np.abs(values) <= LARGEST, values, 0.0) - paid
        values = np.where(np.abs(values) <= _ROUNDED * paid, 0.0, values)
        return bound_of(process, self._contracted(counted), left, values, -paid).at(process.start)

    def policy(self, point: Point) -> Policy:
        """The policy on the original states."""
        return self.augmented.policy(point.choice)
