"""Tables of text for narrow screens: each cell carries the heading of its column."""

from xml.etree.ElementTree import Element

from markdown import Markdown
from markdown.extensions import Extension
from markdown.treeprocessors import Treeprocessor

_AFTER_INLINE = 5  # tree processors run by falling priority; cells are filled in at 20
_LONG = 30  # a table with a cell of so many letters is one of text
_OBVIOUS = 2  # with so many columns nobody needs a heading beside each cell


class _Headings(Treeprocessor):
    """Copy the headings of a table into its cells, for `extra.css` to show."""

    def run(self, root: Element) -> None:
        """Mark the tables of text."""
        for table in root.iter("table"):
            headings = ["".join(cell.itertext()).strip() for cell in table.iter("th")]
            cells = list(table.iter("td"))
            longest = max((len("".join(cell.itertext())) for cell in cells), default=0)
            if longest < _LONG or any("\\(" in heading for heading in headings):
                continue  # numbers, or headings with formulas, which a style sheet cannot show
            table.set("data-text", "")
            for row in table.iter("tr") if len(headings) > _OBVIOUS else ():
                for cell, heading in zip(row.findall("td"), headings, strict=False):
                    if heading:
                        cell.set("data-heading", f"{heading}: ")


class NarrowTables(Extension):
    """Let `extra.css` show tables of text as lists where the screen is narrow."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Register the tree processor."""
        md.treeprocessors.register(_Headings(md), "narrow_tables", _AFTER_INLINE)


def makeExtension(**settings: object) -> NarrowTables:  # noqa: N802
    """Return the extension; Python-Markdown looks for this name."""
    return NarrowTables(**settings)
