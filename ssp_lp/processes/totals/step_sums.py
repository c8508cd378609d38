"""The steps of a model by what they cost, and the sums of them that can occur."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, concatenated_ranges, read_only
from ssp_lp.model import SSP
from ssp_lp.model.chunks import chunks
from ssp_lp.model.graph.kept import kept
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.processes.expectations import uniform_cost
from ssp_lp.processes.totals.lattice import Lattice

MOST_SUMS = 20_000
"""Sums up to which all of them are told apart, where there is room."""

_PRODUCTS = 50  # sums that are formed at once, times those that may be kept
_MOST_PLACES = 300_000  # states times sums that are followed through a model
_MOST_MARKS = 30_000_000  # sums times states, or times steps, whether they are met or not
_UNKNOWN, _BEYOND = -2, -1  # in place of the number of a total
_MOST_ROUNDS = 1_000
_SAME = 1e-11
"""Totals this near to each other, relative to the cap, are one summed in two ways; yet never so far
from each other as a small share of the cheapest step."""

_SHARE = 1e-3  # of the cheapest step


@kept
def step_lattice(model: SSP) -> tuple[Lattice, FloatArray]:
    """The distinct step costs to be summed, in place of layers: each outcome's position among them.

    Args:
        model: the model.

    Returns:
        A lattice of one layer per distinct cost, and the costs, the first of which is 0.
    """
    return _kinds_of_steps_to_sum(model, ~(dead_ends(model) | model.goal_mask))


@kept
def last_steps(model: SSP) -> tuple[Lattice, FloatArray]:
    """The distinct costs of steps into a goal, likewise: no sum goes on from them."""
    return _kinds_of_steps_to_sum(model, model.goal_mask)


def _kinds_of_steps_to_sum(model: SSP, counted: BoolArray) -> tuple[Lattice, FloatArray]:
    """Distinct costs of the steps into some states, [states], and each outcome's place there."""
    same = uniform_cost(model)
    chunk = chunks(model.n_outcomes)
    if same is not None and any(counted[model.successors[some]].any() for some in chunk):
        place = np.int32(same > 0.0)
        steps = read_only(np.unique([0.0, same]))
        ahead = np.broadcast_to(place, (model.n_outcomes,))
        return Lattice(Fraction(1), ahead, len(steps), int(place)), steps
    found = [np.zeros(0)]
    for some in chunks(model.n_outcomes):
        moving = counted[model.successors[some]] & (model.probabilities[some] > 0)
        found.append(np.unique(model.costs[some][moving]))
    distinct = np.unique(np.concatenate(found))
    steps = np.union1d(0.0, distinct)
    ahead = np.zeros(model.n_outcomes, dtype=np.int32)
    for some in chunks(model.n_outcomes):
        moving = counted[model.successors[some]] & (model.probabilities[some] > 0)
        ahead[some] = np.where(moving, np.searchsorted(steps, model.costs[some]), 0)
    least = int(distinct.size > 0 and distinct[0] > 0.0)
    return Lattice(Fraction(1), ahead, len(steps), least), read_only(steps)


def room_of(steps: FloatArray, cap: float) -> float:
    """Sums up to a cap that differ by so little are one.

    Args:
        steps: distinct costs of a step, the first of which is 0, [steps].
        cap: the greatest total.
    """
    cheapest = float(steps[1]) if len(steps) > 1 else cap
    return min(_SAME * cap, _SHARE * cheapest)


