"""Small tables and plain text for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape


def html_table(
    title: str,
    rows: Iterable[Sequence[str]],
    head: Sequence[str] = (),
    notes: Iterable[str] = (),
) -> str:
    """Rows of text as an HTML table under a title, with notes below it, escaped."""
    lines = [f'<caption style="white-space: nowrap">{escape(title)}</caption>']
    if head:
        lines.append(_html_row(head, "th"))
    lines += [_html_row(row, "td") for row in rows]
    below = [f"<p>{escape(note)}</p>" for note in notes]
    return "\n".join(["<table>", *lines, "</table>", *below])


def html_text(text: str) -> str:
    """Text in columns as it stands, escaped."""
    return f'<pre style="line-height: 1.2">{escape(text)}</pre>'


def _html_row(cells: Sequence[str], tag: str) -> str:
    """A row of the HTML table."""
    inside = "".join(f'<{tag} style="text-align: left">{escape(cell)}</{tag}>' for cell in cells)
    return f"<tr>{inside}</tr>"
