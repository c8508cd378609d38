"""Compiled problems: a process, the limits on it, and how to make the process finer.

:class:`CompiledExplicit` has any number of limits: case M on states x failure label, or any charge
of the accumulated cost on layers. ``compiled_layers`` has problems whose only limit is on failure,
which need no explicit process.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any, ClassVar, Self, cast

import numpy as np

from ssp_lp.accumulated_cost import written_out
from ssp_lp.accumulated_cost.charges import Charge, ExponentialUtility, TailValues
from ssp_lp.accumulated_cost.exponential_utility import (
    cost_horizon,
    greatest_moment,
    pairs_keeping_goal,
)
from ssp_lp.accumulated_cost.process import AccumulatedCost, LayeredTails, accumulate_cost
from ssp_lp.accumulated_cost.sweep import follow_rule
from ssp_lp.accumulated_cost.totals import (
    CAP_MARGIN,
    MOST_GROWTH,
    MOST_SUMS,
    Resolution,
    Totals,
    step_costs,
    sums_in,
)
from ssp_lp.arrays import LEAST_BUDGET, FloatArray, IntArray, read_only
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    required,
)
from ssp_lp.column_generation.explicit_pricing import ExplicitPricing
from ssp_lp.column_generation.layered_pricing import OpenEndedPricing
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import READING, limited
from ssp_lp.dynamic_programming.evaluation import PROVED_OF_MANY
from ssp_lp.errors import Argument, InfeasibleError, ModelError, SolverError
from ssp_lp.model import SSP
from ssp_lp.model.graph import goal_approach, surely_reaching
from ssp_lp.policies.policy import Policy
from ssp_lp.processes import goal_reach
from ssp_lp.processes.conditions import FAILURE_ROW, UpperRow
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import LabelledProcess, counting_of, label_failure
from ssp_lp.processes.failure_semantics import (
    RARE_GOAL,
    Aim,
    FailureSemantics,
    ObjectiveSense,
    goal_out_of_reach,
    required_goal,
    survival_of,
)


@dataclass(frozen=True, eq=False)
class LeastFailure:
    """The cheapest policy of least failure (mathematics, section 4: two stages)."""

    policy: Policy
    column: Column  # its cost and failure, both discounted under a discount
    objective_bound: float  # certified lower bound of the objective of every such policy
    proved: float  # certified lower bound of the failure of every policy

    @property
    def is_proved(self) -> bool:
        """Whether the least failure is proved to within the tolerance of budgets."""
        return self.column.failure - self.proved <= LEAST_BUDGET


@dataclass(frozen=True, eq=False)
class GoalFacts:
    """Greatest and least goal probabilities of a model, and policies that attain them.

    Each is computed once. A compiled problem and its copies share this object.
    """

    model: SSP
    start: FloatArray  # [states] the distribution in which an episode begins
    discount: float | None = None  # None: exact

    @cached_property
    def survival(self) -> float:
        """Factor of every transition probability: the discount, or 1 without one."""
        return survival_of(self.discount)

    @cached_property
    def greatest(self) -> goal_reach.GoalReach:
        """The greatest goal probability from every state."""
        return goal_reach.greatest_goal_reach(self.model, self.survival)

    @cached_property
    def greatest_from_start(self) -> goal_reach.GoalReach:
        """The greatest goal probability, and the pairs that attain it, from the start."""
        return goal_reach.greatest_goal_reach(self.model, self.survival, self.start)

    @cached_property
    def least(self) -> goal_reach.GoalReach:
        """The least goal probability from every state."""
        return goal_reach.least_goal_reach(self.model, self.survival)

    @cached_property
    def safest(self) -> goal_reach.ReachPolicy:
        """The cheapest policy of greatest goal probability."""
        return goal_reach.cheapest_reach(self.model, self.greatest, self.survival)

    @cached_property
    def riskiest(self) -> goal_reach.ReachPolicy:
        """The cheapest policy of least goal probability (pi'_or)."""
        return goal_reach.cheapest_reach(self.model, self.least, self.survival)

    @cached_property
    def least_cost(self) -> FloatArray | None:
        """Lower bound of E[cost; goal] of every policy, [states]; None: 0 at each start state.

        A policy that steps to x' reaches the goal with at least the least goal probability of x'.
        So the step costs at least its cost times this probability.
        """
        least = self.least
        if not least.bound[self.start > 0.0].any():
            return None
        anything = np.ones(self.model.n_pairs, dtype=np.bool_)
        reach = replace(least, goal=least.bound, sure_pairs=anything, solved=None)
        return goal_reach.cheapest_reach(self.model, reach, self.survival).bound

    @cached_property
    def directed(self) -> goal_reach.ReachPolicy:
        """A policy each of whose steps comes nearer to the goal with positive probability."""
        return goal_reach.goal_directed(self.model, self.survival)

    @cached_property
    def typical_cost(self) -> float:
        """Cost given success of the cheapest policy of greatest goal probability from the start."""
        reach = self.greatest_from_start
        cost, goal = self.cost_and_goal(goal_reach.cheapest_reach(self.model, reach, self.survival))
        return cost / max(goal, 1e-300)

    def cost_and_goal(self, policy: goal_reach.ReachPolicy) -> tuple[float, float]:
        """Return E[cost; goal] and the goal probability of a policy from the start."""
        values = policy.values
        return float(self.start @ values.cost), float(self.start @ values.goal)


class CompiledProblem(ABC):
    """A problem compiled for column generation: a process, an objective and limits.

    The objective is an expected cost or an expected charge of the total cost, or its ratio to the
    goal probability.
    """

    facts: GoalFacts  # of the model, the start and the discount
    ratio: bool  # whether the objective is cost / (1 - failure) (case S) rather than cost (case M)
    charge: Charge | None  # of the total cost at the goal; None: case M, no accumulated cost

    @property
    @abstractmethod
    def lowest(self) -> float:
        """Lower bound of the objective, known without a search."""

    @property
    @abstractmethod
    def is_guess(self) -> bool:
        """Whether the cap is a guess, and the solution only serves to find a better cap."""

    @property
    @abstractmethod
    def is_cap_poor(self) -> bool:
        """Whether the first cap is a poor guess, and case M should be solved for a better one."""

    @property
    @abstractmethod
    def cost_horizon(self) -> float:
        """Accumulated cost from which a stationary policy is optimal; 0: unknown."""

    @property
    @abstractmethod
    def layers(self) -> int:
        """Number of layers of accumulated cost; 1 without accumulated cost."""

    @property
    @abstractmethod
    def n_columns(self) -> int:
        """Number of columns of the linear program."""

    def capped_at(self, cost: float) -> Self:
        """Return the problem with a cap near a given accumulated cost, if a cap may be chosen."""
        return self

    @abstractmethod
    def least_failure(self) -> LeastFailure:
        """Return the policy of least failure, which decides whether the problem is feasible."""

    def proved_failure(self, reach: goal_reach.GoalReach, failure: float) -> float:
        """Return a certified lower bound of the failure of every policy.

        Args:
            reach: the greatest goal probability, with its bound.
            failure: failure of the safest policy, which the result does not exceed.
        """
        facts = self.facts
        proved = reach.least_failure(facts.start)
        if failure - proved > PROVED_OF_MANY:  # sweeps may prove more than an evaluation
            how = facts.model, facts.survival, facts.start
            again = goal_reach.greatest_goal_reach(*how, precise=False)
            proved = max(proved, again.least_failure(facts.start))
        return min(proved, failure)

    def failure_at_least(self, discount: float | None) -> float:
        """Return the least failure of all policies, discounted if a discount is given."""
        model, start = self.facts.model, self.facts.start
        reach = goal_reach.greatest_goal_reach(model, survival_of(discount), start).goal
        return max(1.0 - float(start @ reach), 0.0)

    @abstractmethod
    def pricing(self) -> PricingProblem:
        """Return the pricing problem."""

    def counting_rare_success(self, budget: float | None) -> Self:
        """Return the problem with the goal counted in place of failure, if success is rare.

        Args:
            budget: failure budget; None: least failure.
        """
        return self

    def for_program(self) -> Self:
        """Return the problem in a form whose explicit process has the same optimum."""
        return self

    @abstractmethod
    def explicit(self) -> ExplicitProcess:
        """Return the explicit process, for the linear program."""

    def explicit_choice(self, column: Column) -> IntArray:
        """Return the pair of the explicit process that a column takes in each state, [states].

        Raises:
            ModelError: pricing did not make the column.
        """
        return required(column.choice)

    @abstractmethod
    def refined(self, price: float) -> Self | None:
        """Return a larger problem with a smaller truncation error; None if there is none.

        Args:
            price: price of failure at the optimum of this problem.
        """

    @abstractmethod
    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> Self:
        """Return the problem with as many layers as a given value function has.

        Args:
            values: the value function.
            levels: totals of the layers of a policy that was found with the value function; None:
                multiples of a unit.

        Raises:
            ModelError: no compiled problem has such value functions.
        """

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Return an upper bound of the error of a dual bound that is due to the cap.

        Args:
            price: price of failure of the dual bound.
            slack: whether the dual bound has the form ``cost - price * goal`` (:class:`Proof`).
            proof: a proof at this price, which may save work.
        """
        return 0.0


def unreachable(
    model: SSP,
    start: FloatArray,
    budget: float | None,
    discount: float | None,
    why: str = "no cost given success exists",
) -> InfeasibleError:
    """Return the InfeasibleError of a problem whose goal cannot be reached.

    Args:
        model: the model.
        start: distribution over states, [states].
        budget: failure budget of the problem, or None.
        discount: discount of the problem, or None.
        why: the end of the message: why the problem therefore has no solution.
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
        SolverError: the policy violates the budget, but it is not proved that all policies do.
    """
    least_failure = compiled.least_failure()
    failure, discounted = least_failure.column.failure, compiled.facts.discount is not None
    facts = compiled.facts
    setting = facts.model, facts.start, budget, facts.discount
    if compiled.ratio and least_failure.column.goal <= 0.0:
        raise unreachable(*setting)
    if budget is None or failure <= budget + LEAST_BUDGET:
        return least_failure
    if goal_out_of_reach(facts.model, facts.start):
        raise unreachable(*setting, f"every policy fails surely, above the budget {budget:g}")
    proved = least_failure.proved
    if proved <= budget:
        kind = "discounted failure" if discounted else "failure probability"
        raise SolverError(
            f"the budget {budget:g} may be infeasible: the least {kind} is only proved to lie "
            f"between {proved:.12g} and {failure:.12g}, because runs are too long for double "
            f"precision; use a budget of at least {failure:.12g}"
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


class Tails(Enum):
    """Kinds of stationary policies that a run follows once its cost has passed the cap."""

    LEAST_FAILURE = "the policies of greatest and of least goal probability"
    ANY_WAY = "a policy to the goal that is cheap to find, or failing"
    FAILING = "failing alone, for a bound of the other policies"


_LARGE = 10_000_000
"""From this many entries of a layer on, a policy to the goal is followed, not solved for."""

MOST_STEPS = 256
"""A first cap of more steps is a long shot: the tail policy is no guide."""

_LEAST = 1e-12  # relative rounding of the goal probability that all safest policies attain


@dataclass(frozen=True, eq=False)
class LayerAndTails:
    """The pattern of one layer of accumulated cost, and the tail policies beyond the cap.

    All layers have this pattern. One object therefore serves problems that differ only in the cap
    or the charge, except exponential utilities, which have other tails.
    """

    facts: GoalFacts
    counts_law: bool = False  # whether any charge of the total cost may follow, the mean otherwise
    by_sums: bool = False  # layers are the sums of step costs that can occur, and a unit is 1
    safest_only: bool = False  # only policies of least failure
    may_fail: bool = True  # whether failing may be optimal; otherwise the goal is always better
    utility: ExponentialUtility | None = None
    side: tuple[UpperRow, ...] = ()  # further limits, whose bounds have no effect

    @cached_property
    def safest(self) -> LayerAndTails:
        """The same object with only the pairs that attain the greatest goal probability."""
        return replace(self, safest_only=True)

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        facts = self.facts
        usable = facts.greatest.usable if self.safest_only else None
        how: dict[str, Any] = {"usable": usable, "side": self.side, "by_steps": self.by_sums}
        setting = facts.model, facts.start, facts.discount
        return accumulate_cost(*setting, arrivals=self.counts_law, **how)

    @cached_property
    def guess(self) -> tuple[float, float] | None:
        """Approximate E[cost; goal] and goal probability of a policy to the goal, or None.

        The guess is made in large processes only, where an exact evaluation would take longer than
        a sweep. Both simple tails are then the policy of least goal probability. If this causes an
        error, the cap is raised or the tails become exact.
        """
        base, later = self.base, self.base.later
        is_large = base.instant.nnz == 0 and later.nnz >= _LARGE
        if not is_large or base.quotient.merged.any():
            return None
        if not accelerated(later.nnz, "layers.follow_layer"):
            return None
        directed = goal_approach(self.facts.model)[0]
        return follow_rule(
            base, base.quotient.placed(directed) - base.pair_offsets[:-1], MOST_STEPS
        )

    @cached_property
    def moments(self) -> goal_reach.ReachPolicy | None:
        """The tail policy of an exponential utility; None for any other charge."""
        if self.utility is None:
            return None
        model, greatest = self.facts.model, self.facts.greatest
        keeping = pairs_keeping_goal(model, greatest) if self.utility.bonus > 0.0 else None
        return greatest_moment(model, self.utility.rate, keeping)

    @cached_property
    def cost_horizon(self) -> float:
        """Accumulated cost from which the stationary tail is optimal; 0: unknown."""
        utility, moments = self.utility, self.moments
        if utility is None or moments is None or utility.bonus == 0.0:
            return 0.0
        model, greatest = self.facts.model, self.facts.greatest
        return cost_horizon(model, greatest, moments, utility.rate, utility.bonus)

    @cached_property
    def exact_tails(self) -> LayeredTails:
        """The optimal tails: of least failure, or of greatest moment for exponential utilities."""
        facts, at, moments = self.facts, self.base.quotient.least_over_members, self.moments
        first = facts.safest if moments is None else moments
        last, least, least_cost = first, np.zeros(facts.model.n_states), None
        if self.safest_only:
            least, least_cost = facts.greatest.goal * (1.0 - _LEAST), at(facts.safest.bound)
        elif self.may_fail:
            least, last = facts.least.bound, facts.riskiest
        moment = None if moments is None else -at(-moments.bound)
        return self.tails(first, last, least, least_cost=least_cost, greatest_moment=moment)

    @cached_property
    def simple_tails(self) -> LayeredTails:
        """Tails that are quick to find: a policy to the goal, and one of least goal probability."""
        facts, guess = self.facts, self.guess
        first = facts.riskiest if guess else facts.directed
        return self.tails(first, facts.riskiest, facts.least.bound, exact=False, guess=guess)

    def tails(
        self,
        first: goal_reach.ReachPolicy,
        last: goal_reach.ReachPolicy,
        least: FloatArray,
        *,
        exact: bool = True,
        **more: Any,
    ) -> LayeredTails:
        """Return two tail policies, with bounds of the goal probability of every policy.

        Args:
            first: a policy to the goal.
            last: a policy that fails.
            least: lower bound of the goal probability, [states].
            exact: whether the upper bound is the greatest goal probability, rather than 1.
            more: further fields of the tails.
        """
        facts, at = self.facts, self.base.quotient.least_over_members
        greatest = facts.greatest.bound if exact else np.full(len(least), facts.survival)
        decisions = np.stack([first.decision, last.decision]).astype(np.int32)
        values = TailValues.stacked([first.values, last.values], at)
        return LayeredTails(decisions, values, -at(-greatest), at(least), exact=exact, **more)

    def totals(self, cap: float) -> Totals | None:
        """Return the totals below a cap, in units; None if the sums of step costs are too many."""
        if not self.by_sums:
            return self.base.totals(int(cap))
        model = self.facts.model
        room = min(MOST_SUMS, MOST_ENTRIES // max(self.base.n_nodes, 1))
        sums, steps = sums_in(model, cap, room), step_costs(model)[1]
        if sums is None:
            return None
        return Totals(read_only(np.append(sums, cap)), steps, complete=True)

    def units(self, total: float) -> float:
        """Return a total in units, rounded up if layers are multiples of the unit."""
        return total if self.by_sums else int(min(np.ceil(total / self.base.unit), 1e15))


ATTAINABLE = 1e-10
"""Relative distance of a bound below the least attainable total that counts as 0."""

_MOST_SWEPT = 400_000_000
"""Most pairs of all layers without writing them out: a choice takes a byte for each node."""

_WORTH_SWEEPING = 400  # entries of a layer from which pricing by layers is faster

_ROOM = 6_000_000  # most pairs with layers that are not multiples of a unit
_ROUGHLY = 0.5  # layers of a trial, in those of a first attempt
_CLEARLY = 1e-9  # share of a budget, or of the goal it demands, that exceeds rounding


@dataclass(frozen=True, eq=False)
class CompiledExplicit(CompiledProblem):
    """Minimise a cost, with limits on failure and on other quantities.

    Without a charge this is case M (paper, section 3.1.2), which needs no layers of accumulated
    cost. With a charge of the total cost (section 3.1.1) the objective is E[charge; goal], or
    E[charge | goal] if ``ratio``. If ``budget`` is None, only policies of least failure are
    feasible.
    """

    facts: GoalFacts
    semantics: FailureSemantics
    side: tuple[UpperRow, ...] = ()
    budget: float | None = 1.0
    charge: Charge | None = None
    layer: LayerAndTails | None = None  # of the charge
    ratio: bool = False
    cap: int | None = None  # layers; None: a first guess
    fixed_cap: float | None = None  # the user's cap on accumulated cost
    exact_tails: bool = True  # optimal tails beyond the cap, not the better of two policies
    is_guess: bool = False  # its layers are a guess to find the price
    objective: UpperRow | None = None  # minimised instead of the cost; then without a charge
    resolution: Resolution | None = None  # of layers that are not multiples of a unit
    by_goal: bool = False  # the second reward is minus the goal probability instead of failure
    priced: ExplicitPricing | OpenEndedPricing | None = None  # shared with other bounds

    lowest: ClassVar[float] = 0.0
    is_cap_poor: ClassVar[bool] = False
    cost_horizon: ClassVar[float] = 0.0
    is_whole: ClassVar[bool] = True  # whether other problems on the model can be solved here

    def counting_rare_success(self, budget: float | None) -> Self:
        """Return the problem with the goal counted in place of failure, if success is rare.

        This avoids cancellation in ``1 - failure`` and in limits on the probability of ends.
        """
        demanded = 0.0 if budget is None else required_goal(budget)
        is_rare = 0.0 < demanded < RARE_GOAL
        if demanded == 0.0 and self.ratio:
            is_rare = self.greatest_goal < RARE_GOAL
        side, by_goal = tuple(row.by_digits for row in self.side), self.by_goal or is_rare
        layer = None if self.layer is None else replace(self.layer, side=side)
        return replace(self, side=side, layer=layer, by_goal=by_goal, priced=None)

    @property
    def may_be_rare(self) -> bool:
        """Whether success may be rare: then counting success, not failure, is more precise."""
        is_greatest = self.semantics.aim is Aim.GREATEST_GOAL and self.objective is None
        is_free = self.ratio and self.budget is not None and self._required == 0.0
        return (is_greatest or is_free) and not self.by_goal

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: first the failure row, limited or not."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def sense(self) -> ObjectiveSense:
        """Relation between the minimised value and the stated objective."""
        shift = 0.0 if self.charge is None else max(-self.charge.lowest, 0.0)
        if self.objective is not None:
            return ObjectiveSense(None, shift, self.objective.offset)
        if self.semantics.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(0.0 if self.by_goal else 1.0, shift)
        failing = self.semantics.failing_value + shift
        return ObjectiveSense(failing if self.semantics.maximises else None, shift)

    @property
    def wants_ends(self) -> bool:
        """Whether a row or the objective counts an end other than the goal."""
        rows = self.side if self.objective is None else (*self.side, self.objective)
        return any(row.condition.wants_ends for row in rows)

    @property
    def texts(self) -> tuple[str, ...]:
        """Descriptions of the limited quantities, for messages."""
        ending = "- goal probability" if self.by_goal else FAILURE_ROW
        return (ending, *(row.text for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each row, [rows]; infinite: no limit."""
        granted, demanded = np.inf, self._required
        if self.budget is not None and demanded > 0.0:
            granted = -demanded if self.by_goal else max(self.budget, 0.0)
        return np.array([granted, *(row.bound for row in self.side)])

    @property
    def _required(self) -> float:
        """Least goal probability that the budget requires; 0 without a budget."""
        return 0.0 if self.budget is None else max(required_goal(self.budget), 0.0)

    @cached_property
    def least(self) -> LeastFailure:
        """The policy of least failure; raises InfeasibleError if it violates the budget."""
        return checked_least_failure(self, self.budget)

    def least_failure(self) -> LeastFailure:
        """Return the cheapest policy among those of greatest goal probability."""
        facts, greatest = self.facts, self.facts.greatest_from_start
        self.check_sure()
        how = facts.model, facts.start, self.semantics, facts.discount
        stage = label_failure(*how, greatest.usable)
        begun_from = stage.placed(greatest.decision)
        second = ExplicitPricing(stage, initial_choice=begun_from, by_goal=self.by_goal)
        column = second.minimise(0.0)
        bound = second.prove(0.0, column).bound
        policy = second.policy(column)
        foreign = replace(column, choice=None, totals=None, found_at=None, policy=policy)
        proved = self.proved_failure(greatest, column.failure)
        return LeastFailure(policy, foreign, bound, proved)

    def check_sure(self) -> None:
        """Check that the goal can be reached surely, if failing is forbidden.

        Raises:
            InfeasibleError: no policy reaches the goal surely.
        """
        if not self.semantics.forbids_failing:
            return
        facts = self.facts
        unsure = np.flatnonzero(~surely_reaching(facts.model)[0] & (facts.start > 0.0))
        if not unsure.size:
            return
        words = (
            f"no policy reaches the goal surely from state {facts.model.states[unsure[0]]!r}: the "
            "cost is infinite"
        )
        if goal_out_of_reach(facts.model, facts.start):
            raise unreachable(facts.model, facts.start, 0.0, facts.discount, words)
        raise InfeasibleError(
            f"{words}; use MCMP for the cheapest of the policies that fail least",
            failure_budget=0.0,
            least_failure=self._least_failure_alone,
        )

    def _least_failure_alone(self) -> float:
        """Return the least failure probability of the model.

        As this may take long, InfeasibleError gets the method itself, and calls it only when its
        attribute ``least_failure`` is read.
        """
        model, start = self.facts.model, self.facts.start
        with limited(READING, "the least failure probability was computed"):
            return max(1.0 - goal_reach.greatest_goal_from(model, start), 0.0)

    @property
    def limits_failure(self) -> bool:
        """Whether there is a failure budget below 1."""
        return self.budget is not None and self._required > 0.0

    def at_least_failure(self, *known: Column) -> CompiledExplicit:
        """Return this problem, or that of least failure if the budget equals the least failure.

        Args:
            known: known columns. If one is clearly within the budget, the least failure is not
                computed.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding; case S,
                and the goal cannot be reached; or failing is forbidden and cannot be avoided.
        """
        self.check_sure()
        if self.ratio and all(column.goal <= 0.0 for column in known) and self.greatest_goal <= 0.0:
            facts = self.facts
            raise unreachable(facts.model, facts.start, self.budget, facts.discount)
        if self.budget is None or not self.limits_failure:
            return self
        row = FailureRow(self.budget, self.ratio)
        room = _CLEARLY * min(self.budget, row.required)
        if any(row.slack(column) > room for column in known):
            return self
        if row.slack(self.least.column) > 0.0:
            return self
        return replace(self, budget=None, priced=None)

    @cached_property
    def greatest_goal(self) -> float:
        """Upper bound of every policy's goal probability (discounted, with a discount)."""
        reach = self.facts.greatest_from_start
        return float(self.facts.start @ np.maximum(reach.goal, reach.bound))

    @cached_property
    def least_goal(self) -> float:
        """Lower bound of the goal probability of every policy within the budget."""
        least = float(self.facts.start @ self._least_goals)
        return max(self._required, least, 0.0)

    @property
    def _least_goals(self) -> FloatArray:
        """Lower bound of the goal probability of every policy, [states]."""
        if self.budget is None:
            return self.facts.greatest_from_start.goal * (1.0 - ATTAINABLE)
        return self.facts.least.bound

    @cached_property
    def augmented(self) -> LabelledProcess | written_out.OpenEnded:
        """The process, with each end component that adds nothing to any reward collapsed."""
        facts = self.facts
        if self.priced is not None:
            return cast("LabelledProcess | written_out.OpenEnded", self.priced.augmented)
        if self.charge is None:
            self.check_sure()
            usable = None if self.budget is not None else facts.greatest_from_start.usable
            setting = facts.start, self.semantics, facts.discount, usable
            return label_failure(facts.model, *setting, self.side, self.objective)
        layers = self.layers  # checks the number of pairs
        how = self.base, self.charge, self.sense.shift, self.totals or self.base.totals(layers)
        return written_out.OpenEnded(*how, facts.start, self._least_goals)

    @property
    def is_rounded(self) -> bool:
        """Whether totals are rounded: then values on the process differ from those on the model."""
        return self.totals is not None and not self.totals.exact

    @cached_property
    def totals(self) -> Totals | None:
        """The totals of the layers; None if they are multiples of a unit, or without a charge."""
        if self.resolution is None or self.charge is None:
            return None
        first = written_out.first_total(self.charge, self.facts.typical_cost)
        grows = self.charge.slope > 0.0
        return self.resolution.totals(self.facts.model, first, self._room, grows=grows)

    @property
    def _room(self) -> int:
        """Greatest number of layers that fits into memory."""
        return max(_ROOM // max(len(self.base.gain), 1), 2)  # levels

    def pricing(self) -> ExplicitPricing | OpenEndedPricing:
        """Return the pricing problem, with a price for each row.

        It is solved by backward sweeps over layers or by policy iteration, whichever is faster.

        Raises:
            InfeasibleError: failing is forbidden and cannot be avoided.
        """
        return self._pricing

    @cached_property
    def _pricing(self) -> ExplicitPricing | OpenEndedPricing:
        if self.priced is not None:
            return self.priced
        layered = self.augmented
        if not isinstance(layered, written_out.OpenEnded) or not self._is_swept:
            return self.explicit_pricing
        counting = layered.counting(self.semantics)
        rows = tuple(row.at(counting) for row in self.side)
        return OpenEndedPricing(layered, rows, self.by_goal, self.exact_tails)

    @property
    def _is_swept(self) -> bool:
        """Whether pricing is by backward sweeps: in large processes without zero-cost steps."""
        if self.charge is None or self.base.by_steps or self.base.instant.nnz > 0:
            return False
        return self.base.later.nnz >= _WORTH_SWEEPING

    @cached_property
    def explicit_pricing(self) -> ExplicitPricing:
        """The pricing problem by policy iteration, with a price for each row."""
        if isinstance(self.priced, ExplicitPricing):
            return self.priced
        own = () if self.objective is None else (self.objective,)
        rows = self.row_coefficients((*own, *self.side))
        counted = rows.pop(0) if own else None
        if self.by_goal and self.semantics.aim is Aim.GREATEST_GOAL:
            counted = -self.augmented.process.goal
        sure = None  # a choice that reaches the goal surely
        if self.semantics.forbids_failing and isinstance(self.augmented, LabelledProcess):
            sure = self.augmented.placed(surely_reaching(self.facts.model)[2])
        how = tuple(rows), counted, sure
        return ExplicitPricing(self.augmented, *how, by_goal=self.by_goal)

    def row_coefficients(self, rows: Sequence[UpperRow]) -> list[FloatArray]:
        """Return the coefficients of each row, [process pairs] each."""
        augmented = self.augmented
        if isinstance(augmented, written_out.OpenEnded):
            counting = augmented.counting(self.semantics)
            return [augmented.everywhere(*row.at(counting)) for row in rows]
        facts = self.facts
        counting = counting_of(augmented, facts.start, self.semantics, facts.discount)
        return [np.append(*row.at(counting))[: augmented.process.n_pairs] for row in rows]

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process; raises ModelError if there is no charge."""
        if self.layer is None:
            raise ModelError("the problem counts no accumulated cost, so it has no layers")
        return (self.layer if self.budget is not None else self.layer.safest).base

    @cached_property
    def layers(self) -> int:
        """Number of layers; 1 without a charge. Raises ModelError if there are too many."""
        if self.charge is None:
            return 1
        layers = self.cap if self.totals is None else self.totals.size
        if layers is None:
            typical = self.facts.typical_cost * (_ROUGHLY if self.is_guess else 1.0)
            layers = written_out.first_cap(self.base, self.charge, typical, self.fixed_cap)
        written_out.check_room(self.base, layers, self._most_pairs)
        return layers

    def with_tails(self, *, exact: bool) -> CompiledExplicit:
        """Return the problem with optimal tail policies beyond its cap or, for speed, simple ones.

        Simple tails are used only if failing becomes optimal beyond the cap, where tails matter
        little.
        """
        grows = self.charge is not None and self.charge.slope > 0.0
        if exact == self.exact_tails or not (exact or (grows and self._is_swept)):
            return self
        is_trial = not exact and self.cap is None and self.fixed_cap is None
        return replace(self, exact_tails=exact, is_guess=is_trial, priced=None)

    @property
    def _most_pairs(self) -> int:
        """Limit on the number of pairs, summed over all layers."""
        return _MOST_SWEPT if self._is_swept else written_out.MOST_WRITTEN

    def refined(self, price: float) -> CompiledExplicit | None:
        """Return the problem with more layers or optimal tails; None if it cannot be improved.

        Args:
            price: price of failure at the optimum of this problem. Once the accumulated cost
                exceeds the price, failing is optimal.
        """
        if self.charge is None:
            return None
        exact = None if self.exact_tails else self.with_tails(exact=True)
        if self.fixed_cap is not None:
            return exact
        end = self.layers * self.base.unit if self.totals is None else float(self.totals.values[-1])
        cut = written_out.truncates(self.charge, end)
        if self.resolution is not None and self.totals is not None:
            enough = self.charge.lossless_total(price) if cut else None
            finer = self.resolution.finer(self.totals, enough, self._room)
            if finer is None:
                return None
            return self.at_resolution(finer)
        here, pairs = self.layers, len(self.base.gain)
        lossless = int(np.ceil(CAP_MARGIN * self.charge.lossless_total(price) / self.base.unit)) + 1
        wanted = min(lossless, MOST_GROWTH * here) if lossless > here else 2 * here
        fits = (wanted + 1) * pairs <= self._most_pairs
        if self.is_guess and (lossless <= here or not fits):
            wanted = here
        elif exact is not None and (lossless <= here or not fits):
            return exact
        elif not (cut and fits):
            return None
        return replace(self, cap=wanted, is_guess=False, priced=None)

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledExplicit:
        """Return the problem with as many layers as a value function.

        Raises:
            ModelError: the shape is not [(layers + 1) * nodes + 1].
        """
        if self.charge is None or self.resolution is not None:
            return self
        nodes = self.base.n_nodes
        layers, odd = divmod(values.size - 1, nodes) if nodes else (2, values.size - 1)
        if values.ndim != 1 or odd or layers < 2:
            raise ModelError("values of a wrong shape: pass an array of [(layers + 1) x nodes + 1]")
        return replace(self, cap=layers - 1, priced=None)

    def at_resolution(self, resolution: Resolution) -> CompiledExplicit:
        """Return the problem with other totals, which are not multiples of a unit."""
        layer = self.layer
        if layer is not None and not layer.by_sums:
            layer = replace(layer, by_sums=True)
        return replace(self, resolution=resolution, layer=layer, priced=None)

    def bounded(self, budget: float | None, side: tuple[UpperRow, ...]) -> CompiledExplicit:
        """Return the problem with other bounds.

        The pricing problem is shared, unless a later refinement may change its tails.
        """
        priced = self.pricing() if self.with_tails(exact=False) is self else None
        return replace(self, budget=budget, side=side, priced=priced)

    def charging(self, charge: Charge) -> CompiledExplicit:
        """Return the problem with another charge; its thresholds must be possible total costs."""
        return replace(self, charge=charge, cap=None, priced=None)

    @property
    def n_columns(self) -> int:
        """Number of pairs of the process."""
        return self.augmented.process.n_pairs

    def explicit(self) -> ExplicitProcess:
        """Return the process, which is explicit already."""
        return self.augmented.process
