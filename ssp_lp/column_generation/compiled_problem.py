"""Compiled problems: an augmented process, its limits and the ways to refine it.

- :class:`CompiledExplicit` has any number of rows: case M on states x failure label, and any charge
  of the accumulated cost in layers.
- :class:`CompiledAccumulatedCost` (case S) and :class:`CompiledArrivalCost` (any charge of the
  accumulated cost) limit failure alone. Their layers need not be written out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from ssp_lp.accumulated_cost import written_out
from ssp_lp.accumulated_cost.charges import TOTAL_COST, Charge, ExponentialUtility, TailValues
from ssp_lp.accumulated_cost.exponential_utility import (
    cost_horizon,
    greatest_moment,
    pairs_keeping_goal,
)
from ssp_lp.accumulated_cost.process import (
    AccumulatedCost,
    LayeredProcess,
    LayeredTails,
    accumulate_cost,
)
from ssp_lp.accumulated_cost.sweep import follow_rule
from ssp_lp.accumulated_cost.totals import (
    MOST_SUMS,
    Resolution,
    Totals,
    layers_within,
    step_costs,
    sums_in,
)
from ssp_lp.arrays import LEAST_BUDGET, MACHINE_EPSILON, FloatArray, IntArray, read_only
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    relative_gap,
    required,
)
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.column_generation.layered_pricing import LayeredPricing, OpenEndedPricing
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import READING, check_time, limited
from ssp_lp.dynamic_programming.evaluation import PROVED_OF_MANY
from ssp_lp.errors import Argument, InfeasibleError, ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, goal_approach, surely_reaching
from ssp_lp.policies.policy import DeterministicPolicy, Policy
from ssp_lp.processes import goal_reach
from ssp_lp.processes.conditions import FAILURE_ROW, UpperRow
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled, counting_of, label_failure
from ssp_lp.processes.failure_semantics import (
    RARE_GOAL,
    Aim,
    FailureSemantics,
    ObjectiveSense,
    demanded_goal,
    goal_out_of_reach,
    survival_of,
)
from ssp_lp.processes.live_rows import uniform_cost


@dataclass(frozen=True, eq=False)
class LeastFailure:
    """The cheapest policy of least failure (mathematics, section 4: two stages)."""

    policy: Policy
    column: Column  # its cost and failure, both discounted under a discount
    objective_bound: float  # certified lower bound of the objective of every such policy
    proved: float  # certified lower bound of the failure of every policy

    @property
    def is_proved(self) -> bool:
        """Whether the least failure is proved up to the tolerance of a budget."""
        return self.column.failure - self.proved <= LEAST_BUDGET


class CompiledProblem(ABC):
    """A problem compiled for methods: a process, a charge, rows and perhaps a ratio.

    The defaults are those of an explicit process without truncation (case M).
    """

    model: SSP
    start: FloatArray  # [states] the distribution in which an episode begins
    discount: float | None  # None: exact
    ratio: bool  # whether the objective is cost / (1 - failure) (case S) rather than cost (case M)
    charge: Charge | None  # of the total cost at the goal; None: case M, no accumulated cost

    @property
    def lowest(self) -> float:
        """Lower bound of the objective, known without a search."""
        return 0.0

    @property
    def is_trial(self) -> bool:
        """Whether this problem only serves to find the price, which determines its size."""
        return False

    @property
    def is_long_shot(self) -> bool:
        """Whether the first cap is only a guess: case M gives a better one (``capped_at``)."""
        return False

    @property
    def cost_horizon(self) -> float:
        """Accumulated cost from which a stationary policy is optimal; 0: unknown."""
        return 0.0

    @property
    @abstractmethod
    def layers(self) -> int:
        """Number of layers of accumulated cost; 1 without accumulated cost."""

    @property
    @abstractmethod
    def n_columns(self) -> int:
        """Number of columns of the linear program."""

    @property
    def survival(self) -> float:
        """The discount, 1 in the exact setting."""
        return survival_of(self.discount)

    def capped_at(self, cost: float) -> Self:
        """Return the problem with a cap of about this accumulated cost, if ``is_long_shot``."""
        return self

    @abstractmethod
    def least_failure(self) -> LeastFailure:
        """Return the policy of least failure, which decides whether the problem is feasible."""

    def proved_failure(self, reach: goal_reach.GoalReach, failure: float) -> float:
        """Return a lower bound of the failure of every policy.

        Args:
            reach: the greatest goal probability.
            failure: failure of the safest policy.
        """
        proved = reach.least_failure(self.start)
        if failure - proved > PROVED_OF_MANY:  # sweeps may prove more than an evaluation
            again = goal_reach.greatest_goal_reach(
                self.model, self.survival, self.start, last_digits=False
            )
            proved = max(proved, again.least_failure(self.start))
        return min(proved, failure)

    def failure_at_least(self, discount: float | None) -> float:
        """Return the least failure of all policies under a discount."""
        survival = survival_of(discount)
        reach = goal_reach.greatest_goal_reach(self.model, survival, self.start).goal
        return max(1.0 - float(self.start @ reach), 0.0)

    @abstractmethod
    def pricing(self) -> PricingProblem:
        """Return the pricing problem."""

    def counting_rare_success(self, budget: float | None) -> Self:
        """Return the problem, with the goal as reward instead of failure if success is rare.

        Args:
            budget: failure budget; None: as low as possible.
        """
        return self

    def for_program(self) -> Self:
        """Return the problem whose explicit process has the optimum of this problem."""
        return self

    @abstractmethod
    def explicit(self) -> ExplicitProcess:
        """Return the process written out, for the linear program."""

    def explicit_choice(self, column: Column) -> IntArray:
        """Return the pair of the explicit process that a column takes in each state, [states].

        Raises:
            ModelError: pricing did not make the column.
        """
        return required(column.choice)

    @abstractmethod
    def refined(self, price: float) -> Self | None:
        """Return a larger problem with a smaller truncation error; None: none exists.

        Args:
            price: price of failure at the optimum of this problem.
        """

    @abstractmethod
    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> Self:
        """Return the problem whose value functions have the shape of the given one.

        Args:
            values: the value function.
            levels: layer totals of a policy found with it; None: multiples of a unit.

        Raises:
            ModelError: no compiled problem has such value functions.
        """

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return the part of a bound at this price that truncation loses.

        Args:
            price: of failure.
            slack: whether the bound is of ``cost - price * goal`` (:class:`Proof`).
            proof: a proof at this price, which may save work.
        """
        return 0.0

    def _copy_with_results(self, other: Self, *own: str) -> Self:
        """Copy cached results to another problem, except those named ``own``; return it."""
        shared = vars(self).keys() - vars(other).keys() - set(own)
        vars(other).update({name: vars(self)[name] for name in shared})
        return other


