"""The failure row together with the form of the objective that it constrains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON
from ssp_lp.column_generation.pricing.pricing_problem import Column, Proof
from ssp_lp.errors import SolverError

_ROUNDED = 4.0 * MACHINE_EPSILON  # of a bound and of what the budget is worth at its price
_TINY = 1e-12  # costs below this are compared with 0
_SAME = 4.0 * MACHINE_EPSILON
"""Relative distance of two failures, or of two rare successes, that are one summed in two ways."""


@dataclass(frozen=True)
class FailureRow:
    """The failure row and the objective's form."""

    budget: float
    ratio: bool
    lowest: float = 0.0  # no objective is less

    def spare(self, column: Column) -> float:
        """What a policy leaves of the budget, without cancellation; below 0 where it breaks it."""
        demanded = 1.0 - self.budget
        return column.goal - demanded if demanded < 0.5 else self.budget - column.failure

    def leaves_only(self, least: Column) -> bool:
        """Whether the budget exceeds what the policy of least failure takes by rounding at most."""
        return self.spare(least) <= self.rounding

    def breaks(self, column: Column) -> bool:
        """Whether a policy breaks the budget by more than rounding."""
        return self.spare(column) < -self.rounding

    @property
    def rounding(self) -> float:
        """By how much a policy may seem to miss a budget that it meets."""
        return _SAME * max(min(self.budget, 1.0 - self.budget), 0.0)

    def objective(self, cost: float, goal: float) -> float:
        """Objective of a point of the hull."""
        if not self.ratio:
            return cost
        return cost / goal if goal > 0.0 else np.inf

    def lower_bound(self, proof: Proof) -> float:
        """Bound on the objective from a proof about every policy's value.

        Case M: cost + price * failure >= bound gives cost >= bound - price * budget. Case S:
        cost >= c * goal follows for c = bound if bound >= price, else, as failure <= budget, for
        c = (bound - price * budget) / (1 - budget). With failing counted 0 the value is shifted
        by the price, which is exact where the budget is slack.
        """
        bound, price, share = proof.bound, proof.price, 1.0 - self.budget
        worth = price * self.budget
        rounding = _ROUNDED * (abs(bound) + worth) if worth > 0.0 else 0.0
        if not self.ratio:
            least = bound - worth - rounding
        elif proof.failing == 0.0:
            least = price + (bound if bound >= 0.0 else _over(bound, share))
        else:
            least = bound if bound >= price else _over(bound - worth - rounding, share)
        return max(least, self.lowest)


def _over(rest: float, share: float) -> float:
    """What is left of a bound, over the share that has to succeed; nothing is known where none."""
    return rest / share if share > 0.0 else -np.inf


def relative_gap(objective: float, lower_bound: float) -> float:
    """(objective - lower_bound) / |objective|; 0 where both are 0."""
    difference = max(objective - lower_bound, 0.0)
    return 0.0 if difference == 0.0 else difference / max(abs(objective), 1e-300)


CONTRADICTION = 1e-9
"""Relative excess of a lower bound over a value that no rounding explains."""


def least_of(lower_bound: float, objective: float) -> float:
    """The failure row's lower bound, or the objective where rounding puts the bound above it.

    Raises:
        SolverError: the bound lies above by more than rounding; then one of them is wrong.
    """
    if lower_bound > objective + CONTRADICTION * max(abs(objective), abs(lower_bound)) + _TINY:
        raise SolverError(
            f"a policy's value, {objective!r}, lies below a bound of all policies, "
            f"{lower_bound!r}: the model is too ill-conditioned for double precision"
        )
    return min(lower_bound, objective)
