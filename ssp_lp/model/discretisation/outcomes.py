"""Trials counted, and the outcomes of pairs collected piece by piece."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges, offsets_of


class Outcomes(NamedTuple):
    """The outcomes of some pairs; within a pair the successors are distinct and ascend."""

    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes], or [] for one number

    def rows(self, wanted: IntArray) -> Outcomes:
        """The rows of these numbers, one after the other."""
        begins = self.outcome_offsets[wanted]
        lengths = self.outcome_offsets[wanted + 1] - begins
        places = concatenated_ranges(begins, lengths)
        costs = self.costs[places] if self.costs.ndim else self.costs
        return Outcomes(
            offsets_of(lengths), self.successors[places], self.probabilities[places], costs
        )


def tally_outcomes(states: IntArray, weights: FloatArray | None, costs: FloatArray) -> Outcomes:
    """Count the outcomes of trials.

    Args:
        states: where they lead, [pairs, trials].
        weights: of the trials, [trials]; None: all the same, and the counts are exact.
        costs: a number, [pairs, 1] or [pairs, trials]; averaged over the trials of an outcome.
    """
    varies = costs.ndim == 2 and costs.shape[1] > 1
    if weights is None and not varies:
        ordered = np.sort(states, axis=1)
        firsts, lengths = _runs_of_outcomes(ordered)
        counts = np.diff(firsts, append=ordered.size)
        paid = np.repeat(costs[:, 0], lengths) if costs.ndim == 2 else costs
        return Outcomes(
            offsets_of(lengths), ordered.ravel()[firsts], counts / states.shape[1], paid
        )

    # the trial's number goes along in the lower digits
    n_trials = states.shape[1]
    packed = states.astype(np.int64) * n_trials + np.arange(n_trials)
    packed.sort(axis=1)
    ordered = packed // n_trials
    trial = packed - ordered * n_trials
    share = np.full(n_trials, 1.0) if weights is None else weights
    taken = share[trial].ravel()
    firsts, lengths = _runs_of_outcomes(ordered)
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
    return Outcomes(offsets_of(lengths), successors, mass / share.sum(), paid)


def _runs_of_outcomes(ordered: IntArray) -> tuple[IntArray, IntArray]:
    """Where runs of equal numbers begin, in the flat array, and how many each row has."""
    begins = np.empty(ordered.shape, dtype=np.bool_)
    begins[:, 0] = True
    np.not_equal(ordered[:, 1:], ordered[:, :-1], out=begins[:, 1:])
    return np.flatnonzero(begins), np.count_nonzero(begins, axis=1)


_ROOM: Final = 1 << 16  # outcomes
_GROWTH: Final = 8  # by an eighth: large arrays grow without being copied


class OutcomeStore:
    """A growing list of rows; their costs are one number as long as they are all the same."""

    def __init__(self, room: int = _ROOM) -> None:
        """Begin without rows, with room for some outcomes."""
        self._lengths: list[IntArray] = []
        self._size = 0
        self._successors = np.empty(room, dtype=np.int32)
        self._probabilities = np.empty(room)
        self._cost: FloatArray | None = None
        self._costs: FloatArray | None = None

    def append(self, rows: Outcomes) -> None:
        """Add the outcomes of more pairs."""
        begin, end = self._size, self._size + len(rows.successors)
        self._reserve(end)
        self._lengths.append(np.diff(rows.outcome_offsets))
        self._successors[begin:end] = rows.successors
        self._probabilities[begin:end] = rows.probabilities
        if self._cost is None and rows.costs.ndim == 0:
            self._cost = rows.costs
        if self._costs is None and (rows.costs.ndim or rows.costs != self._cost):
            known = 0.0 if self._cost is None else self._cost
            self._costs = np.full(len(self._successors), known)
        if self._costs is not None:
            self._costs[begin:end] = rows.costs
        self._size = end

    def outcomes(self) -> Outcomes:
        """All of them; nothing can be added afterwards."""
        for array in self._grown():
            array.resize(self._size, refcheck=False)
        offsets = np.concatenate([[0], *self._lengths])
        np.cumsum(offsets, out=offsets)
        cost = np.asarray(0.0) if self._cost is None else self._cost
        costs = cost if self._costs is None else self._costs
        return Outcomes(offsets, self._successors, self._probabilities, costs)

    def _reserve(self, size: int) -> None:
        """Make room for so many outcomes."""
        room = len(self._successors)
        if size > room:
            for array in self._grown():
                array.resize(max(size, room + room // _GROWTH), refcheck=False)

    def _grown(self) -> list[npt.NDArray[Any]]:
        """The arrays of outcomes that grow."""
        arrays: list[npt.NDArray[Any]] = [self._successors, self._probabilities]
        return arrays if self._costs is None else [*arrays, self._costs]
