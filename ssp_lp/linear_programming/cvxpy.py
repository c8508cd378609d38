"""cvxpy: the readable second formulation, and the door to its other solvers."""

from __future__ import annotations

import time
from typing import Any

import cvxpy as cp
import numpy as np

from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.answer import LPAnswer
from ssp_lp.linear_programming.linear_program import LinearProgram


def solve_with_cvxpy(program: LinearProgram, time_limit: float) -> LPAnswer:
    """State the program row by row in cvxpy and solve it with cvxpy's default for LPs.

    Args:
        time_limit: not passed on; solvers name it differently.

    Raises:
        SolverError: cvxpy's solver failed.
    """
    began = time.perf_counter()
    visits = cp.Variable(program.matrix.shape[1], nonneg=True)
    constraints: dict[str, Any] = {}
    for name, rows in program.rows.items():
        if rows.stop == rows.start:
            continue
        activity: Any = program.matrix[rows] @ visits
        limit = program.upper[rows]
        equal = program.equality[rows].all()
        constraints[name] = activity == limit if equal else activity <= limit
    problem = cp.Problem(cp.Minimize(program.cost @ visits), list(constraints.values()))
    try:
        problem.solve()  # type: ignore[no-untyped-call]
    except cp.SolverError as error:
        raise SolverError(f"cvxpy: {error}") from error
    dual = np.full(program.matrix.shape[0], np.nan)
    for name, constraint in constraints.items():
        if constraint.dual_value is not None:
            dual[program.rows[name]] = -np.asarray(constraint.dual_value)
    found = np.full(program.matrix.shape[1], np.nan) if visits.value is None else visits.value
    return LPAnswer("cvxpy", np.asarray(found), dual, str(problem.status),
                    time.perf_counter() - began)  # fmt: skip
