"""Criteria of the law of the total cost where the sums are too many: costs on a lattice, twice.

With every cost rounded down to a multiple of a unit a model has a lattice of totals, and as no
charge falls as the total grows its optimum bounds every policy of the true model from below. With
every cost rounded up its best policy, which remembers the rounded total, is one of the true model
too: it reaches the goal as often, and later by the rounded costs than by the true ones. So the two
optima enclose the truth, whatever the unit, and approach each other as that gets smaller
(mathematics, section 8). A coarse unit answers in a moment; finer ones follow, by the time left.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from ssp_lp.analysis.total_cost.cost_law import costs_as_counted
from ssp_lp.arrays import SAME_TOTAL, read_only
from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.failure_row import relative_gap
from ssp_lp.compiled.deadline import STOPS, heed, is_late
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.methods.one_row import solve_for_worth
from ssp_lp.methods.risk.least_risk import least_risk
from ssp_lp.methods.risk.question import Near, question_of_compiled
from ssp_lp.methods.rounding_units import rounding_units, span_of_totals
from ssp_lp.model import SSP
from ssp_lp.options import SolveOptions
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, has_rows
from ssp_lp.processes.failure_semantics import FailureSemantics, start_distribution
from ssp_lp.processes.layered.measures_of_law import (
    CostQuantileOf,
    Measure,
    TailMeanOf,
    WithinBound,
)
from ssp_lp.processes.quantities.conditions import Condition
from ssp_lp.processes.totals.lattice import totals_of
from ssp_lp.solution import Solution

_SHARE = 0.1  # of the gap that rounding leaves: as exactly are rounded problems solved next


@dataclass(frozen=True, eq=False)
class Restated:
    """A problem on its model with other costs, or of another worth, the rest as asked."""

    model: SSP
    start: Hashable | Mapping[Hashable, float]
    ratio: bool
    failure_budget: float | None
    semantics: FailureSemantics
    conditions: tuple[Condition, ...] = ()
    discount: None = None

    @property
    def measure(self) -> Measure:
        """What is made of the law of the total cost.

        Raises:
            ModelError: nothing is.
        """
        if self.semantics.measure is None:
            raise ModelError("a criterion of the law of a cost is needed")
        return self.semantics.measure

    def compile(self) -> CompiledArrivalCost:
        """The process on the lattice of the rounded costs."""
        start = start_distribution(self.model, self.start)
        return CompiledArrivalCost(self.model, start, self.measure.charge, self.ratio)

    def solved(self, options: SolveOptions, near: Near | None = None) -> Solution:
        """Its solution, exact but for the rounded costs."""
        if self.measure.maximised:
            return solve_for_worth(self, self.compile(), options)
        question = question_of_compiled(self.compile(), self.failure_budget)
        return least_risk(self, options, question, near)


def solve_on_rounded_costs(problem: Problem, options: SolveOptions) -> Solution:
    """The best policy for rounded costs, and the bound of costs rounded the other way.

    Args:
        problem: a criterion of the law of the total cost, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best: Solution | None = None
    sign = -1.0 if problem.semantics.maximises else 1.0
    bound, span = _no_worse(problem), span_of_totals(problem)
    for unit in rounding_units(problem, span):
        rough = float(unit) / span if best is None else _SHARE * _rounded_gap(best.objective, bound)
        finer = replace(options, tolerance=max(options.tolerance, rough))
        try:
            near = None if best is None else _near_on_rounded_costs(problem, best)
            # the best policy of costs rounded up, on the model itself
            found = _with_rounded_costs(problem, unit, up=True).solved(finer, near)
            members = tuple(_rounding_up(p, problem.model, unit) for p in found.policy.policies)
            found = replace(
                found, policy=MixedPolicy(members, found.policy.weights), value_function=None
            )
            if best is None or sign * found.objective < sign * best.objective:
                best = found
            proved = lattice_bound(problem, unit, finer, near)[0]
            bound = sign * max(sign * bound, sign * proved)
        except STOPS as stop:
            if best is None:
                raise
            heed(stop)
        except ModelError:  # a table of so many layers is too large
            if best is None:
                raise
            break
        if is_late() or _rounded_gap(best.objective, bound) <= options.tolerance:
            break
    if best is None:
        raise SolverError("no unit was tried")
    return _concluded_on_rounded(problem, best, bound, options, unit)


def proved_on_rounded_costs(
    solution: Solution, attained: float, options: SolveOptions
) -> tuple[float, float]:
    """A bound worked out afresh, and the failure that is allowed.

    Units get smaller until the gap is what the solution says, which is taken for no more than that.

    Args:
        solution: of ``solve_on_rounded_costs``.
        attained: what its policy attains.
        options: tolerance and limits.
    """
    problem = solution.problem
    sign = -1.0 if problem.semantics.maximises else 1.0
    rough = replace(options, tolerance=max(options.tolerance, _SHARE * solution.gap))
    enough = max(options.tolerance, (1.0 + _SHARE) * solution.gap)
    bound, allowed = _no_worse(problem), np.inf
    for unit in rounding_units(problem, span_of_totals(problem), finest=True):
        try:
            proved, allowed = lattice_bound(problem, unit, rough)
        except ModelError:  # a table of so many layers is too large
            if np.isinf(allowed):
                raise
            break
        bound = sign * max(sign * bound, sign * proved)
        if _rounded_gap(attained, bound) <= enough:
            break
    return bound, allowed


