"""The full linear program of a problem, solved and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.backends import first_accepted
from ssp_lp.options import SolveOptions
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.programs.occupation_program import rows_program

_AGREEMENT = 1e-6


@dataclass(frozen=True)
class ProgramOptimum:
    """A checked optimum of the linear program."""

    objective: float  # c*
    report: str  # one line: backend, size, residuals, seconds
    prices: Mapping[str, float]  # of all limited rows, by name


def solve_program(
    process: ExplicitProcess,
    limits: Mapping[str, tuple[FloatArray, float]],
    options: SolveOptions,
    *,
    ratio: bool,
) -> ProgramOptimum:
    """Solve the full linear program of a process; if a backend fails, try another one.

    Args:
        process: the process.
        limits: name -> (coefficient of each pair, [pairs], and bound).
        options: backend and deadline.
        ratio: case S, the objective <cost, x> / <goal, x>.

    Raises:
        ModelError: unknown backend.
        SolverError: no backend's solution passes the check of its residuals.
    """
    program = rows_program(process, limits, ratio)
    backend = None if options.program is None else options.program.backend
    answer, worst = first_accepted(program, backend, options.deadline)
    named = set(program.rows) - {"balance", "normaliser"}
    prices = {name: max(-float(answer.dual[program.rows[name]][0]), 0.0) for name in named}
    n_rows, n_columns = program.matrix.shape
    objective = float(program.cost @ answer.x)
    return ProgramOptimum(
        objective=objective,
        report=f"{answer.backend}: {objective:.10g}, {n_rows:,} rows x {n_columns:,} columns, "
        f"residual {worst:.0e}, {answer.seconds:.2g} s",
        prices=prices,
    )


def check_agreement(optimum: ProgramOptimum, objective: float) -> None:
    """Raise :class:`SolverError` unless a program's optimum equals the policies' objective."""
    if abs(optimum.objective - objective) > _AGREEMENT * max(abs(objective), 1.0):
        raise SolverError(
            f"the linear program reports {optimum.objective!r} ({optimum.report}), but the "
            f"policies priced at its dual attain {objective!r}: use method='columns'"
        )
