"""Policy iteration (Howard) on a substochastic process, from a policy that leaves it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import IMPROVEMENT, BoolArray, FloatArray, IntArray, segment_ids
from ssp_lp.bellman import ChosenRows, best_pairs
from ssp_lp.engines.oracles.oracle import Work
from ssp_lp.errors import SolverError
from ssp_lp.linear import DIRECT_STATES, EXACT, accumulate
from ssp_lp.model.approach import nearer_pairs
from ssp_lp.model.predecessors import find_predecessors

_ITERATIONS = 1_000
_ROUGH, _FINE = 0.1, EXACT  # relative residuals of evaluations: the first one, the last one
_LAST_GAINS = 1e-4  # gains, relative to the values, after which evaluations are exact
_FORCING = 0.1  # share of the last gain, relative to the values, that an evaluation may miss by
_NOISE = 0.01  # of a rough residual: changes for less may go back and forth


@dataclass(frozen=True, eq=False)
class Settled:
    """A policy that no single change of a pair improves, with its expected totals."""

    choice: IntArray  # [states]
    totals: FloatArray  # [states, rewards]
    values: FloatArray  # [states] the totals, weighted
    work: Work


def improve(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    guess: FloatArray | None = None,
) -> Settled:
    """Minimise the expected total of ``rewards @ weights`` from every state.

    A state changes its pair only for a gain above rounding. Started from a policy whose chain is
    transient, every later policy is transient too, provided that an end component either does not
    exist or costs something (DESIGN, section 4): then the fixed point reached is the optimum.
    Evaluations are as exact as the last gain warrants; the last one is exact.

    Args:
        pair_offsets: [states + 1].
        transitions: substochastic, [pairs, states].
        rewards: one or more rewards of each pair, [pairs, rewards].
        weights: [rewards].
        choice: pair of the first policy in each state, [states].
        guess: totals to start the first evaluation from, [states, rewards].

    Raises:
        SolverError: no convergence, or a policy that never leaves the process.
    """
    choice = np.asarray(choice, dtype=np.int32)
    if len(choice) > DIRECT_STATES:
        settled = _settle(pair_offsets, transitions, rewards, weights, choice, guess, _ROUGH)
        if settled is not None:
            return settled
    settled = _settle(pair_offsets, transitions, rewards, weights, choice, None, _FINE)
    if settled is None:
        raise SolverError(f"policy iteration did not settle in {_ITERATIONS} rounds")
    return settled


def _settle(
    pair_offsets: IntArray,
    transitions: sp.csr_array,
    rewards: FloatArray,
    weights: FloatArray,
    choice: IntArray,
    totals: FloatArray | None,
    accuracy: float,
) -> Settled | None:
    """Policy iteration whose evaluations become exact as the gains shrink.

    None where a rough evaluation led to a policy that never leaves, or it does not end.
    """
    pair_cost, rough = rewards @ weights, accuracy > _FINE
    products = 0
    chain = ChosenRows(transitions, choice).gathered()
    for backups in range(1, _ITERATIONS + 1):
        try:
            totals = accumulate(chain, rewards[choice], totals, accuracy=accuracy)
        except SolverError:
            if rough:
                return None
            raise
        values = totals @ weights
        backup = best_pairs(pair_offsets, transitions, pair_cost, values, choice)
        scale = max(float(np.abs(values).max(initial=0.0)), 1e-300)
        noise = IMPROVEMENT * np.abs(backup.here)
        if accuracy > _FINE:
            noise = noise + _NOISE * accuracy * scale
        better = backup.minima < backup.here - noise
        if better.any():
            gain = float((backup.here - backup.minima).max()) / scale
            choice = np.where(better, backup.choice, choice).astype(np.int32, copy=False)
            accuracy = min(_FORCING * gain if gain > _LAST_GAINS else _FINE, accuracy)
            products += chain.products
            chain = ChosenRows(transitions, choice).gathered()
        elif accuracy > _FINE:
            accuracy = _FINE
        else:
            work = Work(backups, products + chain.products)
            return Settled(choice, totals, values, work)
    return None


def approach(pair_offsets: IntArray, transitions: sp.csr_array, leaving: BoolArray) -> IntArray:
    """A policy under which every state leaves through one of the leaving pairs.

    Each state takes a pair by which it may come nearer, in number of steps, to such a pair.

    Args:
        leaving: pairs that leave with positive probability, [pairs].

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    before = find_predecessors(
        transitions.shape[1], transitions.indptr, transitions.indices, transitions.data
    )
    return nearer_pairs(before, pair_offsets, segment_ids(pair_offsets), leaving)
