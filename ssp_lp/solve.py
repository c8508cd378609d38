"""The one verb: solve a problem with an engine and hand back a proved solution."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from numbers import Real

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP, read_only
from ssp_lp.column_generation.compiled_problems.accumulated_cost import CompiledAccumulatedCost
from ssp_lp.column_generation.compiled_problems.compiled_problem import checked_least_failure
from ssp_lp.column_generation.failure_constraint import Row, least_of
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.linear_programming.solving import BACKENDS
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.methods.refinement import SolveOptions, optimise
from ssp_lp.methods.risk import solve_for_risk
from ssp_lp.methods.rows.solving import check_options, solve_constrained
from ssp_lp.methods.worth import solve_for_worth
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.problem import Problem, conditions_of
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.processes.layered.law_measure import Measure
from ssp_lp.processes.quantities.rows import FAILURE_ROW
from ssp_lp.solution import Run, Solution, remarks

ENGINES = ("auto", "columns", "lp", "game")
POLICY_CLASSES = ("mixed", "deterministic")

_ROUNDING = 1e-12  # of sums of probabilities

_REASONS = {
    "auto": "column generation, which scales best for one failure row",
    "columns": "column generation, as asked",
    "unlimited": "no failure row: policy iteration at one price",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}

Progress = Callable[[int, float, float], None]


def solve(
    problem: Problem,
    engine: str = "auto",
    *,
    backend: str | None = None,
    policy_class: str = "mixed",
    tolerance: float = RELATIVE_GAP,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Solve a problem to a certified relative gap.

    Args:
        problem: a formulation, such as ``MCMP(...)`` or ``S3P(...)``.
        engine: "columns" (column generation), "lp" (the full linear program), "game" (the paper's
            value iteration and zero-sum game, section 3.5; needs a discount and a budget above 0),
            or "auto".
        backend: the LP engine's solver: "highs", "highs-simplex", "highs-ipx", "clarabel" or
            "cvxpy"; None: chosen by the size of the program. "highs-warm" is a check of optimality
            by HiGHS's simplex method, started at column generation's policies, not a cold solve;
            ``run.program`` tells how many iterations it took from there.
        policy_class: "mixed" (lotteries, the optimum) or "deterministic": the best single policy
            that never tosses a coin, stationary in the model's states, in case S in (state,
            accumulated cost); see ``ssp_lp.integer_programming.best_policy``. With engine "auto"
            or "lp" only.
        tolerance: relative gap to reach.
        time_limit: seconds after which the best policy so far is returned with its honest gap;
            with limits on secondary costs, if any that keeps to them has been found.
        progress: called after each pricing call with (calls, failure price, objective).

    Returns:
        The solution; its numbers are recomputed from the model. Of what is to be large the
        certified side is ``upper_bound``, of everything else ``lower_bound``.

    Raises:
        ModelError: a wrong argument.
        InfeasibleError: the budget is below the least failure probability, which it carries, or
            failing is forbidden and cannot be avoided.
        SolverError: the engine delivered nothing that passes its check.
    """
    began = time.perf_counter()
    _check_arguments(engine, backend, policy_class, tolerance)
    _check_time_limit(time_limit)
    options = SolveOptions(
        engine="columns" if engine == "auto" else engine,
        backend=backend,
        tolerance=tolerance,
        deadline=np.inf if time_limit is None else began + time_limit,
        progress=progress,
    )
    measure, deterministic = problem.semantics.measure, policy_class == "deterministic"
    limited = bool(conditions_of(problem))
    if deterministic and (measure is not None or limited):
        name = type(problem).__name__
        raise ModelError(f"policy_class='deterministic' is not available for {name}")
    if limited:
        check_options(problem, options)
    if limited and (measure is None or measure.maximised):
        solution = solve_constrained(problem, options)
    elif engine == "game":
        solution = _by_game(problem, options)
    elif measure is not None:
        solution = _by_measure(problem, measure, options)
    elif problem.semantics.aim is not Aim.LEAST_COST:
        solution = _extreme_goal(problem, options)
    elif problem.failure_budget is None:
        solution = _at_least_failure(problem)
    else:
        solution = _within_budget(problem, problem.failure_budget, options, engine, deterministic)
    _check_answer(solution)
    run = replace(solution.run, seconds=time.perf_counter() - began)
    return replace(solution, run=run, note=_with_gap(solution, tolerance), prices=_prices(solution))


