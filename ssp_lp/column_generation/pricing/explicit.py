"""The pricing problem of an explicit process: policy iteration over all its states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, expected, weighted
from ssp_lp.column_generation.pricing.pricing_problem import Column, Proof, required
from ssp_lp.dynamic_programming.deadline import NEVER, Deadline
from ssp_lp.dynamic_programming.dual_bounds.dual_bound import dual_bound
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES
from ssp_lp.dynamic_programming.policy_iteration.approach import leaving_choice
from ssp_lp.dynamic_programming.policy_iteration.backward import evaluate_policy
from ssp_lp.dynamic_programming.policy_iteration.improvement import improve
from ssp_lp.dynamic_programming.policy_iteration.switching import switched
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import ModelError
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled


@dataclass(frozen=True, eq=False)
class ExplicitPricing:
    """Column generation's pricing problem for case M."""

    labelled: FailureLabelled
    precise: bool = False  # compare pairs in twice the working precision

    @property
    def process(self) -> ExplicitProcess:
        """The process that is minimised over."""
        return self.labelled.process

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy that leaves the process from every state, towards the goal first, [states]."""
        process = self.process
        return leaving_choice(process.dynamics, process.goal, self.labelled.nearer_goal())

    @cached_property
    def _rewards(self) -> FloatArray:
        """Cost and failure of each pair, [pairs, 2]."""
        return np.stack([self.process.cost, self.process.failure], axis=1)

    def first(self) -> Column:
        """A policy that comes nearer to the goal with every step it takes, where it can."""
        return self._first

    @cached_property
    def _first(self) -> Column:
        return self.measure(self._leaving.astype(np.int32))

    def minimise(
        self, failure_price: float, *warm: Column | None, deadline: Deadline = NEVER
    ) -> Column:
        """A policy of least ``cost + failure_price * failure``, measured exactly."""
        weights = np.array([1.0, failure_price])
        settled = improve(
            self.process.dynamics,
            self._rewards,
            weights,
            *self._begun(weights, warm),
            precise=self.precise,
            deadline=deadline,
        )
        best = self._column(settled.choice, settled.totals, settled.work)
        return replace(best, found_at=failure_price)

    def _begun(
        self, weights: FloatArray, warm: Sequence[Column | None]
    ) -> tuple[IntArray, FloatArray | None]:
        """A policy to start from, [states], and about its totals, [states, 2]: the best of some."""
        known = [c for c in warm if c is not None and c.choice is not None]
        if not known:
            return self._leaving, None
        if self.process.n_states <= DIRECT_STATES or any(c.totals is None for c in known):
            return required(known[0].choice), known[0].totals
        known.append(self._first)
        totals = [required(column.totals) for column in known]
        choice, follows = switched(
            self.process.dynamics,
            [required(column.choice) for column in known],
            [weighted(total, weights) for total in totals],
        )
        if not follows.any():
            return choice, totals[0]
        return choice, np.stack(totals)[follows, np.arange(len(choice))]

    def measure(self, choice: IntArray) -> Column:
        """Exact cost and failure of one pair per state, by a sparse linear solve.

        Args:
            choice: [states].
        """
        totals = evaluate_policy(self.process.dynamics, choice, self._rewards)
        return self._column(choice, totals.values, Work(1, 0))

    def _column(self, choice: IntArray, totals: FloatArray, work: Work) -> Column:
        cost, failure = expected(self.process.start, totals).tolist()
        failure = min(max(failure, 0.0), 1.0)  # verified: beyond it lies rounding
        return Column(cost, failure, 1.0 - failure, choice, totals=totals, work=work)

    def aligned(self, column: Column, price: float) -> Column:
        """The column itself: it has no tails."""
        return column

    def prove(self, price: float, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound from the values of a policy of least priced cost."""
        column = best if best.totals is not None else self.minimise(price, best)
        values = weighted(required(column.totals), np.array([1.0, price]))
        return self._checked(price, values, column.choice)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [states], to a checked sub-solution.

        Raises:
            ModelError: values of another shape, or ``slack``, which is for ratios.
        """
        process = self.process
        if values.shape != (process.n_states,) or slack:
            raise ModelError(f"a value function of shape ({process.n_states},) is needed")
        return self._checked(price, values, None)

    def _checked(self, price: float, values: FloatArray, choice: IntArray | None) -> Proof:
        process = self.process
        priced = process.cost + price * process.failure
        summed = (process.failure > 0.0) & ((process.cost > 0.0) | (process.failure < 1.0))
        priced -= np.where(summed, MACHINE_EPSILON * np.abs(priced), 0.0)  # a bound rounds down
        checked = dual_bound(process.dynamics, priced, values, choice=choice)
        return Proof(price, price, checked.at(process.start), checked.values)

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.labelled.policy(required(column.choice))
