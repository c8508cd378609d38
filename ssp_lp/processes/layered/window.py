"""The layers ahead of a backward sweep, in one contiguous piece without copying at every layer."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray

_SLACK = 4  # the buffer holds this many windows, so that all is moved once in three windows


class Window:
    """Values of the next ``width - 1`` layers, nearest first; a layer is pushed at the front."""

    def __init__(self, first: FloatArray) -> None:
        """Begin with the layers beyond the cap, [width - 1, ...]."""
        self._length = len(first)
        self._buffer = np.empty((_SLACK * self._length, *first.shape[1:]))
        self._front = len(self._buffer) - self._length
        self._buffer[self._front :] = first

    @property
    def ahead(self) -> FloatArray:
        """The layers ahead, contiguous, [width - 1, ...]."""
        return self._buffer[self._front : self._front + self._length]

    @property
    def flat(self) -> FloatArray:
        """The layers ahead one after the other, as the columns of steps are, [layers * nodes]."""
        ahead = self.ahead
        return ahead.reshape(-1, *ahead.shape[2:])

    def push(self, layer: FloatArray) -> None:
        """Put a layer at the front and drop the farthest."""
        if self._length == 0:
            return
        if self._front == 0:
            back = len(self._buffer) - self._length
            self._buffer[back:] = self._buffer[: self._length]
            self._front = back
        self._front -= 1
        self._buffer[self._front] = layer