def lattice_bound(
    problem: Problem, unit: Fraction, options: SolveOptions, near: Near | None = None
) -> tuple[float, float]:
    """What no policy does better than, by costs rounded down, and the failure that is allowed.

    Args:
        problem: the problem.
        unit: of which costs are multiples.
        options: tolerance and limits.
        near: where a search may begin; None: unknown.
    """
    found = _with_rounded_costs(problem, unit, up=False).solved(options, near)
    bound = found.lower_bound if found.upper_bound is None else found.upper_bound
    budget = problem.failure_budget
    return bound, found.budget_used if budget is None else max(budget, found.budget_used)


def is_on_rounded_costs(solution: Solution) -> bool:
    """Whether rounded costs gave a solution, or would: no constraint, and no levels of a grid."""
    problem, levels = solution.problem, levels_of(solution.policy.policies)
    return not has_rows(problem) and levels is None and problem.semantics.measure is not None


def _near_on_rounded_costs(problem: Problem, best: Solution) -> Near | None:
    """Where a risk's search may begin, from the policy of coarser costs."""
    match problem.semantics.measure:
        case CostQuantileOf(level) | TailMeanOf(level):
            quantile = costs_as_counted(best.policy, problem).quantile(level)
            price = best.failure_price
            return Near(quantile, 0.0 if price is None else price + best.objective)
    return None


def _rounding_up(policy: Policy, model: SSP, unit: Fraction) -> CostAwarePolicy:
    """A policy of the model with rounded costs on the model itself.

    One that remembers nothing is given a layer to remember, so that its law is rounded alike.

    Raises:
        ModelError: it remembers something else than the cost paid.
    """
    if isinstance(policy, CostAwarePolicy):
        return replace(policy, model=model, rounds_up=True)
    if not isinstance(policy, DeterministicPolicy):
        raise ModelError(f"a {type(policy).__name__} does not remember the cost paid")
    pair, first = policy.decision, model.pair_offsets[:-1]
    position = np.where(pair < 0, pair, pair - first)[None, :]
    never = np.full(model.n_states, np.inf)
    return CostAwarePolicy(model, float(unit), position, pair[None, :], never, rounds_up=True)


def _with_rounded_costs(problem: Problem, unit: Fraction, *, up: bool) -> Restated:
    """The problem with costs that are multiples of a unit."""
    model = problem.model
    kinds, kind = np.unique(model.costs, return_inverse=True)
    units = kinds / float(unit)
    whole = np.ceil(units * (1.0 - SAME_TOTAL)) if up else np.floor(units * (1.0 + SAME_TOTAL))
    measure = problem.semantics.measure
    if isinstance(measure, WithinBound):  # one step beyond the bound is as late as any
        whole = np.minimum(whole, np.ceil(float(measure.bound) / float(unit)) + 2.0)
    costs = totals_of(whole.astype(np.int64), unit)[kind]
    rounded = replace(model, costs=read_only(costs), exact_costs={})
    asked = problem.start, problem.ratio, problem.failure_budget, problem.semantics
    return Restated(rounded, *asked)


def _no_worse(problem: Problem) -> float:
    """What is known of the optimum before anything is solved."""
    measure = problem.semantics.measure
    if measure is None or not measure.maximised:
        return 0.0
    return problem.semantics.failing_worth - measure.charge.lowest


def _rounded_gap(attained: float, bound: float) -> float:
    """The relative gap between what costs rounded up and down say."""
    return relative_gap(max(attained, bound), min(attained, bound))


def _concluded_on_rounded(
    problem: Problem, best: Solution, bound: float, options: SolveOptions, unit: Fraction
) -> Solution:
    """The best policy with the best bound, and what a reader should know."""
    maximised, attained = problem.semantics.maximises, best.objective
    measure = problem.semantics.measure
    if measure is not None and measure.charge.settled is None and not is_late():
        try:
            attained = measure.of(costs_as_counted(best.policy, problem))  # beyond its table, too
        except STOPS as stop:
            heed(stop)
    told = best.note
    if _rounded_gap(attained, bound) > options.tolerance and not is_late():
        more = "no room for more levels"
        if getattr(problem, "cost_levels", None) is not None:
            more = "more levels leave a smaller gap"
        told = f"costs are rounded to multiples of {float(unit):g}: {more}"
    return replace(
        best,
        problem=problem,
        objective=attained,
        lower_bound=attained if maximised else min(bound, attained),
        upper_bound=max(bound, attained) if maximised else None,
        note=told,
    )