def unreachable(
    model: SSP,
    start: FloatArray,
    budget: float | None,
    discount: float | None,
    why: str = "no cost given success exists",
) -> InfeasibleError:
    """Return the error of a problem that has no answer as its goal cannot be reached.

    Args:
        model: the model.
        start: [states].
        budget: failure budget.
        discount: of the problem.
        why: the consequence.
    """
    words = goal_out_of_reach(model, start) or "the goal cannot be reached from the start"
    return InfeasibleError(
        f"{words}: {why}",
        failure_budget=budget,
        least_failure=1.0,
        least_discounted_failure=None if discount is None else 1.0,
        least_failure_bound=1.0,
        conflicting_rows=() if budget is None else (FAILURE_ROW,),
    )


def checked_least_failure(compiled: CompiledProblem, budget: float | None) -> LeastFailure:
    """Return the policy of least failure, checked to satisfy the budget.

    Args:
        compiled: the problem.
        budget: failure budget; None: the least failure.

    Raises:
        InfeasibleError: no policy satisfies the budget, or no cost given success exists.
        SolverError: the policy violates the budget, but the proof leaves open whether all do.
    """
    least_failure = compiled.least_failure()
    failure, discounted = least_failure.column.failure, compiled.discount is not None
    setting = compiled.model, compiled.start, budget, compiled.discount
    if compiled.ratio and least_failure.column.goal <= 0.0:
        raise unreachable(*setting)
    if budget is None or failure <= budget + LEAST_BUDGET:
        return least_failure
    if goal_out_of_reach(compiled.model, compiled.start):
        raise unreachable(*setting, f"every policy fails surely, above the budget {budget:g}")
    proved = least_failure.proved
    if proved <= budget:
        kind = "discounted failure" if discounted else "failure probability"
        raise SolverError(
            f"the feasibility of the budget {budget:g} is not decided: the least {kind} is "
            f"proved to lie between {proved:.12g} and {failure:.12g} only, as runs are too long "
            f"for double precision; use a budget of at least {failure:.12g}"
        )
    told = f"at least {proved:.12g}, above the budget {budget:g}"
    if f"{proved:.12g}" != f"{failure:.12g}":
        told += f", and the safest known policy with {failure:.12g}"
    if not discounted:
        raise InfeasibleError(
            f"every policy fails with probability {told}",
            "; ",
            Argument("failure_budget", None),
            " minimises it",
            failure_budget=budget,
            least_failure=failure,
            conflicting_rows=("failure",),
            least_failure_bound=proved,
        )
    real = compiled.failure_at_least(None)
    nearer = ("; ", Argument("discount", None), " or a discount nearer to 1 is feasible")
    raise InfeasibleError(
        f"the discounted failure of every policy is {told}; the least real failure probability is "
        f"{real:.12g}",
        *(nearer if real <= budget else ()),
        failure_budget=budget,
        least_failure=real,
        least_discounted_failure=failure,
        conflicting_rows=("failure",),
    )


MOST_ENTRIES = 800_000_000
"""Most decisions of a table, nodes x layers: 0.8 GB a policy at a byte each."""


def check_compiled_table(layers: int, base: AccumulatedCost, remedy: str) -> None:
    """Check that the table of decisions is not too large; else raise :class:`ModelError`."""
    if (layers + base.width) * base.n_nodes > MOST_ENTRIES:
        raise ModelError(
            f"too many layers of accumulated cost ({layers:.6g} of unit {base.unit:g}, on "
            f"{base.n_nodes:,} states): use a coarser grid of costs or a smaller {remedy}"
        )


class _CompiledLayered(CompiledProblem):
    """A compiled problem whose process is layered."""

    charge: Charge

    @property
    @abstractmethod
    def base(self) -> AccumulatedCost:
        """One layer of the process."""

    @property
    @abstractmethod
    def process(self) -> LayeredProcess:
        """The process, truncated at the cap."""

    @cached_property
    def greatest(self) -> goal_reach.GoalReach:
        """The greatest goal probability."""
        return goal_reach.greatest_goal_reach(self.model, self.survival)

    @cached_property
    def safest_policy(self) -> goal_reach.ReachPolicy:
        """The cheapest policy of greatest goal probability."""
        return goal_reach.cheapest_reach(self.model, self.greatest, self.survival)

    @cached_property
    def riskiest(self) -> tuple[goal_reach.GoalReach, goal_reach.ReachPolicy]:
        """The least goal probability and the cheapest policy that attains it (pi'_or)."""
        least = goal_reach.least_goal_reach(self.model, self.survival)
        return least, goal_reach.cheapest_reach(self.model, least, self.survival)

    def _tails_of(
        self,
        first: goal_reach.ReachPolicy,
        last: goal_reach.ReachPolicy,
        greatest: FloatArray,
        least: FloatArray,
        **more: Any,
    ) -> LayeredTails:
        """Return the tails: a policy to the goal, one that fails, and goal bounds, [states]."""
        decisions = np.stack([first.decision, last.decision]).astype(np.int32)
        at = self.base.quotient.least_over_members
        values = TailValues.stacked([first.values, last.values], at)
        return LayeredTails(decisions, values, -at(-greatest), at(least), **more)

    @property
    def layers(self) -> int:
        """Number of layers below the cap."""
        return self.process.cap

    @property
    def n_columns(self) -> int:
        """Number of pairs of all layers."""
        return self.process.cap * len(self.base.quotient.pair_at)

    def pricing(self) -> LayeredPricing:
        """Return the pricing problem, solved by one backward sweep over the layers."""
        return LayeredPricing(self.process)

    def explicit(self) -> ExplicitProcess:
        """Return the process with all layers below the cap written out."""
        return written_out.materialise(self.process)

    def explicit_choice(self, column: Column) -> IntArray:
        """Return the column's pairs: in all layers, in the tails, and at the source."""
        return written_out.chosen_pairs(self.process, required(column.choice), column.tail_price)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return the part of a bound that the cap loses; 0 if it is proved lossless."""
        return self.pricing().tail_loss(price, slack=slack, proof=proof)


_UNPROVED = 1e-10
"""Relative gap with least failure above which pairs are compared in twice the working precision."""

_FIRST_LAYERS = 2.5
"""First cap, as a multiple of the first tail policy's cost given success."""

