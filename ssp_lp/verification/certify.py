"""Certificates: both sides of an answer recomputed from the model, trusting no solver."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from ssp_lp.accumulated_cost.totals import Resolution
from ssp_lp.analysis.evaluation import Evaluation, evaluate_each
from ssp_lp.arrays import BELOW_RATIO, LEAST_BUDGET, RELATIVE_GAP, FloatArray
from ssp_lp.column_generation.column import CONTRADICTION, FailureRow, Proof, relative_gap
from ssp_lp.column_generation.compiled_problem import (
    ATTAINABLE,
    CompiledConstrained,
    CompiledFailureLabel,
    CompiledProblem,
    LeastFailure,
)
from ssp_lp.column_generation.explicit_pricing import LARGEST
from ssp_lp.compiled.deadline import limited
from ssp_lp.errors import ModelError, OutOfTimeError
from ssp_lp.methods.incumbent import broken_limit, has_totals, worth_bound
from ssp_lp.methods.risk import risk_bound
from ssp_lp.methods.rounding import (
    is_on_rounded_costs,
    proved_on_rounded_costs,
    proved_on_split_costs,
    span_of_steps,
    span_to_split,
)
from ssp_lp.methods.rows import lagrange_bound, rows_bound
from ssp_lp.options import CERTIFYING, Game, Status, progress_shown
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.problem import Problem, by_rows, by_sums, compiled_constrained, conditions_of
from ssp_lp.processes.failure_semantics import Aim, ObjectiveSense, start_distribution
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.solution import Solution, as_solved

_LOG = logging.getLogger("ssp_lp.certificate")

_STEEP_PRICES = (1e1, 1e3, 1e5)
"""Prices of failure, in values of the policy, at which least failure is proved best."""

_LITTLE = 1e-13  # of the bound: less than this is not looked for beyond the cap
_SURELY = 1.0 - 1e-9  # of the budget: a policy that fails less shows it to be above the least


def certify(
    solution: Solution, *, verbose: bool = False, time_limit: float | None = None
) -> Certificate:
    """Recompute both sides of a solution from its model, policy, price and value function.

    The objective and the failure come from an exact evaluation of the policy on the model. The
    lower bound comes from the price and the value function alone: the latter is lowered until
    one backup, rounding counted against it, shows that it bounds the priced cost of every policy
    from below. A wrong policy, price or value function is thus refused or widens the gap.

    Args:
        solution: a solution, of ``solve`` or put together by hand.
        verbose: show how far it has come (``ssp_lp.progress_shown``).
        time_limit: seconds; None: any number. A bound that is not proved again by then is, of what
            is made of totals, that of the cheapest way to the goal.

    Returns:
        The certificate. ``accepted`` is false where the policy breaks the budget or a limit.

    Raises:
        ModelError: the policy or the value function does not fit the problem.
        OutOfTimeError: the time limit passed before the policy was evaluated, or before a bound of
            something else was proved.
    """
    solution, began = as_solved(solution, "certify"), perf_counter()
    with progress_shown(verbose):
        with limited(time_limit, "the policy was evaluated"):
            found, members = evaluate_each(solution.policy, solution.problem)
        _LOG.info("%r", found)
        try:
            left = None if time_limit is None else max(began + time_limit - perf_counter(), 0.0)
            with limited(left, "a bound was proved"):
                certificate = _certificate(solution, found, members)
        except OutOfTimeError:
            problem = solution.problem
            if problem.failure_budget is None or not has_totals(problem):
                raise
            certificate = _certificate_of_cheapest_way(problem, found)
        _LOG.info("%r", certificate)
    return certificate


def _certificate(solution: Solution, found: Evaluation, members: list[Evaluation]) -> Certificate:
    """The certificate of a policy that has been evaluated, its members too."""
    problem = solution.problem
    measure = problem.semantics.measure
    risk = measure is not None and not measure.maximised
    if by_rows(problem) and is_on_rounded_costs(solution):
        if not np.isfinite(found.objective):
            return certificate_of(found, 0.0, 1.0, "the goal is never reached")
        bound, allowed = proved_on_rounded_costs(solution, found.objective, CERTIFYING)
        return certificate_of(found, bound, allowed, above=problem.semantics.maximises)
    span, unknown = span_to_split(problem), solution.value_function is None
    if span is None and unknown and problem.ratio and measure is None and by_sums(problem):
        span = span_of_steps(problem)  # for want of time a grid was taken in place of its sums
    if span is not None:
        if not np.isfinite(found.objective):
            return certificate_of(found, 0.0, 1.0, "the goal is never reached")
        bound, allowed = proved_on_split_costs(solution, span, found.objective, CERTIFYING)
        return certificate_of(found, bound, allowed)
    searched = solution.value_function is not None or solution.status is Status.OPTIMAL
    is_in_hand = problem.failure_budget is not None and not searched  # by no search
    if is_in_hand and has_totals(problem) and not risk:
        return _certificate_of_cheapest_way(problem, found)
    if by_rows(problem):
        proved = _risk_certificate if risk else _limits_certificate
        certificate, reason = proved(solution, found), broken_limit(problem, found)
        return replace(certificate, accepted=False, reason=reason) if reason else certificate
    if problem.semantics.aim is not Aim.LEAST_COST:
        return _goal_certificate(problem, found)
    if measure is not None:
        proof = _worth_certificate if measure.maximised else _risk_certificate
        return proof(solution, found)
    if problem.failure_budget is None:
        return _least_failure_certificate(problem, found)
    return _budget_certificate(solution, found, min(map(failure_of, members)))


def _certificate_of_cheapest_way(problem: Problem, found: Evaluation) -> Certificate:
    """The bound that needs no search."""
    above, budget = problem.semantics.maximises, problem.failure_budget or 0.0
    bound, reason = worth_bound(problem), broken_limit(problem, found)
    return certificate_of(found, bound, budget, reason, above=above)


def _budget_certificate(solution: Solution, found: Evaluation, attained: float) -> Certificate:
    """The bound that the price of the budget proves.

    Args:
        solution: what is certified.
        found: what its policy attains.
        attained: the failure of some policy, the least that is known.

    Raises:
        ModelError: the solution carries no price and value function, or one that does not fit.
    """
    problem, budget = solution.problem, max(solution.problem.failure_budget or 0.0, 0.0)
    price, values = solution.failure_price, solution.value_function
    if price is None or values is None:
        raise ModelError("a certificate needs the failure price and its value function")
    penalty = problem.semantics.penalty  # part of the cost: the price beyond it is what limits
    price = 0.0 if price == penalty else price - penalty
    if not (np.isfinite(price) and price >= 0.0):
        reason = f"the price is not a number >= {penalty:g}"
        return certificate_of(found, 0.0, budget, reason)
    kappa = price + (found.objective if problem.ratio and found.goal_probability > 0 else 0.0)
    levels = levels_of(solution.policy.policies, len(values))
    compiled, least = problem.compile().matching(np.asarray(values), levels), None
    row = FailureRow(budget, problem.ratio, compiled.lowest)
    if attained >= budget * _SURELY:
        least = compiled.least_failure()
        row = replace(row, budget=_allowed(budget, least))
    bound, tail = _certified_lower_bound(compiled, row, kappa, price == 0.0, solution)
    if tail > _LITTLE:  # it may be less beyond the cap with better policies there
        compiled = compiled.for_program()
        bound, tail = _certified_lower_bound(compiled, row, kappa, price == 0.0, solution)
    if least is not None and row.leaves_only(least.column) and least.column.failure < 1.0:
        kept = failure_of(found) <= budget  # to the last digit, which tells it from others
        if not (kept and found.objective < least.objective_bound):
            bound = max(bound, least.objective_bound)
    return certificate_of(found, bound, row.budget, tail=tail)


def _allowed(budget: float, least: LeastFailure) -> float:
    """The failure that a budget allows: the least, where that lies above it by rounding only."""
    return max(budget, min(least.column.failure, budget + LEAST_BUDGET))


def _limits_certificate(solution: Solution, found: Evaluation) -> Certificate:
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
        return certificate_of(found, 0.0, 1.0, reason)
    values = np.asarray(values)
    levels = levels_of(solution.policy.policies)
    if levels is not None:
        compiled = replace(compiled, resolution=Resolution(fixed=tuple(levels.tolist())))
    compiled = compiled.matching(values)
    least = compiled.least.column.failure if compiled.budget is None else 0.0
    budget, spent = max(stated.budget or 0.0, least), [failure_of(found)]
    for condition in conditions_of(solution.problem):
        value = found.secondary_costs[condition.name]
        spent += [row.activity(value) for row in condition.rows]
    prices = np.array([solution.prices.get(name, 0.0) for name in compiled.names])
    if not ((prices >= 0.0) & (prices <= LARGEST)).all():
        return certificate_of(found, 0.0, budget, "a price is not a number >= 0")
    limited = np.isfinite(compiled.bounds)
    bounds = np.where(limited, compiled.bounds, 0.0)
    room = ATTAINABLE * np.maximum(np.abs(bounds), 0.0)
    raised = np.where(limited, np.clip(spent, bounds, bounds + room), 0.0)
    claims = found.objective, solution.lower_bound
    known = None if solution.method == Game.name else values  # a game's are of its own layers
    lower = _certified_rows_bound(compiled, prices * limited, raised, known, claims)
    budget = float(raised[0]) if limited[0] else budget
    attained = found.objective - compiled.sense.worth(0.0)
    lower = compiled.sense.settled_bound(
        attained if compiled.sense.constant is None else -attained,
        lower,
        float(prices[limited] @ np.abs(bounds[limited])),
    )
    above = compiled.sense.constant is not None
    return certificate_of(found, compiled.sense.worth(lower), budget, above=above)


def _certified_rows_bound(
    compiled: CompiledConstrained,
    prices: FloatArray,
    bounds: FloatArray,
    values: FloatArray | None,
    claims: tuple[float, ...],
) -> float:
    """The lower bound that prices and values prove; in case S of ratios that are claimed.

    Where the values are None, they are worked out afresh.
    """
    pricing = compiled.pricing

    def prove(weights: FloatArray) -> Proof:
        """What the values prove at weights of the rewards."""
        if values is None:
            return pricing.prove(weights, pricing.minimise(weights))
        return pricing.check(weights, values)

    ratios = [claim for claim in claims if claim > 0.0] if compiled.ratio else [0.0]
    return max([0.0, *(rows_bound(compiled, prices, bounds, r, prove)[0] for r in ratios)])


def _certified_lower_bound(
    compiled: CompiledProblem, row: FailureRow, price: float, slack: bool, solution: Solution
) -> tuple[float, float]:
    """Lower bound of the objective, and the relative gap that truncation leaves in it."""
    slack = slack and row.ratio
    price = price * BELOW_RATIO if slack else price
    proof = compiled.pricing().check(price, np.asarray(solution.value_function), slack=slack)
    bound = row.lower_bound(proof)
    lost = compiled.tail_loss(price, slack=slack, proof=proof)
    if lost == 0.0:
        return bound, 0.0
    return bound, relative_gap(row.lower_bound(replace(proof, bound=proof.bound + lost)), bound)


def _goal_certificate(problem: Problem, found: Evaluation) -> Certificate:
    """The probability attained, and a checked bound of what can be, above or below it."""
    aim = problem.semantics.aim
    start = start_distribution(problem.model, problem.start)
    bound = float(start @ extreme_goal_reach(problem.model, aim, start).bound)
    return certificate_of(found, bound, 1.0, above=aim is not Aim.LEAST_GOAL)


def _worth_certificate(solution: Solution, found: Evaluation) -> Certificate:
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
        allowed = _allowed(max(budget, 0.0), least)
        row = FailureRow(allowed, problem.ratio, compiled.lowest)
        values, levels = np.asarray(values), levels_of(solution.policy.policies, len(values))
        priced = row.lower_bound(compiled.matching(values, levels).pricing().check(price, values))
        bound = max(priced, bound) if row.leaves_only(least.column) else priced
    failing = problem.semantics.failing_worth
    value = failing - found.objective
    is_rounding = ObjectiveSense(failing).settled_bound(value, bound) == value
    worth = found.objective if is_rounding else failing - bound
    return certificate_of(found, worth, allowed, reason, above=True)


def _risk_certificate(solution: Solution, found: Evaluation) -> Certificate:
    """A risk given success, and a bound below it that is searched for afresh."""
    if not np.isfinite(found.objective):
        return certificate_of(found, 0.0, 1.0, "the goal is never reached")
    bound, allowed = risk_bound(solution.problem, found.objective, CERTIFYING)
    return certificate_of(found, bound, allowed)


def _least_failure_certificate(problem: Problem, found: Evaluation) -> Certificate:
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
    return certificate_of(found, bound, allowed)


_BUDGET_ROUNDING = 1e-12


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


def certificate_of(
    found: Evaluation,
    bound: float,
    budget: float,
    reason: str = "",
    *,
    tail: float = 0.0,
    above: bool = False,
) -> Certificate:
    """The verdict on a policy.

    Args:
        found: what it attains.
        bound: of every policy's objective.
        budget: the largest failure allowed.
        reason: why it is refused, if that is known already.
        tail: the part of the relative gap that a cap leaves.
        above: whether the bound is one from above.
    """
    failure = failure_of(found)
    if not reason and failure > budget + _BUDGET_ROUNDING:
        reason = f"the policy fails with {failure:.12g}, above the budget {budget:.12g}"
    if not reason and not np.isfinite(found.objective):
        reason = f"the policy's objective is {found.objective}"
    beyond = (found.objective - bound) if above else (bound - found.objective)
    if not reason and beyond > CONTRADICTION * abs(found.objective) + _BUDGET_ROUNDING:
        side = "above" if above else "below"
        reason = f"the policy's value {found.objective!r} lies {side} its bound {bound!r}"
    return Certificate(
        objective=found.objective,
        lower_bound=bound if reason and not above else min(bound, found.objective),
        upper_bound=max(bound, found.objective) if above else None,
        failure=failure,
        budget=budget,
        budget_slack=budget - failure,
        tail_gap=tail,
        accepted=not reason,
        reason=reason,
    )


def failure_of(found: Evaluation) -> float:
    """The failure that a certificate's budget limits: discounted under a discount, else real."""
    discounted = found.discounted_failure
    return found.failure_probability if discounted is None else discounted
