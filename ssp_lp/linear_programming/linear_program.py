"""Linear programs with named rows, as arrays and as text, and the residuals of their solutions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import is_number, wrong_argument
from ssp_lp.model.report import Table

POLL = 0.1
"""Seconds between two checks whether a solver has ended."""

_WIDEST = 100  # most characters in a line of a table
_MOST = 12  # most columns, and rows, of a program printed in full

_SIGNS = {False: r"{x \ge 0}", True: r"{x \ge 0,\ t \ge 0}"}  # without and with a scale
_RELATIONS = {"=": "=", "<=": r"\le"}


@dataclass(frozen=True, eq=False)
class LinearProgram:
    """The program ``minimise cost @ x`` with ``lower <= matrix @ x <= upper`` and ``x >= 0``."""

    cost: FloatArray  # [columns]
    matrix: sp.csc_array  # [rows, columns]
    lower: FloatArray  # [rows]
    upper: FloatArray  # [rows]
    rows: Mapping[str, slice]  # "balance", the limited rows and, in case S, "normaliser"

    @property
    def equality(self) -> BoolArray:
        """Whether a row is an equation, [rows]."""
        return np.asarray(self.lower == self.upper)

    @property
    def is_small(self) -> bool:
        """Whether the program is small enough to be printed in full."""
        return max(self.matrix.shape) <= _MOST

    @property
    def sides(self) -> list[tuple[str, float]]:
        """Relation, "=" or "<=", and upper bound of each row."""
        relations = np.where(self.equality, "=", "<=").tolist()
        return list(zip(relations, self.upper.tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class LPAnswer:
    """A solver's primal and dual solution of a linear program.

    The dual of a row is the derivative of the optimum with respect to the row's right side.
    """

    backend: str
    x: FloatArray  # [columns]
    dual: FloatArray  # [rows]
    status: str
    seconds: float
    basis: BoolArray | None = None  # [columns + rows] whether basic; None: not a vertex


class MeasuredRow(NamedTuple):
    """A row of an occupation program with its value for given visits, its bound and its dual."""

    name: str
    spent: float
    bound: float
    relation: str = "<="
    price: float | None = None  # its multiplier; None: unknown
    dual: float | None = None  # improvement by one more unit of the bound; in case M the price

    @property
    def slack(self) -> float:
        """Distance of the activity from the bound, positive if satisfied."""
        return self.spent - self.bound if self.relation == ">=" else self.bound - self.spent

    def __str__(self) -> str:
        """Return the row with its activity, bound and price."""
        worth = "" if self.price is None else f"   price {self.price:.6g}"
        if self.dual is not None and self.dual != self.price:
            worth += f" of the ratio: {self.dual:.6g} for another unit of the bound"
        return f"{self.name}: {self.spent:.9g} {self.relation} {self.bound:g}{worth}"


def check_bounds(bounds: Mapping[str, object]) -> None:
    """Raise :class:`ModelError`, naming the row, unless all bounds are numbers."""
    for name, bound in bounds.items():
        if not (is_number(bound) and float(bound) > -np.inf):
            raise wrong_argument(name, "be a number, the bound of its row", bound)


def answer_faults(program: LinearProgram, answer: LPAnswer) -> tuple[float, float]:
    """Return the residual of a solver's answer, and its possible effect on the objective.

    The effect is a violation times its dual, or a negative reduced cost times the visits. It may be
    large although the residual is small: if runs end with probability 1e-6 a step, the violation of
    a row counts a million times.

    Returns:
        The residual: the largest of the violation of a row or of x >= 0, the negative reduced cost,
        and the gap between primal and dual objective, each relative to the size of its numbers (nan
        counts as infinite). Then the greatest effect, relative to the objective.
    """
    x, dual, activity = answer.x, answer.dual, program.matrix @ answer.x
    short = np.maximum(np.maximum(program.lower - activity, activity - program.upper), 0.0)
    negative = np.maximum(program.matrix.T @ dual - program.cost, 0.0)  # reduced costs below 0
    bounds = np.where(np.isfinite(program.upper), program.upper, program.lower)
    value, dual_value = float(program.cost @ x), float(bounds @ dual)
    missed = max(float(short.max(initial=0.0)), float((-x).max(initial=0.0)))
    residuals = np.array(
        [
            missed / (1.0 + float(np.abs(x).max(initial=0.0))),
            float(negative.max(initial=0.0)) / (1.0 + float(np.abs(dual).max(initial=0.0))),
            abs(value - dual_value) / (1.0 + abs(value)),
        ]
    )
    worst = float(np.where(np.isfinite(residuals), residuals, np.inf).max())
    worth = float(np.append(short * np.abs(dual), negative * np.maximum(x, 0.0)).max(initial=0.0))
    return worst, worth / (1.0 + abs(value))


def as_table(program: LinearProgram, columns: Sequence[str], rows: Sequence[str]) -> Table | None:
    """Return a program as a table: a line for each column, then one of bounds; None if too wide.

    Args:
        program: the program.
        columns: names of the columns.
        rows: names of the rows.
    """
    taken = np.vstack([program.cost, program.matrix.toarray()]).T
    lines = [
        (name, *(value or "" for value in line))
        for name, line in zip(columns, taken.tolist(), strict=True)
    ]
    bounds = [f"{relation} {bound:g}" for relation, bound in program.sides]
    table = Table([*lines, ("", "", *bounds)], ("", "minimise", *rows), "in full")
    return table if max(map(len, table.lines())) <= _WIDEST else None


def as_latex(verb: str, aim: str, rows: Iterable[tuple[str, str]], *, scaled: bool) -> str:
    """Return a program in LaTeX, as aligned equations.

    Args:
        verb: minimise or maximise.
        aim: the objective in LaTeX.
        rows: names, and rows in LaTeX.
        scaled: whether the scale t is a variable as well.
    """
    lines = [rf"\{verb[:3]}_{_SIGNS[scaled]} \quad & {aim}"]
    lines += [rf"& {row} && \text{{{_latex_text(name)}}}" for name, row in rows]
    body = " \\\\\n".join(lines)
    return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"


def sums_as_latex(program: LinearProgram, columns: Sequence[str], *, scaled: bool) -> list[str]:
    """Return the objective of a program and its rows in LaTeX, as sums over their columns.

    Args:
        program: the program.
        columns: names.
        scaled: whether the last column is the scale t.
    """
    symbols = [rf"x_{{\text{{{_latex_text(name)}}}}}" for name in columns]
    symbols[-1:] = ["t"] if scaled else symbols[-1:]
    rows = zip(program.matrix.toarray(), program.sides, strict=True)
    return [
        _sum_of(program.cost, symbols),
        *(f"{_sum_of(row, symbols)} {_RELATIONS[sign]} {bound:g}" for row, (sign, bound) in rows),
    ]


def words_as_latex(words: str) -> str:
    """Return an objective or a row in words as LaTeX, with ``<cost, x>`` as an inner product."""
    text = re.sub(r"<(.*?), x>", r"\\langle \\text{\1}, x \\rangle", _latex_text(words))
    text = re.sub(r"= (t )?start$", r"= \1\\text{start}", text)
    return re.sub(r" t$", r" \\, t", text.replace(" <= ", r" \le "))


def _latex_text(text: str) -> str:
    escaped = re.sub(r"([#$%&_{}])", r"\\\1", text.replace("\\", "/"))
    return re.sub(r"([~^])", r"\\\1{}", escaped)


def _sum_of(taken: FloatArray, columns: Sequence[str]) -> str:
    """Return a row in LaTeX as a sum over columns."""
    text = ""
    for k in np.flatnonzero(taken).tolist():
        sign, size = ("-" if taken[k] < 0.0 else "+"), abs(float(taken[k]))
        text += f" {sign} " + ("" if size == 1.0 else rf"{size:.6g}\,") + columns[k]
    return text.removeprefix(" + ").strip() or "0"
