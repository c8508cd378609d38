"""Array aliases, read-only arrays, and every tolerance of the library with its reason."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer[Any]]
BoolArray = npt.NDArray[np.bool_]

MACHINE_EPSILON: Final = float(np.finfo(np.float64).eps)

PROBABILITY_SUM: Final = 1e-9
"""Sums of user probabilities this close to one are rounding and divided out; others are errors."""

SINGLE_PRECISION_SUM: Final = 1e-5
"""The same where a user says that the probabilities are to be normalised: float32 or few digits."""

MAXIMISER: Final = 1e-12
"""Relative distance to the best goal probability within which an action still counts as maximising.

Linear solves leave 1e-15 to 1e-14; 1e-16 drops true maximisers on the paper's robot and 1e-8 moves
the least-failure cost by 4e-4.
"""

LEAST_RISE: Final = 1e-300
"""Rise of a probability below which sweeps that round down would come to an end."""

FAILURE_FLOOR: Final = 1e-15
"""Share of a state's greatest goal probability below which two failure probabilities are alike.

Far from any hazard least failures are 1e-100 or 1e-233: whoever chases gains relative to these does
not end, and no episode would ever show the difference. Rare goals keep their digits, as it is a
share of them, and so do probabilities in components that are solved without subtractions. Gains
are sought down to a tenth of it, and where cost decides among policies that fail alike a step may
lose a hundred times as much: so far apart which pairs are alike does not hang on rounding.
"""

LEAST_BUDGET: Final = 1e-10
"""A budget this close below the least failure counts as equal to it (rounding of sums)."""

IMPROVEMENT: Final = 1e-13
"""Relative gain below which policy iteration keeps an action: the accuracy of a refined solve."""

QUANTILE: Final = 1e-12
"""Relative slack with which a mass reaches a quantile's level.

The masses of many total costs add up to 1e-15 .. 1e-13 of what they are: an atom that ends exactly
at the level must not be missed, for the next one may lie anywhere.
"""

SAME_TOTAL: Final = 5e-13
"""Relative distance at which a total cost and a bound on it are one, summed in two ways.

Sums of some thousand costs are off by 1e-16 to 1e-13 of themselves; a lattice of so many layers
would fill no memory.
"""

BELOW_RATIO: Final = 1.0 - 2.5e-10
"""Share of a ratio at which it is proved once more, where the budget may be slack.

There it is strictly best to fail, so that no rounding enters (``FailureRow.lower_bound``).
"""

RELATIVE_GAP: Final = 1e-9
"""Default relative gap between the objective and its certified lower bound."""

RESIDUAL: Final = 1e-6
"""Largest relative residual with which an LP backend's answer is accepted.

It is a price to start from, not the answer: policies are priced at it and measured exactly, and the
program's optimum must agree with theirs. Interior points after crossover leave up to 2e-7 here.
"""


def read_only(array: npt.ArrayLike, dtype: npt.DTypeLike | None = None) -> npt.NDArray[Any]:
    """Return a view of ``array`` (converted to ``dtype`` if need be) that cannot be written to."""
    view = np.asarray(array, dtype=dtype).view()
    view.flags.writeable = False
    return view


class ReadOnlyCopies:
    """Mix-in of values whose arrays stay read-only in copies and pickles; numpy's own do not."""

    def keep_read_only(self, *names: str, dtype: npt.DTypeLike | None = None) -> None:
        """Make fields read-only arrays, where they are not None, while the value is made."""
        for name in names:
            if (array := vars(self)[name]) is not None:
                object.__setattr__(self, name, read_only(array, dtype))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what a copy is made of."""
        kept = {k: read_only(v) if isinstance(v, np.ndarray) else v for k, v in state.items()}
        vars(self).update(kept)


def least_integer_type(most: int) -> npt.DTypeLike:
    """Return the smallest signed integers that hold -2 .. most."""
    return np.min_scalar_type(-max(most, 2) - 1)


def narrow(offsets: IntArray) -> IntArray:
    """Return an array of offsets in 32 bits where they fit, to match scipy's columns."""
    fits = int(offsets[-1]) <= np.iinfo(np.int32).max
    return offsets.astype(np.int32, copy=False) if fits else offsets


def unsigned(indices: IntArray) -> npt.NDArray[Any]:
    """Return an array of non-negative whole numbers viewed as unsigned ones."""
    return indices.view(np.uint32 if indices.dtype.itemsize == 4 else np.uint64)


def csr_of(
    data: FloatArray, indices: IntArray, indptr: IntArray, shape: tuple[int, int]
) -> sp.csr_array:
    """Scipy's sparse matrix of three arrays that fit, without scipy's checks of them."""
    matrix = copy(_NO_ROWS)
    vars(matrix).update(data=data, indices=indices, indptr=indptr, _shape=shape)
    return matrix


_NO_ROWS: Final = sp.csr_array((0, 0))


def concatenated_ranges(starts: IntArray, lengths: IntArray) -> npt.NDArray[np.int64]:
    """Concatenate ``arange(start, start + length)`` over all given ranges, without a loop."""
    lengths = np.asarray(lengths, dtype=np.int64)
    total = int(lengths.sum())
    first = np.cumsum(lengths) - lengths
    return np.repeat(np.asarray(starts, dtype=np.int64) - first, lengths) + np.arange(total)


def entries_of(offsets: IntArray, segments: IntArray) -> tuple[npt.NDArray[np.int64], IntArray]:
    """Return the entries ``offsets[k] : offsets[k + 1]`` of some segments, one after the other.

    Returns:
        Them, [entries], and how many each segment has, [segments].
    """
    begins = offsets[segments]
    lengths = offsets[segments + 1] - begins
    return concatenated_ranges(begins, lengths), lengths


