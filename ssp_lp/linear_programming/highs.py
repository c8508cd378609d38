"""HiGHS, called directly through highspy with CSC arrays; also reads and writes its files."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory

import highspy
import numpy as np

from ssp_lp.arrays import RESIDUAL, BoolArray, FloatArray
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.linear_programming.linear_program import POLL, LinearProgram, LPAnswer

HighsOptions = dict[str, bool | int | float | str]

_OPTIMAL, _LATE = highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kTimeLimit
_BASIC, _NONBASIC = highspy.HighsBasisStatus.kBasic, highspy.HighsBasisStatus.kNonbasic
_MAGNIFIED = 1e5  # factor of all bounds in the second run of ``solve_with_highs``
_NUMBERED = "x"  # prefix of a column's number, with which its name begins
ENDINGS = (".mps", ".lp", ".mps.gz", ".lp.gz")


_SHARP: HighsOptions = {
    "primal_feasibility_tolerance": 1e-10,
    "dual_feasibility_tolerance": 1e-10,
    "small_matrix_value": 1e-12,  # smaller entries are dropped; the least value allowed
}


def solve_with_highs(
    program: LinearProgram, backend: str, time_limit: float, basis: BoolArray | None = None
) -> LPAnswer:
    """Solve with HiGHS' dual simplex or its interior point IPX (with crossover).

    IPX ignores the time limit. The name ``ipm`` is avoided, because it means another solver if
    ``highspy-extras`` is installed.

    HiGHS's tolerance of rows is absolute. Late states of long runs have fewer visits than it, so
    the last basis may not be optimal, with prices that are wrong by 2e-5. If a basis is given, the
    simplex therefore continues from its optimum on the program with all bounds multiplied by a
    large factor.

    Args:
        backend: "highs-simplex" or "highs-ipx".
        time_limit: seconds.
        basis: basis of an answer to a program of this shape, from which the simplex starts. It then
            stops after a limited number of steps, perhaps before the optimum: a start without a
            basis would be about as fast as more steps.

    Raises:
        SolverError: HiGHS refuses an option or the model.
    """
    solver = _solved_by_highs(program, backend, time_limit, basis)
    answer, bounds = _answer(solver, backend), np.stack([program.lower, program.upper])
    greatest = np.abs(bounds[np.isfinite(bounds)]).max(initial=0.0)
    is_small = _MAGNIFIED * greatest < solver.getOptionValue("infinite_bound")[1]
    if basis is not None and is_small and solver.getModelStatus() == _OPTIMAL:
        solver.setOptionValue("solver", "simplex")
        solver.setOptionValue("simplex_iteration_limit", len(program.lower))
        for row in np.flatnonzero(bounds.any(axis=0)).tolist():
            solver.changeRowBounds(row, *(_MAGNIFIED * bounds[:, row]))
        run_highs(solver)
        if solver.getModelStatus() == _OPTIMAL:
            answer = _answer(solver, backend, _MAGNIFIED)
    return answer


def _answer(solver: highspy.Highs, backend: str, factor: float = 1.0) -> LPAnswer:
    """Return the solution of a program whose bounds were multiplied by a factor."""
    solution, last = solver.getSolution(), solver.getBasis()
    x, dual = np.array(solution.col_value, float) / factor, np.array(solution.row_dual, float)
    statuses = [each == _BASIC for each in (*last.col_status, *last.row_status)]
    basis = np.array(statuses) if last.valid and statuses else None
    status = solver.modelStatusToString(solver.getModelStatus())
    return LPAnswer(backend, x, dual, status, solver.getRunTime(), basis)


def bound_ranges(program: LinearProgram, rows: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Return the range of each row's upper bound in which its dual stays constant, by HiGHS.

    At a degenerate vertex several duals are optimal; the range is that of one of them.

    Raises:
        SolverError: HiGHS finds no optimum, or no ranges.
    """
    solver = _solved_by_highs(program, "highs-simplex")
    status, ranging = solver.getRanging()
    if status != highspy.HighsStatus.kOk or not ranging.valid:
        words = solver.modelStatusToString(solver.getModelStatus())
        raise SolverError(
            f"HiGHS cannot compute how far the bounds may change: the program is {words.lower()}"
        )
    basis, activity = solver.getBasis().row_status, solver.getSolution().row_value
    low, high = ranging.row_bound_dn.value_, ranging.row_bound_up.value_
    places = {name: program.rows[name].start for name in rows}
    return {  # a row that is not met with equality may have any greater bound
        name: (activity[k], np.inf) if basis[k] == _BASIC else (low[k], high[k])
        for name, k in places.items()
    }


