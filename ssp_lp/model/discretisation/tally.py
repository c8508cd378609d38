"""Trials counted: where they lead, with which probability, at which cost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray


class Rows(NamedTuple):
    """The outcomes of some pairs; within a pair the successors are distinct and ascend."""

    lengths: IntArray  # [pairs]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes], or [] for one number


def tally(states: IntArray, weights: FloatArray | None, costs: FloatArray) -> Rows:
    """Count trials.

    Args:
        states: where they lead, [pairs, trials].
        weights: of the trials, [trials]; None: all the same, and the counts are exact.
        costs: a number, [pairs, 1] or [pairs, trials]; averaged over the trials of an outcome.
    """
    varies = costs.ndim == 2 and costs.shape[1] > 1
    if weights is None and not varies:
        ordered = np.sort(states, axis=1)
        firsts, lengths = _runs(ordered)
        counts = np.diff(firsts, append=ordered.size)
        paid = np.repeat(costs[:, 0], lengths) if costs.ndim == 2 else costs
        return Rows(lengths, ordered.ravel()[firsts], counts / states.shape[1], paid)

    # the trial's number goes along in the lower digits
    n_trials = states.shape[1]
    packed = states.astype(np.int64) * n_trials + np.arange(n_trials)
    packed.sort(axis=1)
    ordered = packed // n_trials
    trial = packed - ordered * n_trials
    share = np.full(n_trials, 1.0) if weights is None else weights
    taken = share[trial].ravel()
    firsts, lengths = _runs(ordered)
    mass = np.add.reduceat(taken, firsts)
    paid = costs
    if varies:
        each = np.take_along_axis(costs, trial, axis=1).ravel()
        low, high = np.minimum.reduceat(each, firsts), np.maximum.reduceat(each, firsts)
        # equal costs stay what they are to the last bit: criteria that add up costs rely on it
        paid = np.clip(np.add.reduceat(taken * each, firsts) / mass, low, high)
    elif costs.ndim == 2:
        paid = np.repeat(costs[:, 0], lengths)
    successors = ordered.ravel()[firsts].astype(np.int32)
    return Rows(lengths, successors, mass / share.sum(), paid)


def _runs(ordered: IntArray) -> tuple[IntArray, IntArray]:
    """Where runs of equal numbers begin, in the flat array, and how many each row has."""
    begins = np.empty(ordered.shape, dtype=np.bool_)
    begins[:, 0] = True
    np.not_equal(ordered[:, 1:], ordered[:, :-1], out=begins[:, 1:])
    return np.flatnonzero(begins), np.count_nonzero(begins, axis=1)
