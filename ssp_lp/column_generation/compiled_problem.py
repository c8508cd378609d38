"""Compiled problems: an augmented process with everything that methods ask of it.

:class:`CompiledExplicit` is written out, with any number of rows: case M, which counts no total, on
the failure label; every charge of the total cost in layers. Where failure alone is limited, layers
need not be written out: case S (:class:`CompiledAccumulatedCost`), and any charge of the total cost
(:class:`CompiledArrivalCost`).
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
    """The cheapest policy among those that fail least (mathematics, section 4: two stages)."""

    policy: Policy
    column: Column  # its cost and failure, both discounted under a discount
    objective_bound: float  # certified lower bound of the objective of every such policy
    proved: float  # certified lower bound of the failure of every policy

    @property
    def is_proved(self) -> bool:
        """Whether no policy fails less than the safest one by as much as budgets may lie below."""
        return self.column.failure - self.proved <= LEAST_BUDGET


class CompiledProblem(ABC):
    """A problem compiled for methods: a process, a charge, rows, a ratio, and how to refine them.

    What is said here holds of a process that is written out and truncates nothing (case M).
    """

    model: SSP
    start: FloatArray  # [states] the distribution in which an episode begins
    discount: float | None  # None: exact
    ratio: bool  # whether the objective is cost / (1 - failure) (case S) rather than cost (case M)
    charge: Charge | None  # of arriving, for the total cost; None: no total is counted (case M)

    @property
    def lowest(self) -> float:
        """Lower bound of the compiled problem's objective that needs no search."""
        return 0.0

    @property
    def is_trial(self) -> bool:
        """Whether the compiled problem only serves to learn the price, hence its size."""
        return False

    @property
    def is_long_shot(self) -> bool:
        """Whether a compiled problem's first size can only be guessed; case M tells of it."""
        return False

    @property
    def cost_horizon(self) -> float:
        """Total from which the compiled problem has a stationary optimal policy; 0: unknown."""
        return 0.0

    @property
    @abstractmethod
    def layers(self) -> int:
        """Number of totals that the compiled problem tells apart; 1 where none is counted."""

    @property
    @abstractmethod
    def n_columns(self) -> int:
        """Columns of the compiled problem's linear program."""

    @property
    def survival(self) -> float:
        """The compiled problem's discount, 1 in the exact setting."""
        return survival_of(self.discount)

    def capped_at(self, cost: float) -> Self:
        """The same with totals told apart up to about this one, for a long shot."""
        return self

    @abstractmethod
    def least_failure(self) -> LeastFailure:
        """The first column: it, not a status of an LP, decides whether the problem is feasible."""

    def proved_failure(self, reach: goal_reach.GoalReach, failure: float) -> float:
        """Lower bound of the failure of every policy of the compiled problem.

        Args:
            reach: the greatest goal probability.
            failure: that of the safest policy.
        """
        proved = reach.least_failure(self.start)
        if failure - proved > PROVED_OF_MANY:  # sweeps may prove what an evaluation leaves open
            again = goal_reach.greatest_goal_reach(
                self.model, self.survival, self.start, last_digits=False
            )
            proved = max(proved, again.least_failure(self.start))
        return min(proved, failure)

    def failure_at_least(self, discount: float | None) -> float:
        """The least failure of all policies of the compiled problem, whatever they cost."""
        survival = survival_of(discount)
        reach = goal_reach.greatest_goal_reach(self.model, survival, self.start).goal
        return max(1.0 - float(self.start @ reach), 0.0)

    @abstractmethod
    def pricing(self) -> PricingProblem:
        """The pricing problem of the compiled problem as it stands."""

    def counting_rare_success(self, budget: float | None) -> Self:
        """The compiled problem with success counted in place of failing where it is rare.

        Args:
            budget: failure budget; None: as low as possible.
        """
        return self

    def for_program(self) -> Self:
        """The compiled problem whose written-out process has the problem's optimum."""
        return self

    @abstractmethod
    def explicit(self) -> ExplicitProcess:
        """The compiled problem's process written out, for the linear program."""

    def explicit_choice(self, column: Column) -> IntArray:
        """The pair of the written-out process that a column takes in each state, [states].

        Raises:
            ModelError: the pricing did not make the column.
        """
        return required(column.choice)

    @abstractmethod
    def refined(self, price: float) -> Self | None:
        """A larger compiled problem with a smaller truncation error; None: there is none.

        Args:
            price: price of failure at the optimum of this one.
        """

    @abstractmethod
    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> Self:
        """The compiled problem whose value functions have the shape of this one.

        Args:
            values: the value function.
            levels: totals that a policy found beside it tells apart; None: multiples of a unit.

        Raises:
            ModelError: none has such value functions.
        """

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """Part of a bound at this price that the compiled problem loses to truncation.

        Args:
            price: of failure.
            slack: whether success is counted rather than failure.
            proof: what was proved at this price, which may save the work.
        """
        return 0.0

    def _copy_with_results(self, other: Self, *own: str) -> Self:
        """Hand what has been worked out to a copy, but for what is each one's own."""
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
    """The error of a problem whose goal is out of reach, where that leaves no answer.

    Args:
        model: the model.
        start: [states].
        budget: failure budget.
        discount: of the problem.
        why: what the answer lacks.
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
    """The compiled problem's column of least failure, which has to keep to the budget.

    Args:
        compiled: the problem.
        budget: failure budget; None: whatever is least.

    Raises:
        InfeasibleError: it does not, or no cost given success exists.
        SolverError: it does not, and it is not proved that no policy does.
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
            f"whether a policy keeps to the budget {budget:g} is not decided: the least {kind} is "
            f"proved to lie between {proved:.12g} and {failure:.12g} only, as runs are too long "
            f"for double precision; a budget of {failure:.12g} can be kept"
        )
    told = f"at least {proved:.12g}, above the budget {budget:g}"
    if f"{proved:.12g}" != f"{failure:.12g}":
        told += f", and the safest known policy with {failure:.12g}"
    if not discounted:
        raise InfeasibleError(
            f"every policy fails with probability {told}",
            "; ",
            Argument("failure_budget", None),
            " asks for the least",
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
"""Largest table of decisions, nodes x layers: 0.8 GB a policy at a byte each."""


def check_compiled_table(layers: int, base: AccumulatedCost, remedy: str) -> None:
    """Raise :class:`ModelError` where a compiled problem's table has too many layers."""
    if (layers + base.width) * base.n_nodes > MOST_ENTRIES:
        raise ModelError(
            f"{layers:.6g} layers of accumulated cost (unit {base.unit:g}) on {base.n_nodes:,} "
            f"states are too many; a coarser grid of costs, or a smaller {remedy}, makes it less"
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
        """The process cut at the cap."""

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
        """Tails: one that goes for the goal, one that fails; and bounds of the goal, [states]."""
        decisions = np.stack([first.decision, last.decision]).astype(np.int32)
        at = self.base.quotient.least_over_members
        values = TailValues.stacked([first.values, last.values], at)
        return LayeredTails(decisions, values, -at(-greatest), at(least), **more)

    @property
    def layers(self) -> int:
        """Layers below the cap."""
        return self.process.cap

    @property
    def n_columns(self) -> int:
        """Pairs of all layers."""
        return self.process.cap * len(self.base.quotient.pair_at)

    def pricing(self) -> LayeredPricing:
        """One backward sweep over the layers."""
        return LayeredPricing(self.process)

    def explicit(self) -> ExplicitProcess:
        """All layers below the cap, written out."""
        return written_out.materialise(self.process)

    def explicit_choice(self, column: Column) -> IntArray:
        """The column's pairs in all layers, its tails beyond them and the source's only pair."""
        return written_out.chosen_pairs(self.process, required(column.choice), column.tail_price)

    def tail_loss(self, price: float, *, slack: bool = False, proof: Proof | None = None) -> float:
        """How much of a bound at this price the cap costs; 0 where it is proved lossless."""
        return self.pricing().tail_loss(price, slack=slack, proof=proof)


_UNPROVED = 1e-10
"""Relative gap at least failure from which pairs are compared in twice the working precision."""

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
class CompiledAccumulatedCost(_CompiledLayered):
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

    ratio = True
    charge = TOTAL_COST

    @cached_property
    def lowest(self) -> float:
        """Compiled problem's lower bound: some steps on the way, each at the least cost."""
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
        """One layer of the compiled problem's accumulated-cost process."""
        return accumulate_cost(self.model, self.start, self.discount)

    @property
    def is_trial(self) -> bool:
        """Whether the compiled problem's cap on the accumulated cost is a guess."""
        return self.cap is None and self.fixed_cap is None and not self._has_exact_tails

    @cached_property
    def _directed(self) -> goal_reach.ReachPolicy:
        """The compiled problem's tail that goes for the goal beyond the accumulated cost's cap."""
        return goal_reach.goal_directed(self.model, self.survival)

    @cached_property
    def _guess(self) -> tuple[float, float] | None:
        """(E[cost; goal], goal), about, of a goal-directed policy of the compiled problem.

        In a large process they take longer than a sweep. Beyond the cap the riskiest policy is then
        followed: where that loses something, the cap is raised or the tails become exact.
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
        """Whether the compiled problem's goal-directed policy takes too long to tell a cap."""
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
        """Whether the compiled problem's tails are those of the least failure."""
        return self.exact_tails or bool(self.base.quotient.merged.any()) or self.is_long_shot

    def capped_at(self, cost: float) -> CompiledAccumulatedCost:
        """The compiled problem with a cap of about this accumulated cost.

        Where the start cannot avoid the goal no cap is beyond loss: the tails are exact at once.
        """
        exact = float(self.start @ self.riskiest[0].goal) > 0.0
        most = MOST_ENTRIES // max(self.base.n_nodes, 1) - 2 * self.base.width
        layers = int(min(np.ceil(cost / self.base.unit), max(most, 0))) + self.base.width
        return self._copy_for_cap(replace(self, cap=layers, exact_tails=exact))

    def least_failure(self) -> LeastFailure:
        """First column: greatest goal probability, then the least E[cost; goal] among its actions.

        At least failure the accumulated cost is not needed: a transition to x' is priced
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
        """The compiled problem's layered process, cut at the cap."""
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
        """The compiled problem with more layers or better tails; None: nothing to improve."""
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
        """The compiled problem with as many layers as the value function, [layers, nodes].

        Its tails are the riskiest policy alone: where the cap loses something with that,
        :meth:`for_program` has the exact ones.

        Raises:
            ModelError: the array has no layers.
        """
        if values.ndim != 2 or values.shape[0] == 0:
            raise ModelError("a value function of shape [layers, nodes] is needed")
        return self._copy_for_cap(replace(self, cap=values.shape[0], is_for_bounds=True))

    def for_program(self) -> CompiledAccumulatedCost:
        """The compiled problem with exact tails: beyond the cap no program does better."""
        if self._has_exact_tails:
            return self
        exact = self._copy_for_cap(replace(self, exact_tails=True))
        return self._copy_for_cap(replace(exact, cap=exact.process.cap))

    def _copy_for_cap(self, other: CompiledAccumulatedCost) -> CompiledAccumulatedCost:
        """A copy of the compiled problem with whatever does not depend on the cap."""
        own = "process", "is_long_shot", "_has_exact_tails", "_tails"
        other = self._copy_with_results(other, *own)
        if "_tails" in vars(self) and self._has_exact_tails == other._has_exact_tails:
            vars(other)["_tails"] = self._tails
        return other

    @cached_property
    def _tails(self) -> LayeredTails:
        """Tails of the compiled problem beyond the cap on accumulated cost."""
        least, riskiest = self.riskiest
        if self._has_exact_tails:
            return self._tails_of(self.safest_policy, riskiest, self.greatest.bound, least.bound)
        first = riskiest if self.is_for_bounds or self._guess else self._directed
        greatest = np.full(self.model.n_states, self.survival)
        guess = None if self.is_for_bounds else self._guess
        return self._tails_of(first, riskiest, greatest, least.bound, exact=False, guess=guess)


_FIRST_TOTALS = 64  # of a first attempt where nothing says how many are needed
_NEARLY = 1.25  # costs given success of a way to the goal: from there on failing may be best
_TYPICAL = 2.5  # layers of a first attempt, in costs given success of the safest policy

_MOST_LAYERS = 100_000
"""Layers of a charge that does not settle, after which the gap that is left is left."""

_DOUBLINGS = 60  # of a cap, if all sums that there are lie below it
_LOWER = 0.5  # cap, times the one whose sums are too many
_BEYOND = 1e-9  # relative distance of a total that lies beyond another
_LEAST = 1e-12  # relative room below the goal probability of policies that all attain it
_OF_TAILS: tuple[str, ...] = ("_tails", "_moments", "cost_horizon")
_LOST = 1e-6  # goal probability that a policy of least failure may lack, by rounding of long runs


@dataclass(frozen=True, eq=False)
class CompiledArrivalCost(_CompiledLayered):
    """Minimise E[charge(total cost); goal], or its ratio to Pr(goal), failure limited; exact.

    The table of accumulated costs ends where the charge has become affine: what is best beyond it
    follows in closed form, or, where the charge still grows, as in case S from the price on at
    which it is best to fail. A charge that never settles is cut and refined.
    """

    model: SSP
    start: FloatArray  # [states]
    charge: Charge
    ratio: bool = False
    safest_only: bool = False  # only policies of least failure
    cap: float | None = None  # total at which the table ends, in units; None: as the charge asks
    by_sums: bool = False  # totals are the sums of steps that can occur, and a unit is 1
    discount: None = None

    @property
    def is_trial(self) -> bool:
        """Whether the compiled problem's cap is a guess to learn the price from."""
        grows = self.charge.slope > 0.0 and not self.safest_only
        return self.by_sums and self.cap is None and grows

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process of the compiled problem with a charge."""
        usable = self.greatest.usable if self.safest_only else None
        return accumulate_cost(
            self.model, self.start, None, arrivals=True, usable=usable, by_steps=self.by_sums
        )

    @cached_property
    def _moments(self) -> goal_reach.ReachPolicy | None:
        """The compiled problem's tail of an exponential utility."""
        if not isinstance(self.charge, ExponentialUtility):
            return None
        keeping = pairs_keeping_goal(self.model, self.greatest) if self.charge.bonus > 0.0 else None
        return greatest_moment(self.model, self.charge.rate, keeping)

    @cached_property
    def cost_horizon(self) -> float:
        """Cost from which the compiled problem's stationary tail is optimal; 0: unknown."""
        charge, moments = self.charge, self._moments
        if moments is None or not isinstance(charge, ExponentialUtility) or charge.bonus == 0.0:
            return 0.0
        return cost_horizon(self.model, self.greatest, moments, charge.rate, charge.bonus)

    @cached_property
    def process(self) -> LayeredProcess:
        """The process of the compiled problem with a charge, cut at the cap."""
        cap = self._first_guess() if self.cap is None else self.cap
        if self.by_sums:
            while (totals := self._totals(cap)) is None:  # as far as there is room: the gap tells
                check_time()
                cap *= _LOWER
        else:
            check_compiled_table(int(cap), self.base, "bound on them")
            totals = self.base.totals(int(cap))
        return LayeredProcess(self.base, totals, self._tails, self.charge)

    def _totals(self, cap: float) -> Totals | None:
        """Sums of steps below a cap as the compiled problem's totals; None: too many."""
        room = min(MOST_SUMS, MOST_ENTRIES // max(self.base.n_nodes, 1))
        sums, steps = sums_in(self.model, cap, room), step_costs(self.model)[1]
        if sums is None:
            return None
        return Totals(read_only(np.append(sums, cap)), steps, complete=True)

    def _units(self, total: float) -> float:
        """A total of the compiled problem in units, whole ones if layers are their multiples."""
        return total if self.by_sums else int(min(np.ceil(total / self.base.unit), 1e15))

    def _settled_units(self) -> float:
        """Total from which the compiled problem has an affine charge, or an optimal tail."""
        settled = self.charge.settled or 0.0
        if isinstance(self.charge, ExponentialUtility):
            return max(self._units(self.cost_horizon), self._least_units)
        if self.base.width == 1 and not self.by_sums:
            return 1  # no step costs anything: nothing is ever paid
        if not self.by_sums:
            return max(layers_within(settled, self.base.exact_unit), 1)
        return max(settled * (1.0 + _BEYOND), self._least_units)

    @property
    def _least_units(self) -> float:
        """The compiled problem's smallest table: one layer; of sums, that of nothing paid."""
        return _BEYOND * float(step_costs(self.model)[1].max()) or 1.0 if self.by_sums else 1

    def _first_guess(self) -> float:
        """The compiled problem's first cap: layers that are surely needed, and some more."""
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
        """Tails of the compiled problem, followed and charged beyond the cap."""
        at, moments = self.base.quotient.least_over_members, self._moments
        first = self.safest_policy if moments is None else moments
        last, least, least_cost = first, np.zeros(self.model.n_states), None
        if self.safest_only:
            least = self.greatest.goal * (1.0 - _LEAST)
            least_cost = at(self.safest_policy.bound)
        elif self.ratio:  # else an arrival is never worse than failing
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
        """Lower bound of a compiled problem with a charge that needs no search."""
        return self.charge.lowest

    def least_failure(self) -> LeastFailure:
        """First column: least charged of the policies that fail least; it may remember the cost.

        Raises:
            ModelError: its runs take so many free steps that what each loses adds up.
        """
        pricing = self.safest().pricing()
        best = pricing.minimise(0.0)
        if best.goal < float(self.start @ self.greatest.goal) - _LOST:
            raise ModelError(
                "free steps take some policy so long that its failure cannot be told; costs of "
                "fewer digits, or none of 0, make it shorter"
            )
        policy, bound = pricing.policy(best), pricing.prove(0.0, best).bound
        greatest = min(float(self.start @ self.greatest.bound), 1.0)
        if self.ratio:
            bound = bound / greatest if greatest > 0.0 else 0.0
        proved = self.proved_failure(self.greatest, best.failure)
        return LeastFailure(policy, replace(best, choice=None, policy=policy), bound, proved)

    def lossless_units(self, price: float) -> float:
        """Total from which a compiled problem's policy best fails at this price, with room.

        As many units as the charge needs to settle where it grows no more from there.
        """
        charge, settled = self.charge, self._settled_units()
        if charge.slope == 0.0:
            return settled
        room = 0 if self.by_sums else 1
        return max(settled, self._units(_MARGIN * charge.lossless(price)) + room)

    def refined(self, price: float) -> CompiledArrivalCost | None:
        """The compiled problem with more layers: as its price asks, else twice as many."""
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
            return self.charging(charge, here)  # the trial's table, for good
        return self.charging(charge, wanted) if fits else None

    def charging(self, charge: Charge, cap: float | None = None) -> CompiledArrivalCost:
        """The compiled problem with another charge and cap; shared work is done once.

        An exponential reward has tails of its own.
        """
        own = _OF_TAILS
        exponential = (isinstance(c, ExponentialUtility) for c in (charge, self.charge))
        if charge == self.charge or not any(exponential):
            vars(self)["_tails"], own = self._tails, ()
        return self._copy_with_results(replace(self, charge=charge, cap=cap), "process", *own)

    def safest(self) -> CompiledArrivalCost:
        """The compiled problem restricted to the policies of least failure."""
        _ = self.safest_policy  # is worked out once
        safest = replace(self, safest_only=True, cap=None)
        return self._copy_with_results(safest, "process", "base", *_OF_TAILS)

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledArrivalCost:
        """The charged compiled problem with as many layers as the value function, [layers, nodes].

        Args:
            values: the value function.
            levels: totals of a policy found beside it, the last of which is the cap.

        Raises:
            ModelError: the array has fewer layers than the charge needs to settle.
        """
        least = self._settled_units()
        if values.ndim != 2 or values.shape[0] < (1 if self.by_sums else least):
            raise ModelError(f"a value function of {least} or more layers is needed")
        if not self.by_sums:
            return self.charging(self.charge, values.shape[0])
        cap, n_layers, end = least, values.shape[0], None
        while self._totals(cap) is None:  # as far as there was room
            check_time()
            cap *= _LOWER
        if levels is not None and levels[-1] >= cap:
            capped = self.charging(self.charge, float(levels[-1]))
            if capped.process.cap == n_layers:
                return capped
        for _ in range(_DOUBLINGS):
            if (totals := self._totals(cap)) is None:
                break
            if totals.size >= n_layers:  # the greatest cap below which there are so many sums
                end = float(totals.values[n_layers])
            if totals.size > n_layers:
                break
            cap *= 2.0
        if end is None:
            raise ModelError("a value function of fewer layers is needed")
        return self.charging(self.charge, end)


ATTAINABLE = 1e-10
"""A bound this much below the least attainable total, relative to it, counts as equal to it."""

_MOST_SWEPT = 400_000_000
"""Pairs of all layers of a process that is not written out: a choice takes a byte for each node."""

_WORTH_SWEEPING = 400  # entries of a layer from which pricing by layers pays

_ROOM = 6_000_000  # pairs of a process on levels, each of which is priced many times
_ROUGHLY = 0.5  # of the layers of a first attempt, those of a trial, which can be taken on
_CLEARLY = 1e-9  # share of a budget, or of the success that it demands: more than rounding
_OWN = {"augmented", "explicit_pricing", "_pricing", "totals", "layers"}
"""What depends on the charge, the cap or the resolution."""


@dataclass(frozen=True, eq=False)
class CompiledExplicit(CompiledProblem):
    """Minimise a cost, failure and other quantities limited; a budget of None: at least failure.

    Without a charge this is case M (paper, section 3.1.2), nothing truncated. With one, arriving is
    charged for the total cost (section 3.1.1), E[charge; goal], or E[charge | goal] as ``ratio``.
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
    exact_tails: bool = True  # beyond the cap of layers the best is done, not about the best
    is_trial: bool = False  # its layers are a guess, to learn the price from
    objective: UpperRow | None = None  # minimised in place of the cost; no charge then
    resolution: Resolution | None = None  # totals that are no multiples of a unit
    by_goal: bool = False  # success, as minus the goal, is counted in place of failing

    is_whole: ClassVar[bool] = True  # other questions can be asked of the model as well

    def counting_rare_success(self, budget: float | None) -> Self:
        """The compiled problem with success counted in place of failing where it is rare.

        Nothing is then one minus a small number: not the goal, nor what a limit asks of an end.
        """
        demanded = 0.0 if budget is None else demanded_goal(budget)
        side = tuple(row.by_digits for row in self.side)
        is_rare = 0.0 < demanded < RARE_GOAL
        if demanded == 0.0 and self.ratio:
            is_rare = self.greatest_goal < RARE_GOAL
        return replace(self, side=side, by_goal=self.by_goal or is_rare)

    @property
    def may_be_rare(self) -> bool:
        """Whether rows alone may make success rare, which is not counted by itself yet."""
        is_greatest = self.semantics.aim is Aim.GREATEST_GOAL and self.objective is None
        is_free = self.ratio and self.budget is not None and self._demanded == 0.0
        return (is_greatest or is_free) and not self.by_goal

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the compiled problem's rows: the failure row first, limited or not."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def sense(self) -> ObjectiveSense:
        """Sense of the compiled problem: how its minimum stands for the optimum asked for."""
        shift = 0.0 if self.charge is None else max(-self.charge.lowest, 0.0)
        if self.objective is not None:
            return ObjectiveSense(None, shift, self.objective.offset)
        if self.semantics.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(0.0 if self.by_goal else 1.0, shift)
        failing = self.semantics.failing_worth + shift
        return ObjectiveSense(failing if self.semantics.maximises else None, shift)

    @property
    def wants_ends(self) -> bool:
        """Whether the compiled problem's rows or objective ask for an end other than the goal."""
        rows = self.side if self.objective is None else (*self.side, self.objective)
        return any(row.condition.wants_ends for row in rows)

    @property
    def told(self) -> tuple[str, ...]:
        """Words for the quantities that the compiled problem's rows bound."""
        ending = "- goal probability" if self.by_goal else FAILURE_ROW
        return (ending, *(row.told for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each of the compiled problem's rows; infinite: no limit, [rows]."""
        granted, demanded = np.inf, self._demanded
        if self.budget is not None and demanded > 0.0:
            granted = -demanded if self.by_goal else max(self.budget, 0.0)
        return np.array([granted, *(row.bound for row in self.side)])

    @property
    def _demanded(self) -> float:
        """Goal probability that the compiled problem's budget demands; 0: none."""
        return 0.0 if self.budget is None else max(demanded_goal(self.budget), 0.0)

    @cached_property
    def least(self) -> LeastFailure:
        """The compiled problem's column of least failure; InfeasibleError: it breaks the budget."""
        return checked_least_failure(self, self.budget)

    def least_failure(self) -> LeastFailure:
        """First column: greatest goal probability, then the least cost among its actions."""
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
        """Check that the compiled problem's goal can be reached surely, if failing is forbidden.

        Raises:
            InfeasibleError: it cannot.
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
            f"{words}; MCMP asks for the cheapest of the policies that fail least",
            failure_budget=0.0,
            least_failure=self._least_failure_alone,
        )

    def _least_failure_alone(self) -> float:
        """The compiled problem's least failure probability, for an error that is asked for it."""
        with limited(READING, "the least failure probability was worked out"):
            return max(1.0 - goal_reach.greatest_goal_from(self.model, self.start), 0.0)

    @property
    def limits_failure(self) -> bool:
        """Whether the compiled problem has a failure budget that some policy may break."""
        return self.budget is not None and self._demanded > 0.0

    def settled(self, *known: Column) -> CompiledExplicit:
        """The compiled problem at least failure, where the budget does not exceed that.

        Args:
            known: columns, of which one may show that it does.

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
        """Upper bound of the compiled problem's goal probability, discounted where that is."""
        reach = self.greatest
        return float(self.start @ np.maximum(reach.goal, reach.bound))

    @cached_property
    def greatest(self) -> goal_reach.GoalReach:
        """The compiled problem's greatest goal probability from the start, and its pairs."""
        return goal_reach.greatest_goal_reach(self.model, self.survival, self.start)

    @cached_property
    def least_goal(self) -> float:
        """Goal probability that every policy within the compiled problem's budget has at least."""
        least = float(self.start @ self._least_goals)
        return max(self._demanded, least, 0.0)

    @cached_property
    def _least_goals(self) -> FloatArray:
        """Goal probability that every policy of the compiled problem attains, [states]."""
        if self.budget is None:
            return self.greatest.goal * (1.0 - ATTAINABLE)
        return goal_reach.least_goal_reach(self.model, self.survival).bound

    @cached_property
    def augmented(self) -> FailureLabelled | written_out.OpenEnded:
        """The compiled problem's process, collapsed where it is free in all that is counted."""
        if self.charge is None:
            self.check_sure()
            usable = None if self.budget is not None else self.greatest.usable
            setting = self.start, self.semantics, self.discount, usable
            return label_failure(self.model, *setting, self.side, self.objective)
        layers = self.layers  # checks that there is room
        how = self.base, self.charge, self.sense.shift, self.totals or self.base.totals(layers)
        return written_out.OpenEnded(*how, self.start, self._least_goals)

    @property
    def is_rounded(self) -> bool:
        """Whether the compiled problem rounds totals: its policies are not the model's."""
        return self.totals is not None and not self.totals.exact

    @cached_property
    def totals(self) -> Totals | None:
        """Totals that the compiled problem tells apart, where they are no multiples of a unit."""
        if self.resolution is None or self.charge is None:
            return None
        first = written_out.first_total(self.charge, self.typical_cost)
        return self.resolution.totals(self.model, first, self._room, grows=self.charge.slope > 0.0)

    @property
    def _room(self) -> int:
        """Number of totals that a compiled problem with rows has room for."""
        return max(_ROOM // max(len(self.base.gain), 1), 2)  # levels

    def pricing(self) -> ExplicitPricing | OpenEndedPricing:
        """The compiled problem's pricing with a price for each row: by layers where that pays.

        Raises:
            InfeasibleError: failing is forbidden and cannot be avoided.
        """
        return self._pricing

    @cached_property
    def _pricing(self) -> ExplicitPricing | OpenEndedPricing:
        """The pricing problem, kept."""
        layered = self.augmented
        if not isinstance(layered, written_out.OpenEnded) or not self._is_swept:
            return self.explicit_pricing
        counting = layered.counting(self.semantics)
        rows = tuple(row.at(counting) for row in self.side)
        return OpenEndedPricing(layered, self.precise, rows, self.by_goal, self.exact_tails)

    @property
    def _is_swept(self) -> bool:
        """Whether the compiled problem prices layer by layer: large ones without free pairs."""
        if self.charge is None or self.base.by_steps or self.base.instant.nnz > 0:
            return False
        return self.base.later.nnz >= _WORTH_SWEEPING

    @cached_property
    def explicit_pricing(self) -> ExplicitPricing:
        """The compiled problem's pricing by policy iteration, with a price for each row."""
        own = () if self.objective is None else (self.objective,)
        rows = self.row_coefficients((*own, *self.side))
        counted = rows.pop(0) if own else None
        if self.by_goal and self.semantics.aim is Aim.GREATEST_GOAL:
            counted = -self.augmented.process.goal
        how = self.precise, tuple(rows), counted, self._sure_choice
        return ExplicitPricing(self.augmented, *how, by_goal=self.by_goal)

    @property
    def _sure_choice(self) -> IntArray | None:
        """The compiled problem's choice that surely reaches the goal; None: it may fail."""
        augmented = self.augmented
        if not self.semantics.forbids_failing or isinstance(augmented, written_out.OpenEnded):
            return None
        return augmented.placed(surely_reaching(self.model)[2])

    def row_coefficients(self, rows: Sequence[UpperRow]) -> list[FloatArray]:
        """Coefficients of the compiled problem's rows at each pair, [process pairs] each."""
        augmented = self.augmented
        if isinstance(augmented, written_out.OpenEnded):
            counting = augmented.counting(self.semantics)
            return [augmented.everywhere(*row.at(counting)) for row in rows]
        counting = counting_of(augmented, self.start, self.semantics, self.discount)
        return [np.append(*row.at(counting))[: augmented.process.n_pairs] for row in rows]

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the compiled problem's process with rows."""
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
        """Cost given success of the compiled problem's least failing policy, to size a table."""
        safest = goal_reach.cheapest_reach(self.model, self.greatest, self.survival).values
        return float(self.start @ safest.cost) / max(float(self.start @ safest.goal), 1e-300)

    @property
    def _cost_of_a_way(self) -> float:
        """Cost given success of a policy that goes for the goal, to size a trial's table."""
        directed = goal_reach.goal_directed(self.model, self.survival).values
        cost, goal = float(self.start @ directed.cost), float(self.start @ directed.goal)
        return cost / max(goal, 1e-300)

    @cached_property
    def layers(self) -> int:
        """Totals of the compiled problem; 1: none counted. ModelError: too many to write out."""
        if self.charge is None:
            return 1
        layers = self.cap if self.totals is None else self.totals.size
        if layers is None:
            typical = _ROUGHLY * self._cost_of_a_way if self.is_trial else self.typical_cost
            layers = written_out.first_cap(self.base, self.charge, typical, self.fixed_cap)
        written_out.check_room(self.base, layers, self._most_pairs)
        return layers

    def with_tails(self, *, exact: bool) -> CompiledExplicit:
        """The compiled problem with what is best beyond its cap, or, to search fast, about that.

        Where failing is best beyond the cap little hangs on it; elsewhere tails stay exact.
        """
        grows = self.charge is not None and self.charge.slope > 0.0
        if exact == self.exact_tails or not (exact or (grows and self._is_swept)):
            return self
        is_trial = not exact and self.cap is None and self.fixed_cap is None
        other = replace(self, exact_tails=exact, is_trial=is_trial)
        return self._copy_with_results(other, *_OWN)

    @property
    def _most_pairs(self) -> int:
        """Most pairs that the compiled problem's layers have room for together."""
        return _MOST_SWEPT if self._is_swept else written_out.MOST_WRITTEN

    def refined(self, price: float) -> CompiledExplicit | None:
        """The compiled problem with more layers, or more digits if no total counts; None: no more.

        Args:
            price: what failing is worth, from which accumulated cost on it is best to fail.
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
        """The compiled problem with as many layers as a value function; or ModelError."""
        if self.charge is None or self.resolution is not None:
            return self
        nodes = self.base.n_nodes
        layers, odd = divmod(values.size - 1, nodes) if nodes else (2, values.size - 1)
        if values.ndim != 1 or odd or layers < 2:
            raise ModelError("a value function of [(layers + 1) x nodes + 1] is needed")
        return self._copy_with_results(replace(self, cap=layers - 1), *_OWN)

    def bounded(self, budget: float | None, side: tuple[UpperRow, ...]) -> CompiledExplicit:
        """The same rows with other bounds: all else that is known of the process is handed on."""
        return self._copy_with_results(
            replace(self, budget=budget, side=side), "least", "least_goal"
        )

    def charging(self, charge: Charge) -> CompiledExplicit:
        """The compiled problem with another charge, if its arrivals lie on the lattice of costs."""
        return self._copy_with_results(replace(self, charge=charge, cap=None), *_OWN)

    @property
    def n_columns(self) -> int:
        """Pairs of the compiled problem's process."""
        return self.augmented.process.n_pairs

    def explicit(self) -> ExplicitProcess:
        """The compiled problem's process, which is written out already."""
        return self.augmented.process
