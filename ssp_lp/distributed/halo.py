"""Ghosts: the values of other ranks' states to which a rank's own rows lead, exchanged on demand.

States are numbered from rank to rank. A rank numbers those that it knows by its own first, then the
ghosts in increasing order, so that ghosts of one owner lie in a row and are received in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import IntArray, read_only
from ssp_lp.errors import optional_module

_TAG = 71  # of these messages


class Halo:
    """A rank's ghosts, and the own states that others want. Mutable: it counts what it sends.

    All ranks make theirs at the same time, and fill at the same time.
    """

    def __init__(self, comm: Any, bounds: IntArray, columns: IntArray) -> None:
        """Find the ghosts, and tell their owners.

        Args:
            comm: of mpi4py.
            bounds: first state of each rank, and the end, [ranks + 1].
            columns: numbers of states to which the rank's rows lead, in any order.
        """
        self._comm = comm
        self.first, self.end = int(bounds[comm.rank]), int(bounds[comm.rank + 1])
        outside = (columns < self.first) | (columns >= self.end)
        self.ghosts: IntArray = read_only(np.unique(columns[outside]).astype(np.int64))
        places = np.searchsorted(self.ghosts, bounds)
        asked, lengths = np.diff(places).astype(np.int64), np.empty(comm.size, dtype=np.int64)
        comm.Alltoall(asked, lengths)
        wanted = np.empty(int(lengths.sum()), dtype=np.int64)
        begins = np.concatenate([[0], np.cumsum(lengths)])
        comm.Alltoallv([self.ghosts, (asked, places[:-1])], [wanted, (lengths, begins[:-1])])
        self._wanted = wanted - self.first  # own states that others want, by rank
        self._from = _parts(self.n_own + places)  # where the ghosts of each neighbour lie
        self._to = _parts(begins)  # and among the wanted those that each neighbour wants
        self._buffers: dict[Any, npt.NDArray[Any]] = {}
        self.messages, self.bytes = 0, 0  # sent so far

    @property
    def n_own(self) -> int:
        """Number of the rank's own states."""
        return self.end - self.first

    @property
    def size(self) -> int:
        """Number of states that the rank knows: its own and the ghosts."""
        return self.n_own + len(self.ghosts)

    @property
    def numbers(self) -> IntArray:
        """Numbers of the states that the rank knows, its own first, then the ghosts, [size]."""
        return np.append(np.arange(self.first, self.end), self.ghosts).astype(np.int32)

    def places(self, states: IntArray) -> IntArray:
        """Where own states and ghosts stand among those that the rank knows, like ``states``."""
        places = states - states.dtype.type(self.first)
        outside = np.flatnonzero((places < 0) | (places >= self.n_own))
        places[outside] = self.n_own + np.searchsorted(self.ghosts, states[outside])
        return places

    def fill(self, values: npt.NDArray[Any]) -> None:
        """Receive the ghosts' values, in place, and send own ones to whom they are ghosts.

        Args:
            values: contiguous, those of the own states given, [size, ...].
        """
        buffer = self._buffer(values)
        np.take(values, self._wanted, axis=0, out=buffer, mode="clip")
        self._exchange(buffer, self._to, values, self._from)

    def _exchange(
        self,
        sent: npt.NDArray[Any],
        to: list[tuple[int, slice]],
        received: npt.NDArray[Any],
        by: list[tuple[int, slice]],
    ) -> None:
        """Send parts of an array to neighbours, and receive parts of another, without a copy."""
        comm, waiting = self._comm, []
        for rank, part in by:
            waiting.append(comm.Irecv(received[part], rank, _TAG))
        for rank, part in to:
            waiting.append(comm.Isend(sent[part], rank, _TAG))
            self.messages, self.bytes = self.messages + 1, self.bytes + sent[part].nbytes
        optional_module("mpi4py.MPI", "distributed").Request.Waitall(waiting)

    def _buffer(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Room for what neighbours want, or send, of values of this kind, [wanted, ...]."""
        row = values.shape[1:]
        key = row, values.dtype.str
        if key not in self._buffers:
            self._buffers[key] = np.empty((len(self._wanted), *row), dtype=values.dtype)
        return self._buffers[key]

    def gather(self, values: npt.NDArray[Any]) -> None:
        """Add what ghosts have to their owners' values, in place; nothing is left at ghosts.

        Args:
            values: contiguous, [size, ...].
        """
        buffer = self._buffer(values)
        self._exchange(values, self._from, buffer, self._to)
        for _, part in self._to:
            values[self._wanted[part]] += buffer[part]  # of one neighbour each state once
        values[self.n_own :] = 0

    def filled(self, own: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of the rank's own states with those of the ghosts behind them, [size, ...].

        Args:
            own: [own states, ...].
        """
        values = np.empty((self.size, *own.shape[1:]), dtype=own.dtype)
        values[: self.n_own] = own
        self.fill(values)
        return values


def _parts(bounds: IntArray) -> list[tuple[int, slice]]:
    """The neighbours of a halo, and the part of each by the bounds of all ranks' parts."""
    pairs = zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
    return [(rank, slice(a, b)) for rank, (a, b) in enumerate(pairs) if a < b]
