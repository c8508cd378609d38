"""Answers by name, and as text: tables for people."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from html import escape
from typing import TypeVar

from ssp_lp.errors import did_you_mean

_Value = TypeVar("_Value")


class ByName(dict[str, _Value]):
    """Values by name, whose KeyError says which name was probably meant."""

    def __missing__(self, name: object) -> _Value:
        """Raise :class:`KeyError`."""
        raise KeyError(f"{name!r} is no name here{did_you_mean(name, self, 'there are')}")


def text_table(rows: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """A text table of rows in aligned columns, the first ``left`` of them flush left."""
    table = [*rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(
            [*map(str.ljust, row[:left], widths), *map(str.rjust, row[left:], widths[left:])]
        ).rstrip()
        for row in table
    ]


class Summarised:
    """Mix-in of answers whose ``summary`` is what is printed, and shown in notebooks."""

    @abstractmethod
    def summary(self) -> str:
        """Summary of an object as text, perhaps in a table."""

    def __str__(self) -> str:
        """The summary."""
        return self.summary()

    def _repr_html_(self) -> str:
        """Summary for notebooks: text in a table as it stands, escaped."""
        return html_text(self.summary())


class Reported:
    """Mix-in of reports that are facts, each a name and what is to be said: a line, or a table."""

    @abstractmethod
    def facts(self) -> Sequence[tuple[str, str]]:
        """The facts in the order in which they are told."""

    def __repr__(self) -> str:
        """One line."""
        return f"{type(self).__name__}({', '.join(' '.join(fact) for fact in self.facts())})"

    def summary(self) -> str:
        """A line for each fact."""
        return "\n".join(text_table(self.facts(), left=2))


def html_table(
    title: str, rows: Iterable[Sequence[str]], head: Sequence[str] = (), notes: Iterable[str] = ()
) -> str:
    """An HTML table of rows of text under a title, with notes below it, escaped."""
    lines = [f'<caption style="white-space: nowrap">{escape(title)}</caption>']
    tagged = [(head, "th")] if head else []
    for cells, tag in [*tagged, *((row, "td") for row in rows)]:
        inside = (f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell in cells)
        lines.append(f"<tr>{''.join(inside)}</tr>")
    below = [f"<p>{escape(note)}</p>" for note in notes]
    return "\n".join(["<table>", *lines, "</table>", *below])


def html_text(text: str) -> str:
    """Text in a table as it stands, escaped for HTML."""
    return f'<pre style="line-height: 1.2">{escape(text)}</pre>'
