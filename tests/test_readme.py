"""The code of the README and of the pages in docs runs, and prints what they say; links lead on."""

import codeop
import importlib
import io
import re
import runpy
import shlex
from contextlib import redirect_stdout
from itertools import zip_longest
from pathlib import Path

import pytest

import ssp_lp
import ssp_lp.io
import ssp_lp.plotting
from formulations.command_line import main

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = [str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md"))]
PAGES = ["README.md", "CONTRIBUTING.md", "examples/README.md", *DOCS]

SHOWN = {
    "README.md": 7,
    "docs/coming_from.md": 4,
    "docs/criteria.md": 11,
    "docs/extending.md": 3,
    "docs/gallery.md": 0,
    "docs/guides/command_line.md": 2,
    "docs/guides/explorer.md": 1,
    "docs/guides/from_counts.md": 5,
    "docs/guides/promises_and_tasks.md": 3,
    "docs/guides/what_if.md": 4,
    "docs/index.md": 1,
    "docs/models.md": 6,
    "docs/policies.md": 5,
    "docs/program.md": 10,
    "docs/solving.md": 4,
    "docs/start.md": 4,
    "docs/tutorial.md": 6,
    "docs/verification.md": 5,
}
"""Pages with code, and how often each shows what it prints."""

BY_THEMSELVES = {
    "docs/gallery.md",
    "docs/guides/from_counts.md",
    "docs/guides/promises_and_tasks.md",
    "docs/guides/what_if.md",
    "docs/index.md",
    "docs/program.md",
    "docs/start.md",
    "docs/tutorial.md",
}
"""Pages whose code needs nothing of another page."""

AFTER_START = {
    "docs/coming_from.md",
    "docs/criteria.md",
    "docs/extending.md",
    "docs/models.md",
    "docs/policies.md",
}
"""Pages whose code goes on from Start's; that of all others goes on from the README's."""


def text_of(page):
    return (ROOT / page).read_text(encoding="utf-8")


def blocks_of(text):
    """Language and body of each fenced block."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def run_blocks(text, namespace):
    """Run the code in order; what is shown after it is what it printed. How much is shown.

    Lines of a shell that begin with the command are run, and the first JSON is their model.
    """
    printed = []
    namespace["print"] = lambda *told: printed.append(" ".join(map(str, told)))
    shown = 0
    for language, body in blocks_of(text):
        if language == "python":
            printed.clear()
            exec(body, namespace)
        elif language == "bash":
            printed = [run_shell(line) for line in body.splitlines() if line.startswith("ssp-lp ")]
        elif language == "json" and not Path("roads.json").exists():
            Path("roads.json").write_text(body, encoding="utf-8")
        elif language == "text":
            check_the_same(body, "\n".join(printed))
            shown += 1
    return shown


def run_shell(line):
    """What a line of a shell prints; it ends well."""
    with redirect_stdout(io.StringIO()) as told:
        assert main(shlex.split(line)[1:]) == 0, line
    return told.getvalue()


@pytest.fixture(scope="module")
def after_the_readme():
    """The names that the README's code leaves behind."""
    namespace = {}
    assert run_blocks(README, namespace) == SHOWN["README.md"]
    return namespace


@pytest.fixture(scope="module")
def after_the_start():
    """The names that the code of the page Start leaves behind."""
    namespace = {}
    assert run_blocks(text_of("docs/start.md"), namespace) == SHOWN["docs/start.md"]
    return namespace


def test_every_page_with_code_is_run():
    languages = {page: {language for language, _ in blocks_of(text_of(page))} for page in PAGES}
    assert {page for page in PAGES if languages[page] & {"python", "text", "json"}} == set(SHOWN)


@pytest.mark.parametrize("page", [page for page in SHOWN if page != "README.md"])
def test_the_blocks_run_in_order(page, after_the_readme, after_the_start, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = after_the_start if page in AFTER_START else after_the_readme
    assert run_blocks(text_of(page), {} if page in BY_THEMSELVES else dict(before)) == SHOWN[page]


@pytest.mark.parametrize("page", sorted(SHOWN.keys() - {"docs/extending.md"}))
def test_the_blocks_can_be_typed_into_an_interactive_session(page):
    """A statement in several lines ends with a blank line there; a class has blank lines inside."""
    for language, body in blocks_of(text_of(page)):
        typed = ""
        for line in [*body.splitlines(), ""] if language == "python" else ():
            typed += line + "\n"
            if codeop.compile_command(typed.rstrip("\n") if line else typed) is not None:
                typed = ""
        assert not typed.strip(), typed


def test_the_first_problem_is_the_shortest_example(after_the_readme, capsys):
    first = next(body for language, body in blocks_of(README) if language == "text")
    runpy.run_path(str(ROOT / "examples/quickstart/first_problem.py"))
    printed = capsys.readouterr().out
    assert "first action: " in printed
    check_the_same(first, printed)


def check_the_same(shown, printed):
    """Line by line, but for gaps, which are rounding; more may be printed than is shown."""
    told = printed.splitlines()
    assert shown.strip()
    for mine, theirs in zip_longest(shown.splitlines(), told[: len(shown.splitlines())]):
        assert mine.split("(relative")[0].rstrip() == (theirs or "").split("(relative")[0].rstrip()


def test_there_are_two_commands():
    commands = re.findall(r"```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 2
    assert all("\n" not in command for command in commands)
    assert "examples/paper_robot/obstacle_avoidance.py" in commands[0]
    assert "pytest" in commands[1]


def anchors_of(text):
    """What a link to a heading is called: its words in small letters, joined by dashes."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_pictures_and_files_that_are_named_are_there(page):
    text = text_of(page)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert link.startswith("https://") or target.exists(), link
        assert not anchor or anchor in anchors_of(target.read_text(encoding="utf-8")), link
    folders = r"(?:ssp_lp|formulations|examples|tests|docs)"
    for name in re.findall(rf"`(?:python )?({folders}/[\w./-]+)", text):
        assert "NAME" in name or (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_lists_in_lists_are_nested_on_the_site(page):
    """An item that is indented by fewer than 4 blanks would continue the outer list there."""
    text = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r"^ {1,3}(?:[-*]|\d+\.) .*$", text, flags=re.MULTILINE) == []


@pytest.mark.parametrize("page", PAGES)
def test_formulas_survive_every_reader_of_markdown(page):
    """Nothing in them can be taken for emphasis, an escape, a tag or the end of a table's cell.

    Longer ones stand in blocks named math, which are left as they are.
    """
    text = re.sub(r"^```.*?^```$|`[^`]*`", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    for formula in re.findall(r"\$\$(.+?)\$\$|\$(.+?)\$", text, flags=re.DOTALL):
        assert not re.search(r"[*|`]|\\[^\w\s]|[^\w]_|<\w", "".join(formula)), formula
    assert text.count("$") % 2 == 0


def test_the_reference_names_everything_public():
    """Each name on its pages is there, and each public name is on one of them."""
    pages = [text_of(page) for page in DOCS if page.startswith("docs/reference/")]
    named = re.findall(r"^::: ([\w.]+)$", "\n".join(pages), flags=re.MULTILINE)
    assert len(named) == len(set(named))
    for name in named:
        module, _, last = name.rpartition(".")
        assert hasattr(importlib.import_module(module), last), name
    public = {
        f"{place.__name__}.{name}"
        for place in (ssp_lp, ssp_lp.io, ssp_lp.plotting)
        for name in place.__all__
    }
    # the site reads files, and the criteria's lie beside ``ssp_lp``
    imported = {re.sub(r"^formulations\.", "ssp_lp.", name) for name in named}
    assert public - imported == {"ssp_lp.GIVE_UP", "ssp_lp.CostLimit"}


def test_every_page_stands_in_the_site():
    menu = text_of("docs/site/mkdocs.yml").partition("\nnav:")[2]
    listed = set(re.findall(r"([\w/]+\.md)$", menu, flags=re.MULTILINE))
    stories = {f"stories/{path.stem}.md" for path in (ROOT / "examples/notebooks").glob("*.ipynb")}
    elsewhere = {"contributing.md", "changelog.md", "examples.md"} | stories
    assert listed == {page.removeprefix("docs/") for page in DOCS} | elsewhere
