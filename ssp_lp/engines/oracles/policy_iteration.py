"""Policy iteration (Howard) on a substochastic process, from a policy that leaves it."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    IMPROVEMENT,
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    first_minimisers,
    segment_minima,
)
from ssp_lp.errors import SolverError
from ssp_lp.linear import DIRECT_STATES, accumulate

_ITERATIONS = 1_000
_ROUGH, _FINE = 1e-6, 1e-13  # relative residuals of evaluations
_NOISE = 100.0  # a rough residual grows by the length of a run


def improve(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    pair_cost: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
) -> tuple[IntArray, FloatArray]:
    """Minimise the expected total pair cost from every state.

    A state changes its pair only for a gain above rounding. Started from a policy whose chain is
    transient, every later policy is transient too, provided that an end component either does not
    exist or costs something (DESIGN, section 4): then the fixed point reached is the optimum.

    Args:
        pair_offsets: [states + 1].
        transitions: substochastic, [pairs, states].
        pair_cost: [pairs].
        choice: pair of the first policy in each state, [states].
        guess: values to start the first evaluation from, [states].

    Returns:
        The pair chosen in each state and the values of that policy, [states].

    Raises:
        SolverError: no convergence, or a policy that never leaves the process.
    """
    if len(choice) > DIRECT_STATES:  # come near with rough evaluations first
        near = _settle(pair_offsets, transitions, pair_cost, choice, guess, _ROUGH)
        if near is not None:
            choice, guess = near
    settled = _settle(pair_offsets, transitions, pair_cost, choice, guess, _FINE)
    if settled is None:
        raise SolverError(f"policy iteration did not settle in {_ITERATIONS} rounds")
    return settled


def _settle(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray | None,
    accuracy: float,
) -> tuple[IntArray, FloatArray] | None:
    """Policy iteration with evaluations of this accuracy, until no gain stands out from it.

    None where that does not happen; a rough evaluation may lead to a policy that never leaves.
    """
    for _ in range(_ITERATIONS):
        try:
            values = accumulate(transitions[choice], pair_cost[choice], values, accuracy=accuracy)
        except SolverError:
            if accuracy > _FINE:
                return None
            raise
        ahead = pair_cost + transitions @ values
        best = segment_minima(ahead, pair_offsets)
        here = ahead[choice]
        noise = IMPROVEMENT * np.abs(here)
        if accuracy > _FINE:
            noise = noise + _NOISE * accuracy * float(np.abs(values).max())
        better = best < here - noise
        if not better.any():
            return choice, values
        choice = np.where(better, first_minimisers(ahead, best, pair_offsets), choice)
    return None


def approach(pair_offsets: IntArray, transitions: sp.csr_array, leaving: BoolArray) -> IntArray:
    """A policy under which every state leaves through one of the leaving pairs.

    Each state takes a pair by which it may come nearer, in number of steps, to such a pair.

    Args:
        leaving: pairs that leave with positive probability, [pairs].

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    n_states = len(pair_offsets) - 1
    state_of = np.repeat(np.arange(n_states), np.diff(pair_offsets))
    choice = np.full(n_states, -1, dtype=np.int64)
    entering = transitions.tocsc()
    useful = np.flatnonzero(leaving)
    while useful.size:
        useful = useful[choice[state_of[useful]] < 0]
        states, first = np.unique(state_of[useful], return_index=True)
        choice[states] = useful[first]
        begin = entering.indptr[states]
        useful = np.unique(
            entering.indices[concatenated_ranges(begin, entering.indptr[states + 1] - begin)]
        )
    return choice
