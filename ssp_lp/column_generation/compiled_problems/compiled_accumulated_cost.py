"""Case S compiled: the accumulated cost up to a cap, with a layered pricing problem."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    MOST_ENTRIES,
    CompiledLayered,
    LeastFailure,
    check_compiled_table,
)
from ssp_lp.column_generation.pricing.followed_choice import follow_rule
from ssp_lp.column_generation.pricing.pricing_problem import Column
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import dead_ends, goal_approach
from ssp_lp.policies.stationary import DeterministicPolicy
from ssp_lp.processes.expectations import uniform_cost
from ssp_lp.processes.goal_reach import ReachPolicy, goal_directed
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, accumulate_cost
from ssp_lp.processes.layered.charges import TailValues
from ssp_lp.processes.layered.layered_process import LayeredProcess, LayeredTails

_FIRST_LAYERS = 2.5
"""Layers of the first attempt, as a multiple of the first tail policy's conditional cost."""

_MOST_STEPS = 256
"""Steps of a first attempt beyond which that policy is no guide but a long shot."""

_LARGE = 10_000_000
"""Entries of a layer from which the equations of a policy that goes for the goal are not solved."""

_MARGIN = 1.02
"""Layers beyond what a trial's price asks for: the price still moves a little."""

_MOST_GROWTH = 4
"""A cap that would have to grow by more comes from a steep price near the least failure."""


