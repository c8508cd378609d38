"""Solve a program by the backend that its size asks for, and never accept a solver's word."""

from __future__ import annotations

import time

from ssp_lp.arrays import RESIDUAL
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.linear_programming.answer import LPAnswer, residuals
from ssp_lp.linear_programming.basis import PolicyBasis
from ssp_lp.linear_programming.linear_program import LinearProgram
from ssp_lp.options import BACKENDS

_SIMPLEX_COLUMNS = 3_000  # above: IPX wins by far on these programs
_REMEDY = "column generation needs no LP solver"

Attempt = tuple[str, PolicyBasis | None]


def cold_attempts(program: LinearProgram, backend: str | None) -> list[Attempt]:
    """The backend asked for, or the one for the program's size, and one to fall back on.

    Raises:
        ModelError: an unknown backend.
    """
    if backend is not None and backend not in BACKENDS:
        raise ModelError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    small = program.matrix.shape[1] <= _SIMPLEX_COLUMNS
    preferred = "highs-simplex" if small else "highs-ipx"
    chosen = preferred if backend in (None, "highs") else str(backend)
    spare = "clarabel" if chosen == "highs-ipx" else "highs-ipx"
    if chosen == "highs-warm":
        spare = preferred
    return [(chosen, None), (spare, None)]


def first_accepted(
    program: LinearProgram, attempts: list[Attempt], deadline: float
) -> tuple[LPAnswer, float]:
    """The first answer that passes its check, and its worst residual.

    Args:
        program: the program.
        attempts: backends with what they start from, in the order in which they are tried.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        SolverError: none passes.
    """
    tried = []
    for name, basis in attempts:
        answer = run(program, name, deadline - time.perf_counter(), basis)
        worst = residuals(program, answer).worst
        if worst <= RESIDUAL:
            return answer, worst
        tried.append(f"{name}: {answer.status}, residual {worst:.1e}, {answer.seconds:.1f} s")
    failures = "; ".join(tried)
    raise SolverError(f"no LP backend's answer passes its check ({failures}); {_REMEDY}")


def run(
    program: LinearProgram, backend: str, time_limit: float, basis: PolicyBasis | None = None
) -> LPAnswer:
    """One backend's answer, unchecked.

    Args:
        program: the program.
        backend: "highs-simplex", "highs-ipx", "highs-warm", "clarabel" or "cvxpy".
        time_limit: seconds.
        basis: where "highs-warm" starts.
    """
    if backend == "clarabel":  # each backend is imported only when it is asked for
        from ssp_lp.linear_programming.clarabel import solve_with_clarabel

        return solve_with_clarabel(program, time_limit)
    if backend == "cvxpy":
        from ssp_lp.linear_programming.cvxpy import solve_with_cvxpy

        return solve_with_cvxpy(program, time_limit)
    from ssp_lp.linear_programming.highs import solve_with_highs

    return solve_with_highs(program, backend, time_limit, basis)
