"""The oracle of an explicit process: policy iteration over all its states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.engines.oracles.oracle import Column, Proof, required
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
        to_goal = approach(process.pair_offsets, process.transitions, process.goal > 0)
        leaks = approach(
            process.pair_offsets, process.transitions, process.goal + process.failure > 0
        )
        return np.where(to_goal >= 0, to_goal, leaks)

    def minimise(self, failure_price: float, warm: Column | None = None) -> Column:
        """A policy of least ``cost + failure_price * failure``, measured exactly."""
        process = self.process
        first = self._leaving if warm is None or warm.choice is None else warm.choice
        priced = process.cost + failure_price * process.failure
        choice, _ = improve(process.pair_offsets, process.transitions, priced, first)
        return self.measure(choice)

    def measure(self, choice: IntArray) -> Column:
        """Exact cost and failure of one pair per state, by a sparse linear solve."""
        process = self.process
        reward = np.stack([process.cost[choice], process.failure[choice]], axis=1)
        totals = process.start @ accumulate(process.transitions[choice], reward)
        return Column(float(totals[0]), float(totals[1]), 1.0 - float(totals[1]), choice)

    def aligned(self, column: Column, price: float) -> Column:
        """The column itself: it has no tails."""
        return column

    def prove(self, price: float, best: Column, *, slack: bool = False) -> Proof:
        """Prove a lower bound from the values of a policy of least priced cost."""
        process = self.process
        priced = process.cost + price * process.failure
        choice = self._leaving if best.choice is None else best.choice
        return self.check(price, accumulate(process.transitions[choice], priced[choice]))

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
