"""Extreme probabilities of leaving a process by one of two exits, and the pairs that attain them.

The probabilities of the two exits are each summed from their own data, so that both are accurate
relative to their size. A pair attains the extreme if a policy that takes it whenever possible loses
no more than rounding. (In a loop that is rarely left, small losses of single steps add up.) If a
component is too large for state reduction, a coarser rule holds: a pair may lose a hundred times
``FAILURE_FLOOR`` in a step, and ``LEAST_BUDGET`` in total over the expected steps of a run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import cycle

import numpy as np

from ssp_lp.arrays import (
    FAILURE_FLOOR,
    LEAST_BUDGET,
    LEAST_RISE,
    MACHINE_EPSILON,
    MAXIMISER,
    BoolArray,
    FloatArray,
    IntArray,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import STOPS, check_time, closing, end_with_incumbent, pieces
from ssp_lp.dynamic_programming.bellman import MOST_CACHED, best_pairs, chosen_rows
from ssp_lp.dynamic_programming.dual_bound import dual_bound
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, EXACTLY_SOLVED
from ssp_lp.dynamic_programming.evaluation import (
    PRECISE,
    PROVED,
    PROVED_OF_MANY,
    Totals,
    evaluate_policy,
)
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.model.graph import nearer_pairs

_ONE, _WANTED, _OTHER = np.ones(1), np.array([1.0, 0.0]), np.array([0.0, 1.0])
_SMALL = 1e-2
_SWEEPS = 25  # sweeps before the first evaluation, more than most distances need in both directions
_MOST_SWEEPS = 300  # most sweeps if they alone enclose the optimum
_FOLLOWED = 8  # sweeps along the policy after each sweep over all pairs
_NEARER = 0.1  # factor of the distance between two attempts from above
_WAITED = 5  # sweeps from above that cost as much as one from below and those along the policy
_SLOWEST = 0.9999  # greatest rate of convergence at which an attempt from above is made
_QUICK = 0.1  # rate below which all states must be near, not the requested ones alone
_SOUGHT = 0.1  # least gain of a step, in floors
_ALIKE = 100.0  # loss of a step, in floors, that is allowed: far above the error of values


@dataclass(frozen=True, eq=False)
class ExtremeReach:
    """The greatest or least probability of leaving by the exit ``hit``, and its policy."""

    dynamics: Dynamics
    both: FloatArray  # [pairs, 2] probability of leaving by the wanted exit, and by the other
    choice: IntArray  # [states] a policy that attains it
    totals: Totals | None  # totals of both under this policy, if computed
    reach: FloatArray  # [states]
    bound: FloatArray  # [states] checked: no policy hits more often (greatest), or less often
    floor: float  # relative difference below which probabilities count as equal


def extreme_reach(
    dynamics: Dynamics,
    hit: FloatArray,
    miss: FloatArray,
    *,
    greatest: bool,
    start: FloatArray | None = None,
    precise: bool = True,
) -> ExtremeReach:
    """Compute the greatest or least probability of leaving by the exit ``hit``, from every state.

    The process must not have end components, so that every policy leaves it.

    Args:
        dynamics: the process.
        hit: probability of leaving the process by this exit, [pairs].
        miss: probability of leaving it by the other exit, [pairs].
        greatest: whether to maximise; else the probability is minimised.
        start: positive in the states in which the bound must be tight, [states]; None: all.
        precise: whether all pairs that attain the extreme are needed. If not, sweeps may
            enclose the greatest probability between two bounds, and if the time ends, the best
            policy found so far is returned.

    Raises:
        Stop: the time ended before there was a result.
    """
    # maximise the wanted exit, that is minimise the other: each is exact if it is small
    both = np.stack([hit, miss] if greatest else [miss, hit], axis=1)
    precise = precise or not greatest
    floor = 0.0 if dynamics.components.largest <= EXACTLY_SOLVED else FAILURE_FLOOR
    starts = (np.ones(dynamics.n_states) if start is None else start).nonzero()[0]
    choice, low, high = _swept_towards(
        dynamics,
        np.ascontiguousarray(both[:, 0]),
        starts,
        precise or dynamics.n_states <= DIRECT_STATES,
    )
    if high is None:
        high = np.ones_like(low)
        try:
            return _settled_reach(dynamics, both, choice, floor, greatest, start, precise)
        except STOPS as stop:
            if precise:
                raise
            end_with_incumbent(stop)
        if not low[starts].all():
            with closing():
                low = np.clip(evaluate_policy(dynamics, choice, both).values[:, 0], 0.0, 1.0)
    return ExtremeReach(dynamics, both, choice, None, low, high, floor)


def _settled_reach(
    dynamics: Dynamics,
    both: FloatArray,
    choice: IntArray,
    floor: float,
    greatest: bool,
    start: FloatArray | None,
    precise: bool,
) -> ExtremeReach:
    """Compute the greatest or least probability by policy iteration, with a checked bound."""
    wanted, other = (np.ascontiguousarray(column) for column in both.T)
    run = partial(
        iterate_policy, dynamics, both, _OTHER, floor=floor * (_SOUGHT if precise else 1.0)
    )
    few = dynamics.n_states <= DIRECT_STATES
    enough = None if few or precise else False
    settled = run(choice, precise=enough)
    if settled.totals[:, 0].min(initial=1.0) < _SMALL:  # too small to be computed from the other
        choice = iterate_policy(dynamics, wanted[:, None], -_ONE, settled.choice).choice
        settled = run(choice, precise=enough)
    starts = (np.ones(dynamics.n_states) if start is None else start).nonzero()[0]
    missed = np.clip(settled.totals[:, 1], 0.0, 1.0)
    bounded = partial(dual_bound, dynamics, other, start=start, least_loss=PROVED)
    least = bounded(missed, choice=settled.choice).values
    unproved = float((missed - least)[starts].max(initial=0.0))
    if unproved > (PROVED if few else np.inf if precise else PROVED_OF_MANY):
        settled = run(settled.choice, precise=True)  # a policy of longer runs may be better
        missed = np.clip(settled.totals[:, 1], 0.0, 1.0)
        least = bounded(missed, choice=settled.choice).values
    totals = evaluate_policy(dynamics, settled.choice, both, PRECISE)
    reach, missed = np.clip(totals.values, 0.0, 1.0).T
    least = np.minimum(least, missed)
    most = 1.0 - least
    if reach[starts].min(initial=1.0) < _SMALL:  # so small that 1 - least loses digits
        tight = partial(dual_bound, choice=settled.choice, start=start)
        most = np.minimum(most, -tight(dynamics, -wanted, -reach, floor=-1.0).values)
    highest = np.clip(most, reach, 1.0)
    reach = np.where(missed < reach, 1.0 - missed, reach)
    bound = np.maximum(highest, reach)
    if not greatest:
        reach = np.where(reach > missed, missed, 1.0 - reach)
        bound = np.clip(least, 0.0, reach)
    return ExtremeReach(dynamics, both, settled.choice, totals, reach, bound, floor)


@with_twin
def _swept_towards(
    dynamics: Dynamics, hit: FloatArray, focus: IntArray, precise: bool
) -> tuple[IntArray, FloatArray, FloatArray | None]:
    """Find a policy of nearly greatest probability of the wanted exit, by sweeps.

    The sweeps take the states in the order of their distance from the exit. Values rise from 0, and
    each is rounded down when its state takes a better pair. The policy attains these values. It
    also leaves the process, since values along a cycle would fall by rounding.

    Then values a little above these are swept, rounded up. If a sweep raises none of them, no
    policy attains more (optimistic value iteration: Hartmanns and Kaminski, CAV 2020).

    Args:
        dynamics: the process.
        hit: probability of leaving by the wanted exit, [pairs].
        focus: states at which the optimum must be enclosed.
        precise: whether policy iteration will follow, so that upper bounds are not needed.

    Returns:
        The policy, lower bounds of its values, and upper bounds of the optimum, [states] each. The
        upper bounds are near at the states ``focus``; they are None if not proved.
    """
    distance = np.zeros(dynamics.n_states, dtype=np.int32)
    choice = nearer_pairs(dynamics.graph, hit > 0.0, distance=distance)
    stuck, low = choice < 0, np.zeros(dynamics.n_states)
    if stuck.any():
        choice = np.where(stuck, nearer_pairs(dynamics.graph, dynamics.exits > 0.0), choice)
    choice = choice.astype(np.int32)
    loops = "policy_improvement.sweep_reach", "policy_improvement.follow_reach"
    is_compiled = accelerated(_SWEEPS * dynamics.transitions.nnz, *loops)
    if (precise and not is_compiled) or dynamics.is_solved_backwards:
        return choice, low, None
    order = np.argsort(distance, kind="stable").astype(np.uint32)
    order = order[~stuck[order]]
    directions = cycle((order, np.ascontiguousarray(order[::-1])))
    sweep = partial(_sweep, dynamics, hit, directions, is_compiled, choice)
    near, size, most, rate, next_attempt = 0.5 * PROVED, 0.0, 1.0, 1.0, 0
    try:
        for turn in range(_SWEEPS if precise else _MOST_SWEEPS):
            begun, size_before, most_before, rate_before = low.copy(), size, most, rate
            rise = sweep(low)
            step, size = low - begun, float(low[focus].min(initial=1.0))
            most = float(step.max(initial=0.0))
            rate = most / max(most_before, most, LEAST_RISE)
            # later rises are this share of the last one; at a low rate, all states converge
            slower = max(rate, rate_before)
            if not precise and size > 0.0 and slower < _SLOWEST and turn >= next_attempt:
                ahead = step * (2.0 * slower / (1.0 - slower))
                waiting = ahead[focus] if slower > _QUICK else ahead
                if float(waiting.max(initial=0.0)) <= near * size:
                    high, near = np.minimum(low + ahead + 0.5 * PROVED * size, 1.0), _NEARER * near
                    for ups in range(1, max(_WAITED * turn, _SWEEPS) + 1):
                        settled = sweep(high, up=True) <= 0.0
                        next_attempt = turn + 1 + ups // _WAITED  # at most half of the time
                        if ((high - low)[focus] > PROVED * size).any():
                            break
                        if settled:
                            return choice, low, high
            if rise == 0.0 or (turn > _SWEEPS and size >= 2.0 * size_before):
                break  # converged, or far from it
    except STOPS as stop:
        if precise or not low[focus].all():
            raise
        end_with_incumbent(stop)
    return choice, low, None


def _sweep(
    dynamics: Dynamics,
    hit: FloatArray,
    directions: Iterator[IntArray],
    is_compiled: bool,
    choice: IntArray,
    values: FloatArray,
    *,
    up: bool = False,
) -> float:
    """Sweep over all pairs, then several times over the chosen pairs; return the greatest rise.

    Args:
        dynamics: the process.
        hit: probability of leaving by the wanted exit, [pairs].
        directions: orders of the states, alternately forward and backward.
        is_compiled: whether to run compiled; otherwise numpy sweeps all states at once.
        choice: pairs by which values rise, changed in place, [states].
        values: changed in place, [states].
        up: whether to round up and leave the choice unchanged; otherwise round down.
    """
    order, rows, rise = next(directions), dynamics.transitions, 0.0
    if not is_compiled:
        slack = (int(np.diff(rows.indptr).max(initial=0)) + 5.0) * MACHINE_EPSILON
        for _ in range(1 if up else 1 + _FOLLOWED):
            backup = best_pairs(dynamics.pair_offsets, rows, -hit, -values)
            greatest = np.minimum(-(1.0 + slack if up else 1.0 - slack) * backup.minima[order], 1.0)
            rises = greatest - values[order]
            moved = rises != 0.0 if up else rises > LEAST_RISE
            values[order[moved]] = greatest[moved]
            if not up:
                choice[order[moved]] = backup.choice[order[moved]]
            rise = max(rise, float(rises.max(initial=0.0)))
        return rise
    from ssp_lp.compiled.policy_improvement import follow_reach, sweep_reach

    how = hit, MACHINE_EPSILON, up, choice.view(np.uint32), values
    for some in pieces(order.size, rows.nnz):
        rise = max(rise, sweep_reach(dynamics.rows, order[some], *how))
    if up or rise == 0.0:
        return rise
    pairs = own = choice[order]
    if rows.nnz > MOST_CACHED:  # rows next to each other are read faster
        rows, own = chosen_rows(rows, pairs), np.arange(order.size)
    indptr, indices = unsigned(rows.indptr), unsigned(rows.indices)
    parts = indptr[own], indptr[own + 1], indices, rows.data, order, hit[pairs]
    for number in range(_FOLLOWED):
        check_time()
        follow_reach(*parts, MACHINE_EPSILON, number % 2 == 0, values)
    return rise


def attaining_pairs(found: ExtremeReach) -> BoolArray:
    """Return a mask of pairs that attain the extreme probability, however often taken, [pairs]."""
    dynamics, choice, both = found.dynamics, found.choice, found.both
    totals = found.totals or evaluate_policy(dynamics, choice, both, PRECISE)
    high, lost = totals.values.T
    home = dynamics.pair_state
    gain, loss = (
        dynamics.moves.precise_advantages(*map(np.ascontiguousarray, parts))[0]
        for parts in zip(both.T, totals.values.T, totals.low.T, strict=True)
    )
    ahead = np.where((high < lost)[home], gain, -loss)  # each difference is exact if small
    size = np.minimum(high, lost)[home]  # the smaller one is accurate relative to its size
    slack = MAXIMISER * size if found.floor == 0.0 else _ALIKE * found.floor * high[home]
    slack = np.where(slack > 0.0, slack, MAXIMISER * lost[home])
    tied: BoolArray = np.asarray(ahead >= -slack)
    tied[choice] = True
    chosen = np.zeros_like(tied)
    chosen[choice] = True
    if found.floor > 0.0:
        lost = np.where(tied, np.maximum(-ahead, 0.0), np.inf)
        # losses of many steps add up
        allowed = LEAST_BUDGET / (2.0 * float(totals.runs.max()))
        if (tied & ~chosen & (lost > allowed)).any():  # another policy may be quicker
            kept, among, same = _with_pairs(dynamics, tied, choice)
            quickest = iterate_policy(among, np.ones((kept.size, 1)), _ONE, same)
            allowed = LEAST_BUDGET / (2.0 * float(quickest.runs.max()))
        return np.asarray(tied & (chosen | (lost <= allowed)))
    while (tied & ~chosen & (ahead < 0.0)).any():
        kept, among, same = _with_pairs(dynamics, tied, choice)
        worst = iterate_policy(among, both[kept], -_OTHER, same)
        if high.min() < _SMALL:
            worst = iterate_policy(among, both[kept], _WANTED, worst.choice)
        taken = kept[worst.choice]
        less, more = worst.totals.T
        loss = np.where(high < lost, high - less, more - lost)  # each difference is exact if small
        if (loss <= 10.0 * slack[taken]).all():
            break
        share = np.maximum(-ahead[taken], 0.0) * 2.0 * worst.runs
        share = np.where(chosen[taken], 0.0, share / slack[taken])
        if not share.any():
            break
        tied[taken[share > min(1.0, float(share.max()) * 0.5)]] = False
    return tied


def _with_pairs(
    dynamics: Dynamics, tied: BoolArray, choice: IntArray
) -> tuple[IntArray, Dynamics, IntArray]:
    """Return the tied pairs, the dynamics restricted to these, and the policy's pairs among these.

    Args:
        dynamics: the process.
        tied: mask of the pairs to keep, [pairs].
        choice: a policy of such pairs, [states].
    """
    kept = tied.nonzero()[0]
    place = np.full(len(tied), -1, dtype=np.int32)
    place[kept] = np.arange(kept.size)
    return kept, dynamics.restricted(kept), place[choice]
