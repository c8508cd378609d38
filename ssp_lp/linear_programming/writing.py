"""Linear programs as files, written by HiGHS."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import highspy

from ssp_lp.errors import ModelError, SolverError
from ssp_lp.linear_programming.highs import highs_lp
from ssp_lp.linear_programming.linear_program import LinearProgram

ENDINGS = (".mps", ".lp")


def write_program(program: LinearProgram, path: Path, columns: Sequence[str]) -> None:
    """Write a program in free MPS or CPLEX's LP format.

    Args:
        program: the program.
        path: ends in ``.mps`` or ``.lp``.
        columns: names; what the formats do not allow becomes an underscore.

    Raises:
        ModelError: another ending.
        SolverError: HiGHS cannot write there.
    """
    if path.suffix not in ENDINGS:
        raise ModelError(f"a program is written as {' or '.join(ENDINGS)}, not {path.name!r}")
    lp = highs_lp(program)
    lp.col_names_ = [_allowed(name) for name in columns]
    rows, taken = [""] * program.matrix.shape[0], set[str]()
    for number, (name, places) in enumerate(program.rows.items()):
        plain = _allowed(name)
        if plain in taken or not plain[0].isalpha():
            plain = f"row{number}.{plain}"
        taken.add(plain)
        alone = places.stop - places.start == 1 and name != "balance"
        for k in range(places.start, places.stop):
            rows[k] = plain if alone else f"{plain}.{k - places.start}"
    lp.row_names_ = rows
    solver = highspy.Highs()  # type: ignore[no-untyped-call]
    solver.setOptionValue("output_flag", False)
    accepted = solver.passModel(lp) != highspy.HighsStatus.kError
    if not accepted or solver.writeModel(str(path)) == highspy.HighsStatus.kError:
        raise SolverError(f"HiGHS cannot write the program to {str(path)!r}")


def _allowed(name: str) -> str:
    """A name of letters, digits, dots and underscores."""
    return re.sub(r"[^A-Za-z0-9_.]+", "_", name).strip("_") or "_"
