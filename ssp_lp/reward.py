"""The greatest expected worth of arriving: bounded reach and expected utility."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.arrays import read_only
from ssp_lp.engines.charge_instance import ChargeInstance
from ssp_lp.engines.instance import Instance, checked_least_failure
from ssp_lp.engines.refinement import Effort, Outcome, optimise
from ssp_lp.engines.row import relative_gap
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.solution import Run, Solution, remarks

_LEAST_TOLERANCE = 1e-15
_UNSETTLED = "the utility has not come near its limit within the table of costs: a gap is left"


def solve_for_worth(problem: Problem, instance: Instance, effort: Effort) -> Solution:
    """Maximise what arriving is worth beyond failing.

    Args:
        problem: its measure is an expectation that is to be large.
        instance: charges minus what an arrival is worth beyond failing.
        effort: engine, tolerance and limits.

    Raises:
        InfeasibleError: the budget is below the least failure probability.
        SolverError: the linear program's answer fails its check.
    """
    if problem.failure_budget is None:
        return _at_least_failure(problem, instance)
    failing = problem.semantics.failing_worth
    outcome = optimise(instance, problem.failure_budget, effort)
    gained, worth = -outcome.found.objective, failing - outcome.found.objective
    if failing != 0.0 and 0.0 < abs(worth) < gained and not _is_met(outcome, failing, effort):
        finer = max(effort.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        outcome = outcome.followed_by(
            optimise(outcome.instance, problem.failure_budget, replace(effort, tolerance=finer))
        )
    found = outcome.found
    return Solution(
        problem=problem,
        policy=outcome.lottery,
        objective=failing - found.objective,
        lower_bound=failing - found.objective,
        failure_price=found.price,
        value_function=read_only(found.proof.values),
        budget_used=found.failure,
        run=_run(outcome, effort),
        note=_note(problem, outcome, effort),
        upper_bound=failing - found.lower_bound,
    )


def _is_met(outcome: Outcome, failing: float, effort: Effort) -> bool:
    worth, bound = failing - outcome.found.objective, failing - outcome.found.lower_bound
    return relative_gap(bound, worth) <= effort.tolerance


def _at_least_failure(problem: Problem, instance: Instance) -> Solution:
    least = checked_least_failure(instance, None)
    failing = problem.semantics.failing_worth
    worth = failing - least.column.cost
    return Solution(
        problem=problem,
        policy=MixedPolicy((least.policy,), np.ones(1)),
        objective=worth,
        lower_bound=worth,
        failure_price=None,
        value_function=None,
        budget_used=least.column.failure,
        run=Run("columns", "two stages: greatest goal probability, then greatest worth", 2, 0.0),
        upper_bound=max(failing - least.objective_bound, worth),
    )


def _run(outcome: Outcome, effort: Effort) -> Run:
    layers = ""
    if isinstance(outcome.instance, ChargeInstance):
        process, horizon = outcome.instance.process, outcome.instance.cost_horizon
        layers = f"{process.cap:,} layers of accumulated cost"
        layers += f", exact from cost {horizon:.6g} on" if horizon > 0.0 else ""
    reason = f"backward sweeps over {layers}, {outcome.calls} oracle calls"
    return Run(effort.engine, reason, outcome.calls, 0.0, outcome.work, outcome.program)


def _note(problem: Problem, outcome: Outcome, effort: Effort) -> str:
    """What a reader should know."""
    found, here = outcome.found, outcome.instance
    told = remarks(problem, outcome.row.budget, found.finished)
    unsettled = isinstance(here, ChargeInstance) and (
        here.charge.settled(here.base.exact_unit) is None
    )
    if unsettled and relative_gap(found.objective, found.lower_bound) > effort.tolerance:
        told = f"{told}; {_UNSETTLED}" if told else _UNSETTLED
    return told
