"""The one verb: solve a problem with an engine and hand back a proved solution."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from numbers import Real

import numpy as np

from ssp_lp.arrays import RELATIVE_GAP, read_only
from ssp_lp.constrained import Request, solve_constrained
from ssp_lp.crosscheck.stationary import stationary_game, value_function
from ssp_lp.crosscheck.threshold import Patience
from ssp_lp.deterministic import best_deterministic
from ssp_lp.engines.charge_instance import ChargeInstance
from ssp_lp.engines.cost_instance import CostInstance
from ssp_lp.engines.instance import Instance, LeastFailure, checked_least_failure
from ssp_lp.engines.lp import BACKENDS, check_agreement, solve_program
from ssp_lp.engines.oracles.goal_reach import extreme_goal_reach
from ssp_lp.engines.oracles.oracle import Work
from ssp_lp.engines.refinement import Effort, Outcome, optimise
from ssp_lp.engines.row import Row
from ssp_lp.errors import ModelError
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.problem import Problem, WithLimits
from ssp_lp.process.semantics import Aim
from ssp_lp.reward import solve_for_worth
from ssp_lp.risk import solve_for_risk
from ssp_lp.solution import NOT_YET_RUN, Run, Solution, remarks

ENGINES = ("auto", "columns", "lp", "game")
POLICY_CLASSES = ("mixed", "deterministic")

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
            accumulated cost); see ``ssp_lp.deterministic``. With engine "auto" or "lp" only.
        tolerance: relative gap to reach.
        time_limit: seconds after which the best policy so far is returned with its honest gap.
        progress: called after each oracle call with (calls, failure price, objective).

    Returns:
        The solution; its numbers are recomputed from the model. Of a greatest probability the
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
    if isinstance(problem, WithLimits):
        request = Request(engine, backend, policy_class, tolerance, time_limit, progress)
        return solve_constrained(problem, request)
    instance = problem.instance()
    deadline = np.inf if time_limit is None else began + time_limit
    if engine == "game":
        return _by_game(problem, instance, tolerance, Patience(deadline, progress), began)
    if problem.semantics.aim is not Aim.LEAST_COST:
        return _extreme_goal(problem, instance, engine, backend, began, deadline)
    effort = Effort(
        engine="columns" if engine == "auto" else engine,
        backend=backend,
        tolerance=tolerance,
        deadline=deadline,
        progress=progress,
    )
    if problem.semantics.measure is not None:
        if policy_class == "deterministic":
            raise ModelError("policy_class='deterministic' knows costs, not measures of their law")
        return _timed(_by_measure(problem, instance, effort), began)
    if problem.failure_budget is None:
        return _at_least_failure(problem, checked_least_failure(instance, None), began)
    outcome = optimise(instance, problem.failure_budget, effort)
    solution = _conclude(problem, outcome)
    if policy_class == "deterministic":
        solution = best_deterministic(solution, outcome, tolerance, deadline)
    unlimited = engine != "lp" and not problem.ratio and problem.failure_budget >= 1.0
    reason = f"{_REASONS['unlimited' if unlimited else engine]}, {outcome.calls} oracle calls"
    if policy_class == "deterministic":
        reason += "; then one policy by mixed-integer programs"
    seconds = time.perf_counter() - began
    run = Run(effort.engine, reason, outcome.calls, seconds, outcome.work, outcome.program)
    return replace(solution, run=run)


def _by_measure(problem: Problem, instance: Instance, effort: Effort) -> Solution:
    """The best worth of arriving, or the least risk given success."""
    if isinstance(instance, ChargeInstance) and instance.ratio:
        return solve_for_risk(problem, instance, effort)
    return solve_for_worth(problem, instance, effort)


def _timed(solution: Solution, began: float) -> Solution:
    run = replace(solution.run, seconds=time.perf_counter() - began)
    return replace(solution, run=run)


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


def _by_game(
    problem: Problem, instance: Instance, tolerance: float, patience: Patience, began: float
) -> Solution:
    """The paper's own construction, which knows neither columns nor programs."""
    if isinstance(instance, CostInstance) and instance.fixed_cap is not None:
        raise ModelError("engine='game' chooses its own cap M: leave cost_cap out")
    found = stationary_game(problem, tolerance=tolerance, patience=patience)
    optimum = found.optimum
    replies = optimum.threshold.replies
    reason = f"the paper's game, {len(optimum.threshold.trials)} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    run = Run("game", reason, len(replies), time.perf_counter() - began, work)
    return Solution(
        problem=problem,
        policy=found.policy,
        objective=optimum.objective,
        lower_bound=min(optimum.lower_bound, optimum.objective),
        failure_price=max(optimum.price - optimum.objective, 0.0)
        if problem.ratio
        else optimum.price,
        value_function=read_only(value_function(found)),
        budget_used=optimum.threshold.condition,
        run=run,
        note=remarks(problem, optimum.threshold.budget, optimum.threshold.in_time),
    )


def _extreme_goal(
    problem: Problem,
    instance: Instance,
    engine: str,
    backend: str | None,
    began: float,
    deadline: float,
) -> Solution:
    """The greatest or the least goal probability; the full program, where asked for, agrees."""
    aim = problem.semantics.aim
    reach = extreme_goal_reach(problem.model, aim)
    objective, bound = float(instance.start @ reach.goal), float(instance.start @ reach.bound)
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if engine == "lp":
        optimum = solve_program(instance, Row(1.0, ratio=False), backend, deadline)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    seconds = time.perf_counter() - began
    return Solution(
        problem=problem,
        policy=MixedPolicy((DeterministicPolicy(problem.model, reach.decision),), np.ones(1)),
        objective=objective,
        lower_bound=objective if greatest else min(bound, objective),
        failure_price=None,
        value_function=None,
        budget_used=max(1.0 - objective, 0.0),
        run=Run("lp" if engine == "lp" else "columns", reason, 1, seconds, program=program),
        upper_bound=max(bound, objective) if greatest else None,
    )


def _at_least_failure(problem: Problem, least: LeastFailure, began: float) -> Solution:
    policy = MixedPolicy((least.policy,), np.ones(1))
    row = Row(least.column.failure, problem.ratio)
    objective = row.objective(least.column.cost, least.column.goal)
    reason = "two stages: greatest goal probability, then least cost"
    run = Run("columns", reason, 2, time.perf_counter() - began)
    return Solution(
        problem=problem,
        policy=policy,
        objective=objective,
        lower_bound=min(least.objective_bound, objective),
        failure_price=None,
        value_function=None,
        budget_used=least.column.failure,
        run=run,
    )


def _conclude(problem: Problem, outcome: Outcome) -> Solution:
    found, oracle, ratio = outcome.found, outcome.instance.oracle(), outcome.row.ratio
    policies = tuple(oracle.policy(c) for c in found.columns)
    price = max(found.price - found.objective, 0.0) if ratio else found.price
    price += problem.semantics.penalty
    return Solution(
        problem=problem,
        policy=MixedPolicy(policies, found.weights),
        objective=found.objective,
        lower_bound=found.lower_bound,
        failure_price=price,
        value_function=read_only(found.proof.values),
        budget_used=float(
            sum(w * c.failure for w, c in zip(found.weights, found.columns, strict=True))
        ),
        run=NOT_YET_RUN,
        note=remarks(problem, outcome.row.budget, outcome.found.finished),
    )
