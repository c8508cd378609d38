"""From a problem with one row, or none, to its solution."""

from __future__ import annotations

from dataclasses import replace

from ssp_lp.column_generation.compiled_problems.arrival_cost import CompiledArrivalCost
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.failure_row import FailureRow, relative_gap
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import Argument, ModelError
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.methods.refinement import RefinedOutcome, refined_optimum
from ssp_lp.options import Game, SolveOptions
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import Aim, ObjectiveSense
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
    reach = extreme_goal_reach(problem.model, aim, compiled.start)
    objective, bound = float(compiled.start @ reach.goal), float(compiled.start @ reach.bound)
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.program is not None:
        row = FailureRow(1.0, ratio=False)
        optimum = solve_program(compiled, row, options.program.backend, options.deadline)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    policy = DeterministicPolicy(problem.model, reach.decision)
    sign = -1.0 if greatest else 1.0
    found = Found(policy, sign * objective, sign * bound, max(1.0 - objective, 0.0))
    run = Run(options.method, reason, 1, 0.0, program=program)
    return assembled(problem, found, run, ObjectiveSense(0.0 if greatest else None))


def cheapest_at_least_failure(problem: Problem) -> Solution:
    """The cheapest of the policies that fail least, by two stages.

    Raises:
        InfeasibleError: case S, and the goal cannot be reached.
    """
    least = checked_least_failure(problem.compile(), None)
    row = FailureRow(least.column.failure, problem.ratio)
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
    outcome = refined_optimum(problem.compile(), 1.0 if budget is None else budget, options)
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
        least = checked_least_failure(compiled, None)
        found = Found(least.policy, least.column.cost, least.objective_bound, least.column.failure)
        run = Run("columns", "two stages: greatest goal probability, then greatest worth", 2, 0.0)
        return assembled(problem, found, run, ObjectiveSense(problem.semantics.failing_worth))
    failing = problem.semantics.failing_worth
    outcome = refined_optimum(compiled, problem.failure_budget, options)
    gained, worth = -outcome.found.objective, failing - outcome.found.objective
    if (
        failing != 0.0
        and 0.0 < abs(worth) < gained
        and not _is_met_by_row(outcome, failing, options)
    ):
        finer = max(options.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        outcome = outcome.followed_by(
            refined_optimum(
                outcome.compiled, problem.failure_budget, replace(options, tolerance=finer)
            )
        )
    answer = outcome.answer(outcome.found.price, _note_on_row(problem, outcome, options))
    return assembled(
        problem, answer, outcome.run(options, _reason_of_row(outcome)), ObjectiveSense(failing)
    )


def _is_met_by_row(outcome: RefinedOutcome, failing: float, options: SolveOptions) -> bool:
    """Whether one row's outcome meets the tolerance."""
    worth, bound = failing - outcome.found.objective, failing - outcome.found.lower_bound
    return relative_gap(bound, worth) <= options.tolerance


def _reason_of_row(outcome: RefinedOutcome) -> str:
    """Why the search on one row ended, in words."""
    layers = ""
    if isinstance(outcome.compiled, CompiledArrivalCost):
        process, horizon = outcome.compiled.process, outcome.compiled.cost_horizon
        layers = f"{process.cap:,} layers of accumulated cost"
        layers += f", exact from cost {horizon:.6g} on" if horizon > 0.0 else ""
    return f"backward sweeps over {layers}, {outcome.calls} pricing calls"


def _note_on_row(problem: Problem, outcome: RefinedOutcome, options: SolveOptions) -> str:
    """What a reader should know of an answer with one row."""
    found, here = outcome.found, outcome.compiled
    told = remarks(problem, outcome.row.budget, found.finished)
    unsettled = isinstance(here, CompiledArrivalCost) and here.charge.settled is None
    if unsettled and relative_gap(found.objective, found.lower_bound) > options.tolerance:
        told = f"{told}; {_UNSETTLED}" if told else _UNSETTLED
    return told


def solve_by_game(problem: Problem, options: SolveOptions) -> Solution:
    """The paper's own construction, which knows neither columns nor programs."""
    from ssp_lp.game.stationary import stationary_game, value_function

    compiled = problem.compile()
    if isinstance(compiled, CompiledAccumulatedCost) and compiled.fixed_cap is not None:
        asked, cap = Argument("method", "game"), Argument("cost_cap")
        raise ModelError(asked, " chooses its own cap M: leave ", cap, " out")
    found = stationary_game(problem, tolerance=options.tolerance, progress=options.progress)
    replies = found.threshold.responses
    reason = f"the paper's game, {found.threshold.games} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    price = max(found.price - found.objective, 0.0) if problem.ratio else found.price
    answer = Found(
        policy=found.policy,
        value=found.objective,
        bound=found.lower_bound,
        failure=found.threshold.condition,
        price=price,
        values=value_function(found),
        note=remarks(problem, found.threshold.budget, found.threshold.in_time),
    )
    return assembled(problem, answer, Run(Game.name, reason, len(replies), 0.0, work))
