"""Certificates: both sides of an answer recomputed from the model, trusting no solver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import RELATIVE_GAP, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import CompiledProblem
from ssp_lp.column_generation.compiled_problems.constrained import ATTAINABLE, CompiledConstrained
from ssp_lp.column_generation.compiled_problems.failure_label import CompiledFailureLabel
from ssp_lp.column_generation.failure_constraint import CONTRADICTION, Row, relative_gap
from ssp_lp.column_generation.pricing.explicit import LARGEST
from ssp_lp.errors import ModelError
from ssp_lp.methods.risk import risk_bound
from ssp_lp.methods.rounded_costs import is_on_rounded_costs, proved_on_rounded_costs
from ssp_lp.methods.rows.proof import lagrange_bound, ratios_below, rows_bound
from ssp_lp.options import CERTIFYING
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.problem import Problem, by_rows, compiled_constrained, conditions_of
from ssp_lp.processes.failure_semantics import Aim, start_distribution
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.processes.totals.ladder import Rungs
from ssp_lp.solution import Solution, as_solved

_BUDGET_ROUNDING = 1e-12
_ENOUGH = 1e-290  # a bound below it is 0
_STEEP_PRICES = (1e1, 1e3, 1e5)
"""Prices of failure, in values of the policy, at which least failure is proved best."""

_BELOW = 2.5e-10
"""Relative step below the ratio at which a slack budget's bound is checked: there it is strictly
best to fail, so that no rounding enters (see ``Row.lower_bound``)."""


@dataclass(frozen=True, repr=False)
class Certificate:
    """What was recomputed. ``accepted`` says that the policy keeps to the budget and all limits."""

    objective: float  # exact value of the policy
    lower_bound: float  # no policy within the budget is cheaper
    failure: float  # what the budget limits: exact, or discounted under a discount
    budget: float  # largest failure allowed; at least failure: a certified upper bound of it
    budget_slack: float  # budget - failure
    tail_gap: float  # case S: the part of the relative gap that the cap M leaves; 0 if lossless
    accepted: bool
    reason: str  # why it was refused; empty if accepted
    upper_bound: float | None = None  # of a greatest probability; None where little is better

    @property
    def gap(self) -> float:
        """Relative gap between the objective and the bound that limits it; infinite if refused."""
        if not self.accepted:
            return float("inf")
        if self.upper_bound is not None:
            return relative_gap(self.upper_bound, self.objective)
        return relative_gap(self.objective, self.lower_bound)

    def __repr__(self) -> str:
        """One line: accepted or why not, both sides, and what is left of the budget."""
        upper = self.upper_bound
        side, bound = ("lower", self.lower_bound) if upper is None else ("upper", upper)
        verdict = "accepted" if self.accepted else f"refused: {self.reason}"
        return (
            f"Certificate({verdict}, objective {self.objective:.9g}, {side} bound {bound:.9g}, "
            f"gap {self.gap:.1e}, failure {self.failure:.6g} of {self.budget:.6g})"
        )


def certify(solution: Solution) -> Certificate:
    """Recompute both sides of a solution from its model, policy, price and value function.

    The objective and the failure come from an exact evaluation of the policy on the model. The
    lower bound comes from the price and the value function alone: the latter is lowered until
    one backup, rounding counted against it, shows that it bounds the priced cost of every policy
    from below. A wrong policy, price or value function is thus refused or widens the gap.

    Args:
        solution: a solution, of ``solve`` or put together by hand.

    Returns:
        The certificate. ``accepted`` is false where the policy breaks the budget or a limit.

    Raises:
        ModelError: the policy or the value function does not fit the problem.
    """
    solution = as_solved(solution, "certify")
    problem = solution.problem
    found = evaluate(solution.policy, problem)
    failure = found.discounted_failure
    failure = found.failure_probability if failure is None else failure
    measure = problem.semantics.measure
    if by_rows(problem) and is_on_rounded_costs(solution):
        bound, allowed = proved_on_rounded_costs(solution, CERTIFYING)
        above = measure is not None and measure.maximised
        return _certificate(found, failure, bound, allowed, "", above=above)
    if by_rows(problem):
        risk = measure is not None and not measure.maximised
        proved = _risk_certificate if risk else _limits_certificate
        certificate, reason = proved(solution, found, failure), _broken_limit(problem, found)
        return replace(certificate, accepted=False, reason=reason) if reason else certificate
    if problem.semantics.aim is not Aim.LEAST_COST:
        return _goal_certificate(problem, found, failure)
    if measure is not None:
        proof = _worth_certificate if measure.maximised else _risk_certificate
        return proof(solution, found, failure)
    if problem.failure_budget is None:
        return _least_failure_certificate(problem, found, failure)
    price, values = solution.failure_price, solution.value_function
    if price is None or values is None:
        raise ModelError("a certificate needs the failure price and its value function")
    penalty = problem.semantics.penalty  # part of the cost: the price beyond it is what limits
    price = 0.0 if price == penalty else price - penalty
    if not (np.isfinite(price) and price >= 0.0):
        reason = f"the price is not a number >= {penalty:g}"
        return _certificate(found, failure, 0.0, problem.failure_budget, reason)
    kappa = price + (found.objective if problem.ratio and found.goal_probability > 0 else 0.0)
    levels = levels_of(solution.policy.policies, len(values))
    compiled = problem.compile().matching(np.asarray(values), levels)
    bound, tail = _lower_bound(compiled, problem, kappa, price == 0.0, solution)
    least = compiled.least_failure()
    if problem.failure_budget <= least.column.failure < 1.0:
        kept = failure <= problem.failure_budget  # to the last digit, which tells it from others
        if not (kept and found.objective < least.objective_bound):
            bound = max(bound, least.objective_bound)
    allowed = max(problem.failure_budget, least.column.failure)
    return replace(_certificate(found, failure, bound, allowed, ""), tail_gap=tail)


def _broken_limit(problem: Problem, found: Evaluation) -> str:
    """Which constraint the policy breaks, in words; empty: none."""
    for condition in conditions_of(problem):
        spent = found.secondary_costs[condition.name]
        for row in condition.rows:
            taken, room = row.activity(spent), 2.0 * ATTAINABLE * max(abs(row.bound), _ENOUGH)
            if taken > row.bound + room:
                return f"the policy spends {taken:.12g} of {row.told!r}, {row.bound:.12g} allowed"
    return ""


def _limits_certificate(solution: Solution, found: Evaluation, failure: float) -> Certificate:
    """The bound that the prices prove.

    Raises:
        ModelError: the value function does not fit.
    """
    stated, values = compiled_constrained(solution.problem), solution.value_function
    compiled = stated.settled()
    if values is None:
        raise ModelError("a certificate needs the prices and their value function")
    if not np.isfinite(found.objective):
        reason = f"the policy's objective is {found.objective}"
        return _certificate(found, failure, 0.0, 1.0, reason)
    values = np.asarray(values)
    levels = levels_of(solution.policy.policies)
    if levels is not None:
        compiled = replace(compiled, rungs=Rungs(fixed=tuple(levels.tolist())))
    compiled = compiled.matching(values)
    least = compiled.least.column.failure if compiled.budget is None else 0.0
    budget, spent = max(stated.budget or 0.0, least), [failure]
    for condition in conditions_of(solution.problem):
        value = found.secondary_costs[condition.name]
        spent += [row.activity(value) for row in condition.rows]
    prices = np.array([solution.prices.get(name, 0.0) for name in compiled.names])
    if not ((prices >= 0.0) & (prices <= LARGEST)).all():
        return _certificate(found, failure, 0.0, budget, "a price is not a number >= 0")
    limited = np.isfinite(compiled.bounds)
    bounds = np.where(limited, compiled.bounds, 0.0)
    room = ATTAINABLE * np.maximum(np.abs(bounds), 0.0)
    raised = np.where(limited, np.clip(spent, bounds, bounds + room), 0.0)
    claims = found.objective, solution.lower_bound
    lower = _rows_bound(compiled, prices * limited, raised, values, claims)
    budget = float(raised[0]) if limited[0] else budget
    attained = found.objective - compiled.sense.worth(0.0)
    lower = compiled.sense.settled_bound(
        attained if compiled.sense.constant is None else -attained, lower
    )
    worth, above = compiled.sense.worth(lower), compiled.sense.constant is not None
    return _certificate(found, failure, worth, budget, "", above=above)


def _rows_bound(
    compiled: CompiledConstrained,
    prices: FloatArray,
    bounds: FloatArray,
    values: FloatArray,
    claims: tuple[float, ...],
) -> float:
    """The lower bound that prices and values prove; in case S of ratios that are claimed."""
    found = [0.0]
    ratios = [r for c in claims if c > 0.0 for r in ratios_below(c)] if compiled.ratio else [0.0]
    for ratio in ratios:
        weights = np.append(1.0, prices)
        weights[1] += ratio
        proof = compiled.pricing.check(weights, values)
        found.append(rows_bound(compiled, prices, bounds, ratio, proof))
    return max(found)


def _lower_bound(
    compiled: CompiledProblem, problem: Problem, price: float, slack: bool, solution: Solution
) -> tuple[float, float]:
    """Lower bound of the objective, and the relative gap that truncation leaves in it."""
    row = Row(max(problem.failure_budget or 0.0, 0.0), problem.ratio, compiled.lowest)
    slack = slack and problem.ratio
    price = price * (1.0 - _BELOW) if slack else price
    proof = compiled.pricing().check(price, np.asarray(solution.value_function), slack=slack)
    bound, lost = row.lower_bound(proof), compiled.tail_loss(price, slack=slack)
    if lost == 0.0:
        return bound, 0.0
    return bound, relative_gap(row.lower_bound(replace(proof, bound=proof.bound + lost)), bound)


def _certificate(
    found: Evaluation, failure: float, bound: float, budget: float, reason: str, above: bool = False
) -> Certificate:
    """The certificate of a bound below what the policy attains, or ``above`` it."""
    if not reason and failure > budget + _BUDGET_ROUNDING:
        reason = f"the policy fails with {failure:.12g}, above the budget {budget:.12g}"
    if not reason and not np.isfinite(found.objective):
        reason = f"the policy's objective is {found.objective}"
    most = found.objective + CONTRADICTION * abs(found.objective) + _BUDGET_ROUNDING
    if not reason and bound > most and not above:
        reason = f"the policy's value {found.objective!r} lies below its bound {bound!r}"
    return Certificate(
        objective=found.objective,
        lower_bound=bound if reason and not above else min(bound, found.objective),
        upper_bound=max(bound, found.objective) if above else None,
        failure=failure,
        budget=budget,
        budget_slack=budget - failure,
        tail_gap=0.0,
        accepted=not reason,
        reason=reason,
    )


def _goal_certificate(problem: Problem, found: Evaluation, failure: float) -> Certificate:
    """The probability attained, and a checked bound of what can be, above or below it."""
    aim = problem.semantics.aim
    start = start_distribution(problem.model, problem.start)
    bound = float(start @ extreme_goal_reach(problem.model, aim).bound)
    return _certificate(found, failure, bound, 1.0, "", above=aim is not Aim.LEAST_GOAL)


def _worth_certificate(solution: Solution, found: Evaluation, failure: float) -> Certificate:
    """What arriving is worth, and a checked bound above it.

    Raises:
        ModelError: the solution carries no price and value function, or one that does not fit.
    """
    problem, compiled = solution.problem, solution.problem.compile()
    least, budget, reason = compiled.least_failure(), problem.failure_budget, ""
    bound, allowed = least.objective_bound, least.column.failure
    if budget is not None:
        price, values = solution.failure_price, solution.value_function
        if price is None or values is None:
            raise ModelError("a certificate needs the failure price and its value function")
        if not (np.isfinite(price) and price >= 0.0):
            reason, price = "the price is not a number >= 0", 0.0
        row = Row(max(budget, 0.0), problem.ratio, compiled.lowest)
        values, levels = np.asarray(values), levels_of(solution.policy.policies, len(values))
        priced = row.lower_bound(compiled.matching(values, levels).pricing().check(price, values))
        bound = max(priced, bound) if budget <= allowed else priced
        allowed = max(budget, allowed)
    worth = problem.semantics.failing_worth - bound
    return _certificate(found, failure, worth, allowed, reason, above=True)


def _risk_certificate(solution: Solution, found: Evaluation, failure: float) -> Certificate:
    """A risk given success, and a bound below it that is searched for afresh."""
    if not np.isfinite(found.objective):
        return _certificate(found, failure, 0.0, 1.0, "the goal is never reached")
    bound, allowed = risk_bound(solution.problem, found.objective, CERTIFYING)
    return _certificate(found, failure, bound, allowed, "")


def _least_failure_certificate(problem: Problem, found: Evaluation, failure: float) -> Certificate:
    """At least failure: a bound at finite prices of failure, which holds for every policy.

    Where rounding at such prices leaves a gap, the bound is that of the second stage over the pairs
    that were decided to maximise.
    """
    compiled = problem.compile()
    least = compiled.least_failure()
    allowed, bound = least.column.failure, least.objective_bound
    if isinstance(compiled, CompiledFailureLabel) and np.isfinite(found.objective):
        pricing, column = compiled.pricing(), None
        for steps in _STEEP_PRICES:
            price = steps * max(found.objective, 1.0)
            column = pricing.minimise(price, column)
            priced = lagrange_bound(
                pricing.prove(price, column).bound, np.array([price]), np.array([allowed])
            )
            if relative_gap(found.objective, priced) <= RELATIVE_GAP:
                bound = priced
                break
    return _certificate(found, failure, bound, allowed, "")
