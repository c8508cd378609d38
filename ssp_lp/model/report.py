"""Reports: a result declares its rows once, for text, HTML, frames and CSV."""

from __future__ import annotations

import csv
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from io import StringIO
from typing import Any, TypeVar

from ssp_lp.errors import did_you_mean, optional_module

_Value = TypeVar("_Value")
_DIGITS = 6  # default of significant digits
_FACT = "name", "value", "note"  # columns of a table of facts, which has no printed head


class ByName(dict[str, _Value]):
    """Dict whose KeyError for an unknown name suggests a similar one."""

    def __missing__(self, name: object) -> _Value:
        """Raise :class:`KeyError` with the nearest name."""
        raise KeyError(f"there is no entry {name!r}{did_you_mean(name, self, 'there are')}")


@dataclass(frozen=True)
class Table:
    """Rows of values under the names of their columns.

    A table of facts has no head: each row is a name, a value, and an optional note. Facts without a
    value are not shown.
    """

    rows: Sequence[Sequence[Any]]
    head: Sequence[str] = ()
    title: str = ""
    notes: Sequence[str] = ()
    digits: Mapping[str, int] = field(default_factory=dict)  # by name of a column or a fact
    left: int = 1  # columns that are flush left in text
    shown: Sequence[int] | None = None  # indices of the rows in text and HTML; None: all
    hidden: Collection[str] = ()  # columns in frames and CSV only

    @property
    def columns(self) -> Sequence[str]:
        """Names of the columns in frames and CSV."""
        return self.head or _FACT

    def cells(self) -> list[list[str]]:
        """Return the text of the rows that are shown."""
        rows = self.rows if self.shown is None else [self.rows[k] for k in self.shown]
        if not self.head:
            told = ((name, rest) for name, *rest in rows if rest[0] not in (None, "", {}))
            return [[name, "   ".join(self._cell(name, x) for x in rest)] for name, rest in told]
        return [
            [
                self._cell(name, value)
                for name, value in zip(self.head, row, strict=True)
                if name not in self.hidden
            ]
            for row in rows
        ]

    def _cell(self, name: str, value: Any) -> str:
        """Return the text of a value; ``name`` is the name of its column or fact."""
        if value is None or value != value:
            return "-"
        if isinstance(value, float):
            return f"{value:.{self.digits.get(name, _DIGITS)}g}"
        if self.head:
            return str(value)
        if isinstance(value, Mapping):
            return ", ".join(f"{key} {count:,}" for key, count in value.items() if count)
        if isinstance(value, list):
            return ", ".join(value)
        return f"{value:,}" if isinstance(value, int) else str(value)

    def lines(self) -> list[str]:
        """Return the lines of text: the title, aligned columns, and the notes."""
        rows, left = self.cells(), self.left if self.head else 2
        rows = [self._shown_head, *rows] if self.head and rows else rows
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        body = [
            "  ".join(
                [*map(str.ljust, row[:left], widths), *map(str.rjust, row[left:], widths[left:])]
            )
            for row in rows
        ]
        body = [*map(str.rstrip, body), *["no rows"] * bool(self.head and not rows), *self.notes]
        return [self.title, *(f"  {line}" for line in body)] if self.title else body

    @property
    def _shown_head(self) -> list[str]:
        """Names of the columns that are shown."""
        return [name for name in self.head if name not in self.hidden]

    def html(self) -> str:
        """Return the table as HTML, with its title above and its notes below."""
        cells, lines = self.cells(), []
        for row, tag in [
            *[(self._shown_head, "th")] * bool(self.head),
            *((r, "td") for r in cells),
        ]:
            inside = (f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell in row)
            lines.append(f"<tr>{''.join(inside)}</tr>")
        notes = [f"<p>{escape(note)}</p>" for note in self.notes]
        if not lines:
            return "\n".join([f"<p>{escape(self.title)}</p>"] * bool(self.title) + notes)
        caption = f'<caption style="white-space: nowrap">{escape(self.title)}</caption>'
        return "\n".join(["<table>", caption, *lines, "</table>", *notes])

    def records(self) -> list[dict[str, Any]]:
        """Return each row as ``{column: value}``."""
        return [dict(zip(self.columns, row, strict=False)) for row in self.rows]

    def to_frame(self) -> Any:
        """Return all rows as a pandas ``DataFrame``.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        frame = optional_module("pandas", "frames").DataFrame
        return frame(self.records(), columns=[*self.columns])

    def csv(self) -> str:
        """Return all rows as CSV with a head; missing values are empty."""
        text = StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *self.rows])
        return text.getvalue()


class Report:
    """Mix-in of results that are tables: as text, as HTML in notebooks, as a frame."""

    @abstractmethod
    def tables(self) -> Sequence[Table]:
        """Return the tables of the result; all other forms are made from them."""

    def summary(self) -> str:
        """Return the text of all tables."""
        return "\n".join(line for table in self.tables() for line in table.lines())

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        """Return the HTML of all tables, for notebooks."""
        return "\n".join(table.html() for table in self.tables())

    def to_frame(self) -> Any:
        """Return all rows of the first table as a pandas ``DataFrame``.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return self.tables()[0].to_frame()


class Facts(Report):
    """Mix-in of results that are one table of facts: one line in repr, all lines in summary."""

    def __repr__(self) -> str:
        """Return the facts in a line."""
        told = ", ".join(" ".join(cells) for table in self.tables() for cells in table.cells())
        return f"{type(self).__name__}({told})"

    def __str__(self) -> str:
        return repr(self)
