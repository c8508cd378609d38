"""The comparison of the methods: who contradicts whom, and what about prices at a kink."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.verification.method_result import MethodResult

_NOTHING = 1e-12
"""Costs are compared relative to their size, but never to less than this share of the costliest
step: below it lies the rounding of sums of such steps."""

_EDGE = 1e-9
"""A budget this near to the least failure may be feasible for one method and not for another."""

Findings = dict[str, str]
"""What is held against a method, by its name."""


@dataclass(frozen=True)
class MethodComparison:
    """Compares methods that lead to one problem's answer."""

    budget: float | None
    costliest: float  # step of the model
    tolerance: float  # relative, of costs
    weight_tolerance: float  # of alpha*

    def distance(self, one: float | None, other: float | None) -> float:
        """Relative distance of two costs; infinite if one of them is no number."""
        if one is None or other is None or one != one or other != other:
            return float("inf")
        if one == other:
            return 0.0
        return abs(one - other) / max(abs(one), abs(other), _NOTHING * self.costliest)

    def overrun(self, method: MethodResult) -> float:
        """By how much a method's policy breaks the budget; 0 if it keeps to it.

        Every method counts a budget within LEAST_BUDGET below the least failure as equal to it.
        """
        spent = method.spent
        if self.budget is None or spent is None or spent <= self.budget + LEAST_BUDGET:
            return 0.0
        return spent - self.budget

    def unsound(self, methods: Sequence[MethodResult]) -> Findings:
        """Roads that are wrong by themselves, whatever others say."""
        found: Findings = {}
        for method in methods:
            if self.overrun(method) > 0.0:
                found[method.name] = f"its policy breaks the budget by {self.overrun(method):.1e}"
            elif self.distance(method.objective, method.evaluated) > self.tolerance:
                stated, attained = f"{method.objective:.12g}", f"{method.evaluated:.12g}"
                found[method.name] = f"it states c* = {stated}, but its policy attains {attained}"
        return found

    def outvoted(self, methods: Sequence[MethodResult]) -> Findings:
        """Roads whose c* lies outside the majority's; all of them where no two agree."""
        near: dict[str, set[str]] = {method.name: {method.name} for method in methods}
        for one, other in combinations(methods, 2):
            if self.distance(one.objective, other.objective) <= self.tolerance:
                near[one.name].add(other.name)
                near[other.name].add(one.name)
        majority = max(near.values(), key=len, default=set())
        if len(majority) == len(methods):
            return {}
        if len(majority) < 2:
            return {method.name: "no other method has its c*" for method in methods}
        others = ", ".join(sorted(majority))
        return {
            r.name: f"its c* is not that of {others}" for r in methods if r.name not in majority
        }

    def refuted(self, methods: Sequence[MethodResult]) -> Findings:
        """Roads whose certified lower bound exceeds what a policy within the budget attains."""
        found: Findings = {}
        for method in methods:
            for other in methods:
                low, attained = method.lower_bound, other.evaluated
                if low is None or attained is None or low <= attained:
                    continue
                if self.distance(low, attained) > self.tolerance:
                    found[method.name] = (
                        f"its lower bound {low:.12g} exceeds the {attained:.12g} that the policy "
                        f"of {other.name} attains: one of the two is wrong"
                    )
        return found

    def refusing(self, methods: Sequence[MethodResult]) -> Findings:
        """Roads that call infeasible what another method's policy attains.

        Nearer to the least failure than 1e-9 this is rounding: the row has its note, no more.
        """
        if not any(method.answered for method in methods) or self.budget is None:
            return {}
        return {
            method.name: f"it says that no policy fails less than {least:.12g}"
            for method in methods
            if (least := method.least_failure) is not None and least - self.budget > _EDGE
        }

    def unproved(self, methods: Sequence[MethodResult]) -> Findings:
        """Roads with an alpha* of their own at a price that their bound does not prove."""
        weights = [w for method in methods if (w := method.adversary_weight) is not None]
        if not self._differ(weights):
            return {}
        return {
            method.name: f"its price is not proved: the bound misses c* by {method.gap:.1e}"
            for method in methods
            if not self._is_proved(method)
        }

    def several_prices(self, methods: Sequence[MethodResult]) -> list[str]:
        """A remark where prices differ and each is optimal: at a kink they form an interval."""
        proved = [method for method in methods if self._is_proved(method)]
        weights = [w for method in proved if (w := method.adversary_weight) is not None]
        return ["several prices are optimal"] if self._differ(weights) else []

    def _differ(self, weights: Sequence[float]) -> bool:
        """Whether weights that are compared differ by more than the tolerance."""
        return len(weights) > 1 and max(weights) - min(weights) > self.weight_tolerance

    def _is_proved(self, method: MethodResult) -> bool:
        """Whether the bound at the method's own price meets its c*: the price is then optimal."""
        return self.distance(method.objective, method.lower_bound) <= self.tolerance
