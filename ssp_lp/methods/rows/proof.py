"""What prices of the rows prove: certified lower bounds by Lagrange's relaxation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import BELOW_RATIO, MACHINE_EPSILON, FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.pricing.pricing_problem import Proof
from ssp_lp.compiled.deadline import STOPS, closing, heed


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
    found = []
    every, bounds = np.zeros((2, rows.n_rewards - 1))
    every[rows.index - 1], bounds[rows.index - 1] = prices, rows.bounds
    for priced in ratios_below(ratio) if compiled.ratio else (0.0,):
        proof = pool.proved(replace(rows, ratio=priced).weights(prices))
        found.append((rows_bound(compiled, every, bounds, priced, proof), proof))
    return max(found, key=lambda pair: pair[0])


def bound_in_time(
    compiled: CompiledConstrained, rows: Rows, prices: FloatArray, ratio: float, pool: Pool
) -> tuple[float, FloatArray]:
    """``proved_bound`` and its values; where no time is left 0, and values that ask for the best.

    Args:
        compiled: the problem.
        rows: what is limited.
        prices: [rows] >= 0.
        ratio: case S: the value that is to be proved.
        pool: policies to begin with.
    """
    try:
        with closing():
            bound, proof = proved_bound(compiled, rows, prices, ratio, pool)
        return bound, read_only(proof.values)
    except STOPS as stop:
        heed(stop)
        return 0.0, np.broadcast_to(np.inf, compiled.pricing.value_shape)


def ratios_below(ratio: float) -> tuple[float, float]:
    """Ratios at which a proof is tried: the value itself, and one at which failing is best."""
    return ratio, ratio * BELOW_RATIO


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
    """A proof of a lower bound of every lottery within the rows, at prices by name.

    Args:
        compiled: the problem, settled.
        prices: multipliers of the rows, >= 0.
        ratio: case S: the value that is to be proved.
    """
    pool = Pool(compiled.pricing, [compiled.pricing.first()])
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    rows = replace(pool.rows(1 + limited, compiled.bounds[limited]), ratio=ratio)
    known = np.array([prices.get(compiled.names[k], 0.0) for k in limited.tolist()])
    pool.add(pool.priced(rows.weights(known)))
    return proved_bound(compiled, rows, known, ratio, pool)[0]
