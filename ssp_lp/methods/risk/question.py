"""The least E[charge(total cost) | goal] within a failure budget: what every measure is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.analysis.total_cost.cost_law import CostLaw, success_costs
from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.compiled_problems.compiled_problem import checked_least_failure
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.column_generation.initial_columns import DualGuess
from ssp_lp.column_generation.pricing.pricing_problem import Proof, required
from ssp_lp.errors import ModelError
from ssp_lp.methods.refinement import refined_optimum
from ssp_lp.methods.risk.thresholds import ThresholdMultiples, Thresholds, ThresholdSums
from ssp_lp.methods.rows.lottery import Truth, taken_by_lottery
from ssp_lp.methods.rows.proof import bound_at, least_goal_within
from ssp_lp.methods.rows.rows_optimum import rows_optimum
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, by_rows, compiled_constrained
from ssp_lp.processes.layered.charges import Charge, ExcessCharge, LateCharge, TotalCostCharge
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT

_AHEAD = 8.0  # typical costs up to which all sums must be few to be told apart
_FINE = 500  # thresholds in a typical cost, where totals are rounded
_NEARBY = 1e-2  # relative uncertainty of a price of failure from another threshold
_ROUNDING = 1e-14
"""A budget above the least failure by this share of the success is meant to be equal to it."""


@dataclass(frozen=True, eq=False)
class Trial:
    """The least E[charge | goal], with its proof."""

    value: float
    lower_bound: float
    policy: MixedPolicy
    kappa: float  # price of failure at the optimum
    calls: int
    prices: Mapping[str, float] = field(default_factory=dict)  # of constraints, by name


class Near(NamedTuple):
    """Where a search may begin: what is known from rounder costs."""

    total: float  # quantile of a good policy
    kappa: float  # what failing is worth there; 0: unknown


@dataclass(frozen=True, eq=False)
class _QuestionWithinBudget:
    """Failure alone is limited."""

    compiled: CompiledArrivalCost  # of the total cost
    budget: float | None  # of failure; None: only policies of least failure
    least: float  # the least failure
    typical: float  # a cost given success: of the policy that fails least
    note: str = ""

    @cached_property
    def thresholds(self) -> Thresholds:
        """The totals that can occur."""
        if self.compiled.by_sums:
            return ThresholdSums(self.compiled.model)
        return ThresholdMultiples(self.compiled.base.exact_unit)

    @property
    def allowed(self) -> float:
        """The failure that is allowed: the budget, or what is least."""
        return self.least if self.budget is None else self.budget

    def attempt(self, charge: Charge, options: SolveOptions, kappa: float = 0.0) -> Trial:
        """Minimise E[charge | goal] by one search.

        Args:
            charge: of the total cost.
            options: method, tolerance and limits.
            kappa: what the price of failure may be, to choose the size of the table; 0: unknown.
        """
        compiled = self._charging(charge, kappa)
        if self.budget is None:
            pricing = compiled.pricing()
            column = pricing.minimise(0.0)
            policy = MixedPolicy((pricing.policy(column),), np.ones(1))
            value = column.cost / column.goal
            return Trial(value, min(self._bound(compiled, 0.0), value), policy, 0.0, 2)
        guess = DualGuess(kappa, _NEARBY) if kappa > 0.0 else None
        outcome = refined_optimum(compiled, self.budget, options, guess)
        found = outcome.found
        return Trial(
            found.objective, found.lower_bound, outcome.lottery, found.price, outcome.calls
        )

    def refuted_below(
        self, charge: Charge, kappa: float, prices: Mapping[str, float], *, slack: bool = False
    ) -> float:
        """A lower bound of E[charge | goal] by one sweep at a guess of what failing is worth.

        Policies of least failure all fail alike: there no price matters.

        Args:
            charge: of the total cost.
            kappa: the guess.
            prices: guesses of the multipliers of further rows, by name; there are none.
            slack: the budget is thought to be slack: success is counted rather than failure, which
                is exact where it is best to fail.
        """
        return self._bound(self._charging(charge, kappa), kappa, slack=slack)

    def late_shares(
        self, number: int, kappa: float, prices: Mapping[str, float], *, slack: bool = False
    ) -> Callable[[int], float]:
        """Lower bounds of Pr(C > B | goal) for the bounds B up to one, by their numbers.

        What is best depends on what is left of the bound alone. So where layers are multiples of a
        unit one sweep for the greatest bound answers all: whoever begins with as much paid as parts
        two bounds has the lesser one left.

        Args:
            number: of the greatest bound.
            kappa: what failing is thought to be worth.
            prices: of further rows, by name; there are none.
            slack: as of :meth:`refuted_below`.
        """
        charge = LateCharge(self.thresholds.total(number))
        if self.compiled.by_sums:
            return lambda k: self.refuted_below(
                LateCharge(self.thresholds.total(k)), kappa, prices, slack=slack
            )
        compiled = self.compiled.charging(charge)
        price = 0.0 if self.budget is None else kappa
        proof = compiled.pricing().prove(price, slack=slack and self.budget is not None)
        by_layer = required(proof.by_layer)
        last = len(by_layer) - 1
        return lambda k: self._share(replace(proof, bound=by_layer[min(number - k, last)]))

    def _charging(self, charge: Charge, kappa: float) -> CompiledArrivalCost:
        """The process with a charge, as large as a price of failure asks for."""
        compiled = self.compiled.charging(charge)
        if kappa <= 0.0 or self.budget is None:
            return compiled
        return self.compiled.charging(charge, compiled.lossless_units(kappa))

    def _bound(self, compiled: CompiledArrivalCost, kappa: float, *, slack: bool = False) -> float:
        """One sweep's bound at a price of failure."""
        kappa, slack = (0.0, False) if self.budget is None else (kappa, slack)
        return self._share(compiled.pricing().prove(kappa, slack=slack))

    def _share(self, proof: Proof) -> float:
        """A bound given success, from one of every policy's value."""
        if self.budget is not None:
            return FailureRow(self.budget, ratio=True).lower_bound(proof)
        greatest = float(self.compiled.start @ self.compiled.greatest.bound)
        return max(proof.bound, 0.0) / min(greatest, 1.0)


