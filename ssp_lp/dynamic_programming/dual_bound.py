"""Certified lower bounds: values v with v <= T v, checked by one backup with its rounding.

If v satisfies v_s <= c_u + P_u v for every pair u of s, then v bounds the cost of every policy from
below: of those that leave the process by iterating the inequality, and of those that stay for ever
since staying is failure, which costs at least as much as v says. The inequality is checked as
``c_u + sum_j p_uj (v_j - v_s) - exit_u v_s >= 0`` (see ``advantages``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.bellman import best_pairs
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.leaving import approach_leaving, leaving_chain
from ssp_lp.dynamic_programming.linear_systems.advantages import exact_sum, precise_advantages
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES
from ssp_lp.dynamic_programming.lowering import (
    lowered_at_once,
    lowered_until_nothing_lacks,
    raised,
    shortfall,
)
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.errors import SolverError

_ROUNDS = 12
_SPARE = 16.0  # lacks within which a pair is taken to be as good as the best
_LOST = 1e-11
"""Share of the values that lowering them may cost before they are worked out more precisely."""

_MORE_LOST = 50.0  # times that where there are many states, and each evaluation takes its time

_NEARLY = 1e-9
"""Lack, relative to the values, up to which they are thought to be optimal but for rounding."""

_ONE = np.ones(1)


@dataclass(frozen=True, eq=False)
class DualBound:
    """Values that bound the optimum from below, as sums of two numbers."""

    values: FloatArray  # [states]
    low: FloatArray  # [states] to be added to the values

    @property
    def rounded(self) -> FloatArray:
        """The bound of each state as one number, rounded down, [states]."""
        below = np.nextafter(self.values, -np.inf)
        return np.where(self.low == 0.0, self.values, below)

    def at(self, start: FloatArray) -> float:
        """The bound where an episode begins, rounded down.

        Args:
            start: distribution, [states].
        """
        used = start.nonzero()[0]
        parts = start[used] * self.values[used]
        rounding = np.where(start[used] == 1.0, 0.0, np.abs(parts))  # a term of its own is exact
        summands = float(used.size - 1)
        lost = float(rounding.sum()) + summands * float(np.abs(parts).sum())
        correction = float(start[used] @ self.low[used])
        total = float(parts.sum()) + correction
        if correction != 0.0:
            lost += 2.0 * abs(total)
        return total - lost * float(np.finfo(np.float64).eps)


def dual_bound(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    floor: float = 0.0,
    choice: IntArray | None = None,
    start: FloatArray | None = None,
    least_loss: float | None = None,
) -> DualBound:
    """Lower the given values, as little as is needed, to ones that pass the check.

    Values that are optimal but for rounding, and would have to be lowered by more than rounding
    since the process is hardly ever left, are worked out in twice the working precision.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        values: near-optimal values, or any others (the bound is then worse), [states].
        floor: a constant that is known to be a sub-solution: 0 where no pair cost is negative.
        choice: a policy of about these values, which leaves, [states].
        start: where the bound is to be near the values, positive there, [states]; None: everywhere.
        least_loss: how far below the values it may be, for probabilities, of which none is worked
            out more precisely where there are many; None: a share of their size.

    Returns:
        Values that are checked lower bounds of the optimum.
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    if choice is not None:
        lowered = lowered_at_once(dynamics, pair_cost, values, floor, choice)
        if lowered is not None:
            return DualBound(lowered, np.zeros_like(lowered))
    asked = (np.ones_like(values) if start is None else start).nonzero()[0]
    scale = float(np.abs(values).max(initial=0.0))
    enough = _LOST * scale if least_loss is None else least_loss
    lack, worst = shortfall(dynamics, pair_cost, values), np.inf
    lowered = np.full_like(values, floor)
    if lack.any() and least_loss is not None:  # of probabilities, which sweeps often settle
        lowered, worst = raised(dynamics, pair_cost, lowered, values, asked, enough)
    if worst > enough:
        found = lowered_until_nothing_lacks(dynamics, pair_cost, values, lack, floor)
        lowered = np.maximum(lowered, found)  # of two sub-solutions the greater is one
        lowered, worst = raised(dynamics, pair_cost, lowered, values, asked, enough)
    bound = DualBound(lowered, np.zeros_like(lowered))
    many = dynamics.n_states > DIRECT_STATES
    if worst <= (_MORE_LOST * enough if many else enough) or (many and least_loss is not None):
        return bound
    if float(lack.max(initial=0.0)) > _NEARLY * scale:
        return bound
    precise = _precise_bound(dynamics, pair_cost, values)
    return bound if precise is None else precise


def sub_solution(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, floor: float = 0.0
) -> FloatArray:
    """A dual bound that passes the check in working precision: the given values, lowered.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        values: near-optimal values, or any others, [states].
        floor: a constant that is known to be a sub-solution.
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    lack = shortfall(dynamics, pair_cost, values)
    return lowered_until_nothing_lacks(dynamics, pair_cost, values, lack, floor)


def _precise_bound(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray
) -> DualBound | None:
    """The bound of a policy that is optimal in twice the working precision; None: there is none."""
    choice = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values).choice
    try:
        nearest = approach_leaving(dynamics, dynamics.exits > 0.0)
        choice = leaving_chain(dynamics, choice, nearest)[1]
        settled = iterate_policy(dynamics, pair_cost[:, None], _ONE, choice, precise=True)
        ahead = _precisely_for_bound(dynamics, pair_cost, settled.values, settled.low)
        lack = max(-float(ahead.min(initial=0.0)), 0.0)
        tied = ahead <= _SPARE * lack
        for _ in range(_ROUNDS):
            tied[settled.choice] = True
            kept = tied.nonzero()[0]
            place = np.cumsum(tied) - 1
            steps = -np.ones((kept.size, 1))
            longest = iterate_policy(dynamics.restricted(kept), steps, _ONE, place[settled.choice])
            fall = -4.0 * lack * longest.values  # absorbs the lack wherever it is met again
            lowered = exact_sum(settled.values, settled.low - fall)
            if (_precisely_for_bound(dynamics, pair_cost, *lowered) >= 0.0).all():
                return DualBound(*lowered)
            tied = ahead <= max(float(fall.max(initial=0.0)), _SPARE * lack)
            if np.count_nonzero(tied) <= kept.size:
                lack *= _SPARE
    except SolverError:
        return None
    return None


def _precisely_for_bound(
    dynamics: Dynamics, pair_cost: FloatArray, high: FloatArray, low: FloatArray
) -> FloatArray:
    """Advantages in twice the working precision, rounding counted against us, [pairs]."""
    ahead, rounding = precise_advantages(
        dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, high, low
    )
    return ahead - rounding
