"""Solve a program by the backend that its size asks for, and never accept a solver's word."""

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
from ssp_lp.linear_programming.linear_program import LinearProgram, LPAnswer, answer_faults
from ssp_lp.options import BACKENDS

_SIMPLEX = (None, "highs", "highs-simplex")  # what may begin at a basis
_SIMPLEX_COLUMNS = 3_000  # above: IPX wins by far on these programs
_SIMPLEX_AT_LAST = 50_000  # columns up to which simplex is tried where interior points fail
_LOOK = 0.05  # seconds between two looks at the time while a solver works
_LARGE = 300_000  # entries of a program that takes a solver seconds, and another process a share
_SERVED = """
import os, pickle, sys, threading, time
asker = os.getppid()
def watch():
    while os.getppid() == asker:
        time.sleep(1.0)
    os._exit(1)  # nobody is left to be told
threading.Thread(target=watch, daemon=True).start()
told = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)  # what a solver prints is no answer
sys.path[:] = pickle.load(sys.stdin.buffer)
from ssp_lp.linear_programming.backends import serve_backend
serve_backend(sys.stdin.buffer, told)
told.close()
"""
_DOUBTFUL = 1e-7  # of the objective: worth asking a further backend, policies agree to 1e-6
_CLARABEL = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9)
"""Tighter than Clarabel's own: rows of a process that is hardly left multiply what they miss by."""

_REMEDY = "column generation needs no LP solver"


def backends_for(program: LinearProgram, backend: str | None) -> tuple[str, ...]:
    """The LP backend asked for, or the one for the program's size, and those to fall back on.

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
    """Answer of the first LP backend, in turn, that passes its check.

    Args:
        program: the program.
        backend: one of BACKENDS; None: the one for the program's size.
        deadline: on the clock of ``time.perf_counter``.

    Returns:
        The answer and its worst residual.

    Raises:
        ModelError: an unknown backend.
        SolverError: no answer passes.
        Stop: the time ended before one did.
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
        raise Stop(told=f"no backend's answer passed its check by then: {tried[-1]}")
    failures = "; ".join(tried)
    raise SolverError(f"no LP backend's answer passes its check ({failures}); {_REMEDY}")


def answers_in_turn(
    program: LinearProgram, backend: str | None, time_limit: float, basis: BoolArray | None = None
) -> Iterator[LPAnswer]:
    """Answers of one LP backend after another, unchecked; nan where the time ended before.

    Args:
        program: the program.
        backend: one of BACKENDS; None: the one for the program's size.
        time_limit: seconds, for all of them.
        basis: of an answer to another program; where that has as many columns and rows, HiGHS's
            simplex begins there, if no other backend is asked for, and the others come after it.

    Raises:
        ModelError: an unknown backend.
        SolverError: as of a backend.
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
    """Answer of one LP backend, unchecked.

    The call ends with the deadline of what it is part of, or with Ctrl-C, whatever the solver hears
    of its own: a large program is solved in a process beside this one, which is ended then.

    Args:
        program: the program.
        backend: "highs-simplex", "highs-ipx" or "cvxpy".
        time_limit: seconds, for the solver.
        basis: where HiGHS's simplex begins.

    Raises:
        SolverError: as of the backend.
        Stop: the deadline has passed, with its grace.
    """
    if program.matrix.nnz < _LARGE or not sys.executable:
        return _backend_answer(program, backend, time_limit, basis)
    reply: bytes | None = None
    with TemporaryFile() as question:

        def write(part: bytes) -> int:
            """Write an array of the program, with a look at the time before it."""
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
                        reply = beside.communicate(timeout=_LOOK)[0]
            finally:
                beside.kill()
    if not reply:
        raise SolverError(f"{backend} ended with code {beside.returncode}; {_REMEDY}")
    answer: LPAnswer | Exception = pickle.loads(reply)  # noqa: S301 (of the process begun here)
    if isinstance(answer, Exception):
        raise answer
    return answer


def serve_backend(question: BinaryIO, reply: BinaryIO) -> None:
    """Run an LP backend on one program in a process of its own.

    Args:
        question: the arguments of :func:`run_backend`, pickled.
        reply: where the answer is written, or what was raised.
    """
    try:
        answer: LPAnswer | Exception = _backend_answer(*pickle.load(question))  # noqa: S301
    except Exception as error:  # it is raised where the answer is asked for
        answer = error
    pickle.dump(answer, reply)


def _backend_answer(
    program: LinearProgram, backend: str, time_limit: float, basis: BoolArray | None
) -> LPAnswer:
    """Primal and dual solution by a named LP backend."""
    if backend == "cvxpy":  # each solver is imported only when it is asked for
        return solve_with_cvxpy(program, time_limit)
    from ssp_lp.linear_programming.highs import solve_with_highs

    return solve_with_highs(program, backend, time_limit, basis)


def solve_with_cvxpy(program: LinearProgram, time_limit: float) -> LPAnswer:
    """The LP backend cvxpy: state the program row by row, solve it by Clarabel.

    Args:
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
        simplefilter("ignore")  # that the answer may be inaccurate: it is checked
        problem.solve(solver=cp.CLARABEL, **limit, **_CLARABEL)  # type: ignore[no-untyped-call]
    x, dual = (np.full(size, np.nan) for size in program.matrix.shape[::-1])
    for rows, constraint in constraints:
        if constraint.dual_value is not None:
            dual[rows] = -np.asarray(constraint.dual_value)
    x = x if visits.value is None else np.asarray(visits.value)
    return LPAnswer("cvxpy", x, dual, str(problem.status), time.perf_counter() - began)
