"""Extreme probabilities of leaving a process by one of two ways, and the pairs that attain them.

Hitting and missing are each summed from their own exits, so that both keep their relative accuracy
where they are small. A pair is as good as the best where taking it, as often as it comes round,
loses no more than rounding: one that loses little at a time, in a loop that is hardly ever left,
may lose everything.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import MAXIMISER, BoolArray, FloatArray, IntArray
from ssp_lp.dynamic_programming.dual_bound import dual_bound
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.leaving import approach_leaving
from ssp_lp.dynamic_programming.linear_systems.advantages import precise_advantages
from ssp_lp.dynamic_programming.policy_iteration import Settled, evaluate_policy, iterate_policy

_ONE, _WANTED, _OTHER = np.ones(1), np.array([1.0, 0.0]), np.array([0.0, 1.0])
_SMALL = 1e-2
_PROVED = 1e-11  # gap of a probability that rounding may leave
_PRECISE = 1e-24  # accuracy of probabilities, relative to the greatest, where pairs are compared


def extreme_reach(
    dynamics: Dynamics, hit: FloatArray, miss: FloatArray, *, greatest: bool
) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
    """The greatest or the least probability of hitting, from every state.

    No policy may be able to stay for ever (end components are contracted, or there are none).

    Args:
        dynamics: the process.
        hit: probability of leaving it by hitting, [pairs].
        miss: probability of leaving it otherwise, [pairs].
        greatest: or least.

    Returns:
        The probability, [states], a checked bound of it: no policy hits more often (greatest), or
        less often (least), who attains it, [states], and the pairs that do, [pairs].
    """
    wanted, other = hit, miss
    if dynamics.n_states == 0:
        return hit[:0], hit[:0], np.zeros(0, dtype=np.int32), wanted > 0.0
    if not greatest:
        wanted, other = other, wanted
    # what is wanted is maximised, which is to minimise the other: each is exact where it is small
    choice = approach_leaving(dynamics, wanted > 0.0)
    stuck = choice < 0
    if stuck.any():
        choice = np.where(stuck, approach_leaving(dynamics, dynamics.exits > 0.0), choice)
    both = np.stack([wanted, other], axis=1)
    settled = iterate_policy(dynamics, both, _OTHER, choice.astype(np.int32))
    if settled.totals[:, 0].min() < _SMALL:  # so small that the other cannot tell
        choice = iterate_policy(dynamics, wanted[:, None], -_ONE, settled.choice).choice
        settled = iterate_policy(dynamics, both, _OTHER, choice)
    missed = np.clip(settled.totals[:, 1], 0.0, 1.0)
    least = dual_bound(dynamics, other, missed, choice=settled.choice).values
    if float((missed - least).max()) > _PROVED:  # a policy of longer runs may be better
        settled = iterate_policy(dynamics, both, _OTHER, settled.choice, precise=True)
        missed = np.clip(settled.totals[:, 1], 0.0, 1.0)
        least = dual_bound(dynamics, other, missed, choice=settled.choice).values
    totals = evaluate_policy(dynamics, settled.choice, both, _PRECISE)
    won, lost = totals.values.T
    tied = _tied_in_reach(dynamics, settled, wanted, other, (won, totals.low[:, 0]), lost)
    reach, missed = np.clip(won, 0.0, 1.0), np.clip(lost, 0.0, 1.0)
    least = np.minimum(least, missed)
    most = 1.0 - least
    if reach.min() < _SMALL:  # so small that 1 - least loses digits of it
        above = -dual_bound(dynamics, -wanted, -reach, floor=-1.0, choice=settled.choice).values
        most = np.minimum(most, above)
    highest = np.clip(most, reach, 1.0)
    reach = np.where(missed < reach, 1.0 - missed, reach)
    if greatest:
        return reach, np.maximum(highest, reach), settled.choice, tied
    hit = np.where(reach > missed, missed, 1.0 - reach)
    return hit, np.clip(least, 0.0, hit), settled.choice, tied


def _tied_in_reach(
    dynamics: Dynamics,
    settled: Settled,
    wanted: FloatArray,
    other: FloatArray,
    won: tuple[FloatArray, FloatArray],
    lost: FloatArray,
) -> BoolArray:
    """Pairs by which nothing is lost, however often they come round, [pairs]."""
    home, (high, low) = dynamics.pair_state, won
    ahead, _ = precise_advantages(home, dynamics.transitions, dynamics.exits, wanted, high, low)
    size = np.minimum(high, lost)[home]  # the smaller of both is known to that relative accuracy
    size = np.where(size > 0.0, size, np.maximum(high, lost)[home])
    tied = ahead >= -MAXIMISER * size
    tied[settled.choice] = True
    chosen = np.zeros_like(tied)
    chosen[settled.choice] = True
    while (tied & ~chosen & (ahead < 0.0)).any():
        kept = np.flatnonzero(tied)
        place = np.full(len(tied), -1, dtype=np.int32)
        place[kept] = np.arange(kept.size)
        among = dynamics.restricted(kept)
        both = np.stack([wanted[kept], other[kept]], axis=1)
        worst = iterate_policy(among, both, -_OTHER, place[settled.choice])
        if high.min() < _SMALL:
            worst = iterate_policy(among, both, _WANTED, worst.choice)
        taken = kept[worst.choice]
        less, more = worst.totals.T
        loss = np.where(high < lost, high - less, more - lost)  # each is exact where it is small
        if (loss <= 10.0 * MAXIMISER * size[taken]).all():
            break
        share = np.maximum(-ahead[taken], 0.0) * 2.0 * worst.runs
        share = np.where(chosen[taken], 0.0, share / size[taken])
        if not share.any():
            break
        tied[taken[share > min(MAXIMISER, float(share.max()) * 0.5)]] = False
    return tied
