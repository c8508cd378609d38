"""The oracle of the accumulated-cost process: one backward sweep over its layers."""

from __future__ import annotations

from collections.abc import Callable
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
from ssp_lp.engines.oracles.oracle import Column, required
from ssp_lp.engines.oracles.policy_iteration import approach, improve
from ssp_lp.engines.oracles.sub_solution import backup_rounding, sub_solution
from ssp_lp.errors import ModelError
from ssp_lp.linear import accumulate
from ssp_lp.policies.policy import Policy
from ssp_lp.process.layered import LayeredProcess

LayerSolver = Callable[[int, FloatArray], tuple[IntArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class LayeredOracle:
    """Column generation's oracle for case S; nothing larger than a policy is stored."""

    process: LayeredProcess

    def minimise(self, failure_price: float, warm: Column | None = None) -> Column:
        """A policy of least ``E[cost; goal] + failure_price * failure``, measured exactly."""
        base, offsets = self.process.base, self.process.base.pair_offsets
        choice = np.empty((self.process.cap, base.n_nodes), dtype=np.int32)
        beyond_cost, beyond_failure = self.process.beyond
        window = beyond_cost + failure_price * beyond_failure  # the layers ahead, nearest first
        inner = self._first_choice
        for layer in reversed(range(self.process.cap)):
            ahead = self._stage(layer, failure_price) + base.later @ window.reshape(-1)
            if self._acyclic:
                values = segment_minima(ahead, offsets)
                inner = first_minimisers(ahead, values, offsets)
            else:
                inner, values = improve(offsets, base.instant, ahead, inner)
            choice[layer] = inner
            window = np.vstack([values[None, :], window])[: base.width - 1]
        return self.measure(choice)

    def measure(self, choice: IntArray) -> Column:
        """Exact E[cost; goal] and failure of a choice, [cap, nodes], by a backward sweep."""
        base = self.process.base
        window = np.stack(self.process.beyond, axis=-1)  # [width - 1, nodes, 2]
        values = np.zeros((base.n_nodes, 2))
        for layer in reversed(range(self.process.cap)):
            chosen = choice[layer]
            cost = base.gain[chosen] * (layer * base.unit) + base.gain_cost[chosen]
            values = np.stack([cost, base.failure[chosen]], axis=1)
            values = values + base.later[chosen] @ window.reshape(-1, 2)
            if not self._acyclic:
                values = accumulate(base.instant[chosen], values)
            window = np.concatenate([values[None], window])[: base.width - 1]
        totals = base.start @ values
        return Column(float(totals[0]), float(totals[1]) + base.start_failure, choice)

    def bound(self, failure_price: float, best: Column) -> tuple[float, FloatArray]:
        """A certified lower bound of the priced cost, with its sub-solution, [cap, nodes]."""
        anything = np.full((self.process.cap, self.process.base.n_nodes), np.inf)
        return self.check(failure_price, anything)

    def check(self, failure_price: float, values: FloatArray) -> tuple[float, FloatArray]:
        """Lower values, [cap, nodes], to a checked sub-solution; the bound at the start with them.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved.
        """
        return self._checked(failure_price, values, self.process.beyond_bound(failure_price))

    def tail_loss(self, failure_price: float) -> float:
        """How much of the bound the cap costs: 0 where the tails are proved to be optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there.
        """
        anything = np.full((self.process.cap, self.process.base.n_nodes), np.inf)
        cost, failure = self.process.beyond
        reached, _ = self._checked(failure_price, anything, cost + failure_price * failure)
        return max(reached - self.bound(failure_price, Column(0.0, 0.0, None))[0], 0.0)

    def _checked(
        self, failure_price: float, values: FloatArray, beyond: FloatArray
    ) -> tuple[float, FloatArray]:
        base, offsets = self.process.base, self.process.base.pair_offsets
        if values.shape != (self.process.cap, base.n_nodes):
            raise ModelError(
                f"a value function of shape {self.process.cap, base.n_nodes} is needed"
            )
        proof, window = np.empty_like(values), beyond
        deflate = 1.0 - backup_rounding(base.steps)
        inner = self._first_choice
        for layer in reversed(range(self.process.cap)):
            ahead = self._stage(layer, failure_price) + base.later @ window.reshape(-1)
            ahead = ahead * deflate
            given = np.maximum(np.nan_to_num(values[layer], nan=0.0, posinf=np.inf), 0.0)
            if self._acyclic:
                proof[layer] = np.minimum(segment_minima(ahead, offsets), given)
            else:
                inner, best = improve(offsets, base.instant, ahead, inner)
                given = np.minimum(best, given)
                proof[layer] = sub_solution(offsets, base.instant, ahead, given)
            window = np.vstack([proof[layer][None, :], window])[: base.width - 1]
        bound = float(base.start @ proof[0]) + failure_price * base.start_failure
        terms = np.count_nonzero(base.start) - 1.0 + 2.0 * (base.start_failure > 0)
        return bound * (1.0 - max(terms, 0.0) * MACHINE_EPSILON), proof

    def policy(self, column: Column) -> Policy:
        """The column's policy on the original states."""
        if column.policy is not None:
            return column.policy
        return self.process.policy(required(column.choice))

    @cached_property
    def _acyclic(self) -> bool:
        """Whether every step between states costs something, so that layers need no solving."""
        return self.process.base.instant.nnz == 0

    @cached_property
    def _first_choice(self) -> IntArray:
        base = self.process.base
        inside = base.instant
        stays = np.asarray(inside.sum(axis=1)).ravel()
        return approach(base.pair_offsets, sp.csr_array(inside), stays < 1.0 - 1e-9)

    def _stage(self, layer: int, failure_price: float) -> FloatArray:
        """Priced cost of each pair's step itself, [pairs]."""
        base = self.process.base
        paid = base.gain * (layer * base.unit) + base.gain_cost
        return paid + failure_price * base.failure
