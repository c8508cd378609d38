"""What prices of the rows prove: certified lower bounds by Lagrange's relaxation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.constrained_search import Pool, Rows, first_rows
from ssp_lp.column_generation.pricing.pricing_problem import Proof

_BELOW = 2.5e-10  # relative step below a ratio, where it is strictly best to fail


def lagrange_bound(least: float, prices: FloatArray, bounds: FloatArray) -> float:
    """The lower bound ``least - prices @ bounds``, rounding counted against it.

    Args:
        least: certified bound of ``cost + prices @ activity`` of every policy.
        prices: >= 0, [rows].
        bounds: [rows].
    """
    paid = float(prices @ bounds)
    return least - paid - (len(prices) + 1.0) * MACHINE_EPSILON * float(prices @ np.abs(bounds))


def proved_bound(
    compiled: CompiledConstrained, rows: Rows, prices: FloatArray, ratio: float, pool: Pool
) -> tuple[float, Proof]:
    """A certified lower bound of every lottery within the rows, at prices.

    Args:
        compiled: the problem.
        rows: what is limited.
        prices: [rows] >= 0.
        ratio: case S: the value that is to be proved.
        pool: policies to begin with.
    """
    n_rewards, found = compiled.pricing.rewards.shape[1], []
    for priced in ratios_below(ratio) if compiled.ratio else (0.0,):
        weights = replace(rows, ratio=priced).weights(prices, 1.0, n_rewards)
        start = pool.columns[int(np.argmin(weights @ pool.figures))]
        proof = compiled.pricing.proved(weights, start)
        every = np.zeros(n_rewards - 1)
        every[rows.index - 1] = prices
        bounds = np.zeros(n_rewards - 1)
        bounds[rows.index - 1] = rows.bounds
        found.append((rows_bound(compiled, every, bounds, priced, proof), proof))
    return max(found, key=lambda pair: pair[0])


def ratios_below(ratio: float) -> tuple[float, float]:
    """Ratios at which a proof is tried: the value itself, and one at which failing is best."""
    return ratio, ratio * (1.0 - _BELOW)


def rows_bound(
    compiled: CompiledConstrained,
    prices: FloatArray,
    bounds: FloatArray,
    ratio: float,
    proof: Proof,
) -> float:
    """What a checked bound of the priced cost says of the objective.

    As ``cost - ratio * goal >= D`` for every lottery within the rows, the cost given success is at
    least ``ratio + D / goal``.

    Args:
        compiled: the problem.
        prices: of all rows, [rows].
        bounds: of the same, finite, [rows].
        ratio: case S: the value that is to be proved.
        proof: at these prices and the ratio as a price of failure.
    """
    paid, less = ratio if compiled.ratio else compiled.sense.shift, -np.inf
    if paid > 0.0:
        weights = np.append(1.0, prices)
        less = compiled.pricing.check_less(weights, ratio, compiled.own_cost, paid, proof.values)
    beyond = max(
        lagrange_bound(proof.bound, prices, bounds) - paid, lagrange_bound(less, prices, bounds)
    )
    if not compiled.ratio or beyond >= 0.0:
        return paid + beyond if not compiled.ratio else ratio
    goal = compiled.least_goal
    return max(ratio + beyond / goal, 0.0) if goal > 0.0 else 0.0


def bound_at(compiled: CompiledConstrained, prices: Mapping[str, float], ratio: float) -> float:
    """A certified lower bound of every lottery within the rows, at prices by name.

    Args:
        compiled: the problem, settled.
        prices: multipliers of the rows, >= 0.
        ratio: case S: the value that is to be proved.
    """
    pricing, pool = compiled.pricing, Pool(compiled.pricing, [compiled.pricing.first()])
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    rows = first_rows(pool, 1 + limited, compiled.bounds[limited])
    known = np.array([prices.get(compiled.names[k], 0.0) for k in limited.tolist()])
    weights = replace(rows, ratio=ratio).weights(known, 1.0, pricing.rewards.shape[1])
    pool.add(pool.priced(weights))
    return proved_bound(compiled, rows, known, ratio, pool)[0]
