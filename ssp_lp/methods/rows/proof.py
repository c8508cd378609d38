"""What prices of the rows prove: certified lower bounds by Lagrange's relaxation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import BELOW_RATIO, MACHINE_EPSILON, RELATIVE_GAP, FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.failure_row import relative_gap
from ssp_lp.column_generation.generation import generate
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.pricing.explicit_pricing import LARGEST
from ssp_lp.column_generation.pricing.pricing_problem import Proof
from ssp_lp.compiled.deadline import STOPS, closing, heed
from ssp_lp.errors import InfeasibleError
from ssp_lp.methods.rows.phase_one import phase_one_opening
from ssp_lp.options import CERTIFYING
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics


def lagrange_bound(least: float, prices: FloatArray, bounds: FloatArray) -> float:
    """The lower bound ``least - prices @ bounds``, rounding counted against it.

    Args:
        least: certified bound of ``cost + prices @ activity`` of every policy.
        prices: >= 0, [rows].
        bounds: [rows].
    """
    paid = float(prices @ bounds)
    return least - paid - (len(prices) + 1.0) * MACHINE_EPSILON * float(prices @ np.abs(bounds))


def bound_in_time(
    compiled: CompiledConstrained, rows: Rows, prices: FloatArray, ratio: float, pool: Pool
) -> tuple[float, FloatArray]:
    """A certified lower bound of every lottery within the rows, at prices, and its values.

    Where no time is left the bound is 0, and the values ask for the best.

    Args:
        compiled: the problem.
        rows: what is limited.
        prices: [rows] >= 0.
        ratio: case S: the value that is to be proved.
        pool: policies to begin with.
    """
    every, bounds = np.zeros((2, rows.n_rewards - 1))
    every[rows.index - 1], bounds[rows.index - 1] = prices, rows.bounds
    try:
        with closing():
            bound, proof = rows_bound(compiled, every, bounds, ratio, pool.proved)
        return bound, read_only(proof.values)
    except STOPS as stop:
        heed(stop)
        return 0.0, np.broadcast_to(np.inf, compiled.pricing.value_shape)


def rows_bound(
    compiled: CompiledConstrained,
    prices: FloatArray,
    bounds: FloatArray,
    ratio: float,
    prove: Callable[[FloatArray], Proof],
    least_goal: float | None = None,
) -> tuple[float, Proof]:
    """What checked bounds of the priced cost say of the objective, and the best of them.

    As ``cost - ratio * goal >= D`` for every lottery within the rows, the cost given success is at
    least ``ratio + D / goal``. That is tried at the ratio itself, and at one where failing is best.

    Args:
        compiled: the problem.
        prices: of all rows, [rows].
        bounds: of the same, finite, [rows].
        ratio: case S: the value that is to be proved.
        prove: a checked bound of every policy's totals, by the weights of the rewards.
        least_goal: a goal probability that all lotteries within the rows have; None: worked out
            where a bound without it is poor.
    """
    if not compiled.ratio:
        proof = prove(np.append(1.0, prices))
        proved = _beyond_paid(compiled, prices, bounds, 0.0, proof) + compiled.sense.shift
        return max(proved, 0.0), proof  # what is minimised is a sum of terms of at least 0
    found = []
    for priced in (ratio, ratio * BELOW_RATIO):
        proof = prove(np.concatenate([[1.0, prices[0] + priced], prices[1:]]))
        found.append((priced, _beyond_paid(compiled, prices, bounds, priced, proof), proof))

    def best(goal: float) -> tuple[float, Proof]:
        """The best bound, where every lottery has a goal probability."""
        goal = max(goal, compiled.least_goal, 1.0 / LARGEST)
        proved = [(max(r + min(beyond, 0.0) / goal, 0.0), proof) for r, beyond, proof in found]
        return max(proved, key=lambda pair: pair[0])

    bound = best(least_goal or 0.0)
    if least_goal is None and relative_gap(ratio, bound[0]) > RELATIVE_GAP:
        return best(least_goal_within(compiled, bounds))
    return bound


def _beyond_paid(
    compiled: CompiledConstrained,
    prices: FloatArray,
    bounds: FloatArray,
    ratio: float,
    proof: Proof,
) -> float:
    """By how much every lottery within the rows exceeds what every episode pays, at least."""
    paid, less = ratio if compiled.ratio else compiled.sense.shift, -np.inf
    if paid > 0.0:
        weights = np.append(1.0, prices)
        less = compiled.pricing.check_less(weights, ratio, compiled.own_cost, paid, proof.values)
    return max(
        lagrange_bound(proof.bound, prices, bounds) - paid, lagrange_bound(less, prices, bounds)
    )


def least_goal_within(compiled: CompiledConstrained, bounds: FloatArray) -> float:
    """A certified goal probability that every lottery within the rows has, by a search of its own.

    It follows from all rows together: where "little fuel" and "seldom the pit" leave no room for
    giving up, it is more than any of them says. Costs need not be told apart.

    Args:
        compiled: the problem, settled.
        bounds: of all rows, finite, [rows].
    """
    if compiled.budget is None:
        return compiled.least_goal
    semantics = FailureSemantics(aim=Aim.LEAST_GOAL)
    reach = replace(compiled, semantics=semantics, charge=None, ratio=False, rungs=None)
    try:
        opened = phase_one_opening(reach, reach, CERTIFYING)
    except InfeasibleError:
        return 0.0  # then no lottery is within the rows, and nothing is to be proved
    found, rows = generate(opened, CERTIFYING), opened.rows
    prices = np.zeros(len(bounds))
    prices[rows.index - 1] = found.prices
    return rows_bound(reach, prices, bounds, 0.0, opened.pool.proved)[0]


def bound_at(
    compiled: CompiledConstrained, prices: Mapping[str, float], ratio: float, least_goal: float
) -> float:
    """A proof of a lower bound of every lottery within the rows, at prices by name.

    Args:
        compiled: the problem, settled.
        prices: multipliers of the rows, >= 0.
        ratio: case S: the value that is to be proved.
        least_goal: a goal probability that all of them have.
    """
    pool = Pool(compiled.pricing, [compiled.pricing.first()])
    limited = np.isfinite(compiled.bounds)
    known = np.array([prices.get(name, 0.0) for name in compiled.names]) * limited
    bounds = np.where(limited, compiled.bounds, 0.0)
    pool.add(pool.priced(np.concatenate([[1.0, known[0] + ratio], known[1:]])))
    return rows_bound(compiled, known, bounds, ratio, pool.proved, least_goal)[0]