def sums_of(steps: FloatArray, cap: float, most: int) -> FloatArray | None:
    """The sums of steps below a cap, increasing; None: there are more than so many."""
    moves, found, room = steps[1:], np.zeros(1), room_of(steps, cap)
    if moves.size and cap > (most + 1) * float(moves[0]):
        return None  # the multiples of the cheapest are too many
    fresh, chunk = found, max(_PRODUCTS * (most + 1) // max(moves.size, 1), 1)
    while fresh.size:
        together = found
        for begin in range(0, fresh.size, chunk):
            reached = (fresh[begin : begin + chunk, None] + moves).ravel()
            reached = reached[reached < cap - room]
            together = np.unique(np.concatenate([together, reached]))
            together = together[np.diff(together, prepend=-np.inf) > room]
            if together.size > most:
                return None
        near = np.searchsorted(found, together - room)
        known = np.append(found, np.inf)[np.minimum(near, found.size)] - together <= room
        fresh, found = together[~known], together
    return found


def sums_in(model: SSP, cap: float, most: int) -> FloatArray | None:
    """The sums of steps below a cap that can occur in a model, increasing; None: too many.

    All sums of steps, if these are few, else those that some walk through the model makes.
    """
    steps = step_lattice(model)[1]
    found = sums_of(steps, cap, most)
    return _walked_sums(model, steps, cap, most) if found is None else found


def _walked_sums(model: SSP, steps: FloatArray, cap: float, most: int) -> FloatArray | None:
    """The sums that walks from any state make, by breadth.

    Totals are numbered as they are found: which one a total and a kind of step lead to is worked
    out once for all states.
    """
    n, kinds, room = model.n_states, len(steps), room_of(steps, cap)
    offsets, target, kind = _steps_to_sum(model, steps)
    state, number = np.arange(n), np.zeros(n, dtype=np.int64)
    sums, seen = np.zeros(1), np.ones(n, dtype=np.bool_)  # of totals by number, then the state
    leads = np.full(kinds, _UNKNOWN)  # number that a total and a kind of step lead to
    for _ in range(_MOST_ROUNDS):
        count = offsets[state + 1] - offsets[state]
        edge = concatenated_ranges(offsets[state], count)
        taken = np.repeat(number, count) * kinds + kind[edge]
        is_taken = np.zeros(len(leads), dtype=np.bool_)
        is_taken[taken] = True
        new = np.flatnonzero(is_taken & (leads == _UNKNOWN))
        reached = sums[new // kinds] + steps[new % kinds]
        leads[new] = _BEYOND
        new, reached = new[reached < cap - room], reached[reached < cap - room]
        every = np.concatenate([sums, reached])
        order = np.argsort(every, kind="stable")
        group = np.cumsum(np.diff(every[order], prepend=-np.inf) > room)
        name = np.empty(len(every), dtype=np.int64)
        name[order] = group - 1
        first = np.full(group[-1], len(every))
        np.minimum.at(first, name, np.arange(len(every)))
        fresh = np.sort(first[first >= len(sums)])
        first[name[fresh]] = np.arange(len(sums), len(sums) + len(fresh))
        leads[new] = first[name[len(sums) :]]
        sums = np.append(sums, every[fresh])
        if len(sums) > most or len(sums) * max(n, kinds) > _MOST_MARKS:
            return None
        leads = np.append(leads, np.full(len(fresh) * kinds, _UNKNOWN))
        known = np.append(seen, np.zeros(len(fresh) * n, dtype=np.bool_))
        seen, inside = known.copy(), leads[taken] != _BEYOND
        seen[leads[taken[inside]] * n + target[edge[inside]]] = True
        number, state = np.divmod(np.flatnonzero(seen & ~known), n)
        if not state.size:
            return np.sort(sums)
        if np.count_nonzero(seen) > _MOST_PLACES:
            return None
    return None


def _steps_to_sum(model: SSP, steps: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """The distinct (successor, kind of step) of each state's steps that go on: offsets, both."""
    pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    ended = dead_ends(model) | model.goal_mask
    moving = (model.probabilities > 0.0) & ~ended[model.successors] & ~ended[model.pair_state[pair]]
    place = model.pair_state[pair[moving]].astype(np.int64) * model.n_states
    place = place + model.successors[moving]
    every = np.unique(place * len(steps) + np.searchsorted(steps, model.costs[moving]))
    place, kind = np.divmod(every, len(steps))
    source, target = np.divmod(place, model.n_states)
    return np.searchsorted(source, np.arange(model.n_states + 1)), target, kind
