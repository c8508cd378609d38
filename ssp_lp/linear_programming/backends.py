"""LP backends: the choice by size, fallbacks, and the check of their answers."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from tempfile import TemporaryFile
from types import SimpleNamespace
from typing import Any, BinaryIO
from warnings import catch_warnings, simplefilter

import numpy as np

from ssp_lp.arrays import RESIDUAL, BoolArray
from ssp_lp.compiled.deadline import Stop, check_time, is_late, until
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.linear_programming.linear_program import POLL, LinearProgram, LPAnswer, answer_faults
from ssp_lp.options import BACKENDS

_SIMPLEX = (None, "highs", "highs-simplex")  # backends that accept a first basis
_SIMPLEX_COLUMNS = 3_000  # with more columns, IPX is much faster on these programs
_SIMPLEX_AT_LAST = 50_000  # most columns for simplex as the last resort
_LARGE = 300_000  # entries of a program from which on it is solved in another process
_SERVED = """
import os, pickle, sys, threading, time
asker = os.getppid()
def watch():
    while os.getppid() == asker:
        time.sleep(1.0)
    os._exit(1)  # the calling process has ended
threading.Thread(target=watch, daemon=True).start()
told = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)  # keep a solver's output out of the answer
sys.path[:] = pickle.load(sys.stdin.buffer)
from ssp_lp.linear_programming.backends import serve_backend
serve_backend(sys.stdin.buffer, told)
told.close()
"""
_DOUBTFUL = 1e-7  # relative doubt in the objective from which on another backend is tried
_CLARABEL = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9)
"""Tolerances below Clarabel's own, because long runs amplify violations of rows."""

_REMEDY = "use method='columns', which needs no LP solver"


def backends_for(program: LinearProgram, backend: str | None) -> tuple[str, ...]:
    """Return the names of LP backends to try, in this order.

    The first is the requested one or, if none is requested, the one for the program's size.

    Raises:
        ModelError: an unknown backend.
    """
    if backend is not None and backend not in BACKENDS:
        raise ModelError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    small = program.matrix.shape[1] <= _SIMPLEX_COLUMNS
    preferred = "highs-simplex" if small else "highs-ipx"
    chosen = preferred if backend in (None, "highs") else str(backend)
    spare = "cvxpy" if chosen == "highs-ipx" else "highs-ipx"
    last = "highs-simplex" if program.matrix.shape[1] <= _SIMPLEX_AT_LAST else preferred
    return tuple(dict.fromkeys((chosen, spare, preferred, last)))


def first_accepted(
    program: LinearProgram, backend: str | None, deadline: float
) -> tuple[LPAnswer, float]:
    """Return the first answer that passes its check, trying one LP backend after another.

    Args:
        program: the program.
        backend: one of BACKENDS; None: the one for the program's size.
        deadline: time at which to stop, by ``time.perf_counter``.

    Returns:
        The answer and its worst residual.

    Raises:
        ModelError: an unknown backend.
        SolverError: no answer passes.
        Stop: the time ended before an answer passed.
    """
    tried, accepted = list[str](), list[tuple[float, LPAnswer, float]]()
    for answer in answers_in_turn(program, backend, deadline - time.perf_counter()):
        worst, doubt = answer_faults(program, answer)
        if worst <= RESIDUAL:
            accepted.append((doubt, answer, worst))
            if doubt <= _DOUBTFUL or program.matrix.shape[1] > _SIMPLEX_COLUMNS:
                break
        faults = f"residual {worst:.1e}, {answer.seconds:.1f} s"
        tried.append(f"{answer.backend}: {answer.status}, {faults}")
        if is_late():
            break
    if accepted:
        return min(accepted, key=lambda each: each[0])[1:]
    if is_late():
        raise Stop(note=f"no LP backend's answer passed its check in time: {tried[-1]}")
    failures = "; ".join(tried)
    raise SolverError(f"no LP backend's answer passes its check ({failures}); {_REMEDY}")


def answers_in_turn(
    program: LinearProgram, backend: str | None, time_limit: float, basis: BoolArray | None = None
) -> Iterator[LPAnswer]:
    """Yield unchecked answers of one LP backend after another.

    If the time ends before a backend has answered, the last answer yielded has nan values.

    Args:
        program: the program.
        backend: one of BACKENDS; None: the one for the program's size.
        time_limit: seconds, for all backends together.
        basis: basis of an answer to another program. If both programs have the same shape, and
            ``backend`` requests no other, HiGHS's simplex comes first and starts from it.

    Raises:
        ModelError: an unknown backend.
        SolverError: a backend failed.
    """
    deadline = time.perf_counter() + time_limit
    fits = basis is not None and basis.size == sum(program.matrix.shape) and backend in _SIMPLEX
    attempts = [("highs-simplex", basis)] if fits else []
    for name, begun in [*attempts, *((name, None) for name in backends_for(program, backend))]:
        try:
            with until(deadline):
                check_time()
                answer = run_backend(program, name, deadline - time.perf_counter(), begun)
        except Stop:
            dual, x = (np.full(size, np.nan) for size in program.matrix.shape)
            yield LPAnswer(name, x, dual, f"no answer within {time_limit:g} s", time_limit)
            return
        yield answer


