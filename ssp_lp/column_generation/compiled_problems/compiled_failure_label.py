"""Case M compiled: the failure label, with an explicit pricing problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import LeastFailure
from ssp_lp.column_generation.failure_row import relative_gap
from ssp_lp.column_generation.pricing.explicit_pricing import ExplicitPricing
from ssp_lp.column_generation.pricing.pricing_problem import Column, Proof, required
from ssp_lp.compiled.deadline import READING, limited
from ssp_lp.errors import InfeasibleError
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import surely_reaching
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled, label_failure
from ssp_lp.processes.failure_semantics import FailureSemantics, survival_of
from ssp_lp.processes.goal_reach import GoalReach, greatest_from, greatest_goal_reach

_UNPROVED = 1e-10
"""Relative gap at least failure from which pairs are compared in twice the working precision."""


@dataclass(frozen=True, eq=False)
class CompiledFailureLabel:
    """Minimise E[cost until failure is declared], failure limited (paper, section 3.1.2)."""

    model: SSP
    start: FloatArray  # [states]
    semantics: FailureSemantics
    discount: float | None = None
    ratio: bool = False
    is_trial: bool = False
    lowest: float = 0.0
    precise: bool = False  # compare pairs in twice the working precision

    @cached_property
    def labelled(self) -> FailureLabelled:
        """The process; InfeasibleError where failing is forbidden and cannot be avoided."""
        return self._labelled(None)

    @cached_property
    def _safest(self) -> GoalReach:
        """The greatest goal probability from the start, and the pairs that attain it."""
        return greatest_goal_reach(self.model, survival_of(self.discount), self.start)

    @property
    def second_stage(self) -> FailureLabelled:
        """The process over the pairs that attain the greatest goal probability."""
        return self._labelled(self._safest.usable)

    def _labelled(self, usable: BoolArray | None) -> FailureLabelled:
        """The process of all pairs (None) or, without giving up, of some, [model pairs]."""
        if self.semantics.forbids_failing:
            self.check_sure()
        return label_failure(self.model, self.start, self.semantics, self.discount, usable)

    @cached_property
    def _pricing(self) -> ExplicitPricing:
        """The pricing problem of the labelled process."""
        return ExplicitPricing(self.labelled, self.precise)

    def check_sure(self) -> None:
        """Check that the goal can be reached surely, as must be where failing is forbidden.

        Raises:
            InfeasibleError: it cannot.
        """
        sure, _, _ = surely_reaching(self.model)
        unsure = np.flatnonzero(~sure & (self.start > 0.0))
        if not unsure.size:
            return
        raise InfeasibleError(
            f"no policy reaches the goal surely from state {self.model.states[unsure[0]]!r}: the "
            "cost is infinite; MCMP asks for the cheapest of the policies that fail least",
            failure_budget=0.0,
            least_failure=self._least_failure_alone,
        )

    def _least_failure_alone(self) -> float:
        """The least failure probability, whatever it costs."""
        with limited(READING, "the least failure probability was worked out"):
            return max(1.0 - greatest_from(self.model, self.start), 0.0)

    def pricing(self) -> ExplicitPricing:
        """Policy iteration on the labelled process.

        Raises:
            InfeasibleError: failing is forbidden and cannot be avoided.
        """
        return self._pricing

    def least_failure(self) -> LeastFailure:
        """Greatest goal probability first, then the least cost among its actions."""
        stage = self.second_stage
        begun_from = stage.placed(self._safest.decision)
        second = ExplicitPricing(stage, self.precise, begun_from=begun_from)
        column = second.minimise(0.0)
        bound = second.prove(0.0, column).bound
        if relative_gap(column.cost, bound) > _UNPROVED and not self.precise:
            second = replace(second, precise=True)
            column = second.minimise(0.0, column)
            bound = second.prove(0.0, column).bound
        policy = second.policy(column)
        foreign = replace(column, choice=None, found_at=None, policy=policy)
        return LeastFailure(policy, foreign, bound)

    def explicit(self) -> ExplicitProcess:
        """The labelled process."""
        return self.labelled.process

    def explicit_choice(self, column: Column) -> IntArray:
        """The column's own choice."""
        return required(column.choice)

    def refined(self, price: float) -> CompiledFailureLabel | None:
        """Nothing is truncated: what can be refined is the precision that pairs are compared in."""
        if self.precise:
            return None
        finer = replace(self, precise=True)
        finer.__dict__["labelled"] = self.labelled
        return finer

    def matching(
        self, values: FloatArray, levels: FloatArray | None = None
    ) -> CompiledFailureLabel:
        """Itself: all its value functions have one shape."""
        return self

    def for_program(self) -> CompiledFailureLabel:
        """Itself: nothing in it is truncated."""
        return self

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Nothing is truncated: 0."""
        return 0.0
