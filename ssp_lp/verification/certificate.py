"""What a certificate says: an answer's value, a bound of all others, and whether it is accepted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation
from ssp_lp.column_generation.failure_row import CONTRADICTION, relative_gap

_BUDGET_ROUNDING = 1e-12


@dataclass(frozen=True, repr=False)
class Certificate:
    """What was recomputed. ``accepted`` says that the policy keeps to the budget and all limits."""

    objective: float  # exact value of the policy
    lower_bound: float  # no policy within the budget is cheaper
    failure: float  # what the budget limits: exact, or discounted under a discount
    budget: float  # largest failure allowed; at least failure: a certified upper bound of it
    budget_slack: float  # budget - failure
    tail_gap: float  # case S: the part of the relative gap that the cap M leaves; 0 if lossless
    accepted: bool
    reason: str  # why it was refused; empty if accepted
    upper_bound: float | None = None  # of a greatest probability; None where little is better

    @property
    def gap(self) -> float:
        """Relative gap between the objective and the bound that limits it; infinite if refused."""
        if not self.accepted:
            return float("inf")
        if self.upper_bound is not None:
            return relative_gap(self.upper_bound, self.objective)
        return relative_gap(self.objective, self.lower_bound)

    def __repr__(self) -> str:
        """One line: accepted or why not, both sides, and what is left of the budget."""
        upper = self.upper_bound
        side, bound = ("lower", self.lower_bound) if upper is None else ("upper", upper)
        verdict = "accepted" if self.accepted else f"refused: {self.reason}"
        return (
            f"Certificate({verdict}, objective {self.objective:.9g}, {side} bound {bound:.9g}, "
            f"gap {self.gap:.1e}, failure {self.failure:.6g} of {self.budget:.6g})"
        )


def certificate_of(
    found: Evaluation,
    bound: float,
    budget: float,
    reason: str = "",
    *,
    tail: float = 0.0,
    above: bool = False,
) -> Certificate:
    """The verdict on a policy.

    Args:
        found: what it attains.
        bound: of every policy's objective.
        budget: the largest failure allowed.
        reason: why it is refused, if that is known already.
        tail: the part of the relative gap that a cap leaves.
        above: whether the bound is one from above.
    """
    failure = failure_of(found)
    if not reason and failure > budget + _BUDGET_ROUNDING:
        reason = f"the policy fails with {failure:.12g}, above the budget {budget:.12g}"
    if not reason and not np.isfinite(found.objective):
        reason = f"the policy's objective is {found.objective}"
    beyond = (found.objective - bound) if above else (bound - found.objective)
    if not reason and beyond > CONTRADICTION * abs(found.objective) + _BUDGET_ROUNDING:
        side = "above" if above else "below"
        reason = f"the policy's value {found.objective!r} lies {side} its bound {bound!r}"
    return Certificate(
        objective=found.objective,
        lower_bound=bound if reason and not above else min(bound, found.objective),
        upper_bound=max(bound, found.objective) if above else None,
        failure=failure,
        budget=budget,
        budget_slack=budget - failure,
        tail_gap=tail,
        accepted=not reason,
        reason=reason,
    )


def failure_of(found: Evaluation) -> float:
    """The failure that a certificate's budget limits: discounted under a discount, else real."""
    discounted = found.discounted_failure
    return found.failure_probability if discounted is None else discounted
