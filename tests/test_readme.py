"""The code of the README and of the pages in docs runs, and prints what they say; links lead on."""

from __future__ import annotations

import io
import re
import runpy
from contextlib import redirect_stdout
from itertools import zip_longest
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = [f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))]
PAGES = ["README.md", "CONTRIBUTING.md", "examples/README.md", *DOCS]

SHOWN = {
    "README.md": 3,
    "docs/checks.md": 0,
    "docs/criteria.md": 3,
    "docs/models.md": 2,
    "docs/solving.md": 1,
}
"""Pages with code, and how often each shows what it prints."""


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks_of(text: str) -> list[tuple[str, str]]:
    """Language and body of each fenced block."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def run_blocks(text: str, namespace: dict[str, object]) -> int:
    """Run the code in order; what is shown after it is what it printed. How much is shown."""
    printed: list[str] = []
    namespace["print"] = lambda told: printed.append(str(told))
    shown = 0
    for language, body in blocks_of(text):
        if language == "python":
            printed.clear()
            exec(body, namespace)
        elif language == "text":
            check_the_same(body, "\n".join(printed))
            shown += 1
    return shown


@pytest.fixture(scope="module")
def after_the_readme() -> dict[str, object]:
    """The names that the README's code leaves behind, with which every page goes on."""
    namespace: dict[str, object] = {}
    assert run_blocks(README, namespace) == SHOWN["README.md"]
    return namespace


def test_every_page_with_code_is_run() -> None:
    with_code = {
        page
        for page in PAGES
        if any(language in ("python", "text") for language, _ in blocks_of(text_of(page)))
    }
    assert with_code == set(SHOWN)


@pytest.mark.parametrize("page", [page for page in SHOWN if page != "README.md"])
def test_the_python_blocks_run_in_order(page: str, after_the_readme: dict[str, object]) -> None:
    assert run_blocks(text_of(page), dict(after_the_readme)) == SHOWN[page]


def test_the_first_problem_is_the_shortest_example(after_the_readme: dict[str, object]) -> None:
    first = next(body for language, body in blocks_of(README) if language == "text")
    check_the_same(first, run_first_problem())


def check_the_same(shown: str, printed: str) -> None:
    """Line by line, but for gaps, which are rounding; more may be printed than is shown."""
    told = printed.splitlines()
    assert shown.strip()
    for mine, theirs in zip_longest(shown.splitlines(), told[: len(shown.splitlines())]):
        assert mine.split("(relative")[0].rstrip() == (theirs or "").split("(relative")[0].rstrip()


def run_first_problem() -> str:
    """What the shortest example prints: the README's first problem."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        runpy.run_path(str(ROOT / "examples/quickstart/first_problem.py"))
    assert "first action: " in printed.getvalue()
    return printed.getvalue()


def test_there_are_two_commands() -> None:
    commands = re.findall(r"```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 2
    assert all("\n" not in command for command in commands)
    assert "examples/paper_robot/obstacle_avoidance.py" in commands[0]
    assert "pytest" in commands[1]


def anchors_of(text: str) -> set[str]:
    """What a link to a heading is called: its words in small letters, joined by dashes."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_are_there(page: str) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors_of(target.read_text(encoding="utf-8")), link


@pytest.mark.parametrize("page", PAGES)
def test_files_that_are_named_are_there(page: str) -> None:
    folders = r"(?:ssp_lp|formulations|examples|tests|docs)"
    for name in re.findall(rf"`(?:python )?({folders}/[\w./-]+)", text_of(page)):
        assert "NAME" in name or (ROOT / name).exists(), name
