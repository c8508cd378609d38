"""The LP engine: choose a backend by size, solve, and never accept a solver's word."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from ssp_lp.arrays import RESIDUAL, FloatArray
from ssp_lp.engines.instance import Instance
from ssp_lp.engines.lp.answer import LPAnswer, residuals
from ssp_lp.engines.lp.warm_start import PolicyBasis, policy_basis
from ssp_lp.engines.row import Row
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.process.explicit import ExplicitProcess
from ssp_lp.program import LinearProgram, occupation_program, rows_program

BACKENDS = ("highs", "highs-simplex", "highs-ipx", "highs-warm", "clarabel", "cvxpy")

_SIMPLEX_COLUMNS = 3_000  # above: IPX wins by far on these programs
_AGREEMENT = 1e-6
_REMEDY = "engine='columns' needs no LP solver"

_Attempt = tuple[str, PolicyBasis | None]


@dataclass(frozen=True)
class ProgramOptimum:
    """A checked optimum of the linear program."""

    objective: float  # c*
    price: float  # kappa: the price of failure at which the optimal policies are priced
    report: str  # one line: backend, size, residuals, seconds
    prices: Mapping[str, float] = field(default_factory=dict)  # of all limited rows, by name


def solve_program(
    instance: Instance, row: Row, backend: str | None, deadline: float
) -> ProgramOptimum:
    """Solve an instance's linear program, falling back once to another backend if need be.

    "highs-warm" checks rather than solves: the simplex method starts at the policies that column
    generation found, and reports how many iterations it took from there (0: it agrees at once).
    Where the residuals are large it starts there a second time, with larger pivots.

    Args:
        instance: brings the process.
        row: the failure budget and the form of the objective.
        backend: one of BACKENDS, or None to choose by size.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        ModelError: unknown backend.
        SolverError: no backend's answer passes the check of its residuals.
    """
    if backend is not None and backend not in BACKENDS:
        raise ModelError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    process = instance.explicit()
    program = occupation_program(process, row.budget, row.ratio)
    attempts = _cold_attempts(program, backend)
    if backend == "highs-warm":
        start = policy_basis(instance, process, row, deadline)
        attempts = [(backend, start), (backend, start.stabler), attempts[1]]
    answer, worst = _answer(program, attempts, deadline)
    ratio = float(answer.dual[program.rows["normaliser"]][0]) if row.ratio else 0.0
    return _optimum(program, answer, worst, ratio)


def solve_rows_program(
    process: ExplicitProcess,
    limits: Mapping[str, tuple[FloatArray, float]],
    backend: str | None,
    deadline: float,
) -> ProgramOptimum:
    """Solve the linear program of a process with any named rows, case M; all duals by name.

    Args:
        process: the process.
        limits: name -> (coefficient of each pair, [pairs], and bound).
        backend: one of BACKENDS but "highs-warm", or None to choose by size.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        SolverError: no backend's answer passes the check of its residuals.
    """
    program = rows_program(process, limits, ratio=False)
    return _optimum(program, *_answer(program, _cold_attempts(program, backend), deadline), 0.0)


def _cold_attempts(program: LinearProgram, backend: str | None) -> list[_Attempt]:
    """The backend asked for, or the one for the program's size, and one to fall back on."""
    small = program.matrix.shape[1] <= _SIMPLEX_COLUMNS
    preferred = "highs-simplex" if small else "highs-ipx"
    chosen = preferred if backend in (None, "highs") else str(backend)
    spare = "clarabel" if chosen == "highs-ipx" else "highs-ipx"
    if chosen == "highs-warm":
        spare = preferred
    return [(chosen, None), (spare, None)]


def _answer(
    program: LinearProgram, attempts: list[_Attempt], deadline: float
) -> tuple[LPAnswer, float]:
    """The first answer that passes its check, and its worst residual."""
    tried = []
    for name, basis in attempts:
        answer = _run(program, name, deadline - time.perf_counter(), basis)
        worst = residuals(program, answer).worst
        if worst <= RESIDUAL:
            return answer, worst
        tried.append(f"{name}: {answer.status}, residual {worst:.1e}, {answer.seconds:.1f} s")
    failures = "; ".join(tried)
    raise SolverError(f"no LP backend's answer passes its check ({failures}); {_REMEDY}")


def check_agreement(optimum: ProgramOptimum, objective: float) -> None:
    """Raise :class:`SolverError` if the LP's optimum and its recovered policy's value differ."""
    if abs(optimum.objective - objective) > _AGREEMENT * max(abs(objective), 1.0):
        raise SolverError(
            f"the linear program says {optimum.objective!r} ({optimum.report}) but the policies "
            f"priced at its dual attain {objective!r}"
        )


def _run(
    program: LinearProgram, backend: str, time_limit: float, basis: PolicyBasis | None
) -> LPAnswer:
    if backend == "clarabel":  # each backend is imported only when it is asked for
        from ssp_lp.engines.lp.clarabel import solve_with_clarabel

        return solve_with_clarabel(program, time_limit)
    if backend == "cvxpy":
        from ssp_lp.engines.lp.cvxpy import solve_with_cvxpy

        return solve_with_cvxpy(program, time_limit)
    from ssp_lp.engines.lp.highs import solve_with_highs

    return solve_with_highs(program, backend, time_limit, basis)


def _optimum(
    program: LinearProgram, answer: LPAnswer, worst: float, ratio: float
) -> ProgramOptimum:
    named = set(program.rows) - {"balance", "normaliser"}
    prices = {name: max(-float(answer.dual[program.rows[name]][0]), 0.0) for name in named}
    objective = float(program.cost @ answer.x)
    n_rows, n_columns = program.matrix.shape
    moved = "" if answer.iterations is None else f"{answer.iterations:,} simplex iterations, "
    return ProgramOptimum(
        objective=objective,
        price=prices.get("failure", 0.0) + ratio,
        report=f"{answer.backend}: {objective:.10g}, {n_rows:,} rows x {n_columns:,} columns, "
        f"residual {worst:.0e}, {moved}{answer.seconds:.2g} s",
        prices=prices,
    )
