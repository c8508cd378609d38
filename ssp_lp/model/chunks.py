"""Cutting long arrays into pieces, so that scratch memory does not grow with the model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import IntArray

CHUNK = 1 << 22
"""Entries that are worked on at a time: scratch arrays of some 32 MB."""


class _Piece(NamedTuple):
    """Some segments in a row of a segmented array, and their entries."""

    segments: slice
    entries: slice
    firsts: IntArray  # [segments] where each begins, counted from the piece's first entry
    lengths: IntArray  # [segments]


def chunks(length: int) -> Iterator[slice]:
    """Slices of at most ``CHUNK`` entries that cover ``0 .. length - 1`` in turn."""
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


def pieces_of_chunks(offsets: IntArray) -> Iterator[_Piece]:
    """The chunks of segments with what is needed to work on their entries, [segments + 1]."""
    for segments in segment_chunks(offsets):
        ends = offsets[segments.start : segments.stop + 1]
        yield _Piece(
            segments, slice(int(ends[0]), int(ends[-1])), ends[:-1] - ends[0], np.diff(ends)
        )
