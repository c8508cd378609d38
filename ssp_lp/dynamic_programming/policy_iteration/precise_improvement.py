"""Policy iteration where double precision cannot tell which pair is better.

The advantage of a pair in a loop that is left with probability q is q times what the choice is
worth: pairs are compared by advantages worked out in twice the working precision (``precise``).
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, first_minimisers, segment_minima, weighted
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.precise import precise_advantages
from ssp_lp.dynamic_programming.linear_systems.totals import evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration.leaving import leaving_chain
from ssp_lp.dynamic_programming.policy_iteration.settled import MOST_ROUNDS, Settled
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import SolverError

_PRECISE = 1e-24  # accuracy of evaluations in twice the working precision, relative

_WORTHLESS = 1e-16
"""Worth of all gains, relative to the values, for which policies could go round in circles."""


def improve_precisely(
    dynamics: Dynamics,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    work: Work,
) -> Settled:
    """Policy iteration in twice the working precision.

    Args:
        dynamics: the process.
        rewards: [pairs, rewards].
        weights: [rewards].
        choice: a policy that leaves, [states].
        work: done before.

    Raises:
        Stop: the time ended.
        SolverError: a policy that never leaves, or totals that cannot be verified.
    """
    pair_cost, offsets = weighted(rewards, weights), dynamics.pair_offsets
    before: IntArray | None = None
    last = np.inf
    for _ in range(MOST_ROUNDS):
        check_time()
        system, choice = leaving_chain(dynamics, choice, before)
        priced = evaluate_chain(system, pair_cost[choice][:, None], accuracy=_PRECISE)
        values, low = priced.values[:, 0], priced.low[:, 0]
        ahead, rounding = precise_advantages(
            dynamics.pair_state, dynamics.transitions, dynamics.exits, pair_cost, values, low
        )
        gain = -segment_minima(ahead + rounding, offsets) - 2.0 * float(priced.missed[0])
        better = np.flatnonzero(gain > 0.0)
        work = work + Work(1, system.products)
        most = float(gain.max(initial=0.0))
        worth = 2.0 * float(priced.runs.max(initial=0.0)) * most
        ended = worth <= _WORTHLESS * float(np.abs(values).max(initial=0.0)) and most > 0.5 * last
        last = most
        if ended or not better.size:
            totals = evaluate_chain(system, rewards[choice])
            return Settled(choice, totals.values, values, low, totals.runs, work)
        before, choice = choice, choice.copy()
        least = segment_minima(ahead, offsets)
        picks = np.array(offsets[:-1], dtype=np.int32)
        picks[np.diff(offsets) > 0] = first_minimisers(ahead, least, offsets)
        choice[better] = picks[better]
    raise SolverError("policy iteration goes round in circles")
