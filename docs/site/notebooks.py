"""Notebooks as pages of Markdown: text, code, and what the code printed and drew."""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_DRESS = re.compile(r"<style.*?</style>|\s(?:border|class|style)=\"[^\"]*\"|\s*\n\s*", re.DOTALL)
"""The looks of a table, and its line breaks, which would end the HTML in Markdown."""


def page_of(notebook: Path, folder: Path) -> str:
    """Return a notebook as Markdown; save its pictures in the folder of the page."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    parts = []
    for number, cell in enumerate(cells):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        else:
            parts.append(f"```python\n{source}\n```")
            parts += _outputs(cell["outputs"], folder / f"{notebook.stem}_{number}.png")
    return "\n\n".join(parts) + "\n"


def _outputs(outputs: list[dict[str, Any]], picture: Path) -> Iterator[str]:
    """Yield each output of a cell: a picture, a table or text."""
    for output in outputs:
        shown = output.get("data", {})
        if "image/png" in shown:
            picture.parent.mkdir(parents=True, exist_ok=True)
            picture.write_bytes(base64.b64decode(shown["image/png"]))
            yield f'<p><img alt="What the lines above draw" src="{picture.name}"></p>'
        elif "<table" in (table := "".join(shown.get("text/html", ""))):
            yield f'<div class="output">{_DRESS.sub("", table)}</div>'
        else:
            text = "".join(output.get("text", shown.get("text/plain", "")))
            yield f"```text\n{text.rstrip()}\n```"
