"""From a problem of risk to its solution, and to the bound of its certificate."""

from __future__ import annotations

from ssp_lp.engines.charge_instance import ChargeInstance
from ssp_lp.engines.refinement import Effort
from ssp_lp.errors import ModelError
from ssp_lp.problem import Problem
from ssp_lp.process.measure import CostQuantileOf, TailMeanOf
from ssp_lp.risk.quantile import least_quantile, quantile_bound
from ssp_lp.risk.tail_mean import least_tail_mean, tail_mean_bound
from ssp_lp.risk.trial import pose
from ssp_lp.solution import Solution


def solve_for_risk(problem: Problem, instance: ChargeInstance, effort: Effort) -> Solution:
    """The least quantile, or the least conditional value at risk, of the cost given success.

    Args:
        problem: its measure says which, and at which level.
        instance: the accumulated-cost process, whose ratio is the cost given success.
        effort: engine, tolerance and limits.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
        ModelError: another measure, or a table of costs that would be too large.
    """
    question = pose(problem, instance)
    match problem.semantics.measure:
        case CostQuantileOf(level):
            return least_quantile(problem, question, level, effort)
        case TailMeanOf(level):
            return least_tail_mean(problem, question, level, effort)
    raise ModelError(f"{problem.semantics.measure!r} is no measure of risk")


def risk_bound(
    problem: Problem, instance: ChargeInstance, attained: float, effort: Effort
) -> tuple[float, float]:
    """Prove a lower bound of the least risk afresh, from the model alone.

    Args:
        problem: the problem.
        instance: its process.
        attained: the risk of the policy in question.
        effort: tolerance and limits.

    Returns:
        The bound, and the failure that is allowed.
    """
    question = pose(problem, instance)
    match problem.semantics.measure:
        case CostQuantileOf(level):
            return quantile_bound(question, level, attained, effort), question.allowed
        case TailMeanOf(level):
            return tail_mean_bound(problem, question, level, effort), question.allowed
    raise ModelError(f"{problem.semantics.measure!r} is no measure of risk")
