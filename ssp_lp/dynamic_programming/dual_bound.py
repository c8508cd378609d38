"""Certified lower bounds: values v with v <= T v, T the Bellman operator, checked with rounding.

If v satisfies v_s <= c_u + P_u v for every pair u of s, then v bounds the cost of every policy from
below. For policies that leave the process this follows by iterating the inequality. Policies that
stay for ever fail, and failing costs at least v. The inequality is checked as ``c_u +
sum_j p_uj (v_j - v_s) - exit_u v_s >= 0`` (see ``evaluation``).

Values that satisfy the inequality are a sub-solution. Near-optimal values violate it by rounding
only, and are lowered as little as possible. The violation at a state is called its lack. Lowering a
state by its lack lowers the backups of its predecessors, which then violate the inequality. Each
value is therefore lowered by the sum of the lacks along a whole run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    exact_sum,
    segment_minima,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import PairCost, best_pairs, safe_minima
from ssp_lp.dynamic_programming.dynamics import Dynamics, leaving_chain
from ssp_lp.dynamic_programming.equations import DIRECT_STATES
from ssp_lp.dynamic_programming.evaluation import NEARLY, PROVED, PROVED_OF_MANY, RUN_ACCURACY
from ssp_lp.dynamic_programming.policy_iteration import improve_backwards, iterate_policy
from ssp_lp.errors import SolverError
from ssp_lp.model.graph import nearer_pairs

_ROUNDS = 12
_SPARE = 16.0  # reduced cost, in lacks, up to which a pair counts as optimal
_LOWERINGS = 4  # lowerings by the lack alone, before runs are considered
_ROUNDED = 2e-15  # relative rounding of a value and of its backup
_TIED = 1024.0  # reduced cost, in lacks, up to which a pair may become optimal by lowering
_STEPWISE = 4.0  # lacks by which values are lowered in every step
_LARGE = 50_000  # number of states from which on the least lowering takes too long to find
_HOPELESS = 1e-3
"""Lack, relative to the values, above which the values are not near-optimal."""

_LONGEST = 1e9  # run length above which shrinking by the lack's share cannot help
_RAISING, _MOST_RAISING = 20, 5_000  # sweeps between two checks of the loss, and most sweeps
_RAISED = 0.9  # remaining share of the loss from which on sweeps are too slow
_RAISED_OF_FEW = 0.6  # the same for few states, whose equations are solved faster than sweeps
_ONE = np.ones(1)


@dataclass(frozen=True, eq=False)
class DualBound:
    """Lower bounds of the optimal values, each the sum of two floats, ``values + low``."""

    values: FloatArray  # [states]
    low: FloatArray  # [states] to be added to the values

    @property
    def rounded(self) -> FloatArray:
        """The bound of each state as one number, rounded down, [states]."""
        below = np.nextafter(self.values, -np.inf)
        return np.where(self.low == 0.0, self.values, below)

    def at(self, start: FloatArray) -> float:
        """Return the bound at the start of an episode, rounded down.

        Args:
            start: distribution, [states].
        """
        used = start.nonzero()[0]
        parts = start[used] * self.values[used]
        rounding = np.where(start[used] == 1.0, 0.0, np.abs(parts))  # a single term is exact
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
    """Reduce given values as little as possible to a checked sub-solution.

    If runs are very long, even values that are optimal to rounding would have to be lowered by more
    than rounding. Such values are recomputed in twice the working precision.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        values: near-optimal values, or any others (the bound is then worse), [states].
        floor: a constant that is known to be a sub-solution: 0 if no pair cost is negative.
        choice: a policy that ends every run and has about these values, [states].
        start: positive in states where the bound must be near the values, [states]; None: all.
        least_loss: lowering of a value that is small enough, if the values are probabilities; these
            are not recomputed if there are many states. None: a share of the greatest value.

    Returns:
        Values that are checked lower bounds of the optimum.
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    if choice is not None:
        lowered = lowered_along_longest_run(dynamics, pair_cost, values, floor, choice)
        if lowered is not None:
            return DualBound(lowered, np.zeros_like(lowered))
    starts = (np.ones_like(values) if start is None else start).nonzero()[0]
    scale = float(np.abs(values).max(initial=0.0))
    enough = PROVED * scale if least_loss is None else least_loss
    lack, worst = shortfall(dynamics, pair_cost, values), np.inf
    lowered = np.full_like(values, floor)
    many = dynamics.n_states > DIRECT_STATES
    if many and lack.any() and least_loss is not None:  # for probabilities, sweeps often suffice
        lowered, worst = raised(dynamics, pair_cost, lowered, values, starts, enough)
    if worst > enough:
        found = lowered_to_backups(dynamics, pair_cost, values, lack, floor)
        lowered = np.maximum(lowered, found)  # the maximum of two sub-solutions is one
        lowered, worst = raised(dynamics, pair_cost, lowered, values, starts, enough)
    bound = DualBound(lowered, np.zeros_like(lowered))
    if worst <= (PROVED_OF_MANY * scale if many else enough) or (many and least_loss is not None):
        return bound
    if float(lack.max(initial=0.0)) > NEARLY * scale:
        return bound
    precise = _precise_bound(dynamics, pair_cost, values)
    return bound if precise is None else precise


