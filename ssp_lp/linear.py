"""Linear systems of substochastic chains: ``x = reward + chain @ x``, to near machine precision."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.bellman import ChosenRows, all_rows
from ssp_lp.errors import SolverError

_DENSE_STATES = 40
"""Up to here a dense solve costs less than setting up a sparse one."""

DIRECT_STATES = 1_000
"""Up to here, a sparse factorisation costs less than a Krylov run's overhead."""

_FACTORABLE_STATES = 50_000
"""Above, fill-in may exceed memory: a Krylov answer that is less than exact is kept."""

_TRIAL = 4  # sweeps over which the contraction is judged
_CONTRACTION = 0.85  # per sweep; slower chains are left to BiCGStab, which takes 2 products a step
_SWEEPS = 200

_KRYLOV_STEPS = 1_000
_RESTARTS = 4
EXACT = 4e-15  # relative residual: a few units in the last place of the totals
_LEAST_RESIDUAL = 1e-11  # relative; worse ones are refused


def accumulate(
    chain: sp.csr_array | ChosenRows,
    reward: FloatArray,
    guess: FloatArray | None = None,
    *,
    accuracy: float = EXACT,
) -> FloatArray:
    """Expected total reward of a transient chain: the solution of ``x = reward + chain @ x``.

    Small chains are factorised. Larger ones are swept, ``x <- reward + chain @ x``, while that
    contracts well, then solved by BiCGStab, restarted on the residual until that is rounding; they
    are factorised only where this fails.

    Args:
        chain: substochastic matrix, [states, states], from every state of which mass leaks out.
        reward: [states] or [states, rewards].
        guess: warm start of the iterative solvers, like ``reward``.
        accuracy: relative residual to reach, at best ``EXACT``; small chains are always exact.

    Returns:
        Totals, of the shape of ``reward``.

    Raises:
        SolverError: the chain holds mass for ever (a recurrent class inside).
    """
    size = chain.shape[0]
    if size == 0:
        return reward.copy()
    rows = chain.gathered() if isinstance(chain, ChosenRows) else all_rows(chain)
    if size <= DIRECT_STATES:
        if rows.matrix.nnz == 0:
            return reward.copy()
        return (_dense if size <= _DENSE_STATES else _factorised)(rows.matrix, reward)
    columns = reward.reshape(size, -1)
    first = columns if guess is None else guess.reshape(size, -1)
    x, reached = _swept(rows, columns, first, accuracy)
    if not reached:
        least = accuracy if size <= _FACTORABLE_STATES else max(accuracy, _LEAST_RESIDUAL)
        for j in range(columns.shape[1]):
            solved, residual = _krylov(rows, columns[:, j], x[:, j], accuracy)
            if not residual <= least:
                return _factorised(rows.matrix, reward)
            x[:, j] = solved
    if isinstance(chain, ChosenRows) and rows is not chain:
        chain.products += rows.products
    return x.reshape(reward.shape)


def _swept(
    rows: ChosenRows, reward: FloatArray, x: FloatArray, target: float
) -> tuple[FloatArray, bool]:
    """Repeat ``x <- reward + rows @ x`` while it contracts; x, and whether it is near enough."""
    x = x.copy()
    changes: list[float] = []
    most = float(np.abs(reward).max())
    while True:
        ahead, change, size = rows.sweep(reward, x)
        relative = change / (size + most) if size + most > 0 else 0.0
        if relative <= target:
            return ahead, True
        if not np.isfinite(relative):
            return reward.copy(), False
        slow = len(changes) >= _TRIAL and relative > _CONTRACTION**_TRIAL * changes[-_TRIAL]
        if slow or len(changes) > _SWEEPS:
            return ahead, False
        changes.append(relative)
        x = ahead


def without_self_loops(
    rows: sp.csr_array, home: IntArray, leak: FloatArray
) -> tuple[sp.csr_array, FloatArray]:
    """Rows of transitions seen only when the process departs from where it is.

    Waiting in place changes no total but divides everything else by the probability of departing.
    That is summed from what leaves, never formed as 1 - p, which would cancel for slow loops.

    Args:
        rows: [rows, states], without duplicates.
        home: the state that each row belongs to, [rows].
        leak: mass of each row that goes elsewhere than into ``rows``, [rows].

    Returns:
        The rows without self-loops, divided by the probability of departing, and that
        probability, [rows]. A row that never departs is left as it is, with 1.
    """
    entry = rows.tocoo()
    away = entry.col != home[entry.row]
    departs = leak + np.bincount(entry.row[away], weights=entry.data[away], minlength=rows.shape[0])
    kept = away | (departs[entry.row] == 0)
    departs = np.where(departs == 0, 1.0, departs)
    loops = np.zeros(rows.shape[0], dtype=np.bool_)
    loops[entry.row[~away]] = True
    departs = np.where(loops, departs, 1.0)  # rows without a self-loop depart for sure
    scaled = entry.data[kept] / departs[entry.row[kept]]
    return sp.csr_array((scaled, (entry.row[kept], entry.col[kept])), shape=rows.shape), departs


def _krylov(
    rows: ChosenRows, reward: FloatArray, guess: FloatArray, target: float
) -> tuple[FloatArray, float]:
    """BiCGStab, restarted on the residual; the solution and its relative residual."""
    x, relative = guess, np.inf
    for attempt in range(_RESTARTS + 1):
        residual = reward + rows @ x - x
        scale = float(np.abs(x).max()) + float(np.abs(reward).max())
        size = float(np.abs(residual).max())
        if not np.isfinite(size + scale):
            return x, np.inf
        relative = size / scale if scale > 0 else 0.0
        if relative <= target or attempt == _RESTARTS:
            break
        unit = residual / size  # scipy's test for breakdown is absolute
        x = x + size * rows.solve(unit, 0.3 * target * scale / size, _KRYLOV_STEPS)
    return x, relative


def _dense(chain: sp.csr_array, reward: FloatArray) -> FloatArray:
    """Dense LU with one step of iterative refinement."""
    system = np.eye(chain.shape[0]) - chain.toarray()
    try:
        x = np.linalg.solve(system, reward)
        x = x + np.linalg.solve(system, reward + chain @ x - x)
    except np.linalg.LinAlgError as error:
        raise SolverError("a policy's chain is singular: it holds mass for ever") from error
    return x


def _factorised(chain: sp.csr_array, reward: FloatArray) -> FloatArray:
    """Sparse LU with one step of iterative refinement."""
    system = (sp.eye_array(chain.shape[0], format="csc") - chain).tocsc()
    try:
        factors = linalg.splu(system)
    except RuntimeError as error:
        raise SolverError("a policy's chain is singular: it holds mass for ever") from error
    x = factors.solve(reward)
    x = x + factors.solve(reward + chain @ x - x)
    if not np.isfinite(x).all():
        raise SolverError("a policy's chain is singular to working precision")
    return np.asarray(x)
