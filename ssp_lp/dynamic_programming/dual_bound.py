"""Certified lower bounds: values v with v <= T v, checked by one backup with its rounding.

If v satisfies v_s <= c_u + P_u v for every pair u of s, then v bounds the cost of every policy from
below: of those that leave the process by iterating the inequality, and of those that stay for ever
since staying is failure, which costs at least as much as v says. The inequality is checked as
``c_u + sum_j p_uj (v_j - v_s) - exit_u v_s >= 0`` (see ``precise``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.accelerator import accelerated
from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, segment_minima
from ssp_lp.bellman import best_pairs, unsigned_parts
from ssp_lp.dynamic_programming.approach import approach
from ssp_lp.dynamic_programming.backward import is_solved_backwards, least_backwards
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.policy_iteration import improve
from ssp_lp.dynamic_programming.precise import exact_sum, precise_advantages, safe_advantages
from ssp_lp.errors import SolverError

_ROUNDS = 12
_LOWERINGS = 4  # by what is lacking, before looking at where it is met again
_ROUNDED = 2e-15  # of a value: its own rounding and that of a backup
_TIED = 1024.0  # lacks within which a pair may turn out to be the best after lowering
_RUN_ACCURACY = 1e-3  # runs are used times 1.5 and checked
_STEPWISE = 4.0  # lacks by which values are lowered in every step
_LOST_AT_ONCE = 1e-13  # share of the values that this may cost
_LARGE = 50_000  # states from which looking for the least that will do takes too long
_SLIGHT = 1e-13  # share by which a large model's values are lowered throughout
_SHRINKAGES = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)

_SPARE = 16.0  # lacks within which a pair is taken to be as good as the best

_HOPELESS = 1e-3
"""Lack, relative to the values, from which they are those of no near-optimal policy."""

_LONGEST = 1e9  # steps, beyond which shrinking by the lack's share cannot help
_LEAST_SCALE = 1e-300

_LOST = 1e-11
"""Share of the values that lowering them may cost before they are worked out more precisely."""

_NEARLY = 1e-9
"""Lack, relative to the values, up to which they are thought to be optimal but for rounding."""

_ONE = np.ones(1)


@dataclass(frozen=True, eq=False)
class DualBound:
    """Values that bound the optimum from below, as sums of two numbers."""

    values: FloatArray  # [states]
    low: FloatArray  # [states] to be added to the values

    def at(self, start: FloatArray) -> float:
        """The bound where an episode begins, rounded down.

        Args:
            start: distribution, [states].
        """
        used = np.flatnonzero(start)
        parts = start[used] * self.values[used]
        rounding = np.where(start[used] == 1.0, 0.0, np.abs(parts))  # a term of its own is exact
        summands = float(used.size - 1)
        lost = float(rounding.sum()) + summands * float(np.abs(parts).sum())
        correction = float(start[used] @ self.low[used])
        total = float(parts.sum()) + correction
        if correction != 0.0:
            lost += 2.0 * abs(total)
        return total - lost * float(np.finfo(np.float64).eps)


def shortfall(dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray) -> FloatArray:
    """How far each state's value exceeds its backup, rounding counted against us, [states]."""
    rows, exits = dynamics.transitions, dynamics.exits
    if accelerated(rows.nnz):
        from ssp_lp.compiled.precise import shortfalls

        lack = np.empty(dynamics.n_states)
        parts = unsigned_parts(dynamics.pair_offsets, rows)
        shortfalls(rows.nnz)(*parts, exits, pair_cost, values, MACHINE_EPSILON, lack)
        return lack
    ahead = safe_advantages(dynamics.pair_state, rows, exits, pair_cost, values)
    return np.maximum(-segment_minima(ahead, dynamics.pair_offsets), 0.0)


