"""Case S as an instance: the accumulated cost up to a cap, with a layered oracle."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.engines.instance import LeastFailure
from ssp_lp.engines.oracles.goal_reach import (
    GoalReach,
    ReachPolicy,
    cheapest,
    greatest_goal_reach,
    least_goal_reach,
)
from ssp_lp.engines.oracles.layered import LayeredOracle
from ssp_lp.engines.oracles.oracle import Column
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.policies.deterministic import DeterministicPolicy
from ssp_lp.process.accumulated_cost import AccumulatedCost, accumulate_cost
from ssp_lp.process.explicit import ExplicitProcess
from ssp_lp.process.layered import LayeredProcess, Tails
from ssp_lp.process.materialise import materialise
from ssp_lp.process.semantics import survival_of

_MOST_ENTRIES = 200_000_000
"""Largest table of decisions, nodes x layers: 0.8 GB a policy."""

_FIRST_LAYERS = 2.5
"""Layers of the first attempt, as a multiple of the least-failure policy's conditional cost."""


@dataclass(frozen=True, eq=False)
class Extremes:
    """The stationary policies of greatest and of least goal probability (the two tails)."""

    greatest: GoalReach
    safest: ReachPolicy
    least: GoalReach
    riskiest: ReachPolicy


@dataclass(frozen=True, eq=False)
class CostInstance:
    """Minimise E[cost | goal], failure limited (paper, section 3.1.1).

    ``cap`` says where the table of accumulated costs ends; None: chosen from the least-failure
    policy.
    """

    model: SSP
    start: FloatArray  # [states]
    discount: float | None = None
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    cap: int | None = None  # layers
    ratio: bool = field(default=True, init=False)

    @property
    def survival(self) -> float:
        """The discount, 1 in the exact setting."""
        return survival_of(self.discount)

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        return accumulate_cost(self.model, self.start, self.discount)

    @cached_property
    def extremes(self) -> Extremes:
        """The two tails."""
        greatest = greatest_goal_reach(self.model, self.survival)
        least = least_goal_reach(self.model, self.survival)
        return Extremes(
            greatest,
            cheapest(self.model, greatest, self.survival),
            least,
            cheapest(self.model, least, self.survival),
        )

    def least_failure(self) -> LeastFailure:
        """Greatest goal probability first, then the least E[cost; goal] among its actions.

        At least failure the accumulated cost is not needed: a transition to x' is priced
        ``g * Pmax(x')`` (DESIGN, section 4).
        """
        safest = self.extremes.safest
        cost, goal = float(self.start @ safest.cost), float(self.start @ safest.goal)
        policy = DeterministicPolicy(self.model, safest.decision)
        column = Column(cost, max(1.0 - goal, 0.0), goal, None, policy=policy)
        greatest = float(self.start @ self.extremes.greatest.bound)
        ratio = float(self.start @ safest.cost_bound) / greatest if greatest > 0 else 0.0
        return LeastFailure(policy, column, min(ratio, cost / goal if goal > 0.0 else np.inf))

    @cached_property
    def process(self) -> LayeredProcess:
        """The process cut at the cap."""
        return LayeredProcess(self.base, self._cap_layers(), self._tails)

    def oracle(self) -> LayeredOracle:
        """One backward sweep over the layers."""
        return LayeredOracle(self.process)

    def explicit(self) -> ExplicitProcess:
        """All layers below the cap, written out."""
        return materialise(self.process)

    def refined(self, price: float) -> CostInstance | None:
        """The same problem with more layers, unless the user fixed them or memory ends."""
        if self.fixed_cap is not None:
            return None
        here = self.process.cap
        lossless = int(np.ceil(price / self.base.unit)) + 1  # where every state can fail at will
        wanted = lossless if here < lossless <= 2 * here else 2 * here
        if wanted * self.base.n_nodes > _MOST_ENTRIES:
            return None
        return self._carry(replace(self, cap=wanted))

    def matching(self, values: FloatArray) -> CostInstance:
        """The same problem with as many layers as the value function, [layers, nodes].

        Raises:
            ModelError: the array has no layers.
        """
        if values.ndim != 2 or values.shape[0] == 0:
            raise ModelError("a value function of shape [layers, nodes] is needed")
        return self._carry(replace(self, cap=values.shape[0]))

    def tail_loss(self, price: float, *, slack: bool = False) -> float:
        """How much of a bound at this price the cap costs; 0 where it is proved lossless."""
        return self.oracle().tail_loss(price, slack=slack)

    def _carry(self, other: CostInstance) -> CostInstance:
        """Hand what does not depend on the cap to a copy of this instance."""
        other.__dict__.update(base=self.base, extremes=self.extremes, _tails=self._tails)
        return other

    @cached_property
    def _tails(self) -> Tails:
        safest, riskiest = self.extremes.safest, self.extremes.riskiest
        at = self.base.skeleton.least_over_members
        both = (safest, riskiest)
        return Tails(
            decisions=np.stack([p.decision for p in both]),
            goal=np.stack([at(p.goal) for p in both]),
            early=np.stack([at(p.early) for p in both]),
            cost=np.stack([at(p.cost) for p in both]),
            greatest_goal=-at(-self.extremes.greatest.bound),
            least_goal=at(self.extremes.least.bound),
        )

    def _cap_layers(self) -> int:
        base = self.base
        if self.cap is not None:
            layers = self.cap
        elif self.fixed_cap is not None:
            layers = max(int(np.ceil(self.fixed_cap / base.unit)), 1)
        else:
            first = self.least_failure().column
            typical = first.cost / max(first.goal, 1e-300) / base.unit
            layers = int(np.ceil(_FIRST_LAYERS * typical)) + base.width
        if (layers + base.width) * base.n_nodes > _MOST_ENTRIES:
            raise ModelError(
                f"{layers:,} layers of accumulated cost (unit {base.unit:g}) on {base.n_nodes:,} "
                "states are too many; round the costs to a coarser grid, or set a smaller cost_cap"
            )
        return layers
