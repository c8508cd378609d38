"""From a problem with one row, or none, to its solution."""

from __future__ import annotations

from dataclasses import replace

from ssp_lp.column_generation.compiled_problems.compiled_problem import checked_least_failure
from ssp_lp.column_generation.compiled_problems.sense import Sense
from ssp_lp.column_generation.failure_constraint import Row
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.methods.refinement import optimise
from ssp_lp.options import SolveOptions
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.solution import Run, Solution, remarks

_REASONS = {
    "columns": "column generation, as asked",
    "unlimited": "no failure row: policy iteration at one price",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}


def extreme_goal(problem: Problem, options: SolveOptions) -> Solution:
    """The greatest or the least goal probability; the full program, where asked for, agrees."""
    compiled, aim = problem.compile(), problem.semantics.aim
    reach = extreme_goal_reach(problem.model, aim)
    objective, bound = float(compiled.start @ reach.goal), float(compiled.start @ reach.bound)
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.program is not None:
        row = Row(1.0, ratio=False)
        optimum = solve_program(compiled, row, options.program.backend, options.deadline)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    policy = DeterministicPolicy(problem.model, reach.decision)
    sign = -1.0 if greatest else 1.0
    found = Found(policy, sign * objective, sign * bound, max(1.0 - objective, 0.0))
    run = Run(options.method, reason, 1, 0.0, program=program)
    return assembled(problem, found, run, Sense(0.0 if greatest else None))


def cheapest_at_least_failure(problem: Problem) -> Solution:
    """The cheapest of the policies that fail least, by two stages.

    Raises:
        InfeasibleError: case S, and the goal cannot be reached.
    """
    least = checked_least_failure(problem.compile(), None)
    row = Row(least.column.failure, problem.ratio)
    objective = row.objective(least.column.cost, least.column.goal)
    reason = "two stages: greatest goal probability, then least cost"
    found = Found(least.policy, objective, least.objective_bound, least.column.failure)
    return assembled(problem, found, Run("columns", reason, 2, 0.0))


def best_within_budget(
    problem: Problem, options: SolveOptions, *, deterministic: bool = False
) -> Solution:
    """The best lottery within the budget, or the best single policy.

    Args:
        problem: the problem.
        options: tolerance and limits.
        deterministic: no lotteries.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        SolverError: the linear program's answer fails its check.
    """
    budget = problem.failure_budget
    outcome = optimise(problem.compile(), 1.0 if budget is None else budget, options)
    found = outcome.found
    price = max(found.price - found.objective, 0.0) if outcome.row.ratio else found.price
    unlimited = options.program is None and not problem.ratio and outcome.row.budget >= 1.0
    reason = (
        f"{_REASONS['unlimited' if unlimited else options.method]}, {outcome.calls} pricing calls"
    )
    answer = outcome.answer(price, remarks(problem, outcome.row.budget, found.finished))
    solution = assembled(problem, answer, outcome.run(options, reason))
    if not deterministic:
        return solution
    from ssp_lp.methods.integer_programming.best_policy import best_deterministic

    reason += "; then one policy by mixed-integer programs"
    single = best_deterministic(solution, outcome, options.tolerance, options.deadline)
    return replace(single, run=replace(single.run, reason=reason))