def _prices(solution: Solution) -> Mapping[str, float]:
    """The multiplier of each row, by name; where there is no other, that of the failure budget."""
    price, penalty = solution.failure_price, solution.problem.semantics.penalty
    if solution.prices or price is None or not np.isfinite(penalty):
        return solution.prices
    return {FAILURE_ROW: price - penalty}


def _with_gap(solution: Solution, tolerance: float) -> str:
    """The note, which says so where the tolerance is missed and nothing else says why."""
    if solution.note or solution.gap <= tolerance:
        return solution.note
    return f"the gap of {solution.gap:.1e} misses the tolerance of {tolerance:g}"


def _check_answer(solution: Solution) -> None:
    """Check what every answer must satisfy, whoever found it.

    Raises:
        SolverError: a probability outside [0, 1], a budget that is not kept, weights that are no
            lottery, or a value that is no number.
    """
    budget, used = solution.problem.failure_budget, solution.budget_used
    wrong = {
        f"its value is {solution.objective!r}": not np.isfinite(solution.objective),
        f"it fails with {used!r}": not 0.0 <= used <= 1.0 + _ROUNDING,
        f"it fails with {used!r}, {budget!r} allowed": budget is not None
        and used > budget + LEAST_BUDGET,
        "its weights are no lottery": not solution.policy.weights.min() >= 0.0
        or abs(float(solution.policy.weights.sum()) - 1.0) > _ROUNDING,
    }
    told = ", ".join(reason for reason, found in wrong.items() if found)
    if told:
        raise SolverError(f"the answer fails its check: {told}; please report the model")


def _check_time_limit(time_limit: float | None) -> None:
    """Raise :class:`ModelError` for one that is no number of seconds."""
    if time_limit is not None and not (isinstance(time_limit, Real) and time_limit >= 0.0):
        raise ModelError(f"time_limit must be a number of seconds or None, not {time_limit!r}")


def _check_arguments(engine: str, backend: str | None, policy_class: str, tolerance: float) -> None:
    """Raise :class:`ModelError` for a wrong argument of ``solve``."""
    if engine not in ENGINES:
        raise ModelError(f"engine must be one of {', '.join(ENGINES)}, not {engine!r}")
    if backend is not None and (backend not in BACKENDS or engine != "lp"):
        raise ModelError(f"backend {backend!r}: engine='lp' takes one of {', '.join(BACKENDS)}")
    if policy_class not in POLICY_CLASSES:
        known = ", ".join(POLICY_CLASSES)
        raise ModelError(f"policy_class must be one of {known}, not {policy_class!r}")
    if policy_class == "deterministic" and engine not in ("auto", "lp"):
        raise ModelError(
            f"policy_class='deterministic' needs engine 'auto' or 'lp', not {engine!r}"
        )
    if not 0.0 < tolerance < 1.0:
        raise ModelError(f"tolerance must lie strictly between 0 and 1, not {tolerance!r}")


