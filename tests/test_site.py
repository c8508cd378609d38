"""The script that builds the site: it leads links, turns notebooks into pages, finds errors."""

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def build():
    """The script as a module; what it imports lies beside it."""
    sys.path.insert(0, str(ROOT / "docs" / "site"))
    try:
        import build
    finally:
        sys.path.pop(0)
    return build


@pytest.fixture(scope="module")
def assembled(build, tmp_path_factory):
    """The pages as the builder reads them."""
    folder = tmp_path_factory.mktemp("site")
    assert build.assemble(folder, "9.9", selector=True) == []
    return folder


def test_links_lead_to_the_pages_of_the_site(assembled):
    page = (assembled / "docs/index.md").read_text(encoding="utf-8")
    assert "](stories/drone.md)" in page
    assert page.startswith("---\nhide:")
    readme = (assembled / "docs/readme.md").read_text(encoding="utf-8")
    assert "](tutorial.md)" in readme
    assert "](formulations)" not in readme
    assert "version 9.9" not in readme
    assert "copyright: ssp-lp 9.9" in (assembled / "mkdocs.yml").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["drone", "paper", "treatment"])
def test_a_notebook_becomes_a_page_with_its_code_and_outputs(assembled, name):
    page = (assembled / f"docs/stories/{name}.md").read_text(encoding="utf-8")
    notebook = json.loads((ROOT / f"examples/notebooks/{name}.ipynb").read_text(encoding="utf-8"))
    for cell in notebook["cells"]:
        assert "".join(cell["source"]) in page
        for output in cell.get("outputs", []):
            assert "".join(output.get("text", "")).rstrip() in page
    assert ("<img" in page) == (name == "paper")
    assert all((assembled / "docs/stories" / picture).exists() for picture in pictures_of(page))


def pictures_of(page):
    return [part.partition('"')[0] for part in page.split('src="')[1:]]


def site_of(folder, body):
    """A built site of one page beside a page with one heading."""
    (folder / "search.json").write_text("end_probability failure_price", encoding="utf-8")
    (folder / "other.html").write_text('<h1 id="here">x</h1>', encoding="utf-8")
    page = f"<article>{body}</article>"
    (folder / "page.html").write_text(page, encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    "body",
    [
        '<a href="other.html#here">x</a> <a href="https://x.org">x</a>',
        '<a href="#top" id="top">x</a>',
        "<code>costs 5 $</code>",
        '<img src="data:image/png;base64,AA">',
    ],
)
def test_a_sound_site_has_no_problems(build, tmp_path, body):
    assert build.check(site_of(tmp_path, body)) == []


@pytest.mark.parametrize(
    "body",
    [
        '<a href="other.html#there">x</a>',
        '<a href="nowhere.html">x</a>',
        '<img src="https://x.org/a.png">',
        '<script src="//x.org/a.js"></script>',
        "costs 5 $",
        "<goal, x>",
        "<blockquote>= 0.</blockquote>",
    ],
)
def test_each_kind_of_error_is_found(build, tmp_path, body):
    (problem,) = build.check(site_of(tmp_path, body))
    assert problem.startswith("page.html")


def test_a_search_that_misses_code_is_an_error(build, tmp_path):
    (site_of(tmp_path, "") / "search.json").write_text("failure_price", encoding="utf-8")
    assert build.check(tmp_path) == ["the search does not find 'end_probability'"]


def test_the_newest_version_stands_first_and_is_led_to(build, tmp_path):
    for version in ("0.9.0", "0.10.0", "0.2.0"):
        (tmp_path / version).mkdir()
        (tmp_path / version / "index.html").touch()
    build.list_versions(tmp_path)
    listed = json.loads((tmp_path / "versions.json").read_text(encoding="utf-8"))
    assert [entry["version"] for entry in listed] == ["0.10.0", "0.9.0", "0.2.0"]
    assert "url=0.10.0/" in (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "Page not found" in (tmp_path / "404.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("latex", "drawn"), [("x'", "mrow mrow mi mo"), (r"\pi_{or}'", "msub mrow mi mo mrow mi mi")]
)
def test_primes_are_no_superscripts(latex, drawn):
    """A prime stands beside its letter, and an index beside both."""
    sys.path.insert(0, str(ROOT / "docs" / "site"))
    formulas = pytest.importorskip("formulas")
    sys.path.pop(0)
    shown = formulas._CONVERTER.convert_with_local_state(latex, displaystyle=False)
    plain = formulas._with_plain_primes(shown)
    assert " ".join(re.findall(r"<(m\w+)", plain.removeprefix("<math"))) == drawn


def test_the_site_says_the_version_of_the_package(build):
    import ssp_lp

    assert build.package_version() == ssp_lp.__version__