@dataclass(frozen=True, eq=False)
class _QuestionWithinRows:
    """Other quantities are limited, too."""

    problem: Problem
    compiled: CompiledConstrained  # of the total cost

    @cached_property
    def thresholds(self) -> Thresholds:
        """The totals that can occur, or those of a grid."""
        if self.compiled.rungs is None:
            return ThresholdMultiples(self.compiled.base.exact_unit)
        try:
            found = ThresholdSums(self.compiled.model)
            found.number(_AHEAD * self.compiled.typical_cost)
        except ModelError:
            return ThresholdMultiples(Fraction(self.compiled.typical_cost / _FINE), sharp=False)
        return found

    @property
    def budget(self) -> float | None:
        """Of failure; None: only policies of least failure."""
        return self.compiled.budget

    @property
    def allowed(self) -> float:
        """The failure that is allowed: the budget, or what is least."""
        if self.budget is not None:
            return self.budget
        return max(1.0 - self.compiled.least_goal, 0.0)

    @property
    def typical(self) -> float:
        """The cost given success of the policy that fails least."""
        return self.compiled.typical_cost

    @property
    def note(self) -> str:
        """No note: nothing is rounded here."""
        return ""

    def attempt(self, charge: Charge, options: SolveOptions, kappa: float = 0.0) -> Trial:
        """Minimise E[charge | goal] by column generation with all rows."""
        del kappa  # the table grows until its gap is closed
        found = rows_optimum(self.compiled.charging(charge), options, self._truth(charge))
        failing = found.prices.get(FAILURE_ROW, 0.0) + found.value
        return Trial(found.value, found.bound, found.policy, failing, found.calls, found.prices)

    def refuted_below(
        self, charge: Charge, kappa: float, prices: Mapping[str, float], *, slack: bool = False
    ) -> float:
        """The bound at the prices of another charge's optimum."""
        del slack
        ratio = kappa - prices.get(FAILURE_ROW, 0.0)
        return bound_at(self.compiled.charging(charge), prices, ratio, self._least_goal)

    @cached_property
    def _least_goal(self) -> float:
        """A goal probability that all lotteries within the rows have."""
        bounds = self.compiled.bounds
        return least_goal_within(self.compiled, np.where(np.isfinite(bounds), bounds, 0.0))

    def late_shares(
        self, number: int, kappa: float, prices: Mapping[str, float], *, slack: bool = False
    ) -> Callable[[int], float]:
        """Lower bounds of Pr(C > B | goal) by the numbers of bounds B, a sweep for each.

        Args:
            number: of the greatest bound that is asked for.
            kappa: what failing is thought to be worth.
            prices: of further rows, by name.
            slack: as of :meth:`refuted_below`.
        """
        del number
        total = self.thresholds.total
        return lambda k: self.refuted_below(LateCharge(total(k)), kappa, prices, slack=slack)

    def _truth(self, charge: Charge) -> Truth:
        """The charge of a lottery given success, by the law of its total cost."""

        def value(policy: MixedPolicy) -> float:
            """The charge given success of a lottery."""
            law = success_costs(policy, self.problem)
            return _expected_in_question(charge, law) / law.goal

        def figures(policy: Policy) -> FloatArray:
            """Charge, failure and rows of one policy."""
            law, found = success_costs(policy, self.problem), evaluate(policy, self.problem)
            spent = taken_by_lottery(self.compiled, found)
            return np.array([_expected_in_question(charge, law), found.failure_probability, *spent])

        return Truth(value, figures)


