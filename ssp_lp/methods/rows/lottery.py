"""The best lottery within rows: of the process, and by what policies are worth on the model.

A cost given success is found by Dinkelbach's iteration over column generation. On a grid of totals
the process bounds every policy from below. The policies that it finds remember the rounded total;
what they cost and how they fail is evaluated with the true costs, and the lottery is chosen by
these numbers, so that it keeps to the budget and to all limits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.restricted_master import solve_master
from ssp_lp.column_generation.stabilised_master import StabilisedMaster
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem

_MOST = 8  # policies of the search that are evaluated
_STEEPER = (0.01, 0.1, 1.0, 100.0)  # shares of the prices that are added for further ones
_TRUE_RATIOS = 30  # steps of Dinkelbach's iteration
_TRUE_SETTLED = 1e-13  # relative change of a ratio that is rounding
_RATIOS = 40  # steps of Dinkelbach's iteration
_SETTLED = 1e-14  # relative change of a ratio that is rounding
_STEEP = 1e3  # factor of a ratio at which nothing reached the goal
_STEEPEST = 1e15


@dataclass(frozen=True, eq=False)
class Truth:
    """What a policy is worth by itself, where the process truncates or rounds it."""

    value: Callable[[MixedPolicy], float]  # of a lottery, in what is minimised
    figures: Callable[[Policy], FloatArray] | None = None  # cost, failure and rows of one policy


def best_lottery(
    compiled: CompiledConstrained, opened: StabilisedMaster, options: SolveOptions
) -> tuple[Generated, float]:
    """The best lottery over columns, and in case S its ratio (Dinkelbach's iteration)."""
    if not compiled.ratio:
        return generate(replace(opened), options), 0.0
    rule, best, ratio = opened, None, opened.rows.ratio
    for _ in range(_RATIOS):
        rule = replace(rule, rows=replace(opened.rows, ratio=ratio))
        found = generate(rule, options)
        attained = found.ratio
        if best is None and not np.isfinite(attained):
            ratio *= _STEEP
            if ratio > _STEEPEST:
                raise InfeasibleError(
                    "no policy that keeps to all limits reaches the goal: no cost given success "
                    "exists",
                    failure_budget=compiled.budget,
                    least_failure=max(1.0 - compiled.greatest_goal, 0.0),
                )
            rule = opened
            continue
        if best is not None and not attained < ratio * (1.0 - _SETTLED):
            return replace(found, columns=best.columns, weights=best.weights), ratio
        best, ratio, rule = found, attained, replace(rule, prices=found.prices, bound=0.0)
        if not found.finished or ratio == 0.0:
            break
    if best is None:
        raise SolverError("no policy that reaches the goal was found within the time limit")
    return best, ratio


def true_lottery(
    compiled: CompiledConstrained,
    rows: Rows,
    pool: Pool,
    weights: FloatArray,
    figures: Callable[[Policy], FloatArray],
) -> tuple[MixedPolicy, float] | None:
    """The best lottery within the rows, by true figures, and its failure.

    Args:
        compiled: the problem.
        rows: what is limited.
        pool: policies of the process; the first goes for the goal.
        weights: prices of their totals, by which the best are chosen, [rewards].
        figures: a policy's true cost, failure and rows.

    Returns:
        None where none of them keeps to the rows: the grid is too coarse.
    """
    policies = _lottery_candidates(compiled, rows, pool, weights)
    true = np.stack([figures(policy) for policy in policies], axis=1)
    taken_by_lottery, limits = true[rows.index], (rows.bounds, rows.scales)
    cost, failure = true[0], true[1]
    nearest = solve_master(cost, taken_by_lottery, *limits, elastic=True)
    if (taken_by_lottery @ nearest.weights > rows.bounds * (1.0 + 1e-12) + 1e-15).any():
        return None
    chosen = nearest.weights
    if not compiled.ratio:
        chosen = solve_master(cost, taken_by_lottery, *limits, elastic=False).weights
        return _lottery_of(policies, chosen), float(failure @ chosen)
    ratio = _ratio_of_lottery(cost, failure, chosen)
    if not np.isfinite(ratio):
        ratio = float((cost / np.maximum(1.0 - failure, 1e-300)).max()) + 1.0
    for _ in range(_TRUE_RATIOS):
        found = solve_master(cost + ratio * failure, taken_by_lottery, *limits, elastic=False)
        attained = _ratio_of_lottery(cost, failure, found.weights)
        if not attained < ratio * (1.0 - _TRUE_SETTLED):
            break
        chosen, ratio = found.weights, attained
    return _lottery_of(policies, chosen), float(failure @ chosen)


def _lottery_candidates(
    compiled: CompiledConstrained, rows: Rows, pool: Pool, weights: FloatArray
) -> list[Policy]:
    """The best policies of the search and, where something is limited, some of steeper prices.

    What breaks a limit by rounding needs a policy on the other side.
    """
    pricing, order = compiled.pricing, np.argsort(weights @ pool.figures, kind="stable")
    best = pool.columns[int(order[0])]
    if not compiled.ratio and rows.index.size == 0:
        return [pricing.policy(best)]
    least = np.where(
        rows.bounds > 0.0, weights[0] * float(best.figures @ weights) / rows.scales, 0.0
    )
    points = [pool.columns[k] for k in order[:_MOST].tolist()]
    for factor in _STEEPER:
        steeper = weights.copy()
        steeper[rows.index] += factor * np.maximum(weights[rows.index], least)
        points.append(pricing.minimise(steeper, best))
    return [pricing.policy(point) for point in points]


def _lottery_of(policies: list[Policy], weights: FloatArray) -> MixedPolicy:
    """The lottery of the policies that have a weight."""
    used = np.flatnonzero(weights > 0.0)
    return MixedPolicy(tuple(policies[k] for k in used.tolist()), weights[used])


def _ratio_of_lottery(cost: FloatArray, failure: FloatArray, weights: FloatArray) -> float:
    """The cost given success of a lottery."""
    goal = float((1.0 - failure) @ weights)
    return float(cost @ weights) / goal if goal > 0.0 else float("inf")


def truth_of(problem: Problem, stated: CompiledConstrained) -> Truth | None:
    """What the policies of a lottery are worth on the model itself, where tables truncate them."""
    if stated.charge is None:
        return None

    def value(policy: MixedPolicy) -> float:
        """What a lottery is worth, in what is minimised."""
        attained = evaluate(policy, problem).objective
        return attained if stated.sense.constant is None else stated.sense.constant - attained

    def figures(policy: Policy) -> FloatArray:
        """Cost, failure and rows of one policy."""
        found = evaluate(policy, problem)
        failure = found.discounted_failure
        failure = found.failure_probability if failure is None else failure
        cost = found.objective * (1.0 - failure) if failure < 1.0 else 0.0
        if not stated.ratio:
            cost = value(MixedPolicy((policy,), np.ones(1)))
        return np.array([cost, failure, *taken_by_lottery(stated, found)])

    return Truth(value, figures)


def taken_by_lottery(stated: CompiledConstrained, found: Evaluation) -> list[float]:
    """What a policy of the lottery takes of each row beside failure."""
    spent = found.secondary_costs
    return [row.activity(spent[row.condition.name]) for row in stated.side]
