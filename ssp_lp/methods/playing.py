"""From a problem to its solution by the paper's game."""

from __future__ import annotations

from ssp_lp.column_generation.compiled_problems.accumulated_cost import CompiledAccumulatedCost
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.options import Game, SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.solution import Run, Solution, remarks


def solve_by_game(problem: Problem, options: SolveOptions) -> Solution:
    """The paper's own construction, which knows neither columns nor programs."""
    from ssp_lp.game.stationary import stationary_game, value_function

    compiled = problem.compile()
    if isinstance(compiled, CompiledAccumulatedCost) and compiled.fixed_cap is not None:
        raise ModelError("method='game' chooses its own cap M: leave cost_cap out")
    found = stationary_game(problem, tolerance=options.tolerance, progress=options.progress)
    optimum = found.optimum
    replies = optimum.threshold.responses
    reason = f"the paper's game, {len(optimum.threshold.trials)} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    price = max(optimum.price - optimum.objective, 0.0) if problem.ratio else optimum.price
    answer = Found(
        policy=found.policy,
        value=optimum.objective,
        bound=optimum.lower_bound,
        failure=optimum.threshold.condition,
        price=price,
        values=value_function(found),
        note=remarks(problem, optimum.threshold.budget, optimum.threshold.in_time),
    )
    return assembled(problem, answer, Run(Game.name, reason, len(replies), 0.0, work))
