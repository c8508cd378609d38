"""The pricing problem of the accumulated-cost process: one backward sweep over its layers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.accumulated_cost.sweep import PartOfSweep, Sweep
from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, required
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.policies.policy import DeterministicPolicy, Policy

_SAME = 1e-14
"""Share of a bound below which there is only rounding."""


@dataclass(frozen=True, eq=False)
class LayeredPricing(PricingProblem):
    """Column generation's pricing problem for case S; the process is never written out.

    A choice is the position of a pair among those of its node, [cap, nodes], in the smallest
    integers that hold it.
    """

    process: LayeredProcess

    @property
    def value_shape(self) -> tuple[int, ...]:
        """[layers, nodes]."""
        return self.process.cap, self.process.base.n_nodes

    @cached_property
    def sweep(self) -> Sweep:
        """The sweeps over the process."""
        return Sweep(self.process)

    def incumbent(self, reached: Any) -> Column | None:
        """What a part of a sweep is worth: the best policy at a lower price of failure.

        Whoever begins in its last layer as if nothing had been paid does what is best at the price
        less what the layer stands for. None where the charge is another one than the cost itself.
        """
        process, base = self.process, self.process.base
        if not isinstance(reached, PartOfSweep) or reached.layer == process.cap:
            return None
        if not process.grows_evenly or base.by_steps:
            return None
        paid = float(process.totals.values[reached.layer]) / base.survival
        begun = replace(process, totals=base.totals(process.cap - reached.layer))
        within, choice = replace(self, process=begun), reached.choice[reached.layer :]
        price = reached.price - paid
        if reached.measures is None:
            found = within.sweep.follow(choice, price)
        else:
            found = base.start @ reached.measures
            found[0] -= paid * found[2]
        policy = begun.policy(choice, price)
        return replace(within._column(found, choice, price, 0), choice=None, policy=policy)

    def first(self) -> Column:
        """The first tail, which goes for the goal, followed from the start; or a guess at that."""
        base, tails = self.process.base, self.process.tails
        if tails.guess is not None:
            return Column(tails.guess[0], 1.0, tails.guess[1] + base.start_goal, None)
        nothing_paid = self.process.charge.beyond(np.zeros(base.n_nodes), tails.first)
        cost = float(base.start @ nothing_paid) + self.process.start_charge
        goal = float(base.start @ tails.goal[0])
        failure = float(base.start @ tails.first.failure) + base.start_failure
        policy = DeterministicPolicy(base.quotient.model, tails.decisions[0])
        return Column(cost, failure, goal + base.start_goal, None, policy=policy)

    def minimise(self, failure_price: float, *warm: Column | None) -> Column:
        """A policy of least ``E[charge; goal] + failure_price * failure``, measured exactly."""
        choice = self.sweep.room_for_choice()
        failing = failure_price if self._likely else 0.0
        found = self.sweep.minimise(failure_price, failing, choice)
        return self._column(found, choice, failure_price, self.process.cap)

    def measure(self, choice: IntArray, tail_price: float) -> Column:
        """Exact E[cost; goal] and failure of a choice.

        Args:
            choice: [cap, nodes].
            tail_price: the price of failure by which tails are chosen beyond the cap.
        """
        return self._column(self.sweep.measure(choice, tail_price), choice, tail_price, 0)

    def _column(
        self, totals: FloatArray, choice: IntArray, tail_price: float, backups: int
    ) -> Column:
        """A choice with its charge, failure and goal from the start."""
        base, work = self.process.base, Work(backups, self.process.cap)
        cost, failure, goal = totals.tolist()
        failure = max(failure + base.start_failure, 0.0)  # verified: below it lies rounding
        goal = max(goal + base.start_goal, 0.0)
        cost += self.process.start_charge
        return Column(cost, failure, goal, choice, tail_price, work=work)

    def aligned(self, column: Column, price: float) -> Column:
        """The column with its tails chosen by this price, measured again."""
        if column.choice is None:
            return column
        here, there = self.process.threshold(column.tail_price), self.process.threshold(price)
        return column if np.array_equal(here, there) else self.measure(column.choice, price)

    def prove(self, price: float, best: Column | None = None, *, slack: bool = False) -> Proof:
        """The best lower bound of every policy that a sweep gives; none is needed for it."""
        beyond = self.process.beyond_bound(price, 0.0 if slack else price)
        return self._proof(price, self._anything, beyond, slack=slack)

    def check(self, price: float, values: FloatArray, *, slack: bool = False) -> Proof:
        """Lower values, [cap, nodes], to a checked sub-solution.

        The sweep starts from the lower bound beyond the cap and counts the rounding of every
        backup against itself. Infinite values ask for the best that can be proved: then the choice
        behind them is kept, where it can be followed.

        Raises:
            ModelError: values of another shape.
        """
        choice, beyond = None, self.process.beyond_bound(price, 0.0 if slack else price)
        self.check_shape(values)
        if self.sweep.can_follow and self.sweep.one_pass is None:
            asked = all(bool(np.isposinf(layer).all()) for layer in values)
            choice = self.sweep.room_for_choice() if asked else None
        return self._proof(price, values, beyond, choice, slack=slack)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """How much of the bound the cap costs, at most: 0 where the tails are proved to be optimal.

        The difference, at the start, between the bound with the tail policies' own values beyond
        the cap and the one with the lower bound there. It is no more than what the choice behind
        the latter loses where it gets beyond the cap.

        Args:
            price: of failure.
            slack: as of :meth:`check`.
            proof: what was proved at this price; where its bound is as high, that is all.
        """
        failing = 0.0 if slack else price
        lost = self.sweep.lost_beyond(price, failing)
        if not lost.any():
            return 0.0
        if proof is not None and proof.choice is not None:
            left = self.sweep.mass_beyond(proof.choice)
            most = float((left[: len(lost)] * lost).sum())
            if most <= _SAME * abs(proof.bound):
                return most
        beyond = self.process.beyond_value(price, failing)
        reached = self._proof(price, self._anything, beyond, slack=slack).bound
        if proof is not None and reached <= proof.bound:
            return 0.0
        return max(reached - self.prove(price, slack=slack).bound, 0.0)

    def _proof(
        self,
        price: float,
        values: FloatArray,
        beyond: FloatArray,
        choice: IntArray | None = None,
        *,
        slack: bool,
    ) -> Proof:
        """Lower values layer by layer, from what is given beyond the cap."""
        failing = 0.0 if slack else price
        bounds, kept = self.sweep.bound(price, failing, values, beyond, choice)
        work = Work(self.process.cap, 0)
        return Proof(price, failing, float(bounds[0]), kept, work, choice, by_layer=bounds)

    @property
    def _anything(self) -> FloatArray:
        """Values that ask for the best that can be proved, [cap, nodes]."""
        return np.broadcast_to(np.inf, self.value_shape)

    def pulled_back(self, column: Column) -> Policy:
        """The cost-aware policy of a choice and its tails."""
        return self.process.policy(required(column.choice), column.tail_price)

    @cached_property
    def _likely(self) -> bool:
        """Whether some policy probably succeeds; else success is counted rather than failure."""
        base, tails = self.process.base, self.process.tails
        goal = tails.guess[1] if tails.guess else float(base.start @ tails.goal[0])
        return goal + base.start_goal >= 0.5
