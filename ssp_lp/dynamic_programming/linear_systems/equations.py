"""The equations of a whole chain as a matrix, and their dense and sparse factors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import SolverError

HOLDS_MASS = "a policy's chain holds mass for ever: from some states it is never left"

Solver = Callable[[FloatArray], FloatArray]


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
