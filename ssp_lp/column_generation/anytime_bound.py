"""Lower bounds on the way: what a search that is stopped can still prove without more time."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from ssp_lp.column_generation.failure_constraint import Row
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem, Proof
from ssp_lp.compiled.deadline import STOPS, closing, heed, is_limited

_SHARE = 0.25  # of a search that its bounds on the way may take
_LONG = 0.1  # seconds of a pricing call, below which its proof can wait for the end


@dataclass(eq=False)
class AnytimeBound:
    """The best proof so far. Where there is a time limit, long searches prove as they go."""

    pricing: PricingProblem
    row: Row
    best: Proof | None = None
    _spent: float = 0.0  # seconds on proofs
    _since: float = field(default_factory=time.perf_counter)

    def learn(self, price: float, best: Column, began: float) -> None:
        """Prove a bound at a price, if there is a limit and proofs have taken little so far.

        Args:
            price: of failure.
            best: a policy of least value at this price.
            began: when its pricing began, on the clock of ``time.perf_counter``.
        """
        now = time.perf_counter()
        if not is_limited() or now - began < _LONG or self._spent > _SHARE * (now - self._since):
            return
        try:
            self._keep(self.pricing.prove(price, best))
        except STOPS as stop:
            heed(stop)
        self._spent += time.perf_counter() - now

    def concluded(self, price: float, best: Column, *, slack: bool) -> Proof:
        """The proof at the end, or the best one on the way where there is no time for it."""
        try:
            with closing():
                return self.pricing.prove(price, best, slack=slack)
        except STOPS as stop:
            heed(stop)
            return unproved(self.pricing, price) if self.best is None else self.best

    def _keep(self, proof: Proof) -> None:
        if self.best is None or self.row.lower_bound(proof) > self.row.lower_bound(self.best):
            self.best = proof


def unproved(pricing: PricingProblem, price: float) -> Proof:
    """No bound but the trivial one; its values ask a certificate for the best that can be had."""
    return Proof(price, price, -np.inf, np.broadcast_to(np.inf, pricing.value_shape))
