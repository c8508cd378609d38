"""From a problem of risk to its solution, and to the bound of its certificate."""

from __future__ import annotations

from ssp_lp.compiled.deadline import has_answer
from ssp_lp.errors import ModelError
from ssp_lp.methods.risk.quantile import least_quantile, quantile_bound
from ssp_lp.methods.risk.question import Near, Question, question_of
from ssp_lp.methods.risk.tail_mean import least_tail_mean, tail_mean_bound
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.measures_of_law import CostQuantileOf, TailMeanOf
from ssp_lp.solution import Solution


def least_risk(
    problem: Problem,
    options: SolveOptions,
    question: Question | None = None,
    near: Near | None = None,
) -> Solution:
    """The least quantile, or the least conditional value at risk, of the cost given success.

    Args:
        problem: its measure says which, and at which level.
        options: method, tolerance and limits.
        question: the policies that count; None: as the problem says.
        near: where the search may begin; None: unknown.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
        ModelError: another measure, or a table of costs that would be too large.
    """
    has_answer()
    question = question_of(problem) if question is None else question
    match problem.semantics.measure:
        case CostQuantileOf(level):
            return least_quantile(problem, question, level, options, near)
        case TailMeanOf(level):
            return least_tail_mean(problem, question, level, options, near)
    raise ModelError(f"{problem.semantics.measure!r} is no measure of risk")


def risk_bound(problem: Problem, attained: float, options: SolveOptions) -> tuple[float, float]:
    """Prove a lower bound of the least risk afresh, from the model alone.

    Args:
        problem: the problem.
        attained: the risk of the policy in question.
        options: tolerance and limits.

    Returns:
        The bound, and the failure that is allowed.
    """
    question = question_of(problem)
    match problem.semantics.measure:
        case CostQuantileOf(level):
            return quantile_bound(question, level, attained, options), question.allowed
        case TailMeanOf(level):
            return tail_mean_bound(problem, question, level, options), question.allowed
    raise ModelError(f"{problem.semantics.measure!r} is no measure of risk")
