"""The labelled occupation-measure program of a problem."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import TotalCostCharge
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.column_generation.compiled_problem import CompiledExplicit
from ssp_lp.errors import ModelError
from ssp_lp.methods.rows import rows_optimum, true_figures
from ssp_lp.options import CERTIFYING
from ssp_lp.problem import Problem, compiled_constrained
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_label import label_failure
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.processes.live_rows import cost_means
from ssp_lp.programs.augmented import AugmentedProcess, LabelledModel, LayeredModel
from ssp_lp.programs.occupation_program import OccupationProgram, ProgramRow


def program_of(
    problem: Problem,
    bounds: Mapping[str, float] | None = None,
    start: Hashable | Mapping[Hashable, float] | None = None,
) -> OccupationProgram:
    """Return the labelled program of a problem: a linear program over expected visits.

    With least failure (``failure_budget=None``) it is the program of the second stage: it contains
    only the actions that attain the greatest goal probability, and has no failure row (mathematics,
    section 4).

    In case S there is a layer for each accumulated cost up to a cap: the problem's ``cost_cap``, or
    the cap at which column generation proves the optimum. One last layer stands for all larger
    costs. Runs that reach the goal from this layer are charged less than their cost, so the
    program's optimum is a lower bound of the problem's optimum, also with further rows or other
    bounds. ``OccupationMeasure.beyond`` is the probability of such runs.

    Args:
        problem: a formulation.
        bounds: bounds of rows, by name, that replace the problem's bounds.
        start: a start that replaces the problem's start.

    Returns:
        The labelled program, for any solver.

    Raises:
        ModelError: the criterion is not a linear program (a quantile or a tail mean of cost), or
        the costs have too many sums for an exact program.
        InfeasibleError: the budget is below the least failure.
    """
    if problem.semantics.risk is not None:
        raise ModelError(
            f"{type(problem).__name__} is not a linear program but a search over many: "
            "use CostBoundedReach(...).program() for one fixed cost"
        )
    problem = problem if start is None else replace(cast("Any", problem), start=start)
    inner, horizon = problem.unrolled, problem.horizon
    stated, bounds = compiled_constrained(inner), bounds or {}
    side = tuple(replace(row, bound=bounds.get(row.name, row.bound)) for row in stated.side)
    budget = min(bounds[FAILURE_ROW], 1.0) if FAILURE_ROW in bounds else stated.budget
    compiled = replace(stated, budget=budget, side=side).at_least_failure()
    augmented: AugmentedProcess | None = None
    total = compiled.ratio and isinstance(compiled.charge, TotalCostCharge)
    if total and compiled.budget is None and not inner.has_rows and compiled.fixed_cap is None:
        augmented = _cost_given_success(compiled)  # without accumulated cost
    elif compiled.charge is not None and (compiled.fixed_cap is None or compiled.resolution):
        compiled = rows_optimum(compiled, CERTIFYING, true_figures(inner, compiled)).compiled
        if compiled.totals is not None and not compiled.totals.exact:
            raise ModelError(
                f"too many distinct total costs (over {compiled.layers:,}) for an exact program: "
                "round the costs to fewer distinct values"
            )
    rows = list[ProgramRow]()
    if augmented is None:
        inside = compiled.augmented
        if isinstance(inside, OpenEnded):
            augmented = LayeredModel.of(inside, compiled.facts.start, compiled.semantics)
        else:  # the objective as the cost
            cost = np.ascontiguousarray(compiled.explicit_pricing.rewards[:, 0])
            labelled = replace(inside, process=replace(inside.process, cost=cost))
            facts = compiled.facts
            setting = facts.start, compiled.semantics, facts.discount
            augmented = LabelledModel.of(labelled, *setting)
        limits = compiled.bounds
        if compiled.budget is not None and inner.semantics.aim is Aim.LEAST_COST:
            limits[0] = compiled.budget  # a row even without effect: budgets can vary
        pairs = augmented.part.pairs
        of_side = (row[pairs] for row in compiled.row_coefficients(compiled.side))
        taken = (augmented.process.failure, *of_side)
        bounded = zip(compiled.names, limits, compiled.texts, taken, strict=True)
        for name, bound, words, each in bounded:
            if np.isfinite(bound):
                takes = np.ascontiguousarray(each)
                rows.append(ProgramRow(name, takes, float(bound), words or name))
    asked = "least failure" if budget is None else f"failure budget {budget:g}"
    discount = "" if inner.discount is None else f", discount {inner.discount:g}"
    within = "" if horizon is None else f", within {horizon:,} step{'s' * (horizon > 1)}"
    return OccupationProgram(
        title=f"{type(inner).__name__}, {asked}{discount}{within}",
        objective=_objective_word(inner, compiled),
        augmented=augmented,
        rows=tuple(rows),
        ratio=inner.ratio,
        sense=compiled.sense,
        wants_ends=compiled.wants_ends,
        at_least=compiled.budget is None,
        remade=partial(program_of, problem),
    ).spread_out()


def _cost_given_success(compiled: CompiledExplicit) -> LabelledModel:
    """Return the augmented model of case S with least failure, without accumulated cost.

    All its policies have the greatest goal probability. The cost of each outcome is multiplied by
    the greatest goal probability from its successor, so the total is E[cost; goal].
    """
    facts, semantics = compiled.facts, compiled.semantics
    model, start, greatest = facts.model, facts.start, facts.greatest_from_start
    labelled = label_failure(model, start, semantics, facts.discount, greatest.usable)
    process = labelled.process
    chance = np.where(model.goal_mask, 1.0, greatest.goal)
    cost = labelled.quotient.at_pairs(cost_means(model, chance)) / labelled.escape
    cost = np.append(cost, np.zeros(process.n_pairs - cost.size))
    labelled = replace(labelled, process=replace(process, cost=cost))
    return LabelledModel.of(labelled, start, semantics, facts.discount)


def _objective_word(problem: Problem, compiled: CompiledExplicit) -> str:
    semantics = problem.semantics
    if compiled.objective is not None:
        return "objective"
    if semantics.aim is not Aim.LEAST_COST:
        return "failure" if semantics.aim is Aim.GREATEST_GOAL else "goal"
    if semantics.counts_law:
        return "arrival cost"
    if 0.0 < semantics.penalty < np.inf:
        return f"cost + {semantics.penalty:g} failure"
    return "cost"
