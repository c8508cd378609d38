"""The price rule of one failure row: the slope between two columns.

The master program has the failure row and convexity, so its optimum lies on an edge of the lower
convex hull of the points (failure, cost). The rule keeps a feasible column A and an infeasible
column B, prices failure at the slope between them, and ends when no policy lies below their line.
In case S the objective is the ratio ``cost / (1 - failure)`` (paper, eq. s3p_gamma_j_obj): as long
as no column is infeasible the price is the ratio itself (Dinkelbach's iteration).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ssp_lp.column_generation.failure_row import FailureRow, least_of
from ssp_lp.column_generation.generation import Generated
from ssp_lp.column_generation.pricing.pricing_problem import (
    Column,
    PricingProblem,
    Proof,
    excess_failure,
)
from ssp_lp.compiled.deadline import STOPS, closing, has_time_for, heed, is_limited
from ssp_lp.dynamic_programming.bellman import Work

_SHARE = 0.25  # of a search that its bounds on the way may take
_LONG = 0.1  # seconds of a pricing call, below which its proof can wait for the end
_SAME_COST = 1e-15  # relative; a weight so far below 1 is 1
_SAME_FAILURE = 1e-15  # of columns, one of which is the other, found again
_SAME_SMALL = 1e-14  # the same, relative to failures that are small and to goals that are rare


@dataclass(eq=False)
class Secant:
    """The two columns between which the lottery lies; ``outside`` is missing while none is."""

    pricing: PricingProblem
    row: FailureRow
    inside: Column  # keeps to the budget
    outside: Column | None = None  # cheaper, and breaks it
    last: Column | None = None  # found last: a warm start
    calls: int = 0
    work: Work = field(default_factory=Work)
    proof: Proof | None = None  # the best one so far
    took: float = 0.0  # seconds of the longest pricing call; a proof needs about as many
    _spent: float = 0.0  # seconds on proofs
    _since: float = field(default_factory=time.perf_counter)

    most_rounds: ClassVar[int] = 200

    @property
    def slope(self) -> float:
        """Price of failure at which both columns are worth the same; in case S the ratio so far."""
        if self.outside is not None:
            saved = self.inside.cost - self.outside.cost
            return max(saved / excess_failure(self.outside, self.inside), 0.0)
        return self.row.objective(self.inside.cost, self.inside.goal) if self.row.ratio else 0.0

    @property
    def weight(self) -> float:
        """Weight of the column beyond the budget at which the lottery meets the budget."""
        if self.outside is None:
            return 0.0
        room = self.row.spare(self.inside) / excess_failure(self.outside, self.inside)
        if room * abs(self.inside.cost - self.outside.cost) <= _SAME_COST * abs(self.inside.cost):
            return 0.0  # what it would save is rounding
        return 1.0 if room > 1.0 - _SAME_COST else float(max(room, 0.0))

    @property
    def objective(self) -> float:
        """Objective of the lottery."""
        w = self.weight
        if self.outside is None or w == 0.0:
            return self.row.objective(self.inside.cost, self.inside.goal)
        return self.row.objective(
            (1.0 - w) * self.inside.cost + w * self.outside.cost,
            (1.0 - w) * self.inside.goal + w * self.outside.goal,
        )

    def told(self) -> tuple[float, float]:
        """The price of failure, and the objective so far."""
        return self.slope, self.objective

    def seek(self, tolerance: float) -> Column:
        """The best column at the slope, unless the last one is known to be that."""
        price, last = self.slope, self.inside if self.last is None else self.last
        if last.found_at != price:
            known = last, self.inside, self.outside
            began, last = time.perf_counter(), self.pricing.minimise(price, *known)
            self.took = max(self.took, time.perf_counter() - began)
            self.calls, self.work = self.calls + 1, self.work + last.work
            self._prove_on_the_way(price, last, began)
        self.last = last
        return last

    def learn(self, found: Column, tolerance: float) -> bool:
        """Put a column that lies below the line in the place of one end.

        One that never succeeds has no ratio: the price was too low, nothing is learnt. Where none
        lies below the line and the budget is slack, Dinkelbach's iteration goes on.
        """
        price = self.slope
        if not self._improved_by(found, price, tolerance):
            slack = self.row.ratio and self.outside is not None and price < self.objective
            self.outside = None if slack else self.outside
            return not slack
        if self._has(found):
            return True
        if self.row.breaks(found):
            self.outside = found
        elif self.row.objective(found.cost, found.goal) < np.inf:
            self.inside = found
        return False

    def _improved_by(self, found: Column, price: float, tolerance: float) -> bool:
        """Whether a column lies below the line through ``inside`` at this price."""
        below = self.inside.cost - found.cost - price * excess_failure(found, self.inside)
        scale = abs(self.objective) * (self.inside.goal if self.row.ratio else 1.0)
        return below > 0.1 * tolerance * max(scale, 1e-300)

    def _has(self, found: Column) -> bool:
        """Whether a column is the one beyond the budget again, up to rounding."""
        known = self.outside
        if known is None:
            return False
        same = min(_SAME_FAILURE, _SAME_SMALL * min(known.failure, known.goal))
        is_near = abs(excess_failure(found, known)) <= same
        return is_near and found.cost >= known.cost - _SAME_COST * abs(known.cost)

    def concluded(self, tolerance: float, *, finished: bool) -> Generated:
        """The lottery of both ends, and a certified bound at the slope."""
        row, price, last = self.row, self.slope, self.inside if self.last is None else self.last
        self._align(price)
        weight, best = self.weight, self.objective
        columns: tuple[Column, ...] = (self.inside,)
        weights = np.ones(1)
        if self.outside is not None and weight == 1.0:
            columns = (self.outside,)
        elif self.outside is not None and weight > 0.0:
            columns, weights = (self.inside, self.outside), np.array([1.0 - weight, weight])
        price = max(price, best) if row.ratio else price
        slack = row.ratio and price <= best  # then prove it just below it: Row.lower_bound
        at = price * (1.0 - 0.25 * tolerance) if slack else price
        proof = self._proved(at, last, slack=slack)
        price = price if proof.price == at else max(proof.price, best if row.ratio else 0.0)
        self.work = self.work + proof.work
        bound = least_of(row.lower_bound(proof), best)
        return Generated(columns, weights, np.array([price]), best, bound, finished, proof.values)

    def _prove_on_the_way(self, price: float, best: Column, began: float) -> None:
        """Prove a bound at a price, if there is a time limit and proofs have taken little so far.

        Args:
            price: of failure.
            best: a policy of least value at this price.
            began: when its pricing began, on the clock of ``time.perf_counter``.
        """
        now = time.perf_counter()
        if not is_limited() or now - began < _LONG or self._spent > _SHARE * (now - self._since):
            return
        try:
            found, bound = self.pricing.prove(price, best), self.row.lower_bound
            if self.proof is None or bound(found) > bound(self.proof):
                self.proof = found
        except STOPS as stop:
            heed(stop)
        self._spent += time.perf_counter() - now

    def _proved(self, price: float, best: Column, *, slack: bool) -> Proof:
        """The proof at the end; where there is no time for it the best one so far, or the trivial.

        The values of a trivial bound ask a certificate for the best that can be had.
        """
        try:
            if has_time_for(self.took):
                with closing():
                    return self.pricing.prove(price, best, slack=slack)
        except STOPS as stop:
            heed(stop)
        anything = np.broadcast_to(np.inf, self.pricing.value_shape)
        return self.proof or Proof(price, price, -np.inf, anything)

    def _align(self, price: float) -> None:
        """Let both columns fix what a price fixes by the same one, if they still bracket."""
        if self.outside is None or not has_time_for(self.took):
            return
        try:
            with closing():
                inside = self.pricing.aligned(self.inside, price)
                outside = self.pricing.aligned(self.outside, price)
        except STOPS as stop:
            heed(stop)
            return
        if self.row.breaks(outside) and not self.row.breaks(inside):
            self.inside, self.outside = inside, outside
