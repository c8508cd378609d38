"""The greatest expected worth of arriving: bounded reach and expected utility."""

from __future__ import annotations

from dataclasses import replace

from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.compiled_problems.sense import Sense
from ssp_lp.column_generation.failure_constraint import relative_gap
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.refinement import Outcome, optimise
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.solution import Run, Solution, remarks

_LEAST_TOLERANCE = 1e-15
_UNSETTLED = "the utility has not come near its limit within the table of costs: a gap is left"


def solve_for_worth(problem: Problem, compiled: CompiledProblem, options: SolveOptions) -> Solution:
    """Maximise what arriving is worth beyond failing.

    Args:
        problem: its measure is an expectation that is to be large.
        compiled: charges minus what an arrival is worth beyond failing.
        options: method, tolerance and limits.

    Raises:
        InfeasibleError: the budget is below the least failure probability.
        SolverError: the linear program's answer fails its check.
    """
    if problem.failure_budget is None:
        return _at_least_failure(problem, compiled)
    failing = problem.semantics.failing_worth
    outcome = optimise(compiled, problem.failure_budget, options)
    gained, worth = -outcome.found.objective, failing - outcome.found.objective
    if failing != 0.0 and 0.0 < abs(worth) < gained and not _is_met(outcome, failing, options):
        finer = max(options.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        outcome = outcome.followed_by(
            optimise(outcome.compiled, problem.failure_budget, replace(options, tolerance=finer))
        )
    answer = outcome.answer(outcome.found.price, _note(problem, outcome, options))
    return assembled(problem, answer, outcome.run(options, _reason(outcome)), Sense(failing))


def _is_met(outcome: Outcome, failing: float, options: SolveOptions) -> bool:
    worth, bound = failing - outcome.found.objective, failing - outcome.found.lower_bound
    return relative_gap(bound, worth) <= options.tolerance


def _at_least_failure(problem: Problem, compiled: CompiledProblem) -> Solution:
    least = checked_least_failure(compiled, None)
    found = Found(least.policy, least.column.cost, least.objective_bound, least.column.failure)
    run = Run("columns", "two stages: greatest goal probability, then greatest worth", 2, 0.0)
    return assembled(problem, found, run, Sense(problem.semantics.failing_worth))


def _reason(outcome: Outcome) -> str:
    layers = ""
    if isinstance(outcome.compiled, CompiledArrivalCost):
        process, horizon = outcome.compiled.process, outcome.compiled.cost_horizon
        layers = f"{process.cap:,} layers of accumulated cost"
        layers += f", exact from cost {horizon:.6g} on" if horizon > 0.0 else ""
    return f"backward sweeps over {layers}, {outcome.calls} pricing calls"


def _note(problem: Problem, outcome: Outcome, options: SolveOptions) -> str:
    """What a reader should know."""
    found, here = outcome.found, outcome.compiled
    told = remarks(problem, outcome.row.budget, found.finished)
    unsettled = isinstance(here, CompiledArrivalCost) and here.charge.settled is None
    if unsettled and relative_gap(found.objective, found.lower_bound) > options.tolerance:
        told = f"{told}; {_UNSETTLED}" if told else _UNSETTLED
    return told
