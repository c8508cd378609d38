"""Files: programs that are written, solved elsewhere, and read back by the names of their columns.

The program of every criterion that has one is written as an `.mps` and an `.lp` file. HiGHS reads
the first (its own executable if `highs` is on the path, otherwise a new object of highspy) and
writes a `.sol`. Clarabel solves the arrays of the second, and its answer is written with a name and
a value in each line. Both are read back as measures.

    python examples/formulating/files.py --output files
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import cvxpy as cp
import highspy
import numpy as np
import scipy.sparse as sp

from ssp_lp import (
    MCMP,
    S3P,
    SSP,
    AlphaMCMP,
    CostBoundedReach,
    FinitePenalty,
    MaxProb,
    MinProb,
    solve,
    visits,
)
from ssp_lp.problem import Problem
from ssp_lp.programs.occupation_measure import OccupationMeasure

START = "depot yard"


def depot() -> SSP:
    """Return a model whose names have blanks and signs."""
    return SSP.from_transitions(
        {
            "depot yard": {
                "alley #1": [(0.50, "depot yard", 1.0), (0.40, "home", 2.0), (0.10, "wreck", 2.0)],
                "road": [(0.20, "depot yard", 4.0), (0.80, "bridge: east", 3.0)],
            },
            "bridge: east": {
                "over": [(0.99, "home", 4.0), (0.01, "wreck", 4.0)],
                "back": [(1.0, "depot yard", 3.0)],
            },
            "wreck": {},
        },
        goal={"home"},
        treat_actionless_as_dead_ends=True,
    )


def problems() -> Iterator[tuple[str, Problem]]:
    """Yield a problem of each criterion, by its name."""
    model = depot()
    yield "MCMP", MCMP(model, START, 0.05)
    yield "MCMP, limited", MCMP(model, START, 0.1, constraints={"stays": visits(START) <= 1.4})
    yield "S3P", S3P(model, START, 0.05)
    yield "AlphaMCMP", AlphaMCMP(model, START, 0.95)
    yield "FinitePenalty", FinitePenalty(model, START, 30.0)
    yield "MaxProb", MaxProb(model, START)
    yield "MinProb", MinProb(model, START)
    yield "CostBoundedReach", CostBoundedReach(model, START, 8)


def by_highs(file: Path, solution: Path) -> None:
    """Solve a file by HiGHS, and let it write its solution."""
    if (executable := shutil.which("highs")) is not None:
        command = [executable, str(file.resolve()), "--solution_file", str(solution.resolve())]
        # beside the file, where it leaves its log
        subprocess.run(command, check=True, capture_output=True, cwd=file.parent)  # noqa: S603
        return
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    highs.readModel(str(file))
    highs.run()
    highs.writeSolution(str(solution), 0)


def by_clarabel(file: Path, solution: Path) -> None:
    """Solve a file's program by Clarabel, and write a name and a value in each line."""
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    highs.readModel(str(file))
    lp, matrix = highs.getLp(), highs.getLp().a_matrix_
    by_columns = matrix.format_ == highspy.MatrixFormat.kColwise
    form, shape = (sp.csc_array if by_columns else sp.csr_array), (lp.num_row_, lp.num_col_)
    rows = form((matrix.value_, matrix.index_, matrix.start_), shape=shape)
    x, lower, upper = cp.Variable(lp.num_col_), np.array(lp.row_lower_), np.array(lp.row_upper_)
    equal, below = lower == upper, (lower < upper) & (upper < highspy.kHighsInf)
    above = (lower < upper) & (lower > -highspy.kHighsInf)
    stated = [rows[equal] @ x == upper[equal], x >= np.array(lp.col_lower_)]
    if below.any():
        stated.append(rows[below] @ x <= upper[below])
    if above.any():
        stated.append(rows[above] @ x >= lower[above])
    cp.Problem(cp.Minimize(np.array(lp.col_cost_) @ x), stated).solve(cp.CLARABEL)
    lines = zip(lp.col_names_, x.value, strict=True)
    solution.write_text(
        "".join(f"{name} {value:.17g}\n" for name, value in lines), encoding="utf-8"
    )


def round_trip(problem: Problem, folder: Path) -> tuple[OccupationMeasure, OccupationMeasure]:
    """Write a problem's program, and return the measures that HiGHS and Clarabel find."""
    program = problem.program()
    program.write(folder / "program.mps")
    program.write(folder / "program.lp")
    by_highs(folder / "program.mps", folder / "highs.sol")
    by_clarabel(folder / "program.lp", folder / "clarabel.sol")
    return program.read_solution(folder / "highs.sol"), program.read_solution(
        folder / "clarabel.sol"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print each solver's optimum beside the library's own."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("files"), help="folder")
    folder = parser.parse_args(arguments).output
    print(f"{'criterion':>16} {'solve':>11} {'HiGHS':>11} {'Clarabel':>11} {'columns':>8}")
    for name, problem in problems():
        place = folder / name.replace(", ", "_")
        place.mkdir(parents=True, exist_ok=True)
        highs, clarabel = round_trip(problem, place)
        print(f"{name:>16} {solve(problem).objective:11.7f} {highs.objective:11.7f}"
              f" {clarabel.objective:11.7f} {highs.program.process.n_pairs:8}")  # fmt: skip
    print(f"the files are in {folder}")


if __name__ == "__main__":
    main()
