"""Direct solutions of a chain's equations: dense, by sparse factors, or by state reduction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import SolverError

HOLDS_MASS = "a policy's chain holds mass for ever: from some states it is never left"
Solver = Callable[[FloatArray], FloatArray]
_MOST_STATES = 200_000
"""States above which sparse factors may exceed memory."""


def equations(
    matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None
) -> sp.csc_array:
    """``I - chain`` with a diagonal that is the sum of where a state departs to.

    Args:
        matrix: [states, states].
        exits: [states].
        order: states in the order of the rows and columns; None: as they are.

    Raises:
        SolverError: some state is never departed from.
    """
    n = len(exits)
    entry = matrix.tocoo()
    away = (entry.row != entry.col) & (entry.data != 0.0)
    row, column, data = entry.row[away], entry.col[away], entry.data[away]
    departs = exits + np.bincount(row, weights=data, minlength=n)
    if (departs <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    place = np.arange(n)
    if order is not None:
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
    row, column = place[row], place[column]
    return sp.csc_array(
        (
            np.concatenate([departs, -data]),
            (np.concatenate([place, row]), np.concatenate([place, column])),
        ),
        shape=(n, n),
    )


def factorised(system: sp.csc_array, *, in_order: bool = False) -> linalg.SuperLU:
    """Sparse factors; in the given order where that is topological, so that nothing fills in.

    Raises:
        SolverError: the matrix is singular.
    """
    order = "NATURAL" if in_order else "COLAMD"
    threshold = 0.0 if in_order else 1.0  # diagonally dominant by rows: the order is kept
    try:
        found: linalg.SuperLU = linalg.splu(
            system,  # type: ignore[call-overload]
            permc_spec=order,
            diag_pivot_thresh=threshold,
        )
        return found
    except RuntimeError as error:
        raise SolverError(HOLDS_MASS) from error


def dense_solver(matrix: sp.csr_array, exits: FloatArray) -> Solver:
    """Solve the equations of a few states by dense LU with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].

    Raises:
        SolverError: some state is never left; also when solving, where that shows only then.
    """
    system = -matrix.toarray()
    np.fill_diagonal(system, 0.0)
    departs = exits - system.sum(axis=1)
    if (departs <= 0.0).any():
        raise SolverError(HOLDS_MASS)
    np.fill_diagonal(system, departs)

    def solve(rewards: FloatArray) -> FloatArray:
        """Totals of these rewards, refined once."""
        try:
            x = np.linalg.solve(system, rewards)
            return np.asarray(x + np.linalg.solve(system, rewards - system @ x))
        except np.linalg.LinAlgError as error:
            raise SolverError(HOLDS_MASS) from error

    return solve


def transposed_solve(factors: linalg.SuperLU, inflow: FloatArray) -> FloatArray:
    """Solve with the transposed matrix: visits from what flows in, [states]."""
    return np.asarray(factors.solve(inflow, "T"))  # type: ignore[call-overload]


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
        from ssp_lp.compiled.elimination import eliminate_band

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
        from ssp_lp.compiled.elimination import solve_band

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


def reduce_states(inner: FloatArray, leaving: FloatArray, rewards: FloatArray) -> FloatArray:
    """Expected total rewards of a chain, with every entry's relative accuracy where they are >= 0.

    Grassmann, Taksar and Heyman (1985): a state is taken out by sending what would enter it to
    where it goes next; the probability of departing is summed, never formed as 1 - p.

    Args:
        inner: probabilities among the states, [states, states]; overwritten.
        leaving: probabilities of leaving for good, [states]; overwritten.
        rewards: [states, rewards]; overwritten.

    Returns:
        Totals, [states, rewards].

    Raises:
        SolverError: some states are never left.
    """
    for i in range(len(leaving) - 1, -1, -1):
        departs = leaving[i] + inner[i, :i].sum()
        if departs <= 0.0:
            raise SolverError(HOLDS_MASS)
        inner[i, :i] /= departs
        leaving[i] /= departs
        rewards[i] /= departs
        weight = inner[:i, i]
        inner[:i, :i] += np.outer(weight, inner[i, :i])
        leaving[:i] += weight * leaving[i]
        rewards[:i] += np.outer(weight, rewards[i])
    for i in range(1, len(leaving)):
        rewards[i] += inner[i, :i] @ rewards[:i]
    return rewards