def dual_bound(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    floor: float = 0.0,
    choice: IntArray | None = None,
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

    Returns:
        Values that are checked lower bounds of the optimum.
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    if choice is not None:
        lowered = _lowered_at_once(dynamics, pair_cost, values, floor, choice)
        if lowered is not None:
            return DualBound(lowered, np.zeros_like(lowered))
    lack = shortfall(dynamics, pair_cost, values)
    lowered = _lowered(dynamics, pair_cost, values, lack, floor)
    bound = DualBound(lowered, np.zeros_like(lowered))
    scale = float(np.abs(values).max(initial=0.0))
    if float((values - lowered).max(initial=0.0)) <= _LOST * scale:
        return bound
    if float(lack.max(initial=0.0)) > _NEARLY * scale:
        return bound
    precise = _precise_bound(dynamics, pair_cost, values)
    return bound if precise is None else precise


def sub_solution(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    floor: float = 0.0,
    choice: IntArray | None = None,
) -> FloatArray:
    """Lower the given values to ones that pass the check in working precision, [states].

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        values: near-optimal values, or any others, [states].
        floor: a constant that is known to be a sub-solution.
        choice: a policy of about these values, which leaves, [states].
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    if choice is not None:
        lowered = _lowered_at_once(dynamics, pair_cost, values, floor, choice)
        if lowered is not None:
            return lowered
    lack = shortfall(dynamics, pair_cost, values)
    return _lowered(dynamics, pair_cost, values, lack, floor)


def _lowered_at_once(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, floor: float, choice: IntArray
) -> FloatArray | None:
    """Values lowered by what the worst near-optimal policy gathers; None where that costs much.

    A step gathers a few times the greatest lack, less what its pair is worse than the best: of
    least such totals w, ``v + w`` lacks nothing.
    """
    if not is_solved_backwards(dynamics):
        return None
    ahead = safe_advantages(
        dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, values
    )
    lack = -float(ahead.min(initial=0.0))
    if lack <= 0.0:
        return values
    policy = choice.astype(np.int32, copy=False)
    for step in (_STEPWISE * lack, _STEPWISE**2 * lack):
        try:
            _, fall = least_backwards(dynamics, np.maximum(ahead - step, 0.0) - step, policy)
        except SolverError:
            return None
        if float(fall.min()) < -_LOST_AT_ONCE * float(np.abs(values).max()):
            return None
        lowered = np.maximum(values + fall, floor)
        if not shortfall(dynamics, pair_cost, lowered).any():
            return lowered
    return None


def _lowered(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
    floor: float,
) -> FloatArray:
    """Values lowered until nothing lacks."""
    if not lack.any():
        return values

    def passes(lowered: FloatArray) -> bool:
        return not shortfall(dynamics, pair_cost, lowered).any()

    def shrunk(share: float) -> FloatArray:
        return np.asarray(floor + (1.0 - share) * (values - floor))

    if floor == 0.0 and len(values) > _LARGE and passes(lowered := shrunk(_SLIGHT)):
        return lowered
    lowered, still = values, lack
    for _ in range(_LOWERINGS):
        lowered = np.maximum(lowered - still, floor)
        still = shortfall(dynamics, pair_cost, lowered)
        if not still.any():
            return lowered
    worst = float(lack.max())
    rounding = np.minimum(_ROUNDED * np.abs(values), worst)
    share = worst / max(float(np.abs(values).max()), _LEAST_SCALE)
    for least in (rounding, np.full_like(values, worst)) if share <= _HOPELESS else ():
        run = _longest_run(dynamics, pair_cost, values, lack, least)
        if run is None:
            continue
        for factor in (1.5, 4.0, 16.0, 64.0, 1024.0):
            lowered = np.maximum(values - factor * run, floor)
            if passes(lowered):
                return lowered
    for smaller in _SHRINKAGES:
        if smaller > share / _LONGEST and passes(lowered := shrunk(smaller)):
            return lowered
    return np.full_like(values, floor)


def _longest_run(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
    least: FloatArray,
) -> FloatArray | None:
    """Total lack gathered along the worst near-optimal policy, [states]; None if it is endless.

    A state that comes to lack something counts with at least ``least``, [states]. Lowering the
    values by this amount absorbs the lack wherever it is met again: the violation times the longest
    expected run (DESIGN, section 5). States that never meet it are left alone.
    """
    pair_offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    worst_lack, met = float(lack.max()), lack > 0
    ahead = pair_cost + transitions @ values
    backup = best_pairs(pair_offsets, transitions, pair_cost, values)
    choice = backup.choice
    spare = ahead - np.repeat(backup.minima, np.diff(pair_offsets))
    spare[spare <= _TIED * worst_lack] = 0.0
    run: FloatArray | None = None
    for _ in range(_ROUNDS):
        reward = np.where(met, np.maximum(lack, least), 0.0)
        try:
            run = dynamics.chain(choice).solve(reward, run, _RUN_ACCURACY)
        except SolverError:
            return None
        if not (run >= 0.0).all():
            return None
        worst = best_pairs(pair_offsets, transitions, spare, -run, choice)
        changed = worst.minima < worst.here - 0.1 * reward
        if not changed.any() and np.array_equal(met, run > 0):
            return run
        met = run > 0
        choice = np.where(changed, worst.choice, choice)
    return run


def _precise_bound(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray
) -> DualBound | None:
    """The bound of a policy that is optimal in twice the working precision; None: there is none."""
    choice = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values).choice
    try:
        choice = _leaving(dynamics, choice)
        settled = improve(dynamics, pair_cost[:, None], _ONE, choice, precise=True)
        ahead = _precisely_ahead(dynamics, pair_cost, settled.values, settled.low)
        lack = max(-float(ahead.min(initial=0.0)), 0.0)
        tied = ahead <= _SPARE * lack
        for _ in range(_ROUNDS):
            tied[settled.choice] = True
            kept = np.flatnonzero(tied)
            place = np.cumsum(tied) - 1
            steps = -np.ones((kept.size, 1))
            longest = improve(dynamics.restricted(kept), steps, _ONE, place[settled.choice])
            fall = -4.0 * lack * longest.values  # absorbs the lack wherever it is met again
            lowered = exact_sum(settled.values, settled.low - fall)
            if (_precisely_ahead(dynamics, pair_cost, *lowered) >= 0.0).all():
                return DualBound(*lowered)
            tied = ahead <= max(float(fall.max(initial=0.0)), _SPARE * lack)
            if np.count_nonzero(tied) <= kept.size:
                lack *= _SPARE
    except SolverError:
        return None
    return None


def _precisely_ahead(
    dynamics: Dynamics, pair_cost: FloatArray, high: FloatArray, low: FloatArray
) -> FloatArray:
    """Advantages in twice the working precision, rounding counted against us, [pairs]."""
    ahead, rounding = precise_advantages(
        dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, high, low
    )
    return ahead - rounding


def _leaving(dynamics: Dynamics, choice: IntArray) -> IntArray:
    """A policy that leaves: where one does not, states go by the nearest way out instead."""
    closed = dynamics.chain(choice).closed
    if not closed.size:
        return choice
    nearest = approach(dynamics, dynamics.exits > 0.0)
    mixed = choice.copy()
    mixed[closed] = nearest[closed]
    return mixed if not dynamics.chain(mixed).closed.size else nearest
