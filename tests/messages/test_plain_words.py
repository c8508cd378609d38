"""Words and shapes of sentences that docstrings and messages of the library do without."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support.house import ROOT, files

REPLACED = {
    r"afresh|anew": "again, or recompute",
    r"t(?:ell|ells|old|elling)(?: \w+){0,4} apart": "distinguish",
    r"(?:keep|keeps|keeping|kept) to": "satisfy",
    r"(?:is|are) to be": "must",
    r"whoever|whosoever": "name the reader, or an imperative",
    r"come(?:s)? to the same|came to the same": "be equal",
    r"dear|dearer|dearest|dearly": "expensive, more expensive",
    r"worth having": "say what it improves",
    r"(?:is|are) told": "is reported",
    r"as if drawn": "pseudo-random",
    r"besides": "also, in addition",
    r"given up on": "say that the solver failed",
}  # pattern -> what to write in its place

BARE_STARTS = {"What", "Which", "That", "How", "Of", "Where", "None", "Some", "Who", "Whose"}
NOUN_STARTS = {"The", "A", "An", "Whether"}  # a function's first line is an imperative

NOT_DONE = {
    # the front door and what stands around it
    # processes and methods
    # equations, programs, proofs
}  # folder -> findings that are left; a number may only fall, and its line goes at 0


class Text(NamedTuple):
    """A string of the source."""

    path: Path
    line: int
    kind: str  # "class", "function", "module", "property" (docstrings) or "message"
    words: str

    def findings(self) -> list[str]:
        """List the words and the shape that should be written in another way."""
        found = [  # a word before a colon is the name of an argument
            f"{seen!r}: {instead}"
            for pattern, instead in REPLACED.items()
            for seen in re.findall(rf"\b(?:{pattern})\b(?!:)", self.words, re.IGNORECASE)
        ]
        start = re.match(r"\w+", self.words)
        if self.kind != "message" and start is not None:
            if start[0] in BARE_STARTS:
                found.append(f"begins with {start[0]!r}: name the thing")
            if self.kind == "function" and start[0] in NOUN_STARTS:
                found.append(f"begins with {start[0]!r}: begin with a verb (Return the ...)")
        where = f"{self.path.relative_to(ROOT)}:{self.line}"
        return [f"{where} {note}" for note in found]


def texts_of(path: Path) -> Iterator[Text]:
    """Yield a file's docstrings, then its other strings that are longer than a word."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    seen = set()
    for node in ast.walk(tree):
        match node:
            case ast.Module() | ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef():
                words = ast.get_docstring(node)
                if words is not None:
                    seen.add(id(node.body[0].value))  # type: ignore[attr-defined]
                    yield Text(path, node.body[0].lineno, kind_of(node), words)
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part for part in node.values if isinstance(part, ast.Constant)]
            yield Text(path, node.lineno, "message", "...".join(str(p.value) for p in parts))
            seen |= {id(part) for part in parts}
        elif isinstance(node, ast.Constant) and id(node) not in seen and " " in str(node.value):
            yield Text(path, node.lineno, "message", str(node.value))


def kind_of(node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    """Return "module", "class", "property" or "function"."""
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return type(node).__name__.lower().removesuffix("def")
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    return "property" if any("property" in name for name in decorators) else "function"


@cache
def findings() -> dict[str, list[str]]:
    """Return the findings of each folder; a package's own modules stand under its name."""
    found: dict[str, list[str]] = {}
    for path in files():
        folder = "/".join(path.relative_to(ROOT).parts[:-1][:2])
        found.setdefault(folder, []).extend(
            note for text in texts_of(path) for note in text.findings()
        )
    return found


@pytest.mark.parametrize("folder", sorted(findings()))
def test_docstrings_and_messages_use_plain_words(folder: str) -> None:
    found = findings()[folder]
    assert len(found) <= NOT_DONE.get(folder, 0), "\n".join(found)


def test_folders_that_are_done_are_not_listed_as_undone() -> None:
    assert {folder for folder in NOT_DONE if not findings().get(folder)} == set()


def test_the_words_are_found_in_every_kind_of_text(tmp_path: Path) -> None:
    path = ROOT / "made.py"
    shown = [
        Text(path, 1, "message", "costs of 3 and 4 cannot be told apart"),
        Text(path, 1, "function", "The expected cost."),
        Text(path, 1, "property", "What a failure costs."),
        Text(path, 1, "class", "A policy that keeps to its budget."),
    ]
    assert [len(text.findings()) for text in shown] == [1, 1, 1, 1]
    plain = Text(path, 1, "function", "Return the expected cost; the limit is satisfied.")
    assert plain.findings() == []
