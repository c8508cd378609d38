"""The best lottery by what policies are worth on the model, where the process rounds totals.

On a grid of totals the process bounds every policy from below. The policies that it finds remember
the rounded total; what they cost and how they fail is evaluated with the true costs, and the
lottery is chosen by these numbers, so that it keeps to the budget and to all limits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.restricted_master import solve_master
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy

_MOST = 8  # policies of the search that are evaluated
_STEEPER = (0.01, 0.1, 1.0, 100.0)  # shares of the prices that are added for further ones
_RATIOS = 30  # steps of Dinkelbach's iteration
_SETTLED = 1e-13  # relative change of a ratio that is rounding


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
    policies = _candidates(compiled, rows, pool, weights)
    true = np.stack([figures(policy) for policy in policies], axis=1)
    taken, limits = true[rows.index], (rows.bounds, rows.scales)
    cost, failure = true[0], true[1]
    nearest = solve_master(cost, taken, *limits, elastic=True)
    if (taken @ nearest.weights > rows.bounds * (1.0 + 1e-12) + 1e-15).any():
        return None
    chosen = nearest.weights
    if not compiled.ratio:
        chosen = solve_master(cost, taken, *limits, elastic=False).weights
        return _lottery(policies, chosen), float(failure @ chosen)
    ratio = _ratio(cost, failure, chosen)
    if not np.isfinite(ratio):
        ratio = float((cost / np.maximum(1.0 - failure, 1e-300)).max()) + 1.0
    for _ in range(_RATIOS):
        found = solve_master(cost + ratio * failure, taken, *limits, elastic=False)
        attained = _ratio(cost, failure, found.weights)
        if not attained < ratio * (1.0 - _SETTLED):
            break
        chosen, ratio = found.weights, attained
    return _lottery(policies, chosen), float(failure @ chosen)


def _candidates(
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


def _lottery(policies: list[Policy], weights: FloatArray) -> MixedPolicy:
    used = np.flatnonzero(weights > 0.0)
    return MixedPolicy(tuple(policies[k] for k in used.tolist()), weights[used])


def _ratio(cost: FloatArray, failure: FloatArray, weights: FloatArray) -> float:
    goal = 1.0 - float(failure @ weights)
    return float(cost @ weights) / goal if goal > 0.0 else float("inf")
