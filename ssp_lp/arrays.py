"""Array type aliases, read-only arrays, and the shared tolerances with their reasons."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer[Any]]
BoolArray = npt.NDArray[np.bool_]

MACHINE_EPSILON: Final = float(np.finfo(np.float64).eps)

ROUNDED: Final = 1e-14
"""Rounding error of a sum or difference of few numbers, relative to the largest of them."""

PROBABILITY_SUM: Final = 1e-9
"""Largest deviation from 1 of a sum of probabilities that division corrects; more is an error."""

SINGLE_PRECISION_SUM: Final = 1e-5
"""Largest deviation from 1 that ``normalise=True`` corrects: of float32, or of few digits."""

MAXIMISER: Final = 1e-12
"""Relative distance to the best goal probability within which an action counts as optimal.

Linear solves leave errors of 1e-15 to 1e-14. On the paper's robot 1e-16 loses optimal actions, and
1e-8 changes the least cost of the safest policies by 4e-4.
"""

LEAST_RISE: Final = 1e-300
"""Rise of a probability below which sweeps that round down stop."""

FAILURE_FLOOR: Final = 1e-15
"""Difference of two failure probabilities that counts as 0, as a share of the goal probability.

Far from any hazard the least failure probability may be 1e-100 or 1e-233. A search for gains
relative to these numbers would not end, and no episode would show the difference. The tolerance is
relative to the goal probability, so that the digits of a rare goal are kept. A policy is improved
if it gains at least a tenth of the tolerance. Where cost decides among policies of equal failure,
a step may lose a hundred times the tolerance, so that rounding does not decide which pairs are
equal.
"""

LEAST_BUDGET: Final = 1e-10
"""Distance below the least failure within which a budget counts as equal to it (rounding)."""

IMPROVEMENT: Final = 1e-13
"""Relative gain below which policy iteration keeps an action: the accuracy of a refined solve."""

QUANTILE: Final = 1e-12
"""Relative difference within which a probability counts as equal to a quantile's level.

Sums of the masses of many total costs have errors of 1e-15 to 1e-13. A total at which the sum
reaches the level exactly must be found, because the next total may be much larger.
"""

SAME_TOTAL: Final = 5e-13
"""Relative difference within which two sums of costs count as equal.

Sums of some thousand costs have relative errors of 1e-16 to 1e-13; a lattice with so many layers
does not fit into memory.
"""

BELOW_RATIO: Final = 1.0 - 2.5e-10
"""Factor of the optimal cost given success that gives a second price for its proof.

If the budget is not used up, the price is this ratio, at which failing is as good as the optimum
and rounding decides between them. At the slightly lower price failing is strictly best
(``FailureRow.lower_bound``).
"""

RELATIVE_GAP: Final = 1e-9
"""Default relative gap between the objective and its certified lower bound."""

RESIDUAL: Final = 1e-6
"""Largest relative residual with which an LP backend's answer is accepted.

Only a first price is taken from this answer. Policies are computed at this price and measured
exactly, and the program's optimum must agree with them. Interior points after crossover leave up to
2e-7 here.
"""


def read_only(array: npt.ArrayLike, dtype: npt.DTypeLike | None = None) -> npt.NDArray[Any]:
    """Return a view of ``array`` (converted to ``dtype`` if need be) that cannot be written to."""
    view = np.asarray(array, dtype=dtype).view()
    view.flags.writeable = False
    return view


class ReadOnlyCopies:
    """Mix-in that keeps arrays read-only in copies and pickles, unlike plain arrays."""

    def keep_read_only(self, *names: str, dtype: npt.DTypeLike | None = None) -> None:
        """Make fields read-only arrays, unless they are None, during construction."""
        for name in names:
            if (array := vars(self)[name]) is not None:
                object.__setattr__(self, name, read_only(array, dtype))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the fields of a copy, with read-only arrays."""
        kept = {k: read_only(v) if isinstance(v, np.ndarray) else v for k, v in state.items()}
        vars(self).update(kept)


def fields_of(record: Any, declared: Any) -> dict[str, Any]:
    """Return the values of a record, name -> value, for the fields of the dataclass ``declared``.

    Values are not copied.
    """
    return {part.name: getattr(record, part.name) for part in fields(declared)}


def least_integer_type(most: int) -> npt.DTypeLike:
    """Return the smallest signed integer type that holds -2 .. most."""
    return np.min_scalar_type(-max(most, 2) - 1)


def narrow(offsets: IntArray) -> IntArray:
    """Return offsets as 32-bit integers, the type of scipy's column indices, if they fit."""
    fits = int(offsets[-1]) <= np.iinfo(np.int32).max
    return offsets.astype(np.int32, copy=False) if fits else offsets


def unsigned(indices: IntArray) -> npt.NDArray[Any]:
    """Return a view, as unsigned integers, of an array of whole numbers >= 0."""
    return indices.view(np.uint32 if indices.dtype.itemsize == 4 else np.uint64)


def csr_of(
    data: FloatArray | BoolArray, indices: IntArray, indptr: IntArray, shape: tuple[int, int]
) -> sp.csr_array:
    """Return the sparse matrix made of three arrays, without scipy's checks.

    The arrays must be consistent, as arguments of ``scipy.sparse.csr_array``.
    """
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
    """Return the indices of the entries of some segments, one segment after the other.

    Segment k has the entries ``offsets[k] : offsets[k + 1]``.

    Returns:
        The indices, [entries], and the number of entries of each segment, [segments].
    """
    begins = offsets[segments]
    lengths = offsets[segments + 1] - begins
    return concatenated_ranges(begins, lengths), lengths


