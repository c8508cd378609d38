"""The one verb: solve a problem with an engine and hand back a proved solution."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP, read_only
from ssp_lp.engines.column_generation import HullSearch
from ssp_lp.engines.instance import LeastFailure
from ssp_lp.engines.lp import BACKENDS
from ssp_lp.engines.refinement import Effort, Outcome, optimise
from ssp_lp.engines.row import Row
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.goal_probability import max_goal_probability
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.process.semantics import start_distribution
from ssp_lp.solution import NOT_YET_RUN, Run, Solution

ENGINES = ("auto", "columns", "lp")

_REASONS = {
    "auto": "column generation, which scales best for one failure row",
    "columns": "column generation, as asked",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}

Progress = Callable[[int, float, float], None]


def solve(
    problem: Problem,
    engine: str = "auto",
    *,
    backend: str | None = None,
    tolerance: float = RELATIVE_GAP,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Solve a problem to a certified relative gap.

    Args:
        problem: a formulation, such as ``MCMP(...)`` or ``S3P(...)``.
        engine: "columns" (column generation), "lp" (the full linear program), or "auto".
        backend: the LP engine's solver: "highs", "highs-simplex", "highs-ipx", "clarabel" or
            "cvxpy"; None: chosen by the size of the program.
        tolerance: relative gap to reach.
        time_limit: seconds after which the best policy so far is returned with its honest gap.
        progress: called after each oracle call with (calls, failure price, objective).

    Returns:
        The solution; its numbers are recomputed from the model.

    Raises:
        ModelError: a wrong argument.
        InfeasibleError: the budget is below the least failure probability, which it carries.
        SolverError: the engine delivered nothing that passes its check.
    """
    began = time.perf_counter()
    if engine not in ENGINES:
        raise ModelError(f"engine must be one of {', '.join(ENGINES)}, not {engine!r}")
    if backend is not None and (backend not in BACKENDS or engine != "lp"):
        raise ModelError(f"backend {backend!r}: engine='lp' takes one of {', '.join(BACKENDS)}")
    if not 0.0 < tolerance < 1.0:
        raise ModelError(f"tolerance must lie strictly between 0 and 1, not {tolerance!r}")
    instance = problem.instance()
    least = instance.least_failure()
    _require_feasible(problem, least)
    if problem.failure_budget is None:
        return _at_least_failure(problem, least, began)
    effort = Effort(
        engine="columns" if engine == "auto" else engine,
        backend=backend,
        tolerance=tolerance,
        deadline=np.inf if time_limit is None else began + time_limit,
        progress=progress,
    )
    row = Row(max(problem.failure_budget, least.column.failure), instance.ratio)
    outcome = optimise(instance, least, row, effort)
    solution = _conclude(problem, least, outcome, row)
    reason = f"{_REASONS[engine]}, {outcome.calls} oracle calls"
    seconds = time.perf_counter() - began
    run = Run(effort.engine, reason, outcome.calls, seconds, outcome.program)
    return replace(solution, run=run)


def _require_feasible(problem: Problem, least: LeastFailure) -> None:
    """Raise :class:`InfeasibleError` where no policy keeps to the budget."""
    failure, budget = least.column.failure, problem.failure_budget
    start = start_distribution(problem.model, problem.start)
    if problem.ratio and least.column.goal <= 0.0:
        raise InfeasibleError(
            "the goal cannot be reached from the start: no cost given success exists",
            failure_budget=budget,
            least_failure=1.0,
            least_discounted_failure=None if problem.discount is None else 1.0,
        )
    if budget is None or failure <= budget + LEAST_BUDGET:
        return
    if problem.discount is None:
        raise InfeasibleError(
            f"every policy fails with probability at least {failure:.12g}, above the budget "
            f"{budget:g}; failure_budget=None asks for the least",
            failure_budget=budget,
            least_failure=failure,
        )
    real = max(1.0 - float(start @ max_goal_probability(problem.model)), 0.0)
    raise InfeasibleError(
        f"the discounted failure of every policy is at least {failure:.12g}, above the budget "
        f"{budget:g}; the least real failure probability is {real:.12g}"
        + ("; discount=None or a discount nearer to 1 is feasible" if real <= budget else ""),
        failure_budget=budget,
        least_failure=real,
        least_discounted_failure=failure,
    )


def _at_least_failure(problem: Problem, least: LeastFailure, began: float) -> Solution:
    policy = MixedPolicy((least.policy,), np.ones(1))
    row = Row(least.column.failure, problem.ratio)
    objective = row.objective(least.column.cost, least.column.goal)
    run = Run("columns", "two stages: greatest goal probability, then least cost", 2,
              time.perf_counter() - began)  # fmt: skip
    return Solution(
        problem=problem,
        policy=policy,
        objective=objective,
        lower_bound=min(least.objective_bound, objective),
        failure_price=None,
        value_function=None,
        run=run,
    )


def _conclude(problem: Problem, least: LeastFailure, outcome: Outcome, row: Row) -> Solution:
    found, oracle = outcome.found, outcome.instance.oracle()
    policies = tuple(oracle.policy(c) for c in found.columns)
    policy = MixedPolicy(policies, found.weights)
    price = max(found.price - found.objective, 0.0) if row.ratio else found.price
    return Solution(
        problem=problem,
        policy=policy,
        objective=found.objective,
        lower_bound=found.lower_bound,
        failure_price=price,
        value_function=read_only(found.proof.values),
        run=NOT_YET_RUN,
        note=_note(problem, least, found),
    )


def _note(problem: Problem, least: LeastFailure, found: HullSearch) -> str:
    remarks = []
    budget = problem.failure_budget
    if budget is not None and least.column.failure > budget:
        remarks.append(
            f"the budget lies {least.column.failure - budget:.1e} below the least failure and "
            "counts as equal to it"
        )
    if not found.finished:
        remarks.append("stopped by the time limit; the gap is honest")
    return "; ".join(remarks)