def _solved_by_highs(
    program: LinearProgram, backend: str, time_limit: float = np.inf, basis: BoolArray | None = None
) -> highspy.Highs:
    """Solve a program by HiGHS, from a basis if given, and return the HiGHS object.

    If the answer is doubtful, the program is solved again without presolve: with presolve HiGHS
    1.15 reports some feasible programs as infeasible.
    """
    options: HighsOptions = {"solver": backend.removeprefix("highs-"), **_SHARP}
    if np.isfinite(time_limit):
        options["time_limit"] = max(time_limit, 1e-3)
    solver = highs_solver(highs_lp(program), options)
    if basis is not None:
        solver.setOptionValue("simplex_iteration_limit", max(len(program.lower) // 2, 1_000))
        begun = highspy.HighsBasis()
        statuses = [_BASIC if each else _NONBASIC for each in basis.tolist()]
        n_columns = program.matrix.shape[1]
        begun.col_status, begun.row_status = statuses[:n_columns], statuses[n_columns:]
        begun.valid, begun.alien = True, False
        solver.setBasis(begun)  # if refused, HiGHS starts without one
    run_highs(solver)
    status, broken = solver.getModelStatus(), solver.getInfo().max_primal_infeasibility
    is_doubted = broken > RESIDUAL if status == _OPTIMAL else status != _LATE
    if basis is None and is_doubted:
        solver.setOptionValue("presolve", "off")
        solver.clearSolver()
        run_highs(solver)
    return solver


def minimiser(program: LinearProgram) -> Callable[[FloatArray], float]:
    """Return a function from an objective, [columns], to its minimum within a program's rows.

    The function returns nan if HiGHS finds no optimum. Each call starts from the optimum of the
    last one.
    """
    solver = highs_solver(highs_lp(program), {"solver": "simplex", "simplex_strategy": 4, **_SHARP})

    def least(cost: FloatArray) -> float:
        """Return the minimum of ``cost @ x`` within the program's rows, or nan."""
        solver.changeColsCost(cost.size, np.arange(cost.size, dtype=np.int32), cost)
        for _ in range(2):
            run_highs(solver)
            if solver.getModelStatus() == _OPTIMAL:
                return float(cost @ solver.getSolution().col_value)
            solver.setOptionValue("presolve", "off")
            solver.clearSolver()  # the last basis may be a bad beginning
        return float("nan")

    return least


class _SilentHighs(highspy.Highs):
    """HiGHS with output turned off before it prints its banner."""

    def enableCallbacks(self) -> None:  # noqa: N802 (the first that its constructor calls)
        """Turn the output off, then enable callbacks."""
        self.setOptionValue("output_flag", False)
        super().enableCallbacks()  # type: ignore[no-untyped-call]


def highs_solver(lp: highspy.HighsLp, options: HighsOptions) -> highspy.Highs:
    """Create an instance of HiGHS with a program and options, silent and on one core.

    Raises:
        SolverError: HiGHS refuses an option or the program.
    """
    solver = _SilentHighs()  # type: ignore[no-untyped-call]
    for name, value in {"output_flag": False, "threads": 1, **options}.items():
        if solver.setOptionValue(name, value) != highspy.HighsStatus.kOk:
            raise SolverError(f"HiGHS refuses the option {name}={value!r}")
    if solver.passModel(lp) == highspy.HighsStatus.kError:
        raise SolverError("HiGHS refuses the linear program: make all its numbers finite")
    return solver


def run_highs(solver: highspy.Highs) -> None:
    """Run HiGHS in another thread, so that Ctrl-C ends it.

    If HiGHS ran before in this process, for example by cvxpy, it runs on the same number of threads
    again, since it refuses any other number.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    solver.HandleUserInterrupt = True
    for _ in range(2):
        solver.startSolve()
        try:
            while not (ended := solver.wait(POLL))[0]:
                pass
        except KeyboardInterrupt:
            solver.cancelSolve()  # type: ignore[no-untyped-call]
            solver.wait()
            raise
        if ended[1] != highspy.HighsStatus.kError:
            return
        solver.setOptionValue("threads", 0)


def highs_lp(program: LinearProgram) -> highspy.HighsLp:
    """Return a program in HiGHS' own form."""
    n_rows, n_columns = program.matrix.shape
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = n_columns, n_rows
    lp.col_cost_ = program.cost
    lp.col_lower_ = np.zeros(n_columns)
    lp.col_upper_ = np.full(n_columns, highspy.kHighsInf)
    lp.row_lower_ = np.maximum(program.lower, -highspy.kHighsInf)
    lp.row_upper_ = np.minimum(program.upper, highspy.kHighsInf)
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_ = program.matrix.indptr
    lp.a_matrix_.index_ = program.matrix.indices
    lp.a_matrix_.value_ = program.matrix.data
    return lp


def write_program(program: LinearProgram, path: Path, columns: Sequence[str]) -> None:
    """Write a program through HiGHS, in free MPS or CPLEX's LP format.

    Args:
        program: the program.
        path: ends in ``.mps`` or ``.lp``, optionally followed by ``.gz``.
        columns: names, written after their numbers; characters that the formats do not allow
            become underscores.

    Raises:
        ModelError: another ending.
        SolverError: HiGHS cannot write there.
    """
    if not path.name.endswith(ENDINGS):
        raise ModelError(f"a program is written as {' or '.join(ENDINGS)}, not {path.name!r}")
    lp = highs_lp(program)
    lp.col_names_ = _allowed_in_highs(f"{_NUMBERED}{k}.{name}" for k, name in enumerate(columns))
    rows, taken = [""] * program.matrix.shape[0], set[str]()
    named = zip(_allowed_in_highs(program.rows), program.rows.items(), strict=True)
    for number, (plain, (name, places)) in enumerate(named):
        if plain in taken or not plain[0].isalpha():
            plain = f"row{number}.{plain}"
        count = places.stop - places.start
        is_alone = count == 1 and name != "balance"
        rows[places] = [plain] if is_alone else [f"{plain}.{k}" for k in range(count)]
        taken.update([plain, *rows[places]])
    lp.row_names_ = rows
    with TemporaryDirectory() as folder:
        packs = path.suffix == ".gz"
        target = Path(folder) / path.stem if packs else path
        if highs_solver(lp, {}).writeModel(str(target)) == highspy.HighsStatus.kError:
            raise SolverError(f"HiGHS cannot write the program to {str(path)!r}")
        if packs:
            with target.open("rb") as text, gzip.open(path, "wb", compresslevel=1) as packed:
                copyfileobj(text, packed)


def read_columns(path: Path, n_columns: int) -> FloatArray:
    """Read a solution file of a program that :func:`write_program` wrote, by columns' names.

    Args:
        path: text in which a column's name is followed by its value; columns that it does not name
            are 0.
        n_columns: number of columns of the program.

    Raises:
        ModelError: the file cannot be read, or names no column.
    """
    x, named_columns = np.zeros(n_columns), set[int]()
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"the solution file {str(path)!r} cannot be read: {error}") from error
    for line in lines:
        for name, word in pairwise(line.split()):
            named = re.fullmatch(rf"{_NUMBERED}(\d+)\..*", name)
            place = n_columns if named is None else int(named[1])
            if place < n_columns and place not in named_columns:
                with suppress(ValueError):  # no number
                    x[place] = float(word)
                    named_columns.add(place)  # duals that follow under the same names are ignored
    if not named_columns:
        raise ModelError(f"{str(path)!r} names no column of the program: check the file")
    return x


def _allowed_in_highs(names: Iterable[str]) -> list[str]:
    """Convert names to the characters HiGHS may write: letters, digits, dots, underscores."""
    return [re.sub(r"[^A-Za-z0-9.]+", "_", name).strip("_") or "_" for name in names]
