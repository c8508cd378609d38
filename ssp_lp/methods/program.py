"""From a problem to its occupation-measure program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.column_generation.compiled_problems.compiled_failure_label import CompiledFailureLabel
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledLayered,
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.errors import ModelError
from ssp_lp.methods.refinement import refined_optimum
from ssp_lp.methods.rows.lottery import truth_of
from ssp_lp.methods.rows.rows_optimum import rows_optimum
from ssp_lp.options import CERTIFYING
from ssp_lp.problem import Problem, by_rows, by_sums, compiled_constrained, unrolled
from ssp_lp.processes.failure_semantics import Aim, ObjectiveSense
from ssp_lp.processes.layered.charges import TOTAL_COST
from ssp_lp.processes.layered.measures_of_law import CostQuantileOf, TailMeanOf
from ssp_lp.processes.layered.open_ended import OpenEnded
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.programs.augmented import Augmented, LabelledModel
from ssp_lp.programs.layered_models import LayeredModel, OpenEndedModel
from ssp_lp.programs.occupation_program import OccupationProgram
from ssp_lp.programs.program_rows import ProgramRow


def program_of(problem: Problem) -> OccupationProgram:
    """The linear program over expected visits whose optimum is the problem's.

    At least failure (``failure_budget=None``) it is the program of the second stage: over the
    actions that attain the greatest goal probability, without a failure row (mathematics, section
    4). In case S the cost up to which accumulated costs are told apart is the one at which column
    generation proves the optimum, or the problem's ``cost_cap``. With further constraints, costs
    beyond it are counted as if it had just been reached: rows that are added later may make
    ``objective`` less than what the policy's evaluation says.

    Args:
        problem: a formulation.

    Returns:
        The program: labelled, and open to every solver.

    Raises:
        ModelError: the criterion is no linear program (a quantile or a tail mean of the cost).
        InfeasibleError: the budget is below the least failure.
    """
    if isinstance(problem.semantics.measure, CostQuantileOf | TailMeanOf):
        raise ModelError(
            f"{type(problem).__name__} is no linear program but a search over many: "
            "CostBoundedReach(...).program() is the one at a fixed cost"
        )
    horizon = getattr(problem, "horizon", None)
    if horizon is not None:
        found = program_of(unrolled(problem))
        return replace(found, title=f"{found.title}, within {horizon:,} steps")
    if by_rows(problem) or by_sums(problem):
        return _constrained_program(problem)
    compiled, budget = problem.compile(), problem.failure_budget
    rows: tuple[ProgramRow, ...] = ()
    if budget is None:
        augmented = _program_at_least_failure(compiled)
    else:
        augmented, granted = _program_within(compiled, budget)
        if budget < 1.0:
            rows = (ProgramRow(FAILURE_ROW, augmented.process.failure, granted),)
    objective, constant = _objective_of_program(problem)
    sense, title = ObjectiveSense(constant), _title_of_program(problem)
    return OccupationProgram(title, objective, augmented, rows, problem.ratio, sense)


def _constrained_program(problem: Problem) -> OccupationProgram:
    """The program's row for each constraint, on as many layers of cost as the proof needs."""
    compiled = compiled_constrained(problem).settled()
    if compiled.charge is not None:
        compiled = rows_optimum(compiled, CERTIFYING, truth_of(problem, compiled)).compiled
        if compiled.ladder is not None and not compiled.ladder.exact:
            raise ModelError(
                f"the costs have more than {compiled.layers:,} sums: on a grid of totals the "
                "program is a bound, no problem; fewer distinct costs make it one"
            )
    pricing, found = compiled.pricing, compiled.augmented
    rows = tuple(
        ProgramRow(name, np.ascontiguousarray(pricing.rewards[:, k]), float(bound), told)
        for k, (name, bound, told) in enumerate(
            zip(compiled.names, compiled.bounds, compiled.told, strict=True), 1
        )
        if np.isfinite(bound)
    )
    augmented: Augmented
    if isinstance(found, OpenEnded):
        augmented = OpenEndedModel(found)
    else:
        cost = np.ascontiguousarray(pricing.rewards[:, 0])
        process = replace(found.process, cost=cost)
        augmented = LabelledModel(replace(found, process=process), compiled.start)
    return OccupationProgram(
        title=_title_of_program(problem),
        objective="objective"
        if compiled.objective is not None
        else _objective_of_program(problem)[0],
        augmented=augmented,
        rows=rows,
        ratio=problem.ratio,
        sense=compiled.sense,
        wants_ends=compiled.wants_ends,
    )


def _program_at_least_failure(compiled: CompiledProblem) -> Augmented:
    """The process of the program's second stage."""
    checked_least_failure(compiled, None)
    if isinstance(compiled, CompiledFailureLabel):
        return LabelledModel(compiled.second_stage, compiled.start)
    if isinstance(compiled, CompiledAccumulatedCost):
        compiled = CompiledArrivalCost(compiled.model, compiled.start, TOTAL_COST, ratio=True)
    if isinstance(compiled, CompiledArrivalCost):
        return LayeredModel(compiled.safest().process, compiled.start)
    raise ModelError(f"no program is known for {type(compiled).__name__}")


def _program_within(compiled: CompiledProblem, budget: float) -> tuple[Augmented, float]:
    """The process of a problem with a budget, and the budget, raised to what is attainable."""
    if isinstance(compiled, CompiledFailureLabel):
        least = checked_least_failure(compiled, budget).column.failure if budget < 1.0 else 0.0
        return LabelledModel(compiled.labelled, compiled.start), max(budget, least)
    found = refined_optimum(compiled, budget, CERTIFYING)
    if found.least is not None and found.row.budget <= found.least.column.failure:
        if compiled.discount is None:  # only policies of least failure are within the budget
            return _program_at_least_failure(compiled), found.row.budget
        here = found.compiled.for_program()
    else:
        here = found.compiled
    if not isinstance(here, CompiledLayered):
        raise ModelError(f"no program is known for {type(compiled).__name__}")
    return LayeredModel(here.process, here.start), found.row.budget


def _objective_of_program(problem: Problem) -> tuple[str, float | None]:
    """What the program minimises, and the constant of what is maximised in its place."""
    semantics = problem.semantics
    if semantics.aim is Aim.GREATEST_GOAL:
        return "failure", 1.0
    if semantics.aim is Aim.LEAST_GOAL:
        return "goal", None
    if semantics.measure is not None:
        return "arrival cost", semantics.failing_worth
    if 0.0 < semantics.penalty < np.inf:
        return f"cost + {semantics.penalty:g} failure", None
    return "cost", None


def _title_of_program(problem: Problem) -> str:
    """The program's title: the formulation, and what is asked about failing."""
    budget = problem.failure_budget
    asked = "least failure" if budget is None else f"failure budget {budget:g}"
    discount = "" if problem.discount is None else f", discount {problem.discount:g}"
    return f"{type(problem).__name__}, {asked}{discount}"
