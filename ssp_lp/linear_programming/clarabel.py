"""Clarabel, called directly: an interior point for conic programs."""

from __future__ import annotations

import time

import clarabel
import numpy as np
import scipy.sparse as sp

from ssp_lp.linear_programming.answer import LPAnswer
from ssp_lp.linear_programming.linear_program import LinearProgram


def solve_with_clarabel(program: LinearProgram, time_limit: float) -> LPAnswer:
    """Solve ``min q @ x, A x + s = b`` with s = 0 on equalities and s >= 0 elsewhere.

    Args:
        time_limit: seconds.
    """
    began = time.perf_counter()
    n_columns = program.matrix.shape[1]
    equal, below = np.flatnonzero(program.equality), np.flatnonzero(~program.equality)
    rows = program.matrix.tocsr()
    system = sp.csc_matrix(sp.vstack([rows[equal], rows[below], -sp.eye_array(n_columns)]))
    right = np.concatenate([program.upper[equal], program.upper[below], np.zeros(n_columns)])
    cones = [
        clarabel.ZeroConeT(equal.size),
        clarabel.NonnegativeConeT(below.size + n_columns),
    ]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
    if np.isfinite(time_limit):
        settings.time_limit = max(time_limit, 1e-3)
    nothing = sp.csc_matrix((n_columns, n_columns))
    result = clarabel.DefaultSolver(nothing, program.cost, system, right, cones, settings).solve()
    dual = np.zeros(len(right) - n_columns)
    dual[np.concatenate([equal, below])] = -np.asarray(result.z)[: dual.size]
    return LPAnswer(
        backend="clarabel",
        x=np.asarray(result.x),
        dual=dual,
        status=str(result.status),
        seconds=time.perf_counter() - began,
    )