def offsets_of(lengths: IntArray) -> IntArray:
    """Return the offsets of adjacent segments with given lengths, [segments + 1].

    Segment k has the entries ``offsets[k] : offsets[k + 1]``.
    """
    offsets = np.zeros(len(lengths) + 1, dtype=np.int64)
    np.add.accumulate(lengths, out=offsets[1:])
    return offsets


def sorted_unique(values: IntArray) -> IntArray:
    """Return the distinct non-negative entries of an array in increasing order, by sorting."""
    ordered = np.sort(values)
    return ordered[run_starts(ordered)]


def run_starts(values: IntArray) -> BoolArray:
    """Return a mask of the first entry, and of all entries that differ from the entry before."""
    begins = np.ones(values.size, dtype=np.bool_)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return begins


def segment_ids(offsets: IntArray) -> npt.NDArray[np.int32]:
    """Return for each entry the number of its segment, [entries].

    Segment k has the entries ``offsets[k] : offsets[k + 1]``.
    """
    return np.arange(len(offsets) - 1, dtype=np.int32).repeat(offsets[1:] - offsets[:-1])


def drawn_in_segments(
    sums: FloatArray, begins: IntArray, ends: IntArray, rng: np.random.Generator
) -> IntArray:
    """Draw the index of one entry in each segment, [segments].

    An entry is drawn with a probability proportional to its value.

    Args:
        sums: running sums of the entries' values, after a leading 0, [entries + 1].
        begins: first entry of each segment, [segments].
        ends: entry after the last one of each segment, [segments].
        rng: draws a number for each segment.
    """
    level = sums[begins] + rng.random(len(begins)) * (sums[ends] - sums[begins])
    return np.clip(np.searchsorted(sums[1:], level, side="right"), begins, ends - 1)


def segment_sums(values: FloatArray, offsets: IntArray) -> FloatArray:
    """Return the sum of each segment's values, [segments]; 0 if the segment is empty.

    Segment k has the entries ``offsets[k] : offsets[k + 1]``.
    """
    result = np.zeros(len(offsets) - 1)
    filled = (offsets[1:] > offsets[:-1]).nonzero()[0]
    if filled.size:
        result[filled] = np.add.reduceat(values, np.asarray(offsets)[filled])
    return result


def segment_minima(values: FloatArray, offsets: IntArray) -> FloatArray:
    """Return the minimum of each segment's values, [segments]; infinite if the segment is empty.

    Segment k has the entries ``offsets[k] : offsets[k + 1]``.
    """
    result = np.full(len(offsets) - 1, np.inf)
    filled = (offsets[1:] > offsets[:-1]).nonzero()[0]
    if filled.size:
        result[filled] = np.minimum.reduceat(values, np.asarray(offsets)[filled])
    return result


def first_minimisers(values: FloatArray, minima: FloatArray, offsets: IntArray) -> IntArray:
    """Return the index of the first least entry of each non-empty segment.

    Args:
        values: [entries].
        minima: minimum of each segment, [segments].
        offsets: segment k has the entries ``offsets[k] : offsets[k + 1]``, [segments + 1].
    """
    segment = segment_ids(offsets)
    attained = np.flatnonzero(values <= minima[segment])
    return attained[np.flatnonzero(np.diff(segment[attained], prepend=-1))]


def weighted(columns: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted sum of an array's columns, [rows], without the threads of ``@``.

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
    """Return the rounding error of weighted sums, relative to the size of their terms, [rows].

    It is 0 for sums that are exact.

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
    """Return ``start @ values``, computed only where the start is not 0.

    Args:
        start: distribution, [states].
        values: [states] or [states, values].
    """
    used = np.flatnonzero(start)
    return np.asarray(start[used] @ values[used])


_SPLIT = 134217729.0  # 2**27 + 1 (Veltkamp)


def exact_sum(a: Any, b: Any) -> tuple[Any, Any]:
    """Return the rounded sum of numbers or arrays, and its rounding error (Knuth)."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


def exact_product(a: Any, b: Any) -> tuple[Any, Any]:
    """Return the rounded product of numbers or arrays, and its rounding error (Dekker)."""
    total = a * b
    c, d = _SPLIT * a, _SPLIT * b
    a_high, b_high = c - (c - a), d - (d - b)
    a_low, b_low = a - a_high, b - b_high
    return total, a_low * b_low - (((total - a_high * b_high) - a_low * b_high) - a_high * b_low)


CHUNK = 1 << 22
"""Number of entries processed at a time: scratch arrays of some 32 MB."""


def segment_chunks(offsets: IntArray) -> Iterator[slice]:
    """Yield slices of consecutive segments with at most ``CHUNK`` entries in all.

    A segment with more entries is a slice by itself.

    Args:
        offsets: the entries of segment k are ``offsets[k] : offsets[k + 1]``, [segments + 1].
    """
    begin, n_segments = 0, len(offsets) - 1
    if 0 < int(offsets[-1]) <= CHUNK:
        yield slice(0, n_segments)
        return
    while begin < n_segments:
        full = offsets.dtype.type(min(int(offsets[begin]) + CHUNK, int(offsets[-1])))
        last = int(np.searchsorted(offsets, full, side="right")) - 1
        end = min(max(last, begin + 1), n_segments)
        yield slice(begin, end)
        begin = end
