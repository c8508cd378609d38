"""Direct solutions of one component's equations: as a narrow band, or by sparse factors."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.linear_systems.equations import HOLDS_MASS
from ssp_lp.errors import SolverError

_MOST_STATES = 200_000
"""States above which sparse factors may exceed memory."""


class Band:
    """A narrow component, reduced state by state without subtractions (compiled)."""

    def __init__(self, own: sp.csr_array, leaving: FloatArray, place: IntArray, width: int) -> None:
        """Reduce the component.

        Args:
            own: moves on departing, [members, members].
            leaving: probability of leaving on departing, [members].
            place: position of each member in the order in which it is narrow, [members].
            width: greatest distance of two members that a move joins in that order.

        Raises:
            SolverError: the component is never left.
        """
        from ssp_lp.compiled.linear_systems.band import eliminate_band

        entry, size = own.tocoo(), len(leaving)
        self._place = place
        self._band, self._departs = np.zeros((size, 2 * width + 1)), np.empty(size)
        row, column = place[entry.row], place[entry.col]
        np.add.at(self._band, (row, width + column - row), entry.data)
        ordered = np.empty(size)
        ordered[place] = leaving
        if not eliminate_band(self._band, ordered, self._departs):
            raise SolverError(HOLDS_MASS)

    def solve(self, right: FloatArray) -> FloatArray:
        """Totals of the members, [members, rewards]."""
        from ssp_lp.compiled.linear_systems.band import solve_band

        ordered = np.empty_like(right)
        ordered[self._place] = right
        solve_band(self._band, self._departs, ordered)
        return np.asarray(ordered[self._place])


class Factors:
    """Sparse factors, in a given order or in one that fills in little."""

    def __init__(
        self,
        own: sp.csr_array,
        departs: FloatArray,
        leaving: FloatArray,
        place: IntArray | None = None,
    ) -> None:
        """Factorise the component.

        Args:
            own: moves on departing, [members, members].
            departs: probability of departing, [members].
            leaving: probability of leaving, [members].
            place: position of each member in the order to be kept; None: one is found.

        Raises:
            SolverError: there are too many members, or they are never left.
        """
        size = len(leaving)
        if size > _MOST_STATES and place is None:
            raise SolverError(
                f"no method solves the equations of a policy on {size:,} states that hang "
                "together; a discount may help"
            )
        self._place = np.arange(size) if place is None else place
        entry = own.tocoo()
        row, column = self._place[entry.row], self._place[entry.col]
        diagonal = np.empty(size)
        diagonal[self._place] = leaving / departs + np.asarray(own.sum(axis=1)).ravel()
        every = np.arange(size)
        self._system = sp.csc_array(
            (
                np.concatenate([diagonal, -entry.data]),
                (np.concatenate([every, row]), np.concatenate([every, column])),
            ),
            shape=(size, size),
        )
        try:
            self._factors = linalg.splu(
                self._system,
                permc_spec="COLAMD" if place is None else "NATURAL",
                diag_pivot_thresh=1.0 if place is None else 0.0,
            )
        except RuntimeError as error:
            raise SolverError(HOLDS_MASS) from error

    def solve(self, right: FloatArray) -> FloatArray:
        """Totals of the members, [members, rewards]."""
        ordered = np.empty_like(right)
        ordered[self._place] = right
        x = self._factors.solve(ordered)
        x = x + self._factors.solve(ordered - self._system @ x)
        return np.asarray(x[self._place])