def sub_solution(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, floor: float = 0.0
) -> FloatArray:
    """Reduce given values to a sub-solution that is checked in working precision.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        values: near-optimal values, or any others, [states].
        floor: a constant that is known to be a sub-solution.
    """
    values = np.maximum(np.where(np.isfinite(values), values, floor), floor)
    lack = shortfall(dynamics, pair_cost, values)
    return lowered_to_backups(dynamics, pair_cost, values, lack, floor)


def _precise_bound(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray
) -> DualBound | None:
    """Compute a bound by policy iteration in twice the working precision; None if that fails."""
    choice = best_pairs(dynamics.pair_offsets, dynamics.transitions, pair_cost, values).choice
    try:
        nearest = nearer_pairs(dynamics.graph, dynamics.exits > 0.0)
        choice = leaving_chain(dynamics, choice, nearest)[1]
        settled = iterate_policy(dynamics, pair_cost[:, None], _ONE, choice, precise=True)
        ahead = _bound_advantages(dynamics, pair_cost, settled.values, settled.low)
        lack = max(-float(ahead.min(initial=0.0)), 0.0)
        tied = ahead <= _SPARE * lack
        for _ in range(_ROUNDS):
            tied[settled.choice] = True
            kept = tied.nonzero()[0]
            place = np.cumsum(tied) - 1
            steps = -np.ones((kept.size, 1))
            longest = iterate_policy(dynamics.restricted(kept), steps, _ONE, place[settled.choice])
            with np.errstate(over="ignore"):
                fall = -4.0 * lack * longest.values  # absorbs the lack along the longest run
            if not (fall < np.abs(settled.values)).any():  # nothing can be proved
                return None
            lowered = exact_sum(settled.values, settled.low - fall)
            if (_bound_advantages(dynamics, pair_cost, *lowered) >= 0.0).all():
                return DualBound(*lowered)
            tied = ahead <= max(float(fall.max(initial=0.0)), _SPARE * lack)
            if np.count_nonzero(tied) <= kept.size:
                lack *= _SPARE
    except SolverError:
        return None
    return None


def _bound_advantages(
    dynamics: Dynamics, pair_cost: FloatArray, high: FloatArray, low: FloatArray
) -> FloatArray:
    """Return lower bounds of advantages, computed in twice the working precision, [pairs]."""
    ahead, rounding = dynamics.moves.precise_advantages(pair_cost, high, low)
    return ahead - rounding


@with_twin
def shortfall(dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray) -> FloatArray:
    """Return upper bounds of the excess of values over their backups, at least 0, [states]."""
    check_time()
    if accelerated(len(dynamics.transitions.indices), "equations.shortfalls_safely"):
        from ssp_lp.compiled.equations import shortfalls_safely

        lack = np.empty(dynamics.n_states)
        run = shortfalls_safely(len(dynamics.transitions.indices))
        run(*dynamics.rows, pair_cost, values, MACHINE_EPSILON, lack)
        return lack
    ahead = dynamics.moves.safe_advantages(pair_cost, values)
    return np.maximum(-segment_minima(ahead, dynamics.pair_offsets), 0.0)


@with_twin
def lowered_along_longest_run(
    dynamics: Dynamics, pair_cost: FloatArray, values: FloatArray, floor: float, choice: IntArray
) -> FloatArray | None:
    """Reduce values v to a sub-solution along the worst near-optimal policy.

    In a process without cycles each value is lowered to its backup, ends first, which is the least
    possible lowering. With cycles, let each step cost the advantage of its pair, less a few times
    the greatest lack, and let w be the least expected totals of these costs: ``v + w`` is a
    sub-solution.

    Returns:
        The sub-solution. None if values had to be lowered by more than rounding, or if a component
        is too large.
    """
    if not dynamics.is_solved_backwards:
        return None
    n_entries = len(dynamics.transitions.indices)
    if dynamics.components.largest <= 1 and accelerated(n_entries, "equations.lower_in_order"):
        from ssp_lp.compiled.equations import lower_in_order

        order, lowered = unsigned(dynamics.components.order), values.copy()
        lower_in_order(*dynamics.rows, order, pair_cost, MACHINE_EPSILON, lowered)
        lowered = np.maximum(lowered, floor)
        if (lowered >= values - IMPROVEMENT * np.abs(values)).all():
            return None if shortfall(dynamics, pair_cost, lowered).any() else lowered
    ahead = dynamics.moves.safe_advantages(pair_cost, values)
    lack = -float(ahead.min(initial=0.0))
    if lack <= 0.0:
        return values
    policy = choice.astype(np.int32, copy=False)
    for step in (_STEPWISE * lack, _STEPWISE**2 * lack):
        try:
            _, fall = improve_backwards(dynamics, np.maximum(ahead - step, 0.0) - step, policy)
        except SolverError:
            return None
        lowered = np.maximum(values + fall, floor)
        if (lowered < values - IMPROVEMENT * np.abs(values)).any():
            return None
        if not shortfall(dynamics, pair_cost, lowered).any():
            return lowered
    return None