def _by_game(problem: Problem, options: SolveOptions) -> Solution:
    """The paper's own construction, which knows neither columns nor programs."""
    from ssp_lp.game.stationary import stationary_game, value_function
    from ssp_lp.game.threshold import Patience

    compiled = problem.compile()
    if isinstance(compiled, CompiledAccumulatedCost) and compiled.fixed_cap is not None:
        raise ModelError("engine='game' chooses its own cap M: leave cost_cap out")
    patience = Patience(options.deadline, options.progress)
    found = stationary_game(problem, tolerance=options.tolerance, patience=patience)
    optimum = found.optimum
    replies = optimum.threshold.responses
    reason = f"the paper's game, {len(optimum.threshold.trials)} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    return Solution(
        problem=problem,
        policy=found.policy,
        objective=optimum.objective,
        lower_bound=least_of(optimum.lower_bound, optimum.objective),
        failure_price=max(optimum.price - optimum.objective, 0.0)
        if problem.ratio
        else optimum.price,
        value_function=read_only(value_function(found)),
        budget_used=optimum.threshold.condition,
        run=Run("game", reason, len(replies), 0.0, work),
        note=remarks(problem, optimum.threshold.budget, optimum.threshold.in_time),
    )


def _by_measure(problem: Problem, measure: Measure, options: SolveOptions) -> Solution:
    """The best worth of arriving, or the least risk given success."""
    if measure.maximised:
        return solve_for_worth(problem, problem.compile(), options)
    return solve_for_risk(problem, options)


def _extreme_goal(problem: Problem, options: SolveOptions) -> Solution:
    """The greatest or the least goal probability; the full program, where asked for, agrees."""
    compiled, aim = problem.compile(), problem.semantics.aim
    reach = extreme_goal_reach(problem.model, aim)
    objective, bound = float(compiled.start @ reach.goal), float(compiled.start @ reach.bound)
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.engine == "lp":
        row = Row(1.0, ratio=False)
        optimum = solve_program(compiled, row, options.backend, options.deadline)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    return Solution(
        problem=problem,
        policy=MixedPolicy((DeterministicPolicy(problem.model, reach.decision),), np.ones(1)),
        objective=objective,
        lower_bound=objective if greatest else least_of(bound, objective),
        failure_price=None,
        value_function=None,
        budget_used=max(1.0 - objective, 0.0),
        run=Run(options.engine, reason, 1, 0.0, program=program),
        upper_bound=-least_of(-bound, -objective) if greatest else None,
    )


def _at_least_failure(problem: Problem) -> Solution:
    least = checked_least_failure(problem.compile(), None)
    row = Row(least.column.failure, problem.ratio)
    objective = row.objective(least.column.cost, least.column.goal)
    reason = "two stages: greatest goal probability, then least cost"
    return Solution(
        problem=problem,
        policy=MixedPolicy((least.policy,), np.ones(1)),
        objective=objective,
        lower_bound=least_of(least.objective_bound, objective),
        failure_price=None,
        value_function=None,
        budget_used=least.column.failure,
        run=Run("columns", reason, 2, 0.0),
    )


def _within_budget(
    problem: Problem, budget: float, options: SolveOptions, asked: str, deterministic: bool
) -> Solution:
    """The best lottery within the budget, or the best single policy.

    Args:
        problem: the problem.
        budget: of failure.
        options: engine, tolerance and limits.
        asked: the engine's name as it was given.
        deterministic: no lotteries.
    """
    outcome = optimise(problem.compile(), budget, options)
    found = outcome.found
    price = max(found.price - found.objective, 0.0) if outcome.row.ratio else found.price
    unlimited = asked != "lp" and not problem.ratio and budget >= 1.0
    reason = f"{_REASONS['unlimited' if unlimited else asked]}, {outcome.calls} pricing calls"
    solution = Solution(
        problem=problem,
        policy=outcome.lottery,
        objective=found.objective,
        lower_bound=found.lower_bound,
        failure_price=price + problem.semantics.penalty,
        value_function=read_only(found.proof.values),
        budget_used=found.failure,
        run=Run(options.engine, reason, outcome.calls, 0.0, outcome.work, outcome.program),
        note=remarks(problem, outcome.row.budget, found.finished),
    )
    if not deterministic:
        return solution
    from ssp_lp.integer_programming.best_policy import best_deterministic

    reason += "; then one policy by mixed-integer programs"
    single = best_deterministic(solution, outcome, options.tolerance, options.deadline)
    return replace(single, run=replace(single.run, reason=reason))