@dataclass(frozen=True, eq=False)
class CompiledAccumulatedCost(CompiledLayered):
    """Minimise E[cost | goal], failure limited (paper, section 3.1.1).

    ``cap`` says where the table of accumulated costs ends; None: a first guess, to learn the
    price from. From accumulated cost kappa on it is best to fail wherever that can be done for
    sure, so a cap there loses (almost) nothing whatever is followed beyond it: a policy that goes
    for the goal and the trivial bound on it will do. Only where kappa is too large for that are
    the exact policies of greatest goal probability worked out.
    """

    model: SSP
    start: FloatArray  # [states]
    discount: float | None = None
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    cap: int | None = None  # layers
    exact_tails: bool = False  # beyond the cap: the least failure, or any way to the goal
    is_for_bounds: bool = False  # nothing is followed: no way to the goal is looked for
    ratio: bool = field(default=True, init=False)

    @cached_property
    def lowest(self) -> float:
        """Every run that reaches the goal takes some steps, each of which costs the least one."""
        begins = np.flatnonzero(self.start)
        begins = begins[~dead_ends(self.model)[begins]]
        if self.discount is not None or not begins.size:
            return 0.0
        steps, same = int(goal_approach(self.model)[1][begins].min()), uniform_cost(self.model)
        if steps == 0:
            return 0.0
        last = float(self.model.costs.min()) if same is None else same
        going_on = self.base.lattice.least * self.base.unit if same is None else same
        return ((steps - 1) * going_on + last) * (1.0 - 2.0 * MACHINE_EPSILON)

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        return accumulate_cost(self.model, self.start, self.discount)

    @property
    def is_trial(self) -> bool:
        """Whether the cap is a guess."""
        return self.cap is None and self.fixed_cap is None and not self._has_exact_tails

    @cached_property
    def _directed(self) -> ReachPolicy:
        """A policy that goes for the goal, for the tail beyond the accumulated cost's cap."""
        return goal_directed(self.model, self.survival)

    @cached_property
    def _guess(self) -> tuple[float, float] | None:
        """(E[cost; goal], goal) of such a policy, about; None where its equations are solved.

        In a large process they take longer than a sweep. Beyond the cap the riskiest policy is then
        followed: where that loses something, the cap is raised or the tails become exact.
        """
        base, later = self.base, self.base.later
        is_large = base.instant.nnz == 0 and later.nnz >= _LARGE and accelerated(later.nnz)
        if self.exact_tails or not is_large or base.quotient.merged.any():
            return None
        rule = base.quotient.placed(goal_approach(self.model)[0]) - base.pair_offsets[:-1]
        return follow_rule(base, rule, _MOST_STEPS)

    @cached_property
    def is_long_shot(self) -> bool:
        """Whether a policy that goes for the goal takes too long to tell a first cap."""
        if self.exact_tails or self.base.quotient.merged.any():
            return False
        if self.cap is not None or self.fixed_cap is not None:
            return False
        if self._guess is not None:
            cost, goal = self._guess[0], self._guess[1] + self.base.start_goal
        else:
            cost = float(self.start @ self._directed.cost)
            goal = float(self.start @ self._directed.goal)
        steps = _FIRST_LAYERS * cost / max(goal, 1e-300) / (self.base.unit * self.base.width)
        return steps > _MOST_STEPS

    @cached_property
    def _has_exact_tails(self) -> bool:
        """Whether the tails are those of the least failure, asked for or needed."""
        return self.exact_tails or bool(self.base.quotient.merged.any()) or self.is_long_shot

    def capped_at(self, cost: float) -> CompiledAccumulatedCost:
        """The same problem with a cap of about this accumulated cost.

        Where the start cannot avoid the goal no cap is beyond loss: the tails are exact at once.
        """
        exact = float(self.start @ self.riskiest[0].goal) > 0.0
        most = MOST_ENTRIES // max(self.base.n_nodes, 1) - 2 * self.base.width
        layers = int(min(np.ceil(cost / self.base.unit), max(most, 0))) + self.base.width
        return self._carry(replace(self, cap=layers, exact_tails=exact))

    def least_failure(self) -> LeastFailure:
        """Greatest goal probability first, then the least E[cost; goal] among its actions.

        At least failure the accumulated cost is not needed: a transition to x' is priced
        ``g * Pmax(x')`` (mathematics, section 4).
        """
        safest = self.safest_policy
        cost, goal = float(self.start @ safest.cost), float(self.start @ safest.goal)
        policy = DeterministicPolicy(self.model, safest.decision)
        column = Column(cost, float(self.start @ safest.failure), goal, None, policy=policy)
        greatest = float(self.start @ self.greatest.bound)
        ratio = float(self.start @ safest.cost_bound) / greatest if greatest > 0 else 0.0
        return LeastFailure(policy, column, min(ratio, cost / goal if goal > 0.0 else np.inf))

    @cached_property
    def process(self) -> LayeredProcess:
        """The process cut at the cap."""
        return LayeredProcess(self.base, self._cap_layers(), self._tails)

    def refined(self, price: float) -> CompiledAccumulatedCost | None:
        """The same problem with more layers or better tails, unless nothing is left to improve."""
        here, exact = self.process.cap, self._has_exact_tails
        lossless = int(np.ceil(_MARGIN * price / self.base.unit)) + 1
        if self.fixed_cap is not None:
            return None if exact else self._carry(replace(self, exact_tails=True))
        if self.is_trial and lossless <= _MOST_GROWTH * here:
            wanted = lossless
        elif not exact:
            wanted, exact = lossless if here < lossless <= _MOST_GROWTH * here else here, True
        else:
            wanted = lossless if here < lossless <= 2 * here else 2 * here
        if wanted * self.base.n_nodes > MOST_ENTRIES:
            if self._has_exact_tails:
                return None
            wanted, exact = here, True
        return self._carry(replace(self, cap=wanted, exact_tails=exact))

    def matching(
        self, values: FloatArray, levels: FloatArray | None = None
    ) -> CompiledAccumulatedCost:
        """The same problem with as many layers as the value function, [layers, nodes].

        Its tails are the riskiest policy alone: where the cap loses something with that,
        :meth:`for_program` has the exact ones.

        Raises:
            ModelError: the array has no layers.
        """
        if values.ndim != 2 or values.shape[0] == 0:
            raise ModelError("a value function of shape [layers, nodes] is needed")
        return self._carry(replace(self, cap=values.shape[0], is_for_bounds=True))

    def for_program(self) -> CompiledAccumulatedCost:
        """The same problem with exact tails: beyond the cap no program does better than they do."""
        if self._has_exact_tails:
            return self
        exact = self._carry(replace(self, exact_tails=True))
        return self._carry(replace(exact, cap=exact.process.cap))

    def _carry(self, other: CompiledAccumulatedCost) -> CompiledAccumulatedCost:
        """Hand what does not depend on the cap to a copy."""
        other = self._handing_on(other, "base", "_directed", "_guess")
        if "_tails" in vars(self) and self._has_exact_tails == other._has_exact_tails:
            vars(other)["_tails"] = self._tails
        return other

    @cached_property
    def _tails(self) -> LayeredTails:
        """The tails that are followed beyond the cap on accumulated cost."""
        at = self.base.quotient.least_over_members
        least, riskiest = self.riskiest
        exact = self._has_exact_tails
        if exact:
            first = self.safest_policy
            greatest = -at(-self.greatest.bound)
        else:
            first = riskiest if self.is_for_bounds or self._guess else self._directed
            greatest = np.full(self.base.n_nodes, self.survival)
        both = (first, riskiest)
        return LayeredTails(
            decisions=np.stack([p.decision for p in both]).astype(np.int32),
            values=TailValues.stacked([p.values for p in both], at),
            greatest_goal=greatest,
            least_goal=at(least.bound),
            exact=exact,
            guess=None if exact or self.is_for_bounds else self._guess,
        )

    def _cap_layers(self) -> int:
        """Layers of accumulated cost below the cap."""
        base = self.base
        if self.cap is not None:
            layers = self.cap
        elif self.fixed_cap is not None:
            layers = max(int(np.ceil(self.fixed_cap / base.unit)), 1)
        else:
            tails = self._tails
            cost, goal = tails.guess or (base.start @ tails.first.cost, base.start @ tails.goal[0])
            typical = float(cost) / max(float(goal) + base.start_goal, 1e-300) / base.unit
            layers = int(np.ceil(_FIRST_LAYERS * typical)) + base.width
        check_compiled_table(layers, base, "cost_cap")
        return layers
