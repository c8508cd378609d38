"""A compiled problem: an augmented process with everything that methods ask of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

from ssp_lp.arrays import LEAST_BUDGET, FloatArray, IntArray
from ssp_lp.column_generation.pricing.layered_pricing import LayeredPricing
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem, Proof, required
from ssp_lp.errors import Argument, InfeasibleError, ModelError
from ssp_lp.model import SSP
from ssp_lp.policies.policy import Policy
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.failure_semantics import survival_of
from ssp_lp.processes.goal_reach import (
    GoalReach,
    ReachPolicy,
    cheapest_reach,
    greatest_goal_reach,
    least_goal_reach,
)
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess, chosen_pairs, materialise


@dataclass(frozen=True, eq=False)
class LeastFailure:
    """The cheapest policy among those that fail least (mathematics, section 4: two stages)."""

    policy: Policy
    column: Column  # its cost and failure, both discounted under a discount
    objective_bound: float  # certified lower bound of the objective of every such policy


class CompiledProblem(Protocol):
    """What a method asks of a problem; a user's own formulation may bring its own."""

    @property
    def model(self) -> SSP:
        """The model."""
        ...

    @property
    def start(self) -> FloatArray:
        """The distribution in which an episode begins, [states]."""
        ...

    @property
    def discount(self) -> float | None:
        """The discount; None: exact."""
        ...

    @property
    def ratio(self) -> bool:
        """Whether the objective is cost / (1 - failure) (case S) rather than cost (case M)."""
        ...

    @property
    def lowest(self) -> float:
        """No objective is less."""
        ...

    @property
    def is_trial(self) -> bool:
        """Whether this is only to learn the price, from which its size will follow."""
        ...

    def least_failure(self) -> LeastFailure:
        """The first column: feasibility is decided by it, never by the status of an LP."""
        ...

    def pricing(self) -> PricingProblem:
        """The pricing problem of the process as it stands."""
        ...

    def for_program(self) -> CompiledProblem:
        """The one whose written-out process has the optimum of the problem, up to its size."""
        ...

    def explicit(self) -> ExplicitProcess:
        """The process written out, for the linear program."""
        ...

    def explicit_choice(self, column: Column) -> IntArray:
        """The pair of ``explicit()`` that a column takes in each state, [states].

        Raises:
            ModelError: the pricing did not make the column.
        """
        ...

    def refined(self, price: float) -> CompiledProblem | None:
        """A larger one with a smaller truncation error, or None where there is none.

        Args:
            price: price of failure at the optimum of this one.
        """
        ...

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledProblem:
        """The one whose value functions have the shape of this one.

        Args:
            values: the value function.
            levels: totals that a policy found beside it tells apart; None: multiples of a unit.

        Raises:
            ModelError: none has such value functions.
        """
        ...

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """How much of a bound at this price is lost to truncation; 0 where nothing is.

        Args:
            price: of failure.
            slack: whether success is counted rather than failure.
            proof: what was proved at this price, which may save the work.
        """
        ...


def checked_least_failure(compiled: CompiledProblem, budget: float | None) -> LeastFailure:
    """The policy of least failure, which keeps to the budget.

    Args:
        compiled: the problem.
        budget: failure budget; None: whatever is least.

    Raises:
        InfeasibleError: it does not, or no cost given success exists.
    """
    least = compiled.least_failure()
    failure, discounted = least.column.failure, compiled.discount is not None
    if compiled.ratio and least.column.goal <= 0.0:
        raise InfeasibleError(
            "the goal cannot be reached from the start: no cost given success exists",
            failure_budget=budget,
            least_failure=1.0,
            least_discounted_failure=1.0 if discounted else None,
        )
    if budget is None or failure <= budget + LEAST_BUDGET:
        return least
    if not discounted:
        raise InfeasibleError(
            f"every policy fails with probability at least {failure:.12g}, above the budget "
            f"{budget:g}",
            "; ",
            Argument("failure_budget", None),
            " asks for the least",
            failure_budget=budget,
            least_failure=failure,
            conflicting_rows=("failure",),
        )
    greatest = float(
        compiled.start @ greatest_goal_reach(compiled.model, start=compiled.start).goal
    )
    real = max(1.0 - greatest, 0.0)
    nearer = ("; ", Argument("discount", None), " or a discount nearer to 1 is feasible")
    raise InfeasibleError(
        f"the discounted failure of every policy is at least {failure:.12g}, above the budget "
        f"{budget:g}; the least real failure probability is {real:.12g}",
        *(nearer if real <= budget else ()),
        failure_budget=budget,
        least_failure=real,
        least_discounted_failure=failure,
        conflicting_rows=("failure",),
    )


MOST_ENTRIES = 800_000_000
"""Largest table of decisions, nodes x layers: 0.8 GB a policy at a byte each."""


def check_compiled_table(layers: int, base: AccumulatedCost, remedy: str) -> None:
    """Raise :class:`ModelError` with a remedy where a table of so many layers is too large."""
    if (layers + base.width) * base.n_nodes > MOST_ENTRIES:
        raise ModelError(
            f"{layers:.6g} layers of accumulated cost (unit {base.unit:g}) on {base.n_nodes:,} "
            f"states are too many; a coarser grid of costs, or a smaller {remedy}, makes it less"
        )


class CompiledLayered(ABC):
    """A compiled problem whose process is layered."""

    model: SSP
    discount: float | None

    @property
    @abstractmethod
    def process(self) -> LayeredProcess:
        """The process cut at the cap."""

    @property
    def survival(self) -> float:
        """The discount, 1 in the exact setting."""
        return survival_of(self.discount)

    @cached_property
    def greatest(self) -> GoalReach:
        """The greatest goal probability."""
        return greatest_goal_reach(self.model, self.survival)

    @cached_property
    def safest_policy(self) -> ReachPolicy:
        """The cheapest policy of greatest goal probability."""
        return cheapest_reach(self.model, self.greatest, self.survival)

    @cached_property
    def riskiest(self) -> tuple[GoalReach, ReachPolicy]:
        """The least goal probability and the cheapest policy that attains it (pi'_or)."""
        least = least_goal_reach(self.model, self.survival)
        return least, cheapest_reach(self.model, least, self.survival)

    def _handing_on(self, other: Self, *kept: str) -> Self:
        """Hand what has been worked out to a copy: the extreme probabilities, and what is named."""
        names = ("greatest", "safest_policy", "riskiest", *kept)
        vars(other).update((name, vars(self)[name]) for name in names if name in vars(self))
        return other

    def pricing(self) -> LayeredPricing:
        """One backward sweep over the layers."""
        return LayeredPricing(self.process)

    def explicit(self) -> ExplicitProcess:
        """All layers below the cap, written out."""
        return materialise(self.process)

    def explicit_choice(self, column: Column) -> IntArray:
        """The column's pairs in all layers, its tails beyond them and the source's only pair."""
        return chosen_pairs(self.process, required(column.choice), column.tail_price)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """How much of a bound at this price the cap costs; 0 where it is proved lossless."""
        return self.pricing().tail_loss(price, slack=slack, proof=proof)
