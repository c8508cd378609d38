"""What the library's code measures: lines, constants, questions asked of objects, ways of a solve.

``python tests/support/house.py`` prints the table; `tests/test_architecture.py` holds its limits.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGES = ("ssp_lp", "formulations")
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class Way(NamedTuple):
    """What a call runs through: modules, functions, calls of these, changes from file to file."""

    modules: int
    functions: int
    calls: int
    switches: int


def files() -> list[Path]:
    """Every module of the library."""
    return sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))


def code_lines(path: Path) -> int:
    """Lines with code on them: docstrings, comments and blank lines are none."""
    text = path.read_text(encoding="utf-8")
    nodes = ast.walk(ast.parse(text))
    words = [node.value for node in nodes if isinstance(node, ast.Expr)]
    said = {
        line
        for word in words
        if isinstance(word, ast.Constant) and isinstance(word.value, str)
        for line in range(word.lineno, (word.end_lineno or word.lineno) + 1)
    }
    code = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in NO_CODE
        for line in range(token.start[0], token.end[0] + 1)
    }
    return len(code - said)


def lines_by_folder() -> dict[str, int]:
    """Code lines of each folder; a package's own modules stand under its name."""
    counts: Counter[str] = Counter()
    for path in files():
        counts["/".join(path.relative_to(ROOT).parts[:-1][:2])] += code_lines(path)
    return dict(sorted(counts.items()))


def lines_in_all() -> int:
    """Code lines of Python and, in the same sense, of C and of stubs."""
    own = [
        path
        for kind in ("*.c", "*.h", "*.pyi")
        for name in PACKAGES
        for path in (ROOT / name).rglob(kind)
    ]
    return sum(lines_by_folder().values()) + sum(
        bool(line.strip()) and not line.strip().startswith(("/*", "*", "//"))
        for path in own
        for line in path.read_text(encoding="utf-8").splitlines()
    )


def _trees() -> Iterator[ast.Module]:
    for path in files():
        yield ast.parse(path.read_text(encoding="utf-8"))


def numeric_constants() -> int:
    """Names to which a module assigns a number."""

    def number(node: ast.expr | None) -> bool:
        if isinstance(node, ast.UnaryOp):
            return number(node.operand)
        if isinstance(node, ast.BinOp):
            return number(node.left) and number(node.right)
        return isinstance(node, ast.Constant) and type(node.value) in {int, float}

    return sum(
        isinstance(node, (ast.Assign, ast.AnnAssign)) and number(node.value)
        for tree in _trees()
        for node in tree.body
    )


def questions_asked() -> int:
    """Calls of ``getattr`` and ``hasattr``."""
    return sum(
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in {"getattr", "hasattr"}
        for tree in _trees()
        for node in ast.walk(tree)
    )


def written_past_freezing() -> int:
    """Uses of ``vars(...)`` and of ``object.__setattr__``."""
    return sum(
        isinstance(node, ast.Call) and ast.unparse(node.func) in {"vars", "object.__setattr__"}
        for tree in _trees()
        for node in ast.walk(tree)
    )


def public_classes() -> int:
    """Classes at the top of a module whose names begin with a letter."""
    return sum(
        isinstance(node, ast.ClassDef) and not node.name.startswith("_")
        for tree in _trees()
        for node in tree.body
    )


def way_of(call: Callable[[], object]) -> Way:
    """The way of a call through the library, warm: it is made once before it is watched."""
    call()
    crossed: Counter[tuple[str, str]] = Counter()
    switches, last = 0, ""

    def cross(frame: FrameType, event: str, _: object) -> None:
        nonlocal switches, last
        code = frame.f_code
        if event == "call" and Path(code.co_filename).is_relative_to(ROOT / "ssp_lp"):
            crossed[code.co_filename, code.co_qualname] += 1
            switches += code.co_filename != last
            last = code.co_filename

    sys.setprofile(cross)
    try:
        call()
    finally:
        sys.setprofile(None)
    return Way(len({file for file, _ in crossed}), len(crossed), crossed.total(), switches)


if __name__ == "__main__":
    for folder, count in lines_by_folder().items():
        print(f"{folder:32}{count:8,}")
    print(f"{'in all, C too':32}{lines_in_all():8,}")
    print(f"{'modules':32}{len(files()):8,}")
    for measure in (public_classes, numeric_constants, questions_asked, written_past_freezing):
        print(f"{measure.__name__:32}{measure():8,}")
