"""Values lowered, as little as is needed, until no backup lies below them.

What lacks is the rounding of near-optimal values. Lowering a state by what it lacks makes its
predecessors lack as much, so that in a process that is long in leaving the lack of a step is met
again and again: values are lowered by what is gathered along a whole run.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray, segment_minima, unsigned
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.backward_induction import (
    is_compiled_backwards,
    is_solved_backwards,
    least_backwards,
)
from ssp_lp.dynamic_programming.bellman import PairCost, best_pairs, safe_minima, unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.advantages import safe_advantages
from ssp_lp.errors import SolverError

_ROUNDS = 12
_LOWERINGS = 4  # by what is lacking, before looking at where it is met again
_ROUNDED = 2e-15  # of a value: its own rounding and that of a backup
_TIED = 1024.0  # lacks within which a pair may turn out to be the best after lowering
_RUN_ACCURACY = 1e-3  # runs are used times 1.5 and checked
_STEPWISE = 4.0  # lacks by which values are lowered in every step
_LOST_AT_ONCE = 1e-13  # share of a value that this may cost
_LARGE = 50_000  # states from which looking for the least that will do takes too long
_SLIGHT = 1e-13  # share by which a large model's values are lowered throughout
_SHRINKAGES = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_HOPELESS = 1e-3
"""Lack, relative to the values, from which they are those of no near-optimal policy."""

_LONGEST = 1e9  # steps, beyond which shrinking by the lack's share cannot help
_LEAST_SCALE = 1e-300
_RAISING, _MOST_RAISING = 20, 5_000  # sweeps between two looks at what is lost still, and of all
_RAISED = 0.9  # share of the loss from which sweeps are too slow


def shortfall(dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray) -> FloatArray:
    """How far each state's value has to be lowered to its backup, rounding counted, [states]."""
    check_time()
    rows, exits = dynamics.transitions, dynamics.exits
    if accelerated(len(rows.indices)):
        from ssp_lp.compiled.precision import shortfalls_safely

        lack = np.empty(dynamics.n_states)
        parts = unsigned_parts(dynamics.pair_offsets, rows)
        run = shortfalls_safely(len(rows.indices))
        run(*parts, exits, pair_cost, values, MACHINE_EPSILON, lack)
        return lack
    ahead = safe_advantages(dynamics.pair_state, rows, exits, pair_cost, values)
    return np.maximum(-segment_minima(ahead, dynamics.pair_offsets), 0.0)


def lowered_at_once(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, floor: float, choice: IntArray
) -> FloatArray | None:
    """Values lowered by what the worst near-optimal policy gathers; None where that costs much.

    A step gathers a few times the greatest lack, less what its pair is worse than the best: of
    least such totals w, ``v + w`` lacks nothing. Without cycles each value is lowered to its backup
    in turn, ends first, which is the least that will do.
    """
    if not is_solved_backwards(dynamics):
        return None
    if is_compiled_backwards(dynamics) and dynamics.components.largest <= 1:
        from ssp_lp.compiled.precision import lower_in_order

        parts = unsigned_parts(dynamics.pair_offsets, dynamics.transitions)
        order, lowered = unsigned(dynamics.components.order), values.copy()
        lower_in_order(*parts, dynamics.exits, order, pair_cost, MACHINE_EPSILON, lowered)
        lowered = np.maximum(lowered, floor)
        if (lowered >= values - _LOST_AT_ONCE * np.abs(values)).all():
            return None if shortfall(dynamics, pair_cost, lowered).any() else lowered
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
        lowered = np.maximum(values + fall, floor)
        if (lowered < values - _LOST_AT_ONCE * np.abs(values)).any():
            return None
        if not shortfall(dynamics, pair_cost, lowered).any():
            return lowered
    return None


def lowered_until_nothing_lacks(
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
        """Whether lowered values lack nothing."""
        return not shortfall(dynamics, pair_cost, lowered).any()

    def shrunk(share: float) -> FloatArray:
        """The values, moved towards the floor by a share."""
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


def raised(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    lowered: FloatArray,
    values: FloatArray,
    asked: IntArray,
    enough: float,
) -> tuple[FloatArray, float]:
    """Lowered values raised again by backups rounded down, which keeps them a sub-solution.

    Sweeps end where no value that counts has lost more than enough, or where they are slow.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        lowered: a checked sub-solution, [states].
        values: what it was lowered from, [states].
        asked: the states that count.
        enough: what may be lost there.

    Returns:
        The sub-solution, and the most that is lost where it counts.
    """
    lost, size = values - lowered, np.abs(pair_cost)
    offsets, rows, cost = dynamics.pair_offsets, dynamics.transitions, PairCost(pair_cost)
    never, sweeps = np.full(len(size), -1.0), 0
    while lost[asked].max(initial=0.0) > enough and sweeps < _MOST_RAISING:
        for _ in range(_RAISING):
            lowered = np.maximum(lowered, safe_minima(offsets, rows, cost, size, never, lowered))
        before, lost = lost, values - lowered
        sweeps += _RAISING
        if (
            lost.max() > _RAISED * before.max()
            and lost[asked].max() > _RAISED * before[asked].max()
        ):
            break
    return lowered, float(lost[asked].max(initial=0.0))


def _longest_run(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
    least: FloatArray,
) -> FloatArray | None:
    """Total lack by which values are lowered along the worst near-optimal policy; None: endless.

    A state that comes to lack something counts with at least ``least``, [states]. Lowering the
    values by this amount absorbs the lack wherever it is met again: the violation times the longest
    expected run (mathematics, section 5). States that never meet it are left alone.
    """
    pair_offsets, transitions = dynamics.pair_offsets, dynamics.transitions
    worst_lack, met = float(lack.max()), lack > 0
    backup = best_pairs(pair_offsets, transitions, pair_cost, values)
    choice, spare = backup.choice, transitions @ values
    spare += pair_cost
    spare -= np.repeat(backup.minima, np.diff(pair_offsets))
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
