"""HiGHS called directly on the occupation program: its interior points and first-order methods.

The program is the one of `ssp_lp.programs.occupation_program`. Interior points run without
crossover, since only the value is needed; threads and tolerances have their defaults.
"""

import math

import highspy
import numpy as np

from examples.solver_comparison.instances.models import ReadyInstance
from examples.solver_comparison.solvers.answer import Answer, Prepared
from examples.solver_comparison.solvers.catalogue import Order
from examples.solver_comparison.solvers.explicit import describe, size_of, written_out
from ssp_lp.linear_programming.highs import highs_lp
from ssp_lp.linear_programming.linear_program import LinearProgram, LPAnswer, answer_faults
from ssp_lp.programs.occupation_program import rows_program


def prepare(ready: ReadyInstance, order: Order, *, method: str) -> Prepared:
    """Assemble an instance's program; `method` is the value of HiGHS' option "solver"."""
    process, asked = written_out(ready), ready.instance
    limits = {"failure": (process.failure, asked.failure_budget)}
    program = rows_program(process, limits, asked.case == "S")
    options = {
        "output_flag": False,
        "solver": method,
        "run_crossover": "off",
        "time_limit": order.time_limit,
    }

    def call() -> Answer:
        solver = highspy.Highs()
        for name, value in options.items():
            _require(solver.setOptionValue(name, value), f"the option {name}={value!r}")
        _require(solver.passModel(highs_lp(program)), "the program")
        solver.run()
        return _answer(solver, program)

    return Prepared(call, note=size_of(process), details=describe(process))


def _require(status: highspy.HighsStatus, what: str) -> None:
    if status == highspy.HighsStatus.kError:
        raise ValueError(f"HiGHS refuses {what}")


def _answer(solver: highspy.Highs, program: LinearProgram) -> Answer:
    found, status = solver.getSolution(), solver.getModelStatus()
    x, dual = np.asarray(found.col_value), np.asarray(found.row_dual)
    words = solver.modelStatusToString(status)
    if status != highspy.HighsModelStatus.kOptimal:
        in_time = status != highspy.HighsModelStatus.kTimeLimit
        return Answer(math.nan, unsolved=f"HiGHS: {words}" if in_time else "", in_time=in_time)
    worst, _ = answer_faults(program, LPAnswer("", x, dual, words, 0.0))
    bounds = np.where(np.isfinite(program.upper), program.upper, program.lower)
    objective = float(program.cost @ x)
    return Answer(
        objective=objective,
        gap=abs(objective - float(bounds @ dual)) / (1.0 + abs(objective)),
        note=f"largest residual {worst:.0e}",
        excess=lambda: excess_failure(program, x),
    )


def excess_failure(program: LinearProgram, x: np.ndarray) -> float:
    """Return by how much a solution's failure exceeds the budget; in case S divided by t."""
    row = program.rows["failure"]
    over = float((program.matrix[row] @ x - program.upper[row])[0])
    scale = float(x[-1]) if "normaliser" in program.rows else 1.0
    return max(over / scale, 0.0)