_MOST_STEPS = 256
"""First cap, in steps, above which it is a long shot: the tail policy is no guide."""

_LARGE = 10_000_000
"""Entries of a layer from which a policy to the goal is followed, not solved for."""

_MARGIN = 1.02
"""Factor of the cap that a trial's price implies, as the price still changes a little."""

_MOST_GROWTH = 4
"""Most growth of a cap in one step: more comes from a high price near the least failure."""


@dataclass(frozen=True, eq=False)
class CompiledAccumulatedCost(_CompiledLayered):
    """Minimise E[cost | goal], failure limited (paper, section 3.1.1).

    ``cap`` is the last layer of accumulated cost; None: a first guess, to find the price. From
    accumulated cost kappa on, failing is optimal in every state where it is possible for sure.
    A cap at kappa therefore loses (almost) nothing with simple tails: any policy to the goal and
    the trivial bound of its goal probability. The exact policies of greatest goal probability are
    computed only if kappa is too large for such a cap.
    """

    model: SSP
    start: FloatArray  # [states]
    discount: float | None = None
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    cap: int | None = None  # layers
    exact_tails: bool = False  # tails of least failure beyond the cap, not any way to the goal
    is_for_bounds: bool = False  # for bounds only: no tail to the goal is computed

    ratio = True
    charge = TOTAL_COST

    @cached_property
    def lowest(self) -> float:
        """Lower bound of the objective: least number of steps times least cost."""
        begins = np.flatnonzero(self.start)
        begins = begins[~dead_ends(self.model)[begins]]
        if self.discount is not None or not begins.size:
            return 0.0
        steps, same = int(goal_approach(self.model)[1][begins].min()), uniform_cost(self.model)
        if steps == 0:
            return 0.0
        last = float(self.model.costs.min()) if same is None else same
        going_on = self.base.step_classes.least * self.base.unit if same is None else same
        return ((steps - 1) * going_on + last) * (1.0 - 2.0 * MACHINE_EPSILON)

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the accumulated-cost process."""
        return accumulate_cost(self.model, self.start, self.discount)

    @property
    def is_trial(self) -> bool:
        """Whether the cap on accumulated cost is a guess."""
        return self.cap is None and self.fixed_cap is None and not self._has_exact_tails

    @cached_property
    def _directed(self) -> goal_reach.ReachPolicy:
        """A policy to the goal, the tail beyond the cap."""
        return goal_reach.goal_directed(self.model, self.survival)

    @cached_property
    def _guess(self) -> tuple[float, float] | None:
        """Approximate (E[cost; goal], goal) of a policy to the goal, in a large process.

        There an evaluation would take longer than a sweep. The tail beyond the cap is then the
        riskiest policy; if this loses something, the cap is raised or the tails become exact.
        """
        base, later = self.base, self.base.later
        is_large = base.instant.nnz == 0 and later.nnz >= _LARGE
        if self.exact_tails or not is_large or base.quotient.merged.any():
            return None
        if not accelerated(later.nnz, "layers.follow_layer"):
            return None
        rule = base.quotient.placed(goal_approach(self.model)[0]) - base.pair_offsets[:-1]
        return follow_rule(base, rule, _MOST_STEPS)

    @cached_property
    def is_long_shot(self) -> bool:
        """Whether the policy to the goal takes too many steps to give a cap."""
        if self.exact_tails or self.base.quotient.merged.any():
            return False
        if self.cap is not None or self.fixed_cap is not None:
            return False
        if self._guess is not None:
            cost, goal = self._guess[0], self._guess[1] + self.base.start_goal
        else:
            directed = self._directed.values
            cost, goal = float(self.start @ directed.cost), float(self.start @ directed.goal)
        steps = _FIRST_LAYERS * cost / max(goal, 1e-300) / (self.base.unit * self.base.width)
        return steps > _MOST_STEPS

    @cached_property
    def _has_exact_tails(self) -> bool:
        """Whether the tails are the policies of least failure."""
        return self.exact_tails or bool(self.base.quotient.merged.any()) or self.is_long_shot

    def capped_at(self, cost: float) -> CompiledAccumulatedCost:
        """Return the problem with a cap of about this accumulated cost.

        If no policy avoids the goal surely from the start, every cap loses something, and the tails
        become exact at once.
        """
        exact = float(self.start @ self.riskiest[0].goal) > 0.0
        most = MOST_ENTRIES // max(self.base.n_nodes, 1) - 2 * self.base.width
        layers = int(min(np.ceil(cost / self.base.unit), max(most, 0))) + self.base.width
        return self._copy_for_cap(replace(self, cap=layers, exact_tails=exact))

    def least_failure(self) -> LeastFailure:
        """Return the policy of greatest goal probability, then of least E[cost; goal].

        For least failure the accumulated cost is not needed: a transition to x' is priced
        ``g * Pmax(x')`` (mathematics, section 4).
        """
        safest, values = self.safest_policy, self.safest_policy.values
        cost, goal = float(self.start @ values.cost), float(self.start @ values.goal)
        policy = DeterministicPolicy(self.model, safest.decision)
        column = Column(cost, float(self.start @ values.failure), goal, None, policy=policy)
        greatest = float(self.start @ self.greatest.bound)
        ratio = float(self.start @ safest.bound) / greatest if greatest > 0 else 0.0
        bound = min(ratio, cost / goal if goal > 0.0 else np.inf)
        return LeastFailure(
            policy, column, bound, self.proved_failure(self.greatest, column.failure)
        )

    @cached_property
    def process(self) -> LayeredProcess:
        """The layered process, truncated at the cap."""
        base, layers = self.base, self.cap
        if layers is None and self.fixed_cap is not None:
            layers = max(int(np.ceil(self.fixed_cap / base.unit)), 1)
        elif layers is None:
            tails = self._tails
            cost, goal = tails.guess or (base.start @ tails.first.cost, base.start @ tails.goal[0])
            typical = float(cost) / max(float(goal) + base.start_goal, 1e-300) / base.unit
            layers = int(np.ceil(_FIRST_LAYERS * typical)) + base.width
        check_compiled_table(layers, base, "cost_cap")
        return LayeredProcess(base, base.totals(layers), self._tails)

    def refined(self, price: float) -> CompiledAccumulatedCost | None:
        """Return the problem with more layers or better tails; None: nothing to improve."""
        here, exact = self.process.cap, self._has_exact_tails
        lossless = int(np.ceil(_MARGIN * price / self.base.unit)) + 1
        if self.fixed_cap is not None:
            return None if exact else self._copy_for_cap(replace(self, exact_tails=True))
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
        return self._copy_for_cap(replace(self, cap=wanted, exact_tails=exact))

    def matching(
        self, values: FloatArray, levels: FloatArray | None = None
    ) -> CompiledAccumulatedCost:
        """Return the problem with as many layers as the value function, [layers, nodes].

        Its tails are the riskiest policy alone; :meth:`for_program` has exact tails.

        Raises:
            ModelError: the array has no layers.
        """
        if values.ndim != 2 or values.shape[0] == 0:
            raise ModelError("values of a wrong shape: pass an array of [layers, nodes]")
        return self._copy_for_cap(replace(self, cap=values.shape[0], is_for_bounds=True))

    def for_program(self) -> CompiledAccumulatedCost:
        """Return the problem with exact tails, the best beyond the cap in any program."""
        if self._has_exact_tails:
            return self
        exact = self._copy_for_cap(replace(self, exact_tails=True))
        return self._copy_for_cap(replace(exact, cap=exact.process.cap))

    def _copy_for_cap(self, other: CompiledAccumulatedCost) -> CompiledAccumulatedCost:
        """Copy all results that do not depend on the cap; return the copy."""
        own = "process", "is_long_shot", "_has_exact_tails", "_tails"
        other = self._copy_with_results(other, *own)
        if "_tails" in vars(self) and self._has_exact_tails == other._has_exact_tails:
            vars(other)["_tails"] = self._tails
        return other

    @cached_property
    def _tails(self) -> LayeredTails:
        """The tails beyond the cap."""
        least, riskiest = self.riskiest
        if self._has_exact_tails:
            return self._tails_of(self.safest_policy, riskiest, self.greatest.bound, least.bound)
        first = riskiest if self.is_for_bounds or self._guess else self._directed
        greatest = np.full(self.model.n_states, self.survival)
        guess = None if self.is_for_bounds else self._guess
        return self._tails_of(first, riskiest, greatest, least.bound, exact=False, guess=guess)


_FIRST_TOTALS = 64  # first cap of a charge that never settles
_NEARLY = 1.25  # first cap of a trial, in costs given success of a policy to the goal
_TYPICAL = 2.5  # first cap, in costs given success of the safest policy

_MOST_LAYERS = 100_000
"""Most layers of a charge that never settles; the gap that remains is reported."""

_DOUBLINGS = 60  # most doublings of a cap
_LOWER = 0.5  # factor of a cap below which too many sums lie
_BEYOND = 1e-9  # relative distance of a total that lies beyond another
_LEAST = 1e-12  # relative rounding of the goal probability that all safest policies attain
_OF_TAILS: tuple[str, ...] = ("_tails", "_moments", "cost_horizon")
_LOST = 1e-6  # goal probability that a policy of least failure may lose to rounding of long runs


@dataclass(frozen=True, eq=False)
class CompiledArrivalCost(_CompiledLayered):
    """Minimise E[charge(total cost); goal], or its ratio to Pr(goal), failure limited; exact.

    The layers of accumulated cost end where the charge becomes affine, as the optimal tail is then
    known in closed form. If the affine charge grows, they end, as in case S, at the price from
    which failing is optimal. A charge that never becomes affine is truncated and refined.
    """

    model: SSP
    start: FloatArray  # [states]
    charge: Charge
    ratio: bool = False
    safest_only: bool = False  # only policies of least failure
    cap: float | None = None  # total at which the layers end, in units; None: from the charge
    by_sums: bool = False  # layers are the sums of step costs that can occur, and a unit is 1
    discount: None = None

    @property
    def is_trial(self) -> bool:
        """Whether the cap is a guess to find the price."""
        grows = self.charge.slope > 0.0 and not self.safest_only
        return self.by_sums and self.cap is None and grows

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        usable = self.greatest.usable if self.safest_only else None
        return accumulate_cost(
            self.model, self.start, None, arrivals=True, usable=usable, by_steps=self.by_sums
        )

    @cached_property
    def _moments(self) -> goal_reach.ReachPolicy | None:
        """The tail of an exponential utility; None: another charge."""
        if not isinstance(self.charge, ExponentialUtility):
            return None
        keeping = pairs_keeping_goal(self.model, self.greatest) if self.charge.bonus > 0.0 else None
        return greatest_moment(self.model, self.charge.rate, keeping)

    @cached_property
    def cost_horizon(self) -> float:
        """Accumulated cost from which the stationary tail is optimal; 0: unknown."""
        charge, moments = self.charge, self._moments
        if moments is None or not isinstance(charge, ExponentialUtility) or charge.bonus == 0.0:
            return 0.0
        return cost_horizon(self.model, self.greatest, moments, charge.rate, charge.bonus)

    @cached_property
    def process(self) -> LayeredProcess:
        """The process, truncated at the cap."""
        cap = self._first_guess() if self.cap is None else self.cap
        if self.by_sums:
            while (totals := self._totals(cap)) is None:  # as many as fit; the gap shows the loss
                check_time()
                cap *= _LOWER
        else:
            check_compiled_table(int(cap), self.base, "bound on them")
            totals = self.base.totals(int(cap))
        return LayeredProcess(self.base, totals, self._tails, self.charge)

    def _totals(self, cap: float) -> Totals | None:
        """Return the sums of step costs below a cap, as layers; None: too many."""
        room = min(MOST_SUMS, MOST_ENTRIES // max(self.base.n_nodes, 1))
        sums, steps = sums_in(self.model, cap, room), step_costs(self.model)[1]
        if sums is None:
            return None
        return Totals(read_only(np.append(sums, cap)), steps, complete=True)

    def _units(self, total: float) -> float:
        """Return a total in units, rounded up if layers are multiples of the unit."""
        return total if self.by_sums else int(min(np.ceil(total / self.base.unit), 1e15))

    def _settled_units(self) -> float:
        """Return the total, in units, from which the charge is affine or the tail optimal."""
        settled = self.charge.settled or 0.0
        if isinstance(self.charge, ExponentialUtility):
            return max(self._units(self.cost_horizon), self._least_units)
        if self.base.width == 1 and not self.by_sums:
            return 1  # no step costs anything
        if not self.by_sums:
            return max(layers_within(settled, self.base.exact_unit), 1)
        return max(settled * (1.0 + _BEYOND), self._least_units)

    @property
    def _least_units(self) -> float:
        """Smallest cap: one layer; by sums, that of total 0."""
        return _BEYOND * float(step_costs(self.model)[1].max()) or 1.0 if self.by_sums else 1

    def _first_guess(self) -> float:
        """Return the first cap: the layers that are needed in any case, and a guess of more."""
        if self.is_trial:
            directed = goal_reach.goal_directed(self.model).values
            cost, goal = float(self.start @ directed.cost), float(self.start @ directed.goal)
            return self._settled_units() + _NEARLY * cost / max(goal, 1e-300)
        goal = float(self.base.start @ self._tails.goal[0])
        cost = float(self.base.start @ self._tails.first.cost)
        typical = self._units(_TYPICAL * cost / max(goal, 1e-300))
        width = float(step_costs(self.model)[1][-1]) if self.by_sums else self.base.width
        if self.charge.settled is None:
            first = typical if self.by_sums else _FIRST_TOTALS
            return max(first + width, self._least_units)
        if self.charge.slope == 0.0 or self.safest_only:
            return self._settled_units()
        return self._settled_units() + typical + width

    @cached_property
    def _tails(self) -> LayeredTails:
        """The tails beyond the cap."""
        at, moments = self.base.quotient.least_over_members, self._moments
        first = self.safest_policy if moments is None else moments
        last, least, least_cost = first, np.zeros(self.model.n_states), None
        if self.safest_only:
            least = self.greatest.goal * (1.0 - _LEAST)
            least_cost = at(self.safest_policy.bound)
        elif self.ratio:  # otherwise the goal is never worse than failing
            least, last = self.riskiest[0].bound, self.riskiest[1]
        greatest_moment = None if moments is None else -at(-moments.bound)
        return self._tails_of(
            first,
            last,
            self.greatest.bound,
            least,
            least_cost=least_cost,
            greatest_moment=greatest_moment,
        )

    @property
    def lowest(self) -> float:
        """Lower bound of the objective, known without a search."""
        return self.charge.lowest

    def least_failure(self) -> LeastFailure:
        """Return the policy of least charge among those of least failure; it may remember the cost.

        Raises:
            ModelError: its runs have so many zero-cost steps that rounding errors add up.
        """
        pricing = self.safest().pricing()
        best = pricing.minimise(0.0)
        if best.goal < float(self.start @ self.greatest.goal) - _LOST:
            raise ModelError(
                "zero-cost cycles make a policy run too long for its failure probability to be "
                "computed: give these actions a positive cost, or round the costs"
            )
        policy, bound = pricing.policy(best), pricing.prove(0.0, best).bound
        greatest = min(float(self.start @ self.greatest.bound), 1.0)
        if self.ratio:
            bound = bound / greatest if greatest > 0.0 else 0.0
        proved = self.proved_failure(self.greatest, best.failure)
        return LeastFailure(policy, replace(best, choice=None, policy=policy), bound, proved)

    def lossless_units(self, price: float) -> float:
        """Return the total from which failing is optimal at this price, with a margin.

        If the charge is constant in the end, it is the total from which it is.
        """
        charge, settled = self.charge, self._settled_units()
        if charge.slope == 0.0:
            return settled
        room = 0 if self.by_sums else 1
        return max(settled, self._units(_MARGIN * charge.lossless(price)) + room)

    def refined(self, price: float) -> CompiledArrivalCost | None:
        """Return the problem with the layers that the price requires, or twice as many."""
        here, charge = self.process.end, self.charge
        wanted = 2 * here
        if charge.settled is None:
            wanted = wanted if self.by_sums else min(wanted, _MOST_LAYERS)
        elif charge.slope == 0.0 or self.safest_only:
            return None
        else:
            lossless = self.lossless_units(price)
            near = self.is_trial or here < lossless
            wanted = lossless if near and lossless <= 4 * here else wanted
        if not self.by_sums:
            entries = (wanted + self.base.width) * self.base.n_nodes
            fits = here < wanted and entries <= MOST_ENTRIES
        elif not (fits := self._totals(wanted) is not None) and self.is_trial:
            return self.charging(charge, here)  # keep the cap of the trial
        return self.charging(charge, wanted) if fits else None

    def charging(self, charge: Charge, cap: float | None = None) -> CompiledArrivalCost:
        """Return the problem with another charge and cap; common results are shared.

        An exponential utility has other tails.
        """
        own = _OF_TAILS
        exponential = (isinstance(c, ExponentialUtility) for c in (charge, self.charge))
        if charge == self.charge or not any(exponential):
            vars(self)["_tails"], own = self._tails, ()
        return self._copy_with_results(replace(self, charge=charge, cap=cap), "process", *own)

    def safest(self) -> CompiledArrivalCost:
        """Return the problem restricted to the policies of least failure."""
        _ = self.safest_policy  # computed once
        safest = replace(self, safest_only=True, cap=None)
        return self._copy_with_results(safest, "process", "base", *_OF_TAILS)

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledArrivalCost:
        """Return the problem with as many layers as the value function, [layers, nodes].

        Args:
            values: the value function.
            levels: layer totals of a policy found with it, of which the last is the cap.

        Raises:
            ModelError: the array has too few or too many layers for the charge.
        """
        least = self._settled_units()
        if values.ndim != 2 or values.shape[0] < (1 if self.by_sums else least):
            raise ModelError(f"values of too few layers: pass an array of {least} or more layers")
        if not self.by_sums:
            return self.charging(self.charge, values.shape[0])
        cap, n_layers, end = least, values.shape[0], None
        while self._totals(cap) is None:  # as many as fitted
            check_time()
            cap *= _LOWER
        if levels is not None and levels[-1] >= cap:
            capped = self.charging(self.charge, float(levels[-1]))
            if capped.process.cap == n_layers:
                return capped
        for _ in range(_DOUBLINGS):
            if (totals := self._totals(cap)) is None:
                break
            if totals.size >= n_layers:  # the greatest cap with this number of sums
                end = float(totals.values[n_layers])
            if totals.size > n_layers:
                break
            cap *= 2.0
        if end is None:
            raise ModelError("values of too many layers: pass an array of fewer layers")
        return self.charging(self.charge, end)


ATTAINABLE = 1e-10
"""A bound this much below the least attainable total, relative to it, counts as equal to it."""

_MOST_SWEPT = 400_000_000
"""Most pairs of all layers without writing them out: a choice takes a byte for each node."""

_WORTH_SWEEPING = 400  # entries of a layer from which pricing by layers is faster

_ROOM = 6_000_000  # most pairs with layers that are not multiples of a unit
_ROUGHLY = 0.5  # layers of a trial, in those of a first attempt
_CLEARLY = 1e-9  # share of a budget, or of the goal it demands, that exceeds rounding
_OWN = {"augmented", "explicit_pricing", "_pricing", "totals", "layers"}
"""Cached results that depend on the charge, the cap or the resolution."""


@dataclass(frozen=True, eq=False)
class CompiledExplicit(CompiledProblem):
    """Minimise a cost with limits on failure and other quantities; budget None: least failure.

    Without a charge this is case M (paper, section 3.1.2), without truncation. With a charge of the
    total cost (section 3.1.1) the objective is E[charge; goal], or E[charge | goal] if ``ratio``.
    """

    model: SSP
    start: FloatArray  # [states]
    semantics: FailureSemantics
    discount: float | None = None
    side: tuple[UpperRow, ...] = ()
    budget: float | None = 1.0
    precise: bool = False  # compare pairs in twice the working precision
    charge: Charge | None = None
    ratio: bool = False
    cap: int | None = None  # layers; None: a first guess
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    exact_tails: bool = True  # optimal tails beyond the cap, not the better of two policies
    is_trial: bool = False  # its layers are a guess to find the price
    objective: UpperRow | None = None  # minimised instead of the cost; then without a charge
    resolution: Resolution | None = None  # of layers that are not multiples of a unit
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure

    is_whole: ClassVar[bool] = True  # whether other problems on the model can be solved here

    def counting_rare_success(self, budget: float | None) -> Self:
        """Return the problem, with the goal as reward instead of failure if success is rare.

        This avoids cancellation in ``1 - failure`` and in limits on the probability of ends.
        """
        demanded = 0.0 if budget is None else demanded_goal(budget)
        side = tuple(row.by_digits for row in self.side)
        is_rare = 0.0 < demanded < RARE_GOAL
        if demanded == 0.0 and self.ratio:
            is_rare = self.greatest_goal < RARE_GOAL
        return replace(self, side=side, by_goal=self.by_goal or is_rare)

    @property
    def may_be_rare(self) -> bool:
        """Whether rows alone may make success rare while failure is the reward."""
        is_greatest = self.semantics.aim is Aim.GREATEST_GOAL and self.objective is None
        is_free = self.ratio and self.budget is not None and self._demanded == 0.0
        return (is_greatest or is_free) and not self.by_goal

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: first the failure row, limited or not."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def sense(self) -> ObjectiveSense:
        """Relation between the minimum and the objective that the user asked for."""
        shift = 0.0 if self.charge is None else max(-self.charge.lowest, 0.0)
        if self.objective is not None:
            return ObjectiveSense(None, shift, self.objective.offset)
        if self.semantics.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(0.0 if self.by_goal else 1.0, shift)
        failing = self.semantics.failing_worth + shift
        return ObjectiveSense(failing if self.semantics.maximises else None, shift)

    @property
    def wants_ends(self) -> bool:
        """Whether a row or the objective counts an end other than the goal."""
        rows = self.side if self.objective is None else (*self.side, self.objective)
        return any(row.condition.wants_ends for row in rows)

    @property
    def told(self) -> tuple[str, ...]:
        """Descriptions of the limited quantities, for messages."""
        ending = "- goal probability" if self.by_goal else FAILURE_ROW
        return (ending, *(row.told for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each row, [rows]; infinite: no limit."""
        granted, demanded = np.inf, self._demanded
        if self.budget is not None and demanded > 0.0:
            granted = -demanded if self.by_goal else max(self.budget, 0.0)
        return np.array([granted, *(row.bound for row in self.side)])

    @property
    def _demanded(self) -> float:
        """Least goal probability that the budget requires; 0: none."""
        return 0.0 if self.budget is None else max(demanded_goal(self.budget), 0.0)

    @cached_property
    def least(self) -> LeastFailure:
        """The policy of least failure; InfeasibleError: it violates the budget."""
        return checked_least_failure(self, self.budget)

    def least_failure(self) -> LeastFailure:
        """Return the policy of greatest goal probability, then of least cost."""
        how = self.model, self.start, self.semantics, self.discount
        self.check_sure()
        stage = label_failure(*how, self.greatest.usable)
        begun_from = stage.placed(self.greatest.decision)
        second = ExplicitPricing(stage, self.precise, begun_from=begun_from, by_goal=self.by_goal)
        column = second.minimise(0.0)
        bound = second.prove(0.0, column).bound
        if relative_gap(column.cost, bound) > _UNPROVED and not self.precise:
            second = replace(second, precise=True)
            column = second.minimise(0.0, column)
            bound = second.prove(0.0, column).bound
        policy = second.policy(column)
        foreign = replace(column, choice=None, found_at=None, policy=policy)
        return LeastFailure(
            policy, foreign, bound, self.proved_failure(self.greatest, column.failure)
        )

    def check_sure(self) -> None:
        """Check that the goal can be reached surely, if failing is forbidden.

        Raises:
            InfeasibleError: no policy reaches the goal surely.
        """
        if not self.semantics.forbids_failing:
            return
        unsure = np.flatnonzero(~surely_reaching(self.model)[0] & (self.start > 0.0))
        if not unsure.size:
            return
        words = (
            f"no policy reaches the goal surely from state {self.model.states[unsure[0]]!r}: the "
            "cost is infinite"
        )
        if goal_out_of_reach(self.model, self.start):
            raise unreachable(self.model, self.start, 0.0, self.discount, words)
        raise InfeasibleError(
            f"{words}; use MCMP for the cheapest of the policies that fail least",
            failure_budget=0.0,
            least_failure=self._least_failure_alone,
        )

    def _least_failure_alone(self) -> float:
        """Return the least failure probability, computed when an error is asked for it."""
        with limited(READING, "the least failure probability was computed"):
            return max(1.0 - goal_reach.greatest_goal_from(self.model, self.start), 0.0)

    @property
    def limits_failure(self) -> bool:
        """Whether there is a failure budget that some policy may violate."""
        return self.budget is not None and self._demanded > 0.0

    def settled(self, *known: Column) -> CompiledExplicit:
        """Return the problem of least failure if the budget does not exceed it, else this problem.

        Args:
            known: columns, of which one may lie clearly within the budget.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding; case S,
                and the goal cannot be reached; or failing is forbidden and cannot be avoided.
        """
        self.check_sure()
        if self.ratio and all(column.goal <= 0.0 for column in known) and self.greatest_goal <= 0.0:
            raise unreachable(self.model, self.start, self.budget, self.discount)
        if self.budget is None or not self.limits_failure:
            return self
        row = FailureRow(self.budget, self.ratio)
        room = _CLEARLY * min(self.budget, row.demanded)
        if any(row.spare(column) > room for column in known):
            return self
        return replace(self, budget=None) if row.spare(self.least.column) <= 0.0 else self

    @cached_property
    def greatest_goal(self) -> float:
        """Upper bound of the goal probability, discounted under a discount."""
        reach = self.greatest
        return float(self.start @ np.maximum(reach.goal, reach.bound))

    @cached_property
    def greatest(self) -> goal_reach.GoalReach:
        """The greatest goal probability, and the pairs that attain it."""
        return goal_reach.greatest_goal_reach(self.model, self.survival, self.start)

    @cached_property
    def least_goal(self) -> float:
        """Lower bound of the goal probability of every policy within the budget."""
        least = float(self.start @ self._least_goals)
        return max(self._demanded, least, 0.0)

    @cached_property
    def _least_goals(self) -> FloatArray:
        """Lower bound of the goal probability of every policy, [states]."""
        if self.budget is None:
            return self.greatest.goal * (1.0 - ATTAINABLE)
        return goal_reach.least_goal_reach(self.model, self.survival).bound

    @cached_property
    def augmented(self) -> FailureLabelled | written_out.OpenEnded:
        """The process, with end components collapsed that are free in all rewards."""
        if self.charge is None:
            self.check_sure()
            usable = None if self.budget is not None else self.greatest.usable
            setting = self.start, self.semantics, self.discount, usable
            return label_failure(self.model, *setting, self.side, self.objective)
        layers = self.layers  # checks the number of pairs
        how = self.base, self.charge, self.sense.shift, self.totals or self.base.totals(layers)
        return written_out.OpenEnded(*how, self.start, self._least_goals)

    @property
    def is_rounded(self) -> bool:
        """Whether totals are rounded, so that values differ from those on the model."""
        return self.totals is not None and not self.totals.exact

    @cached_property
    def totals(self) -> Totals | None:
        """The layers' totals; None: multiples of a unit, or no charge."""
        if self.resolution is None or self.charge is None:
            return None
        first = written_out.first_total(self.charge, self.typical_cost)
        return self.resolution.totals(self.model, first, self._room, grows=self.charge.slope > 0.0)

    @property
    def _room(self) -> int:
        """Most layers that fit into memory."""
        return max(_ROOM // max(len(self.base.gain), 1), 2)  # levels

    def pricing(self) -> ExplicitPricing | OpenEndedPricing:
        """Return the pricing problem with a price for each row: by layers if this is faster.

        Raises:
            InfeasibleError: failing is forbidden and cannot be avoided.
        """
        return self._pricing

    @cached_property
    def _pricing(self) -> ExplicitPricing | OpenEndedPricing:
        """The pricing problem, cached."""
        layered = self.augmented
        if not isinstance(layered, written_out.OpenEnded) or not self._is_swept:
            return self.explicit_pricing
        counting = layered.counting(self.semantics)
        rows = tuple(row.at(counting) for row in self.side)
        return OpenEndedPricing(layered, self.precise, rows, self.by_goal, self.exact_tails)

    @property
    def _is_swept(self) -> bool:
        """Whether pricing is by layers: large processes without free pairs."""
        if self.charge is None or self.base.by_steps or self.base.instant.nnz > 0:
            return False
        return self.base.later.nnz >= _WORTH_SWEEPING

    @cached_property
    def explicit_pricing(self) -> ExplicitPricing:
        """The pricing problem by policy iteration, with a price for each row."""
        own = () if self.objective is None else (self.objective,)
        rows = self.row_coefficients((*own, *self.side))
        counted = rows.pop(0) if own else None
        if self.by_goal and self.semantics.aim is Aim.GREATEST_GOAL:
            counted = -self.augmented.process.goal
        how = self.precise, tuple(rows), counted, self._sure_choice
        return ExplicitPricing(self.augmented, *how, by_goal=self.by_goal)

    @property
    def _sure_choice(self) -> IntArray | None:
        """A choice that reaches the goal surely; None: failing is allowed."""
        augmented = self.augmented
        if not self.semantics.forbids_failing or isinstance(augmented, written_out.OpenEnded):
            return None
        return augmented.placed(surely_reaching(self.model)[2])

    def row_coefficients(self, rows: Sequence[UpperRow]) -> list[FloatArray]:
        """Return the coefficients of each row, [process pairs] each."""
        augmented = self.augmented
        if isinstance(augmented, written_out.OpenEnded):
            counting = augmented.counting(self.semantics)
            return [augmented.everywhere(*row.at(counting)) for row in rows]
        counting = counting_of(augmented, self.start, self.semantics, self.discount)
        return [np.append(*row.at(counting))[: augmented.process.n_pairs] for row in rows]

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        return accumulate_cost(
            self.model,
            self.start,
            self.discount,
            arrivals=self.semantics.counts_law,
            usable=None if self.budget is not None else self.greatest.usable,
            side=self.side,
            by_steps=self.resolution is not None,
        )

    @cached_property
    def typical_cost(self) -> float:
        """Cost given success of the policy of least failure, to choose a cap."""
        safest = goal_reach.cheapest_reach(self.model, self.greatest, self.survival).values
        return float(self.start @ safest.cost) / max(float(self.start @ safest.goal), 1e-300)

    @property
    def _cost_of_a_way(self) -> float:
        """Cost given success of a policy to the goal, to choose the cap of a trial."""
        directed = goal_reach.goal_directed(self.model, self.survival).values
        cost, goal = float(self.start @ directed.cost), float(self.start @ directed.goal)
        return cost / max(goal, 1e-300)

    @cached_property
    def layers(self) -> int:
        """Number of layers; 1 without a charge. ModelError: too many to write out."""
        if self.charge is None:
            return 1
        layers = self.cap if self.totals is None else self.totals.size
        if layers is None:
            typical = _ROUGHLY * self._cost_of_a_way if self.is_trial else self.typical_cost
            layers = written_out.first_cap(self.base, self.charge, typical, self.fixed_cap)
        written_out.check_room(self.base, layers, self._most_pairs)
        return layers

    def with_tails(self, *, exact: bool) -> CompiledExplicit:
        """Return the problem with optimal tails beyond its cap or, for speed, simple ones.

        Tails become simple only if failing is optimal beyond the cap, where they matter little.
        """
        grows = self.charge is not None and self.charge.slope > 0.0
        if exact == self.exact_tails or not (exact or (grows and self._is_swept)):
            return self
        is_trial = not exact and self.cap is None and self.fixed_cap is None
        other = replace(self, exact_tails=exact, is_trial=is_trial)
        return self._copy_with_results(other, *_OWN)

    @property
    def _most_pairs(self) -> int:
        """Most pairs of all layers together."""
        return _MOST_SWEPT if self._is_swept else written_out.MOST_WRITTEN

    def refined(self, price: float) -> CompiledExplicit | None:
        """Return the problem with more layers or, in case M, precision; None: at its finest.

        Args:
            price: price of failure, which is the accumulated cost from which failing is optimal.
        """
        if self.charge is None:
            if self.precise:
                return None
            precise = replace(self, precise=True)
            vars(precise)["augmented"] = self.augmented
            return precise
        exact = None if self.exact_tails else self.with_tails(exact=True)
        if self.fixed_cap is not None:
            return exact
        end = self.layers * self.base.unit if self.totals is None else float(self.totals.values[-1])
        cut = written_out.truncates(self.charge, end)
        if self.resolution is not None and self.totals is not None:
            enough = self.charge.lossless(price) if cut else None
            finer = self.resolution.finer(self.totals, enough, self._room)
            if finer is None:
                return None
            return self._copy_with_results(replace(self, resolution=finer), *_OWN)
        here, pairs = self.layers, len(self.base.gain)
        lossless = int(np.ceil(_MARGIN * self.charge.lossless(price) / self.base.unit)) + 1
        wanted = min(lossless, _MOST_GROWTH * here) if lossless > here else 2 * here
        fits = (wanted + 1) * pairs <= self._most_pairs
        if self.is_trial and (lossless <= here or not fits):
            wanted = here
        elif exact is not None and (lossless <= here or not fits):
            return exact
        elif not (cut and fits):
            return None
        return self._copy_with_results(replace(self, cap=wanted, is_trial=False), *_OWN)

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledExplicit:
        """Return the problem with as many layers as a value function, or raise ModelError."""
        if self.charge is None or self.resolution is not None:
            return self
        nodes = self.base.n_nodes
        layers, odd = divmod(values.size - 1, nodes) if nodes else (2, values.size - 1)
        if values.ndim != 1 or odd or layers < 2:
            raise ModelError("values of a wrong shape: pass an array of [(layers + 1) x nodes + 1]")
        return self._copy_with_results(replace(self, cap=layers - 1), *_OWN)

    def bounded(self, budget: float | None, side: tuple[UpperRow, ...]) -> CompiledExplicit:
        """Return the problem with other bounds; results for the process are shared."""
        return self._copy_with_results(
            replace(self, budget=budget, side=side), "least", "least_goal"
        )

    def charging(self, charge: Charge) -> CompiledExplicit:
        """Return the problem with another charge, whose arrivals lie on the lattice of costs."""
        return self._copy_with_results(replace(self, charge=charge, cap=None), *_OWN)

    @property
    def n_columns(self) -> int:
        """Number of pairs of the process."""
        return self.augmented.process.n_pairs

    def explicit(self) -> ExplicitProcess:
        """Return the process, which is explicit already."""
        return self.augmented.process
