"""The judge of the roads: who contradicts whom, and what about prices at a kink."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.road import Road

_NOTHING = 1e-12
"""Costs are compared relative to their size, but never to less than this share of the costliest
step: below it lies the rounding of sums of such steps."""

_EDGE = 1e-9
"""A budget this near to the least failure may be feasible for one road and not for another."""

Findings = dict[str, str]
"""What is held against a road, by its name."""


@dataclass(frozen=True)
class Judge:
    """Compares roads that lead to one problem's answer."""

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

    def overrun(self, road: Road) -> float:
        """By how much a road's policy breaks the budget; 0 if it keeps to it.

        Every road counts a budget within LEAST_BUDGET below the least failure as equal to it.
        """
        spent = road.spent
        if self.budget is None or spent is None or spent <= self.budget + LEAST_BUDGET:
            return 0.0
        return spent - self.budget

    def unsound(self, roads: Sequence[Road]) -> Findings:
        """Roads that are wrong by themselves, whatever others say."""
        found: Findings = {}
        for road in roads:
            if self.overrun(road) > 0.0:
                found[road.name] = f"its policy breaks the budget by {self.overrun(road):.1e}"
            elif self.distance(road.objective, road.evaluated) > self.tolerance:
                stated, attained = f"{road.objective:.12g}", f"{road.evaluated:.12g}"
                found[road.name] = f"it states c* = {stated}, but its policy attains {attained}"
        return found

    def outvoted(self, roads: Sequence[Road]) -> Findings:
        """Roads whose c* lies outside the majority's; all of them where no two agree."""
        near: dict[str, set[str]] = {road.name: {road.name} for road in roads}
        for one, other in combinations(roads, 2):
            if self.distance(one.objective, other.objective) <= self.tolerance:
                near[one.name].add(other.name)
                near[other.name].add(one.name)
        majority = max(near.values(), key=len, default=set())
        if len(majority) == len(roads):
            return {}
        if len(majority) < 2:
            return {road.name: "no other road has its c*" for road in roads}
        others = ", ".join(sorted(majority))
        return {r.name: f"its c* is not that of {others}" for r in roads if r.name not in majority}

    def refuted(self, roads: Sequence[Road]) -> Findings:
        """Roads whose certified lower bound exceeds what a policy within the budget attains."""
        found: Findings = {}
        for road in roads:
            for other in roads:
                low, attained = road.lower_bound, other.evaluated
                if low is None or attained is None or low <= attained:
                    continue
                if self.distance(low, attained) > self.tolerance:
                    found[road.name] = (
                        f"its lower bound {low:.12g} exceeds the {attained:.12g} that the policy "
                        f"of {other.name} attains: one of the two is wrong"
                    )
        return found

    def refusing(self, roads: Sequence[Road]) -> Findings:
        """Roads that call infeasible what another road's policy attains.

        Nearer to the least failure than 1e-9 this is rounding: the row has its note, no more.
        """
        if not any(road.answered for road in roads) or self.budget is None:
            return {}
        return {
            road.name: f"it says that no policy fails less than {least:.12g}"
            for road in roads
            if (least := road.least_failure) is not None and least - self.budget > _EDGE
        }

    def unproved(self, roads: Sequence[Road]) -> Findings:
        """Roads with an alpha* of their own at a price that their bound does not prove."""
        weights = [w for road in roads if (w := road.adversary_weight) is not None]
        if not self._differ(weights):
            return {}
        return {
            road.name: f"its price is not proved: the bound misses c* by {road.gap:.1e}"
            for road in roads
            if not self._is_proved(road)
        }

    def several_prices(self, roads: Sequence[Road]) -> list[str]:
        """A remark where prices differ and each is optimal: at a kink they form an interval."""
        proved = [road for road in roads if self._is_proved(road)]
        weights = [w for road in proved if (w := road.adversary_weight) is not None]
        return ["several prices are optimal"] if self._differ(weights) else []

    def _differ(self, weights: Sequence[float]) -> bool:
        return len(weights) > 1 and max(weights) - min(weights) > self.weight_tolerance

    def _is_proved(self, road: Road) -> bool:
        """Whether the bound at the road's own price meets its c*: the price is then optimal."""
        return self.distance(road.objective, road.lower_bound) <= self.tolerance
