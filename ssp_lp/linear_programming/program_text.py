"""A small linear program written out: as a table, and in LaTeX."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.linear_programming.linear_program import LinearProgram
from ssp_lp.model.report import Table

_WIDEST = 100  # characters of a table that can be read
_MOST = 12  # columns, and as many rows

_SIGNS = {False: r"{x \ge 0}", True: r"{x \ge 0,\ t \ge 0}"}  # without and with a scale
_RELATIONS = {"=": "=", "<=": r"\le"}


def is_small(program: LinearProgram) -> bool:
    """Whether a linear program is small enough to be printed in full."""
    return max(program.matrix.shape) <= _MOST


def as_table(program: LinearProgram, columns: Sequence[str], rows: Sequence[str]) -> Table | None:
    """A linear program printed in full: a row for each column, then the bounds.

    None where that is wider than a page.

    Args:
        program: the program.
        columns: names.
        rows: names.
    """
    taken = np.vstack([program.cost, program.matrix.toarray()]).T
    lines = [
        (name, *(value or "" for value in line))
        for name, line in zip(columns, taken.tolist(), strict=True)
    ]
    bounds = [f"{relation} {bound:g}" for relation, bound in _sides(program)]
    table = Table([*lines, ("", "", *bounds)], ("", "minimise", *rows), "in full")
    return table if max(map(len, table.lines())) <= _WIDEST else None


def as_latex(
    program: LinearProgram, columns: Sequence[str], rows: Sequence[str], *, scaled: bool
) -> str:
    """A linear program in full in LaTeX: objective and rows as sums over their columns.

    Args:
        program: the program.
        columns: names.
        rows: names.
        scaled: whether the last column is the scale t.
    """
    symbols = [rf"x_{{\text{{{_latex_text(name)}}}}}" for name in columns]
    symbols[-1:] = ["t"] if scaled else symbols[-1:]
    lines = [rf"\min_{_SIGNS[scaled]} \quad & {_sum_of(program.cost, symbols)}"]
    for taken, name, (relation, bound) in zip(
        program.matrix.toarray(), rows, _sides(program), strict=True
    ):
        row = f"{_sum_of(taken, symbols)} {_RELATIONS[relation]} {bound:g}"
        lines.append(rf"& {row} && \text{{{_latex_text(name)}}}")
    return _aligned(lines)


def words_as_latex(verb: str, aim: str, rows: Iterable[tuple[str, str]], *, scaled: bool) -> str:
    """A linear program told in words, in LaTeX, ``<cost, x>`` being a product.

    Args:
        verb: minimise or maximise.
        aim: what.
        rows: names, and rows in words.
        scaled: whether the scale t is a variable as well.
    """
    lines = [rf"\{verb[:3]}_{_SIGNS[scaled]} \quad & {_products(aim)}"]
    lines += [rf"& {_products(words)} && \text{{{_latex_text(name)}}}" for name, words in rows]
    return _aligned(lines)


def _products(words: str) -> str:
    """Words of a linear program's row in LaTeX."""
    text = re.sub(r"<(.*?), x>", r"\\langle \\text{\1}, x \\rangle", _latex_text(words))
    text = re.sub(r"= (t )?start$", r"= \1\\text{start}", text)
    return re.sub(r" t$", r" \\, t", text.replace(" <= ", r" \le "))


def _aligned(lines: list[str]) -> str:
    """Lines of a linear program's equations in LaTeX, aligned."""
    body = " \\\\\n".join(lines)
    return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"


def _latex_text(text: str) -> str:
    """Text for a program in LaTeX, special characters escaped."""
    escaped = re.sub(r"([#$%&_{}])", r"\\\1", text.replace("\\", "/"))
    return re.sub(r"([~^])", r"\\\1{}", escaped)


def _sides(program: LinearProgram) -> Iterator[tuple[str, float]]:
    """Bounds of each row of a program printed in full."""
    equal = program.equality
    for k, bound in enumerate(program.upper.tolist()):
        yield "=" if equal[k] else "<=", bound


def _sum_of(taken: FloatArray, columns: Sequence[str]) -> str:
    """A row of a program in LaTeX as a sum over columns."""
    text = ""
    for k in np.flatnonzero(taken).tolist():
        sign, size = ("-" if taken[k] < 0.0 else "+"), abs(float(taken[k]))
        text += f" {sign} " + ("" if size == 1.0 else rf"{size:.6g}\,") + columns[k]
    return text.removeprefix(" + ").strip() or "0"
