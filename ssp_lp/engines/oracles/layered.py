"""The oracle of the accumulated-cost process: one backward sweep over its layers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
)
from ssp_lp.engines.oracles.oracle import Column, Proof, required
from ssp_lp.engines.oracles.policy_iteration import approach, improve
from ssp_lp.engines.oracles.sub_solution import backup_rounding, sub_solution
from ssp_lp.engines.oracles.window import Window
from ssp_lp.errors import ModelError
from ssp_lp.linear import accumulate
from ssp_lp.policies.policy import Policy
from ssp_lp.process.layered import LayeredProcess

_FEW_ENTRIES = 20_000

_BELOW_EVERY_VALUE = 1e-6
"""No value is below minus the price; a floor this much lower leaves room to count rounding."""


@dataclass(frozen=True, eq=False)
class LayeredOracle:
    """Column generation's oracle for case S; the process is never written out."""

    process: LayeredProcess

    def minimise(self, failure_price: float, warm: Column | None = None) -> Column:
        """A policy of least ``E[cost; goal] + failure_price * failure``, measured exactly."""
        base, offsets = self.process.base, self.process.base.pair_offsets
        choice = np.empty((self.process.cap, base.n_nodes), dtype=np.int32)
        failing = failure_price if self._likely else 0.0
        owed = failing * base.failure - (failure_price - failing) * base.survival * base.gain
        window = Window(self._tail_values(failure_price, failing))
        inner = self._first_choice
        for layer in reversed(range(self.process.cap)):
            paid = base.gain * (layer * base.unit) + base.gain_cost
            ahead = paid + owed + base.later @ window.ahead.reshape(-1)
            if self._acyclic:
                values = segment_minima(ahead, offsets)
                inner = first_minimisers(ahead, values, offsets)
            else:
                inner, values = improve(offsets, base.instant, ahead, inner)
            choice[layer] = inner
            window.push(values)
        return self.measure(choice, failure_price)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice, by a backward sweep.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        base = self.process.base
        beyond_cost, beyond_goal = self.process.beyond(tail_price)
        window = Window(np.stack([beyond_cost, 1.0 - beyond_goal, beyond_goal], axis=-1))
        values = np.zeros((base.n_nodes, 3))
        for layer in reversed(range(self.process.cap)):
            chosen = choice[layer]
            cost = base.gain[chosen] * (layer * base.unit) + base.gain_cost[chosen]
            hit = base.survival * base.gain[chosen]
            values = np.stack([cost, base.failure[chosen], hit], axis=1)
            values = values + _chosen_rows(base.later, chosen, window.ahead.reshape(-1, 3))
            if not self._acyclic:
                values = accumulate(base.instant[chosen], values)
            window.push(values)
        cost, failure, goal = (base.start @ values).tolist()
        return Column(
            cost, failure + base.start_failure, goal + base.start_goal, choice, tail_price
        )

    def aligned(self, column: Column, price: float) -> Column:
        """The column with its tails chosen by this price, measured again."""
        if column.choice is None:
            return column
        here, there = self.process.threshold(column.tail_price), self.process.threshold(price)
        return column if np.array_equal(here, there) else self.measure(column.choice, price)

    def prove(self, price: float, best: Column, *, slack: bool = False) -> Proof:
        """Prove the best lower bound that a sweep gives; no policy is needed for it."""
        return self.check(price, self._anything, slack=slack)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [cap, nodes], to a checked sub-solution.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved.

        Raises:
            ModelError: values of another shape.
        """
        failing = 0.0 if slack else price
        beyond = self.process.beyond_bound(price, failing)
        return self._swept(price, failing, values, beyond)

    def tail_loss(self, price: float, *, slack: bool = False) -> float:
        """How much of the bound the cap costs: 0 where the tails are proved to be optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there.
        """
        failing = 0.0 if slack else price
        beyond = self._tail_values(price, failing)
        reached = self._swept(price, failing, self._anything, beyond).bound
        return max(reached - self.check(price, self._anything, slack=slack).bound, 0.0)

    def _swept(self, price: float, failing: float, values: FloatArray, beyond: FloatArray) -> Proof:
        base, offsets, success = self.process.base, self.process.base.pair_offsets, price - failing
        if values.shape != (self.process.cap, base.n_nodes):
            raise ModelError(
                f"a value function of shape {self.process.cap, base.n_nodes} is needed"
            )
        checked, window = np.empty(values.shape), Window(beyond)
        rounding, inner = backup_rounding(base.steps), self._first_choice
        owed, saved = failing * base.failure, success * base.survival * base.gain
        floor = -success * (1.0 + _BELOW_EVERY_VALUE)
        for layer in reversed(range(self.process.cap)):
            paid = base.gain * (layer * base.unit) + base.gain_cost + owed
            size = paid + saved + base.later @ np.abs(window.ahead).reshape(-1)
            ahead = paid - saved + base.later @ window.ahead.reshape(-1)
            ahead = np.where(size == owed, ahead, ahead - rounding * size)
            given = np.maximum(np.nan_to_num(values[layer], nan=floor, posinf=np.inf), floor)
            if self._acyclic:
                checked[layer] = np.minimum(segment_minima(ahead, offsets), given)
            else:
                inner, best = improve(offsets, base.instant, ahead, inner)
                given = np.minimum(best, given)
                checked[layer] = sub_solution(offsets, base.instant, ahead, given, floor)
            window.push(checked[layer])
        parts = np.append(base.start * checked[0], [failing * base.start_failure,
                                                    -success * base.start_goal])  # fmt: skip
        loss = (np.count_nonzero(parts) - 1.0) * MACHINE_EPSILON * float(np.abs(parts).sum())
        return Proof(price, failing, float(parts.sum()) - max(float(loss), 0.0), checked)

    @cached_property
    def _anything(self) -> FloatArray:
        """Values that ask for the best that can be proved, [cap, nodes]."""
        return np.broadcast_to(np.inf, (self.process.cap, self.process.base.n_nodes))

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.process.policy(required(column.choice), column.tail_price)

    @cached_property
    def _acyclic(self) -> bool:
        """Whether every step between states costs something, so that layers need no solving."""
        return self.process.base.instant.nnz == 0

    @cached_property
    def _likely(self) -> bool:
        """Whether some policy probably succeeds; else success is counted rather than failure."""
        base, tails = self.process.base, self.process.tails
        return float(base.start @ tails.goal[0]) + base.start_goal >= 0.5

    @cached_property
    def _first_choice(self) -> IntArray:
        base = self.process.base
        leaving = (base.gain > 0) | (base.failure > 0) | (np.diff(base.later.indptr) > 0)
        return approach(base.pair_offsets, base.instant, leaving)

    def _tail_values(self, price: float, failing: float) -> FloatArray:
        """Values of the tails beyond the cap, [width - 1, nodes]."""
        cost, goal = self.process.beyond(price)
        return cost + failing * (1.0 - goal) - (price - failing) * goal


def _chosen_rows(matrix: sp.csr_array, rows: IntArray, dense: FloatArray) -> FloatArray:
    """``matrix[rows] @ dense``; picking rows costs more than multiplying where all are few."""
    if matrix.nnz <= _FEW_ENTRIES:
        return np.asarray((matrix @ dense)[rows])
    return np.asarray(matrix[rows] @ dense)