Question = _QuestionWithinBudget | _QuestionWithinRows
"""The policies among which the least risk is sought."""


def _expected_in_question(charge: Charge, law: CostLaw) -> float:
    """E[charge; goal].

    Raises:
        ModelError: no charge of a risk.
    """
    match charge:
        case TotalCostCharge():
            return law.cost
        case LateCharge(bound):
            return law.goal - law.within(bound)
        case ExcessCharge(threshold, share):
            return threshold * law.goal + law.excess(threshold) / share
    raise ModelError(f"{charge!r} is no charge of a risk")


def question_of(problem: Problem) -> Question:
    """Check the budget, and say which policies count.

    A budget above the least failure by no more than rounding counts as equal to it.

    Args:
        problem: a criterion given success.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
        ModelError: the problem is not compiled to accumulated costs.
    """
    if by_rows(problem):
        return _QuestionWithinRows(problem, compiled_constrained(problem).settled())
    compiled = problem.compile()
    if not isinstance(compiled, CompiledArrivalCost):
        raise ModelError(f"{type(problem).__name__}: risk needs the accumulated-cost process")
    return question_of_compiled(compiled, problem.failure_budget)


def question_of_compiled(compiled: CompiledArrivalCost, budget: float | None) -> Question:
    """The same of a problem whose failure alone is limited, already compiled.

    Args:
        compiled: of the total cost.
        budget: of failure; None: only policies of least failure count.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
    """
    column = checked_least_failure(compiled, budget).column
    least, typical = column.failure, column.cost / column.goal
    if budget is not None and budget > least + _ROUNDING * column.goal:
        return _QuestionWithinBudget(compiled, budget, least, typical)
    note = ""
    if budget is not None and budget != least:
        side = "below" if budget < least else "above"
        away = abs(budget - least)
        note = f"the budget lies {away:.1e} {side} the least failure and counts as equal"
    return _QuestionWithinBudget(compiled.safest(), None, least, typical, note)


def question_remarks(question: Question, *, in_time: bool) -> str:
    """The note, and whether time ran out."""
    return "; ".join(told for told in (question.note, "" if in_time else CUT_SHORT) if told)
