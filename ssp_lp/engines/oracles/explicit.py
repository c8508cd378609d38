"""The oracle of an explicit process: policy iteration over all its states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.engines.oracles.oracle import Column, required
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
        return Column(float(totals[0]), float(totals[1]), choice)

    def bound(self, failure_price: float, best: Column) -> tuple[float, FloatArray]:
        """A certified lower bound of the priced cost, with its sub-solution, [states]."""
        process = self.process
        priced = process.cost + failure_price * process.failure
        choice = self._leaving if best.choice is None else best.choice
        return self.check(failure_price, accumulate(process.transitions[choice], priced[choice]))

    def check(self, failure_price: float, values: FloatArray) -> tuple[float, FloatArray]:
        """Lower values, [states], to a checked sub-solution; the bound at the start with them."""
        process = self.process
        if values.shape != (process.n_states,):
            raise ModelError(f"a value function of shape ({process.n_states},) is needed")
        priced = process.cost + failure_price * process.failure
        checked = sub_solution(process.pair_offsets, process.transitions, priced, values)
        terms = np.count_nonzero(process.start) - 1.0  # a sum of one term is exact
        return float(process.start @ checked) * (1.0 - terms * MACHINE_EPSILON), checked

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.labelled.policy(required(column.choice))