def run_backend(
    program: LinearProgram, backend: str, time_limit: float, basis: BoolArray | None = None
) -> LPAnswer:
    """Solve a program by one LP backend, without a check of the answer.

    The call ends at the current deadline (``compiled.deadline``) or with Ctrl-C, even if the solver
    ignores both: a large program is solved in another process, which can be killed.

    Args:
        program: the program.
        backend: "highs-simplex", "highs-ipx" or "cvxpy".
        time_limit: seconds, for the solver.
        basis: the basis from which HiGHS's simplex starts.

    Raises:
        SolverError: the backend failed.
        Stop: the deadline and the time of grace after it have passed.
    """
    if program.matrix.nnz < _LARGE or not sys.executable:
        return _backend_answer(program, backend, time_limit, basis)
    reply: bytes | None = None
    with TemporaryFile() as question:

        def write(part: bytes) -> int:
            """Check the deadline, then write a part of the pickled program."""
            check_time()
            return question.write(part)

        for part in (sys.path, (program, backend, time_limit, basis)):
            pickle.dump(part, SimpleNamespace(write=write))
        question.seek(0)
        with subprocess.Popen(  # noqa: S603 (this very interpreter)
            [sys.executable, "-c", _SERVED],
            stdin=question,
            stdout=subprocess.PIPE,
            start_new_session=True,
        ) as beside:
            try:
                while reply is None:
                    check_time()
                    with suppress(subprocess.TimeoutExpired):
                        reply = beside.communicate(timeout=POLL)[0]
            finally:
                beside.kill()
    if not reply:
        raise SolverError(f"{backend} ended with code {beside.returncode}; {_REMEDY}")
    answer: LPAnswer | Exception = pickle.loads(reply)  # noqa: S301 (of the process started here)
    if isinstance(answer, Exception):
        raise answer
    return answer


def serve_backend(request: BinaryIO, reply: BinaryIO) -> None:
    """Run an LP backend on one program in a separate process.

    Args:
        request: the arguments of :func:`run_backend`, pickled.
        reply: the file to which the answer, or the error, is pickled.
    """
    try:
        answer: LPAnswer | Exception = _backend_answer(*pickle.load(request))  # noqa: S301
    except Exception as error:  # the asking process raises it
        answer = error
    pickle.dump(answer, reply)


def _backend_answer(
    program: LinearProgram, backend: str, time_limit: float, basis: BoolArray | None
) -> LPAnswer:
    """Compute a primal and dual solution by a named LP backend."""
    if backend == "cvxpy":  # import only the solver that is used
        return solve_with_cvxpy(program, time_limit)
    from ssp_lp.linear_programming.highs import solve_with_highs

    return solve_with_highs(program, backend, time_limit, basis)


def solve_with_cvxpy(program: LinearProgram, time_limit: float) -> LPAnswer:
    """Solve a program by Clarabel, called through cvxpy.

    Args:
        program: the program.
        time_limit: seconds.
    """
    import cvxpy as cp

    began, equal = time.perf_counter(), program.equality
    visits = cp.Variable(program.matrix.shape[1], nonneg=True)
    constraints: list[tuple[BoolArray, Any]] = []
    for rows in (equal, ~equal):
        if rows.any():
            activity: Any = program.matrix[rows] @ visits
            bound = program.upper[rows]
            constraints.append((rows, activity == bound if rows is equal else activity <= bound))
    problem = cp.Problem(cp.Minimize(program.cost @ visits), [row for _, row in constraints])
    limit = {"time_limit": max(time_limit, 1e-3)} if np.isfinite(time_limit) else {}
    with suppress(cp.SolverError), catch_warnings():
        simplefilter("ignore")  # the answer may be inaccurate, and is checked
        problem.solve(solver=cp.CLARABEL, **limit, **_CLARABEL)  # type: ignore[no-untyped-call]
    x, dual = (np.full(size, np.nan) for size in program.matrix.shape[::-1])
    for rows, constraint in constraints:
        if constraint.dual_value is not None:
            dual[rows] = -np.asarray(constraint.dual_value)
    x = x if visits.value is None else np.asarray(visits.value)
    return LPAnswer("cvxpy", x, dual, str(problem.status), time.perf_counter() - began)
