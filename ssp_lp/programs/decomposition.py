"""An occupation measure as a lottery over deterministic policies.

The measures of a process are a polytope whose vertices are those of deterministic policies
(Altman 1999; paper, section 2.2). A policy that only takes pairs with positive visits is split
off with the greatest weight that leaves no visit negative: one pair at least is used up, so that
there are at most as many members as pairs beyond one per state, and one more. At a vertex of a
program these are as many as its rows that are met with equality. What is left in the end are visits
that go round for ever; they cost nothing where the measure is optimal, and no policy needs them.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    segment_sums,
)
from ssp_lp.dynamic_programming.dynamics import leaving_choice
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.errors import SolverError
from ssp_lp.model.graph.reachability import nearer_pairs
from ssp_lp.processes.explicit import ExplicitProcess

_SEEN = 1e-9  # outflow that a solver's tolerance leaves meaningful
_LEVELS = (1e-8, 1e-7, 1e-6)
NOISES = ((_SEEN, 0.0), *((level, 0.0) for level in _LEVELS), *zip(_LEVELS, _LEVELS, strict=True))
"""Visits of states, and shares of them, that interior points leave where there are none."""

_DUST = 1e-12  # of a state's visits: less is rounding
_ROUNDED = 1e-15  # of them: what subtracting leaves
_REST = 1e-12  # weight that is not worth a member of its own
_ABOVE = 10.0  # times rounding: visits that count
_WRONG = 1e-8  # of a state's visits: what members may have too many
_USED_UP = 1e-9  # share of a pair's visits that rounding may leave of it


def balanced_visits(
    process: ExplicitProcess,
    visits: FloatArray,
    otherwise: IntArray,
    gives_up: BoolArray | None = None,
    noise: tuple[float, float] = NOISES[0],
) -> FloatArray:
    """The visits of the policy that draws each pair with its share of a solver's visits, [pairs].

    A solver's answer balances within its tolerance only; these are a policy's own, to rounding.
    Where nothing can come of going on, the policy gives up, if it may and ``gives_up`` is given.
    Visits that go round for ever are left out: no policy comes to them.

    Args:
        process: the process.
        visits: the solver's, [pairs].
        otherwise: a policy that leaves, for states that the solver's tolerance does not tell from
            unvisited ones, [states].
        gives_up: pairs by which a policy gives up, [pairs].
        noise: outflow of a state, and share of it, up to which a solver's visits are none.
    """
    kept = np.maximum(visits, 0.0)
    outflow = segment_sums(kept, process.pair_offsets)
    unseen = outflow <= noise[0] * min(float(outflow.max(initial=0.0)), 1.0)
    kept[kept <= noise[1] * outflow[process.pair_state]] = 0.0
    share = _decomposed_shares(process, kept, unseen, otherwise)
    if gives_up is not None:
        reaching = (share > 0.0) & (process.goal > 0.0)
        lost = nearer_pairs(process.dynamics.graph, reaching, share > 0.0) < 0
        lost &= segment_sums(gives_up.astype(np.float64), process.pair_offsets) > 0.0
        if lost.any():
            price = np.where(gives_up, process.cost, np.inf)
            share = _decomposed_shares(process, share, lost, _least_pairs(process, price))
    while True:
        drawn = np.flatnonzero(share)
        draws = sp.csr_array(
            (share[drawn], (process.pair_state[drawn], drawn)),
            shape=(process.n_states, process.n_pairs),
        )
        exits = np.asarray(draws @ process.dynamics.exits)
        chain = System(sp.csr_array(draws @ process.transitions), exits)
        if not chain.closed.size:
            break
        rounds = np.bincount(chain.closed, minlength=process.n_states) > 0
        share = _decomposed_shares(process, share, rounds, otherwise)
    return np.asarray(chain.solve_transposed(process.start)[process.pair_state] * share)


def _decomposed_shares(
    process: ExplicitProcess, visits: FloatArray, unseen: BoolArray, otherwise: IntArray
) -> FloatArray:
    """Probability of each pair in its state, [pairs]."""
    share = np.where(unseen[process.pair_state], 0.0, visits)
    share[otherwise[unseen]] = 1.0
    return np.asarray(share / segment_sums(share, process.pair_offsets)[process.pair_state])


def decomposed(
    process: ExplicitProcess, visits: FloatArray
) -> tuple[tuple[IntArray, ...], FloatArray, FloatArray]:
    """Deterministic policies and weights whose expected visits are the given ones.

    Args:
        process: the process.
        visits: of a measure that balances, [pairs].

    Returns:
        A pair of each state for each policy, the policies' weights, which sum to one, and the
        visits of this lottery, [pairs].

    Raises:
        SolverError: the visits are not those of any policy.
    """
    left, members, weights = visits.copy(), [], []
    followed = np.zeros_like(visits)
    outflow, remaining = segment_sums(visits, process.pair_offsets), 1.0
    safe = _nearer_to_leaving(process, visits, leaving_choice(process.dynamics, process.goal))
    while remaining > 0.0:
        rounding = max(_DUST * remaining, _ROUNDED) * outflow[process.pair_state]
        left[left <= rounding] = 0.0
        choice = _within_support(process, left, safe)
        own = process.dynamics.chain(choice.astype(np.int32)).solve_transposed(process.start)
        visited = (own * remaining > _ABOVE * rounding[choice]) & (left[choice] > 0.0)
        if not visited.any():
            break
        weight = min(float((left[choice[visited]] / own[visited]).min()), remaining)
        weight = remaining if remaining - weight <= _REST else weight
        members.append(choice)
        weights.append(weight)
        spent = np.zeros_like(left)
        spent[choice] = weight * own
        followed += spent
        used_up = np.abs(left - spent) <= _USED_UP * spent
        left = np.where(used_up, 0.0, np.maximum(left - spent, 0.0))
        remaining -= weight
    subtracted = _ABOVE * _ROUNDED * max(float(outflow.max(initial=0.0)), 1.0)
    excess = (followed - visits - subtracted)[visits > 0.0] / outflow[process.pair_state][
        visits > 0.0
    ]
    wrong = max(float(excess.max(initial=0.0)), remaining)
    if wrong > _WRONG:
        raise SolverError(f"the visits are no policy's: those of the lottery differ by {wrong:.1e}")
    total = np.sum(weights)
    return tuple(members), np.array(weights) / total, followed / total


def _least_pairs(process: ExplicitProcess, values: FloatArray) -> IntArray:
    """The pair of least value in each state, [states]."""
    offsets = process.pair_offsets
    return first_minimisers(values, segment_minima(values, offsets), offsets)


def _within_support(process: ExplicitProcess, visits: FloatArray, safe: IntArray) -> IntArray:
    """A policy for the decomposition that leaves, by pairs that are visited where there are such.

    The most visited pair of each state is taken where that leaves, else one by which a visited pair
    that leaves comes nearer.
    """
    supported, most = visits > 0.0, _least_pairs(process, -visits)
    choice = np.where(supported[most], most, safe)
    if not process.dynamics.chain(choice.astype(np.int32)).closed.size:
        return choice
    return _nearer_to_leaving(process, visits, safe)


def _nearer_to_leaving(
    process: ExplicitProcess, visits: FloatArray, otherwise: IntArray
) -> IntArray:
    """Visited pairs by which one that leaves comes nearer; ``otherwise`` where none does."""
    supported = visits > 0.0
    nearer = nearer_pairs(
        process.dynamics.graph, supported & (process.dynamics.exits > 0.0), supported
    )
    return np.where(nearer >= 0, nearer, otherwise)
