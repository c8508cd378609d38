"""From a problem to its occupation-measure program."""

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
from ssp_lp.programs.augmented import Augmented, LabelledModel, LayeredModel
from ssp_lp.programs.occupation_program import OccupationProgram, ProgramRow


def program_of(
    problem: Problem,
    bounds: Mapping[str, float] | None = None,
    start: Hashable | Mapping[Hashable, float] | None = None,
) -> OccupationProgram:
    """The labelled program of a problem: linear, over expected visits, with its optimum.

    At least failure (``failure_budget=None``) it is the program of the second stage: over the
    actions that attain the greatest goal probability, without a failure row (mathematics, section
    4). In case S accumulated costs are told apart up to where column generation proves the
    optimum, or up to the problem's ``cost_cap``; from there on one place stands for all of them,
    and arriving is charged as if it had just been reached. So the program bounds the problem from
    below, whatever rows and bounds it is given, and ``OccupationMeasure.beyond`` says how much is
    charged too little.

    Args:
        problem: a formulation.
        bounds: other bounds of rows than the problem's, by name.
        start: another start than the problem's.

    Returns:
        The program: labelled, and open to every solver.

    Raises:
        ModelError: the criterion is no linear program (a quantile or a tail mean of the cost).
        InfeasibleError: the budget is below the least failure.
    """
    if problem.requirements.is_risk:
        raise ModelError(
            f"{type(problem).__name__} is no linear program but a search over many: "
            "CostBoundedReach(...).program() is the one at a fixed cost"
        )
    problem = problem if start is None else replace(cast("Any", problem), start=start)
    inner, horizon = problem.unrolled, problem.horizon
    stated, bounds = compiled_constrained(inner), bounds or {}
    side = tuple(replace(row, bound=bounds.get(row.name, row.bound)) for row in stated.side)
    budget = min(bounds[FAILURE_ROW], 1.0) if FAILURE_ROW in bounds else stated.budget
    compiled = replace(stated, budget=budget, side=side).settled()
    augmented: Augmented | None = None
    total = compiled.ratio and isinstance(compiled.charge, TotalCostCharge)
    if total and compiled.budget is None and not inner.has_rows and compiled.fixed_cap is None:
        augmented = _cost_given_success(compiled)  # where no total has to be remembered
    elif compiled.charge is not None and (compiled.fixed_cap is None or compiled.resolution):
        compiled = rows_optimum(compiled, CERTIFYING, true_figures(inner, compiled)).compiled
        if compiled.totals is not None and not compiled.totals.exact:
            raise ModelError(
                f"the costs have more than {compiled.layers:,} sums: on a grid of totals the "
                "program is a bound, no problem; fewer distinct costs make it one"
            )
    rows = list[ProgramRow]()
    if augmented is None:
        inside = compiled.augmented
        if isinstance(inside, OpenEnded):
            augmented = LayeredModel.of(inside, compiled.start, compiled.semantics)
        else:  # what is minimised as the cost
            cost = np.ascontiguousarray(compiled.explicit_pricing.rewards[:, 0])
            labelled = replace(inside, process=replace(inside.process, cost=cost))
            setting = compiled.start, compiled.semantics, compiled.discount
            augmented = LabelledModel.of(labelled, *setting)
        limits = compiled.bounds
        if compiled.budget is not None and inner.semantics.aim is Aim.LEAST_COST:
            limits[0] = compiled.budget  # a row even where it limits nothing: sweeps begin there
        pairs = augmented.part.pairs
        of_side = (row[pairs] for row in compiled.row_coefficients(compiled.side))
        taken = (augmented.process.failure, *of_side)
        bounded = zip(compiled.names, limits, compiled.told, taken, strict=True)
        for name, bound, words, each in bounded:
            if np.isfinite(bound):
                takes = np.ascontiguousarray(each)
                rows.append(ProgramRow(name, takes, float(bound), words or name))
    asked = "least failure" if budget is None else f"failure budget {budget:g}"
    discount = "" if inner.discount is None else f", discount {inner.discount:g}"
    within = "" if horizon is None else f", within {horizon:,} steps"
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
    """Cost in the labelled program at least failure: each step's, by success from its end.

    All policies have the greatest one there, so that no total needs to be remembered.
    """
    model, start, usable = compiled.model, compiled.start, compiled.greatest.usable
    labelled = label_failure(model, start, compiled.semantics, compiled.discount, usable)
    process = labelled.process
    chance = np.where(model.goal_mask, 1.0, compiled.greatest.goal)
    cost = labelled.quotient.at_pairs(cost_means(model, chance)) / labelled.departs
    cost = np.append(cost, np.zeros(process.n_pairs - cost.size))
    labelled = replace(labelled, process=replace(process, cost=cost))
    return LabelledModel.of(labelled, start, compiled.semantics, compiled.discount)


def _objective_word(problem: Problem, compiled: CompiledExplicit) -> str:
    """The labelled program's objective in a word."""
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