def offsets_of(lengths: IntArray) -> IntArray:
    """Return an array of offsets: where each of several segments in a row begins, and the end."""
    offsets = np.zeros(len(lengths) + 1, dtype=np.int64)
    np.add.accumulate(lengths, out=offsets[1:])
    return offsets


def sorted_unique(values: IntArray) -> IntArray:
    """Return the distinct non-negative entries of an array in increasing order, by sorting."""
    ordered = np.sort(values)
    return ordered[run_starts(ordered)]


def run_starts(values: IntArray) -> BoolArray:
    """Where each run of equal entries of an array begins, as a mask."""
    begins = np.ones(values.size, dtype=np.bool_)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return begins


def segment_ids(offsets: IntArray) -> npt.NDArray[np.int32]:
    """Return the segment ``offsets[k] : offsets[k + 1]`` that each entry lies in, [entries]."""
    return np.arange(len(offsets) - 1, dtype=np.int32).repeat(offsets[1:] - offsets[:-1])


def drawn_in_segments(
    sums: FloatArray, begins: IntArray, ends: IntArray, rng: np.random.Generator
) -> IntArray:
    """Draw an entry of each segment of an array with its share of the segment's sum, [segments].

    Args:
        sums: running sums of the array's entries, after a leading 0, [entries + 1].
        begins: where each segment begins, [segments].
        ends: where it ends, [segments].
        rng: draws a number for each segment.
    """
    level = sums[begins] + rng.random(len(begins)) * (sums[ends] - sums[begins])
    return np.clip(np.searchsorted(sums[1:], level, side="right"), begins, ends - 1)


def segment_sums(values: FloatArray, offsets: IntArray) -> FloatArray:
    """Sum ``values`` over the segments ``offsets[k] : offsets[k + 1]``; empty segments give 0."""
    result = np.zeros(len(offsets) - 1)
    filled = (offsets[1:] > offsets[:-1]).nonzero()[0]
    if filled.size:
        result[filled] = np.add.reduceat(values, np.asarray(offsets)[filled])
    return result


def segment_minima(values: FloatArray, offsets: IntArray) -> FloatArray:
    """Minimum of ``values`` over the segments ``offsets[k] : offsets[k + 1]``; empty: infinity."""
    result = np.full(len(offsets) - 1, np.inf)
    filled = (offsets[1:] > offsets[:-1]).nonzero()[0]
    if filled.size:
        result[filled] = np.minimum.reduceat(values, np.asarray(offsets)[filled])
    return result


def first_minimisers(values: FloatArray, minima: FloatArray, offsets: IntArray) -> IntArray:
    """Position, within each non-empty segment in turn, of the first value equal to its minimum."""
    segment = segment_ids(offsets)
    attained = np.flatnonzero(values <= minima[segment])
    return attained[np.flatnonzero(np.diff(segment[attained], prepend=-1))]


def weighted(columns: FloatArray, weights: FloatArray) -> FloatArray:
    """Return a weighted sum of an array's columns, without waking the threads of a matrix product.

    Args:
        columns: [rows, columns]; few columns.
        weights: [columns].
    """
    result: FloatArray = columns[:, 0] * weights[0]
    for j in range(1, len(weights)):
        if weights[j] != 0.0:
            result += columns[:, j] * weights[j]
    return result


def weighted_rounding(columns: FloatArray, weights: FloatArray) -> FloatArray:
    """Rounding of weighted sums, relative to their terms' sizes; 0: a row's sum is exact, [rows].

    Args:
        columns: [rows, columns]; few columns.
        weights: [columns].
    """
    terms, products = np.zeros(len(columns), dtype=np.int64), np.zeros(len(columns), dtype=np.bool_)
    for column, weight in zip(columns.T, weights.tolist(), strict=True):
        if weight != 0.0:
            counted = column != 0.0
            terms += counted
            if abs(weight) != 1.0:
                products |= counted & (np.abs(column) != 1.0)
    return np.asarray(MACHINE_EPSILON * np.maximum(terms - 1, products))


def expected(start: FloatArray, values: FloatArray) -> npt.NDArray[Any]:
    """``start @ values`` of arrays over states, for a start that is mostly zeros.

    Args:
        start: distribution, [states].
        values: [states] or [states, values].
    """
    used = np.flatnonzero(start)
    return np.asarray(start[used] @ values[used])


CHUNK = 1 << 22
"""Entries that are worked on at a time: scratch arrays of some 32 MB."""


def chunks(length: int) -> Iterator[slice]:
    """Yield the slices of at most ``CHUNK`` entries that cover ``0 .. length - 1`` in turn."""
    for begin in range(0, length, CHUNK):
        yield slice(begin, min(begin + CHUNK, length))


def segment_chunks(offsets: IntArray) -> Iterator[slice]:
    """Slices of whole segments with at most ``CHUNK`` entries together, or of one longer segment.

    Args:
        offsets: the entries of segment k are ``offsets[k] : offsets[k + 1]``, [segments + 1].
    """
    begin, n_segments = 0, len(offsets) - 1
    while begin < n_segments:
        full = offsets.dtype.type(min(int(offsets[begin]) + CHUNK, int(offsets[-1])))
        last = int(np.searchsorted(offsets, full, side="right")) - 1
        end = min(max(last, begin + 1), n_segments)
        yield slice(begin, end)
        begin = end
