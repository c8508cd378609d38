"""Code that the pages in docs name in backticks exists: files, folders, tests and names."""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("ssp_lp", "formulations", "tests", "examples", "docs")
PAGES = [str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs").rglob("*.md"))]
FILE = re.compile(r"[\w./-]+\.(?:py|c|h|md|toml|yml)")
NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")
IN_FILE = re.compile(r"`([\w./]+\.py)`: ((?:`\w[^`/]*`(?:, | and )?)+)")
PAPER = "docs/paper.md"
LABELS = re.compile(r"^\|(?: \d+ \|)?[^|]*\|", flags=re.MULTILINE)
"""The cell of a row of its tables that holds labels of the paper's source, not of the code."""

OTHERS = {"numpy", "scipy", "cvxpy", "highspy", "stormpy", "petsc4py", "mpi4py", "client"}
"""Packages, and Dask's client, whose names are not this library's to check."""

WRITTEN = {"policy_unit"}
"""Names in files that the library writes, made of parts."""


@cache
def files():
    """All files of the project and their folders, with a slash in front."""
    every = [path for room in ROOMS for path in (ROOT / room).rglob("*")]
    return [f"/{path.relative_to(ROOT)}" for path in [*every, *ROOT.iterdir()]]


@cache
def words():
    """Every word of the project's code: names, and what strings and comments say."""
    code = [path for room in ROOMS[:4] for path in (ROOT / room).rglob("*.py")]
    texts = [path.read_text(encoding="utf-8") for path in [*code, ROOT / "pyproject.toml"]]
    return {word for text in texts for word in re.findall(r"\w+", text)}


def defined_in(path):
    """Names of functions, classes, fields and arguments in a file."""
    named = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        given = [getattr(node, key, None) for key in ("name", "id", "attr", "arg")]
        named.update(name for name in given if isinstance(name, str))
    return named


@cache
def labels():
    """The paper's labels, which the tables of its page list."""
    return set(
        re.findall(r"`([^`]+)`", " ".join(LABELS.findall((ROOT / PAPER).read_text("utf-8"))))
    )


def prose_of(page):
    """A page without its blocks of code, which are run elsewhere."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def exists(reference, page):
    """Whether what a page names exists, as far as it is a name of this project's."""
    first, *rest = reference.split(".")
    if reference in WRITTEN or (page == PAPER and reference in labels()):
        return True
    if FILE.fullmatch(reference):
        shown = (ROOT / page).read_text(encoding="utf-8")  # a reader's own file is run or written
        return any(f.endswith(f"/{reference}") for f in files()) or f"python {reference}" in shown
    if re.fullmatch(r"[\w./-]+/", reference):
        return any(f.endswith(f"/{reference[:-1]}") for f in files())
    name = re.match(NAME, reference.partition("(")[0])
    if name is None or name[0] != reference.partition("(")[0] or first in OTHERS:
        return True
    if first in ("ssp_lp", "formulations", "examples", "tests") and rest:
        return is_importable(name[0])
    is_code = "_" in reference or "." in name[0] or re.fullmatch(r"([A-Z]\w*[a-z]\w*){2,}", first)
    return not is_code or all(part in words() for part in name[0].split("."))


def is_importable(dotted):
    """Whether a dotted name leads to a module, or to something in one."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if not hasattr(found, part):
                return part in getattr(found, "__dataclass_fields__", {})
            found = getattr(found, part)
        return True
    return False


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_exists(page):
    named = re.findall(r"`([^`\n]+)`", prose_of(page))
    assert [reference for reference in named if not exists(reference, page)] == []


@pytest.mark.parametrize("page", PAGES)
def test_names_beside_a_file_are_in_it(page):
    rotten = []
    for file, listed in IN_FILE.findall(prose_of(page)):
        (path,) = [ROOT / f[1:] for f in files() if f.endswith(f"/{file}")]
        for name in re.findall(r"`([^`]+)`", listed):
            parts = name.partition("(")[0].split(".")
            rotten += [(file, name)] * (not defined_in(path) >= set(parts))
    assert rotten == []