def lowered_to_backups(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
    floor: float,
) -> FloatArray:
    """Reduce values to a sub-solution; ``lack``, [states], is their excess over their backups."""
    if not lack.any():
        return values

    def passes(lowered: FloatArray) -> bool:
        """Return whether lowered values are a sub-solution."""
        return not shortfall(dynamics, pair_cost, lowered).any()

    def shrunk(share: float) -> FloatArray:
        """Return the values, moved towards ``floor`` by a share of their distance."""
        return np.asarray(floor + (1.0 - share) * (values - floor))

    if floor == 0.0 and len(values) > _LARGE and passes(lowered := shrunk(IMPROVEMENT)):
        return lowered
    lowered, still = values, lack
    for _ in range(_LOWERINGS):
        lowered = np.maximum(lowered - still, floor)
        still = shortfall(dynamics, pair_cost, lowered)
        if not still.any():
            return lowered
    worst = float(lack.max())
    rounding = np.minimum(_ROUNDED * np.abs(values), worst)
    scale = float(np.abs(values).max())
    share = worst / scale if scale > 0.0 else np.inf
    for least in (rounding, np.full_like(values, worst)) if share <= _HOPELESS else ():
        run = _longest_run(dynamics, pair_cost, values, lack, least)
        if run is None:
            continue
        for factor in (1.5, 4.0, 16.0, 64.0, 1024.0):
            lowered = np.maximum(values - factor * run, floor)
            if passes(lowered):
                return lowered
    for smaller in 10.0 ** np.arange(-12, 0):
        if smaller > share / _LONGEST and passes(lowered := shrunk(smaller)):
            return lowered
    return np.full_like(values, floor)


def raised(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    lowered: FloatArray,
    values: FloatArray,
    focus: IntArray,
    tolerated_loss: float,
) -> tuple[FloatArray, float]:
    """Raise a sub-solution, made by lowering values, by backups that are rounded down.

    The result is a sub-solution, too. The loss of a state is its original value minus its raised
    value. Sweeps end if the loss at all states ``focus`` is small enough, or falls too slowly.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        lowered: a checked sub-solution, [states].
        values: the original values, before they were lowered, [states].
        focus: states at which the loss must be small.
        tolerated_loss: loss that is small enough.

    Returns:
        The sub-solution, and the greatest loss at the states ``focus``.
    """
    lost, size = values - lowered, np.abs(pair_cost)
    offsets, rows, cost = dynamics.pair_offsets, dynamics.transitions, PairCost(pair_cost)
    never, sweeps = np.full(len(size), -1.0), 0
    slow = _RAISED if dynamics.n_states > DIRECT_STATES else _RAISED_OF_FEW
    while lost[focus].max(initial=0.0) > tolerated_loss and sweeps < _MOST_RAISING:
        for _ in range(_RAISING):
            lowered = np.maximum(lowered, safe_minima(offsets, rows, cost, size, never, lowered))
        before, lost = lost, values - lowered
        sweeps += _RAISING
        if lost.max() > slow * before.max() and lost[focus].max() > slow * before[focus].max():
            break
    return lowered, float(lost[focus].max(initial=0.0))


def _longest_run(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    values: FloatArray,
    lack: FloatArray,
    least: FloatArray,
) -> FloatArray | None:
    """Sum the lacks along the worst near-optimal policy, from each state, [states].

    Values lowered by a small multiple of this sum are a sub-solution (mathematics, section 5).
    States from which no lack is reached do not change. A lack above 0 counts as at least ``least``,
    [states]. The result is None if the policy never ends.
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
            run = dynamics.chain(choice).solve(reward, run, RUN_ACCURACY)
        except SolverError:
            return None
        if not (run >= 0.0).all():
            return None
        worst = best_pairs(pair_offsets, transitions, spare, -run, choice)
        changed = worst.minima < worst.current_values - 0.1 * reward
        if not changed.any() and np.array_equal(met, run > 0):
            return run
        met = run > 0
        choice = np.where(changed, worst.choice, choice)
    return run
