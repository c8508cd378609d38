"""The full linear program of a problem, solved and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.column import FailureRow
from ssp_lp.column_generation.compiled_problem import CompiledProblem
from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.backends import first_accepted
from ssp_lp.linear_programming.linear_program import LinearProgram, LPAnswer
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.programs.program_rows import rows_program

_AGREEMENT = 1e-6


@dataclass(frozen=True)
class ProgramOptimum:
    """A checked optimum of the linear program."""

    objective: float  # c*
    price: float  # kappa: the price of failure at which the optimal policies are priced
    report: str  # one line: backend, size, residuals, seconds
    prices: Mapping[str, float] = field(default_factory=dict)  # of all limited rows, by name


def solve_program(
    compiled: CompiledProblem, row: FailureRow, backend: str | None, deadline: float
) -> ProgramOptimum:
    """Solve a problem's linear program, falling back once to another backend if need be.

    Args:
        compiled: brings the process.
        row: the failure budget and the form of the objective.
        backend: one of BACKENDS, or None to choose by size.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        ModelError: unknown backend.
        SolverError: no backend's answer passes the check of its residuals.
    """
    process = compiled.explicit()
    limits = {FAILURE_ROW: (process.failure, row.budget)}
    program = rows_program(process, limits, row.ratio)
    answer, worst = first_accepted(program, backend, deadline)
    ratio = float(answer.dual[program.rows["normaliser"]][0]) if row.ratio else 0.0
    return _program_optimum(program, answer, worst, ratio)


def solve_rows_program(
    process: ExplicitProcess,
    limits: Mapping[str, tuple[FloatArray, float]],
    backend: str | None,
    deadline: float,
    *,
    ratio: bool = False,
) -> ProgramOptimum:
    """Solve the linear program of a process with any named rows; all duals by name.

    Args:
        process: the process.
        limits: name -> (coefficient of each pair, [pairs], and bound).
        backend: one of BACKENDS, or None to choose by size.
        deadline: on the clock of ``time.perf_counter``.
        ratio: case S, the objective <cost, x> / <goal, x>.

    Raises:
        SolverError: no backend's answer passes the check of its residuals.
    """
    program = rows_program(process, limits, ratio)
    return _program_optimum(program, *first_accepted(program, backend, deadline), 0.0)


def check_agreement(optimum: ProgramOptimum, objective: float) -> None:
    """Raise :class:`SolverError` if the program's optimum and its policy's value differ."""
    if abs(optimum.objective - objective) > _AGREEMENT * max(abs(objective), 1.0):
        raise SolverError(
            f"the linear program says {optimum.objective!r} ({optimum.report}) but the policies "
            f"priced at its dual attain {objective!r}"
        )


def _program_optimum(
    program: LinearProgram, answer: LPAnswer, worst: float, ratio: float
) -> ProgramOptimum:
    """The optimum of the full program, with its prices by name."""
    named = set(program.rows) - {"balance", "normaliser"}
    prices = {name: max(-float(answer.dual[program.rows[name]][0]), 0.0) for name in named}
    objective = float(program.cost @ answer.x)
    n_rows, n_columns = program.matrix.shape
    return ProgramOptimum(
        objective=objective,
        price=prices.get(FAILURE_ROW, 0.0) + ratio,
        report=f"{answer.backend}: {objective:.10g}, {n_rows:,} rows x {n_columns:,} columns, "
        f"residual {worst:.0e}, {answer.seconds:.2g} s",
        prices=prices,
    )
