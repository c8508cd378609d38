"""Certificates: the objective and the bound of a solution, recomputed without any solver."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate_each
from ssp_lp.arrays import RELATIVE_GAP
from ssp_lp.column_generation.column import CONTRADICTION, relative_gap
from ssp_lp.compiled.deadline import limited
from ssp_lp.errors import ModelError, OutOfTimeError
from ssp_lp.methods.approaches import Case, approach_to
from ssp_lp.methods.incumbent import broken_limit, by_moments, prove_by_cheapest_way
from ssp_lp.methods.refinement import Proved
from ssp_lp.model.arguments import explained
from ssp_lp.model.implicit import ExploredSSP
from ssp_lp.model.report import Facts, Table
from ssp_lp.model.tracked_product import check_not_rounded
from ssp_lp.options import Status, progress_shown
from ssp_lp.policies.policy import as_lottery
from ssp_lp.problem import least_failure_bound, on_one_model
from ssp_lp.reductions.exploration import states_in_doubt
from ssp_lp.solution import Solution, as_solved, gap_of_least_failure, unproved_failure

_LOG = logging.getLogger("ssp_lp.certificate")


@explained
def certify(
    solution: Solution, *, verbose: bool = False, time_limit: float | None = None
) -> Certificate:
    """Certify a solution: recompute objective and bound from model, policy, price and values.

    The objective and the failure come from an exact evaluation of the policy on the model. If the
    table for the distribution of the policy's total cost would be too large, a bound by mean and
    variance replaces the objective; the true objective is at least as good.

    The lower bound comes from the price and the value function alone. The value function is lowered
    until one Bellman backup, less its rounding errors, shows that the values bound the priced cost
    of every policy from below. So a wrong policy, price or value function is refused or widens the
    gap.

    Args:
        solution: a solution of ``solve``, or one put together by hand.
        verbose: whether to show the progress (``ssp_lp.progress_shown``).
        time_limit: seconds; None: no limit. If the bound of a criterion of the total cost is not
            proved in time, it is replaced by a weaker bound from the cheapest way to the goal.

    Returns:
        The certificate. ``accepted`` is false if the policy breaks the budget or a limit.

    Raises:
        ModelError: the policy or the value function does not fit the problem.
        OutOfTimeError: the time limit passed before the policy was evaluated or, for other
            criteria, before a bound was proved.
    """
    solution, began = as_solved(solution, "certify"), perf_counter()
    check_not_rounded(solution.problem.tracked.model, "certify")
    with progress_shown(verbose):
        with limited(time_limit, "the policy was evaluated"):
            evaluation, members = _evaluated(solution)
        _LOG.info("%r", evaluation)
        try:
            left = None if time_limit is None else max(began + time_limit - perf_counter(), 0.0)
            with limited(left, "a bound was proved"):
                proved = _proved(solution, evaluation, members)
                least = proved.least_failure_bound
                least = least_failure_bound(solution.problem) if least is None else least
        except OutOfTimeError:
            if not Case.of_solution(solution).has_cheapest_way:
                raise
            proved, least = prove_by_cheapest_way(solution.problem, evaluation), None
        reason = proved.reason or broken_limit(solution.problem, evaluation)
        assumption, part = "", solution.problem.model
        if isinstance(part, ExploredSSP):
            assumption = part.whole.assumption
            if not reason and states_in_doubt(solution).size:
                reason = "the policy depends on states that were not explored"
        is_maximised = solution.problem.semantics.sense.constant is not None
        above = is_maximised and solution.problem.objective_condition is None
        certificate = certificate_of(
            evaluation, proved.bound, proved.allowed, reason, tail=proved.tail, above=above
        )
        certificate = replace(certificate, least_failure_bound=least, assumption=assumption)
        _LOG.info("%r", certificate)
    return certificate


def _evaluated(solution: Solution) -> tuple[Evaluation, list[Evaluation]]:
    """Return the evaluation of a solution's lottery, and of each of its members.

    If the table for the distribution of the total cost would be too large, the objectives are
    bounds by mean and variance: the true objectives are at least as good.
    """
    problem = solution.problem
    try:
        return evaluate_each(solution.policy, problem)
    except ModelError:
        if not problem.semantics.counts_law:
            raise
        lottery, problem = on_one_model(solution.policy, problem, "certify")
        each = [by_moments(as_lottery(member), problem) for member in lottery.policies]
        return by_moments(lottery, problem), each


def _proved(solution: Solution, evaluation: Evaluation, members: list[Evaluation]) -> Proved:
    """Return a bound of the optimum, proved by the method that fits the problem.

    If this method fails or proves less, the bound comes from the cheapest way to the goal instead.

    Args:
        solution: the solution.
        evaluation: evaluation of its lottery.
        members: evaluations of the lottery's members.
    """
    case = Case.of_solution(solution)
    approach = approach_to(case)
    unsearched = solution.value_function is None and solution.status is not Status.OPTIMAL
    if unsearched and not approach.afresh and case.has_cheapest_way:
        return prove_by_cheapest_way(solution.problem, evaluation)
    attained = min(member.limited_failure for member in members)
    try:
        proved = approach.prove(solution, evaluation, attained)
    except ModelError:  # a table that is too large
        if not (approach.afresh and case.has_cheapest_way):
            raise
        return prove_by_cheapest_way(solution.problem, evaluation)
    if proved.gap <= RELATIVE_GAP or proved.reason or not case.has_cheapest_way:
        return proved
    other = prove_by_cheapest_way(solution.problem, evaluation)
    return replace(proved, bound=other.bound) if other.gap < proved.gap else proved


_BUDGET_ROUNDING = 1e-12


@dataclass(frozen=True, repr=False)
class Certificate(Facts):
    """Verdict on a solution, with its recomputed values.

    It is ``accepted`` if the policy satisfies the budget and all limits.
    """

    objective: float  # exact value of the policy
    lower_bound: float  # no policy within the budget is cheaper
    failure: float  # the failure that the budget limits: exact, or discounted under a discount
    budget: float  # largest failure allowed; with least failure: its certified upper bound
    budget_slack: float  # budget - failure
    tail_gap: float  # case S: the part of the relative gap that the cap M leaves; 0 if lossless
    accepted: bool
    reason: str  # why it was refused; empty if accepted
    upper_bound: float | None = None  # of a maximised probability; None if the problem minimises
    least_failure_bound: float | None = None  # with least failure: no policy fails less
    assumption: str = ""  # of a model given by its successor function: what its bounds assume

    @property
    def gap(self) -> float:
        """Certified relative gap between objective and bound; infinite if refused.

        If least failure was asked for, the gap of the failure counts as well: the larger one is
        returned.
        """
        if not self.accepted:
            return float("inf")
        failing = gap_of_least_failure(self.failure, self.least_failure_bound)
        if self.upper_bound is not None:
            return max(relative_gap(self.upper_bound, self.objective), failing)
        return max(relative_gap(self.objective, self.lower_bound), failing)

    def tables(self) -> list[Table]:
        """Return one table: verdict, objective, bound, gap, failure and assumptions."""
        upper = self.upper_bound
        side, bound = ("lower", self.lower_bound) if upper is None else ("upper", upper)
        facts = [
            ("verdict", "accepted" if self.accepted else f"refused: {self.reason}"),
            ("objective", self.objective),
            (f"{side} bound", bound),
            ("gap", self.gap),
            ("failure", f"{self.failure:.6g} of {self.budget:.6g}"),
            ("least failure", unproved_failure(self.failure, self.least_failure_bound)),
            ("assuming that", self.assumption),
        ]
        return [Table(facts, digits={"objective": 9, f"{side} bound": 9, "gap": 2})]


def certificate_of(
    evaluation: Evaluation,
    bound: float,
    budget: float,
    reason: str = "",
    *,
    tail: float = 0.0,
    above: bool = False,
) -> Certificate:
    """Return the certificate of a policy: its recomputed values with the verdict.

    Args:
        evaluation: exact evaluation of the policy.
        bound: bound of every policy's objective.
        budget: the largest failure allowed.
        reason: reason for which the policy is refused; empty: it is refused only if its values
            demand it.
        tail: the part of the relative gap that is due to a cap on accumulated cost.
        above: whether the bound is an upper bound.
    """
    failure = evaluation.limited_failure
    if not reason and np.isnan(evaluation.objective) and evaluation.goal_probability == 0.0:
        reason = "the goal is never reached"
    if not reason and failure > budget + _BUDGET_ROUNDING:
        reason = f"the policy fails with {failure:.12g}, above the budget {budget:.12g}"
    if not reason and not np.isfinite(evaluation.objective):
        reason = f"the policy's objective is {evaluation.objective}"
    beyond = (evaluation.objective - bound) if above else (bound - evaluation.objective)
    if not reason and beyond > CONTRADICTION * abs(evaluation.objective) + _BUDGET_ROUNDING:
        side = "above" if above else "below"
        reason = f"the policy's value {evaluation.objective!r} lies {side} its bound {bound!r}"
    return Certificate(
        objective=evaluation.objective,
        lower_bound=bound if reason and not above else min(bound, evaluation.objective),
        upper_bound=max(bound, evaluation.objective) if above else None,
        failure=failure,
        budget=budget,
        budget_slack=budget - failure,
        tail_gap=tail,
        accepted=not reason,
        reason=reason,
    )
