"""Docstrings as the site's reader of them expects: its headings, and names without roles."""

import re
from typing import Any

from griffe import Class, Extension, Object

_OWN = r"^(Problem|Program|Guarantee|Semantics|Reference{}):\n((?:    .*\n|\n)+)"
"""A part of a page of mathematics, to be shown as a paragraph under its name."""


class Docstrings(Extension):
    """Rewrites each docstring before it is parsed."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Examples are a section, and ``:meth:`~place.name``` is a name."""
        if obj.docstring is None:
            return
        text = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
        text = re.sub(r":[a-z]+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", text)
        text = re.sub(r"(?<![`\w])<[a-z_ -]+,\s+x>(?!`)", r"`\g<0>`", text)  # no tag of HTML
        own = _OWN.format("|Returns" if isinstance(obj, Class) else "")
        obj.docstring.value = re.sub(own, _paragraph, text, flags=re.MULTILINE)


def _paragraph(found: re.Match[str]) -> str:
    words = re.sub(r"^    ", "", found[2], flags=re.MULTILINE)
    return f"**{found[1]}:** {words}"
