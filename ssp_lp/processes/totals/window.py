"""The layers ahead of a backward sweep, in one contiguous piece without copying at every layer."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.processes.totals.levels import Levels

_SLACK = 4  # the buffer holds this many windows, so that all is moved once in three windows


class Window:
    """Values of the next layers, nearest first; a layer is pushed at the front."""

    def __init__(self, first: FloatArray, levels: Levels | None = None) -> None:
        """Begin at the cap.

        Args:
            first: values of the layers beyond the cap, [layers, ...].
            levels: which step leads where; None: to as many layers ahead as it costs units.
        """
        self._length = len(first) if levels is None else levels.span
        self._leads = None if levels is None else levels.ahead
        self._layer = 0 if levels is None else levels.cap - 1
        self._buffer = np.zeros((_SLACK * self._length, *first.shape[1:]))
        self._front = len(self._buffer) - self._length
        self._buffer[self._front : self._front + len(first)] = first

    @property
    def ahead(self) -> FloatArray:
        """The layers ahead, contiguous, [layers, ...]."""
        return self._buffer[self._front : self._front + self._length]

    @property
    def flat(self) -> FloatArray:
        """What steps lead to, one layer after the other, as their columns are, [layers * nodes]."""
        ahead = self.ahead
        if self._leads is not None:
            ahead = ahead[self._leads[self._layer]]
        return ahead.reshape(-1, *ahead.shape[2:])

    def push(self, layer: FloatArray) -> None:
        """Put a layer at the front and drop the farthest."""
        self._layer -= 1
        if self._length == 0:
            return
        if self._front == 0:
            back = len(self._buffer) - self._length
            self._buffer[back:] = self._buffer[: self._length]
            self._front = back
        self._front -= 1
        self._buffer[self._front] = layer
