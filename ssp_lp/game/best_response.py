"""What the player answers to the adversary's weights, and the value iteration that finds it.

Value iteration from below has a stopping rule that is a bound (paper, sections 3.3 and 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from ssp_lp.arrays import IMPROVEMENT, MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.errors import wrong_argument

_ROUNDED_SUCCESS = 1e-12
"""Success up to which it is rounding, where it is what J_cond leaves over."""

_ROUNDED = 64.0 * MACHINE_EPSILON
"""Relative rounding of one backup; over a run it adds up to this share of 1 / (1 - gamma)."""


def check_alpha(alpha: object) -> None:
    """Raise :class:`ModelError` unless the adversary's weight of M_o lies in [0, 1]."""
    if not (isinstance(alpha, Real) and 0.0 <= float(alpha) <= 1.0):
        raise wrong_argument("alpha", "lie between 0 and 1", alpha)


@dataclass(frozen=True, eq=False)
class BestResponse:
    """A deterministic policy that minimises a weighted sum of the game's two costs.

    Where the goal is hardly ever reached J_cond is 1 but for rounding. Its player then counts it
    from ``origin`` 1: minus the success, a sum of its own in which no digit is lost.
    """

    objective: float  # J_obj(x'; pi), exact for the policy
    failing: float  # J_cond(x'; pi) - origin, exact for the policy
    bound: float  # no policy has less of weight * J_obj + weight * failing, at the weights asked
    strategy: Any = None  # the policy in the player's own form
    sweeps: int = 0  # Bellman backups that it took
    origin: float = 0.0  # 0, or 1 where the goal is hardly ever reached

    @property
    def condition(self) -> float:
        """J_cond(x'; pi) of the best response."""
        return self.origin + self.failing

    @property
    def success(self) -> float:
        """1 - J_cond of the best response: in case S E[gamma^T; goal]."""
        return (1.0 - self.origin) - self.failing

    @property
    def is_hopeful(self) -> bool:
        """Whether the best response's cost given success can be told."""
        return self.success > (0.0 if self.origin else _ROUNDED_SUCCESS)

    @property
    def ratio(self) -> float:
        """The best response's cost given success, J_obj / (1 - J_cond)."""
        return self.objective / self.success

    def payoff(self, objective_weight: float, condition_weight: float) -> float:
        """Payoff of the best response at other weights, J_cond counted from its origin."""
        return objective_weight * self.objective + condition_weight * self.failing

    def size(self, objective_weight: float, condition_weight: float) -> float:
        """Size of the best response's payoff in its parts, to which rounding is relative."""
        return objective_weight * self.objective + condition_weight * abs(self.failing)


@dataclass(frozen=True, eq=False)
class Iterated:
    """Result of value iteration: a policy, its exact costs, and a bound below all policies."""

    values: FloatArray  # [nodes] checked: at most the optimal value everywhere
    choice: IntArray  # [nodes] greedy pairs
    totals: FloatArray  # [nodes, costs] exact expected costs of that policy
    sweeps: int


def iterate_values(
    dynamics: Dynamics,
    costs: FloatArray,
    discount: float,
    weights: FloatArray,
    watched: FloatArray,
    *,
    accuracy: float,
    first_sweeps: int = 16,
    most_sweeps: int = 1 << 14,
) -> Iterated:
    """Best response by value iteration, T_alpha of section 3.5: minimise ``weights @ costs``.

    The iterates ``T^N J_0`` increase to the optimum from ``J_0 = 0``. The greedy policy, improved
    by its own values while that helps, bounds the optimum from above with its exact value; the
    iterate, once a backup with its rounding has confirmed it, from below. The iteration ends when
    the two meet where a run may begin; it is lifted to the policy's own value, lowered as far as
    that backup demands, so that slow loops do not hold it up. Where rounding keeps the two apart it
    ends too, with the distance that is left.

    Args:
        dynamics: every transition scaled by gamma, so that T is a contraction.
        costs: of each pair, non-negative, [pairs, costs].
        discount: gamma.
        weights: of the costs, non-negative, [costs].
        watched: how much each node counts when bounds are compared, [nodes].
        accuracy: relative distance of the two bounds to reach.
        first_sweeps: before a policy is improved by its own values.
        most_sweeps: beyond them sweeps only fight rounding.
    """
    pair_cost = costs @ weights
    values = np.zeros(dynamics.n_states)
    best, block, sweeps = -np.inf, first_sweeps, 0
    rounding = _ROUNDED / (1.0 - discount)
    choice: IntArray | None = None
    while True:
        if choice is None:
            for _ in range(block):  # of values that are nowhere above their backup
                backup = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values)
                values = np.maximum(values, backup.minima)
            choice, sweeps = backup.choice, sweeps + block
        choice, totals, steps = improved_response(dynamics, costs, weights, choice)
        attained, sweeps = totals @ weights, sweeps + steps
        lifted = sub_solution(dynamics, pair_cost, attained)
        values = np.maximum(lifted, sub_solution(dynamics, pair_cost, values))
        below, above = float(watched @ values), float(watched @ attained)
        stuck = best > -np.inf and above - below <= rounding * above
        if above - below <= accuracy * above or stuck or sweeps > most_sweeps:
            return Iterated(values, choice, totals, sweeps)
        best, block, choice = below, max(sweeps, first_sweeps), None


def improved_response(
    dynamics: Dynamics,
    costs: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    most_steps: float = 100,
) -> tuple[IntArray, FloatArray, int]:
    """A best response improved by its own values, its exact costs, and the backups that took."""
    pair_cost, steps = costs @ weights, 0
    offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    while True:
        totals = dynamics.chain(choice).solve(costs[choice])
        steps += 1
        backup = best_pairs(offsets, transitions, pair_cost, totals @ weights, choice)
        better = backup.minima < backup.here - IMPROVEMENT * np.abs(backup.here)
        if steps >= most_steps or not better.any():
            return choice, totals, steps
        choice = np.where(better, backup.choice, choice)
