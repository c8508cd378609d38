"""The least E[charge(total cost) | goal] within a failure budget: what every measure is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.compiled_problems.compiled_problem import checked_least_failure
from ssp_lp.column_generation.failure_constraint import Row
from ssp_lp.methods.refinement import SolveOptions, optimise
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.arrival_cost import Charge
from ssp_lp.solution import CUT_SHORT

_ROUNDING = 1e-14
"""A budget above the least failure by this share of the success is meant to be equal to it."""


@dataclass(frozen=True, eq=False)
class Question:
    """The policies among which the least risk is sought."""

    compiled: CompiledArrivalCost  # of the total cost
    budget: float | None  # of failure; None: only policies of least failure
    least: float  # the least failure
    note: str = ""

    def remarks(self, *, in_time: bool) -> str:
        """The note, and whether time ran out."""
        return "; ".join(told for told in (self.note, "" if in_time else CUT_SHORT) if told)

    @property
    def allowed(self) -> float:
        """The failure that is allowed: the budget, or what is least."""
        return self.least if self.budget is None else self.budget

    @property
    def unit(self) -> float:
        """Cost of a layer."""
        return self.compiled.base.unit

    def cost_of(self, layer: int) -> float:
        """The total cost of so many layers, as the nearest float."""
        return float(layer * self.compiled.base.exact_unit)

    def layer_of(self, cost: float) -> int:
        """The layer of a total cost."""
        return round(cost / self.unit)


@dataclass(frozen=True, eq=False)
class Trial:
    """The least E[charge | goal], with its proof."""

    value: float
    lower_bound: float
    policy: MixedPolicy
    kappa: float  # price of failure at the optimum
    calls: int


def pose(problem: Problem, compiled: CompiledArrivalCost) -> Question:
    """Check the budget, and say which policies count.

    A budget above the least failure by no more than rounding counts as equal to it.

    Args:
        problem: says the budget.
        compiled: the accumulated-cost process, whose ratio is the cost given success.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
    """
    budget = problem.failure_budget
    column = checked_least_failure(compiled, budget).column
    least = column.failure
    if budget is not None and budget > least + _ROUNDING * column.goal:
        return Question(compiled, budget, least)
    note = ""
    if budget is not None and budget != least:
        side = "below" if budget < least else "above"
        away = abs(budget - least)
        note = f"the budget lies {away:.1e} {side} the least failure and counts as equal"
    return Question(compiled.safest(), None, least, note)


def attempt(question: Question, charge: Charge, options: SolveOptions, kappa: float = 0.0) -> Trial:
    """Minimise E[charge | goal].

    Args:
        question: the policies that count.
        charge: of the total cost.
        options: engine, tolerance and limits.
        kappa: what the price of failure may be, to choose the size of the table; 0: unknown.
    """
    compiled = charging(question, charge, kappa)
    if question.budget is None:
        pricing = compiled.pricing()
        column = pricing.minimise(0.0)
        policy = MixedPolicy((pricing.policy(column),), np.ones(1))
        value = column.cost / column.goal
        return Trial(value, min(refuted_below(question, compiled, 0.0), value), policy, 0.0, 2)
    outcome = optimise(compiled, question.budget, options)
    found = outcome.found
    return Trial(found.objective, found.lower_bound, outcome.lottery, found.price, outcome.calls)


def charging(question: Question, charge: Charge, kappa: float) -> CompiledArrivalCost:
    """The process with a charge, as large as a price of failure asks for."""
    compiled = question.compiled.charging(charge)
    if kappa <= 0.0 or question.budget is None:
        return compiled
    return question.compiled.charging(charge, compiled.lossless_layers(kappa))


def refuted_below(
    question: Question, compiled: CompiledArrivalCost, kappa: float, *, slack: bool = False
) -> float:
    """One sweep's lower bound of E[charge | goal], at a guess of the price of failure.

    Policies of least failure all fail alike: there the price is 0, whatever the guess.

    Args:
        question: the policies that count.
        compiled: with the charge.
        kappa: the guess.
        slack: the budget is thought to be slack: success is counted rather than failure, which
            is exact where it is best to fail.
    """
    if question.budget is None:
        proof = compiled.pricing().best_bound(0.0)
        return max(proof.bound, 0.0) / min(float(compiled.start @ compiled.greatest.bound), 1.0)
    return Row(question.budget, ratio=True).lower_bound(
        compiled.pricing().best_bound(kappa, slack=slack)
    )
