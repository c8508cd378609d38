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
    """Equations of a direct solver: ``I - chain``, its diagonal a sum of where states depart to.

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
    """Sparse factors for a direct solver; in the given order where that is topological.

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


def factor_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray | None = None) -> Solver:
    """Solve the equations of a chain by sparse factors with one step of refinement.

    Args:
        matrix: [states, states].
        exits: [states].
        order: states in the order to be kept; None: in one that fills in little.

    Raises:
        SolverError: there are too many states, or they are never left.
    """
    size = len(exits)
    if size > _MOST_STATES and order is None:
        raise SolverError(
            f"no method solves the equations of a policy on {size:,} states that hang together; a "
            "discount may help"
        )
    system = equations(matrix, exits, order)
    factors = factorised(system, in_order=order is not None)

    def solve(right: FloatArray) -> FloatArray:
        """The totals of a right side, refined once, like ``right``."""
        ordered = right if order is None else right[order]
        found = factors.solve(ordered)
        found = found + factors.solve(ordered - system @ found)
        return _solved_in_place(found, order)

    return solve


def band_solver(matrix: sp.csr_array, exits: FloatArray, order: IntArray, width: int) -> Solver:
    """Solve the equations of a narrow chain, reduced state by state without subtractions.

    Compiled.

    Args:
        matrix: without self-loops, [states, states].
        exits: [states].
        order: states in the order in which the chain is narrow.
        width: greatest distance of two states that a move joins in that order.

    Raises:
        SolverError: the chain is never left.
    """
    from ssp_lp.compiled.elimination import eliminate_band, solve_band

    entry, size = matrix.tocoo(), len(exits)
    place = np.empty(size, dtype=np.int64)
    place[order] = np.arange(size)
    band, departs = np.zeros((size, 2 * width + 1)), np.empty(size)
    row, column = place[entry.row], place[entry.col]
    np.add.at(band, (row, width + column - row), entry.data)
    if not eliminate_band(band, exits[order], departs):
        raise SolverError(HOLDS_MASS)

    def solve(right: FloatArray) -> FloatArray:
        """The totals of a right side, like ``right``."""
        ordered = right[order]
        solve_band(band, departs, ordered)
        return _solved_in_place(ordered, order)

    return solve


def _solved_in_place(ordered: FloatArray, order: IntArray | None) -> FloatArray:
    """What was worked out in some order, in the order of the states."""
    if order is None:
        return np.asarray(ordered)
    result = np.empty_like(ordered)
    result[order] = ordered
    return result


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
