"""Value iteration from below with a stopping rule that is a bound (paper, sections 3.3 and 3.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import IMPROVEMENT, MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.dynamic_programming.dual_bounds.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics

_FIRST_SWEEPS = 16
_MOST_SWEEPS = 1 << 14
"""Policies are improved by their own values, so that sweeps beyond this only fight rounding."""

_MOST_IMPROVEMENTS = 100
_ROUNDED = 64.0 * MACHINE_EPSILON
"""Relative rounding of one backup; over a run it adds up to this share of 1 / (1 - gamma)."""


@dataclass(frozen=True, eq=False)
class Discounted:
    """A discounted decision process with two costs per pair: the operator T_alpha of section 3.5.

    Every transition is scaled by gamma, so that T is a contraction.
    """

    dynamics: Dynamics
    costs: FloatArray  # [pairs, costs] non-negative
    discount: float  # gamma


@dataclass(frozen=True, eq=False)
class Iterated:
    """Where value iteration stopped: a policy, its exact costs, and a bound below all policies."""

    values: FloatArray  # [nodes] checked: at most the optimal value everywhere
    choice: IntArray  # [nodes] greedy pairs
    totals: FloatArray  # [nodes, costs] exact expected costs of that policy
    sweeps: int


def iterate_values(
    process: Discounted,
    weights: FloatArray,
    watched: FloatArray,
    *,
    accuracy: float,
    guess: IntArray | None = None,
) -> Iterated:
    """Minimise ``weights @ costs`` by value iteration.

    The iterates ``T^N J_0`` increase to the optimum from ``J_0 = 0``. The greedy policy, improved
    by its own values while that helps, bounds the optimum from above with its exact value; the
    iterate, once a backup with its rounding has confirmed it, from below. The iteration ends when
    the two meet where a run may begin; it is lifted to the policy's own value, lowered as far as
    that backup demands, so that slow loops do not hold it up. Where rounding keeps the two apart it
    ends too, with the distance that is left.

    Args:
        process: the process.
        weights: of the costs, non-negative, [costs].
        watched: how much each node counts when bounds are compared, [nodes].
        accuracy: relative distance of the two bounds to reach.
        guess: a policy to improve before the first sweep, [nodes].
    """
    dynamics, pair_cost = process.dynamics, process.costs @ weights
    values = np.zeros(dynamics.n_states)
    best, block, sweeps = -np.inf, _FIRST_SWEEPS, 0
    rounding = _ROUNDED / (1.0 - process.discount)
    choice = guess
    while True:
        if choice is None:
            values, choice = _swept(process, pair_cost, values, block)
            sweeps += block
        choice, totals, steps = improved(process, weights, choice)
        attained, sweeps = totals @ weights, sweeps + steps
        lifted = sub_solution(dynamics, pair_cost, attained)
        values = np.maximum(lifted, sub_solution(dynamics, pair_cost, values))
        below, above = float(watched @ values), float(watched @ attained)
        stuck = best > -np.inf and above - below <= rounding * above
        if above - below <= accuracy * above or stuck or sweeps > _MOST_SWEEPS:
            return Iterated(values, choice, totals, sweeps)
        best, block, choice = below, max(sweeps, _FIRST_SWEEPS), None


def _swept(
    process: Discounted, pair_cost: FloatArray, values: FloatArray, times: int
) -> tuple[FloatArray, IntArray]:
    """So many backups of values that are nowhere above their backup, and the greedy pairs."""
    dynamics = process.dynamics
    for _ in range(times):
        backup = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values)
        values = np.maximum(values, backup.minima)
    return values, backup.choice


def improved(
    process: Discounted, weights: FloatArray, choice: IntArray
) -> tuple[IntArray, FloatArray, int]:
    """A policy after improvement by its own values, its exact costs, and the backups that took."""
    dynamics, pair_cost, steps = process.dynamics, process.costs @ weights, 0
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    while True:
        totals = dynamics.chain(choice).solve(process.costs[choice])
        steps += 1
        backup = best_pairs(offsets, transitions, pair_cost, totals @ weights, choice)
        better = backup.minima < backup.here - IMPROVEMENT * np.abs(backup.here)
        if steps >= _MOST_IMPROVEMENTS or not better.any():
            return choice, totals, steps
        choice = np.where(better, backup.choice, choice)
