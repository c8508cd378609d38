"""The oracle of an explicit process: policy iteration over all its states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.bellman import ChosenRows
from ssp_lp.engines.oracles.oracle import Column, Proof, Work, required
from ssp_lp.engines.oracles.policy_iteration import approach, improve
from ssp_lp.engines.oracles.sub_solution import sub_solution
from ssp_lp.errors import ModelError
from ssp_lp.linear import accumulate
from ssp_lp.policies.policy import Policy
from ssp_lp.process.explicit import ExplicitProcess
from ssp_lp.process.failure_label import FailureLabelled


@dataclass(frozen=True, eq=False)
class ExplicitOracle:
    """Column generation's oracle for case M."""

    labelled: FailureLabelled

    @property
    def process(self) -> ExplicitProcess:
        """The process that is minimised over."""
        return self.labelled.process

    @cached_property
    def _leaving(self) -> IntArray:
        """A policy that leaves the process from every state, towards the goal first, [states]."""
        process = self.process
        offsets, transitions = process.pair_offsets, process.transitions
        found = self.labelled.nearer_goal()
        to_goal = approach(offsets, transitions, process.goal > 0) if found is None else found
        if to_goal.min(initial=0) >= 0:
            return to_goal
        leaks = approach(offsets, transitions, process.goal + process.failure > 0)
        return np.where(to_goal >= 0, to_goal, leaks)

    @cached_property
    def _rewards(self) -> FloatArray:
        """Cost and failure of each pair, [pairs, 2]."""
        return np.stack([self.process.cost, self.process.failure], axis=1)

    def first(self) -> Column:
        """A policy that comes nearer to the goal with every step it takes, where it can."""
        return self.measure(self._leaving.astype(np.int32))

    def minimise(self, failure_price: float, warm: Column | None = None) -> Column:
        """A policy of least ``cost + failure_price * failure``, measured exactly."""
        process = self.process
        found = warm is not None and warm.choice is not None
        settled = improve(
            process.pair_offsets,
            process.transitions,
            self._rewards,
            np.array([1.0, failure_price]),
            warm.choice if warm is not None and warm.choice is not None else self._leaving,
            warm.totals if warm is not None and found else None,
        )
        return self._column(settled.choice, settled.totals, settled.work)

    def measure(self, choice: IntArray) -> Column:
        """Exact cost and failure of one pair per state, by a sparse linear solve.

        Args:
            choice: [states].
        """
        chain = ChosenRows(self.process.transitions, choice)
        totals = accumulate(chain, self._rewards[choice])
        return self._column(choice, totals, Work(0, chain.products))

    def _column(self, choice: IntArray, totals: FloatArray, work: Work) -> Column:
        cost, failure = (self.process.start @ totals).tolist()
        return Column(cost, failure, 1.0 - failure, choice, totals=totals, work=work)

    def aligned(self, column: Column, price: float) -> Column:
        """The column itself: it has no tails."""
        return column

    def prove(self, price: float, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound from the values of a policy of least priced cost."""
        column = best if best.totals is not None else self.minimise(price, best)
        return self.check(price, required(column.totals) @ np.array([1.0, price]))

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [states], to a checked sub-solution.

        Raises:
            ModelError: values of another shape, or ``slack``, which is for ratios.
        """
        process = self.process
        if values.shape != (process.n_states,) or slack:
            raise ModelError(f"a value function of shape ({process.n_states},) is needed")
        priced = process.cost + price * process.failure
        checked = sub_solution(process.pair_offsets, process.transitions, priced, values)
        summands = int(np.count_nonzero(process.start))  # a sum of one term is exact
        bound = float(process.start @ checked) * (1.0 - (summands - 1.0) * MACHINE_EPSILON)
        return Proof(price, price, bound, checked)

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.labelled.policy(required(column.choice))
