"""Build the site: the pages of docs/ and of the repository, by Zensical.

    python docs/site/build.py                    # into .site
    python docs/site/build.py --publish FOLDER   # into FOLDER/VERSION, listed in versions.json

Pages that lie outside docs/ become pages of the site, links lead to the pages' places in it, and
links to other files of the repository become plain words. A page may not fetch scripts, styles,
fonts or pictures from elsewhere. Every link must lead to a page and a heading that exist. Warnings
are errors.
"""

import argparse
import json
import os
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from notebooks import page_of

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]

ADOPTED = {
    "readme.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "examples.md": "examples/README.md",
}
"""Pages of the site that lie elsewhere in the repository."""

STORIES = {
    f"stories/{path.stem}.md": path.relative_to(ROOT).as_posix()
    for path in sorted((ROOT / "examples/notebooks").glob("*.ipynb"))
}
"""Notebooks, which become pages."""

FRONT = "hide: [toc]"
UNSEARCHED = "search: {exclude: true}"
HEADS = {"index.md": FRONT, "readme.md": UNSEARCHED}
"""Settings of pages; the README says what other pages say, too."""

MISSING = """<!doctype html><html lang="en"><meta charset="utf-8">
<title>Page not found - ssp-lp</title>
<meta name="viewport" content="width=device-width">
<body style="font: 1.1rem sans-serif; margin: 3rem auto; max-width: 40rem; padding: 0 1rem">
<h1>Page not found</h1>
<p>It may have moved. Go to the <a href="/">front page</a>.</p>
<script>
for (const link of document.querySelectorAll('a[href="/"]'))
  link.href = location.pathname.replace(/\\/[0-9]+[.][0-9][^/]*\\/.*|[^/]*$/, "/")
</script>
"""
"""Page for wrong addresses. A server shows it at any depth, so it needs no other file; its link
leads to the folder of all versions or, without versions, to the folder of the address."""

FOUND = ("end_probability", "failure_price")
"""Words that the pages use in code only, which the search must find."""

_LINK = re.compile(r"(!?\[((?:[^\]`]|`[^`]*`)+)\])\(([^)\s]+)\)")
_HEADING = re.compile(r"^# (.+)$", re.MULTILINE)
_VERSION = re.compile(r"^__version__ = \"(.+)\"$", re.MULTILINE)
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)[^>]*\ssrc=\"(?:https?:|//)[^>]*|@import[^;]*"
    r"|<link(?![^>]*rel=\"canonical\")[^>]*\shref=\"(?:https?:|//)[^>]*|url\([\"']?(?:https?:|//)[^)]*"
)
_ARTICLE = re.compile(r"<article\b.*?</article>", re.DOTALL)
_CODE = re.compile(r"<(code|pre|math)\b.*?</\1>", re.DOTALL)
_TARGET = re.compile(r"<(?:a|img|script|link)\b[^>]*?\s(?:href|src)=\"([^\"]*)\"")
_NAME = re.compile(r"\s(?:id|name)=\"([^\"]+)\"")


def main(arguments: Sequence[str] | None = None) -> int:
    """Build the site; report what is wrong with it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / ".site", help="folder of the site")
    parser.add_argument("--publish", type=Path, help="folder of all versions of the site")
    options = parser.parse_args(arguments)
    version = package_version()
    output = options.publish / version if options.publish else options.output
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        problems = assemble(work, version, options.publish is not None)
        environment = os.environ | {"PYTHONPATH": str(HERE)}  # formulas.py is found there
        command = [sys.executable, "-m", "zensical", "build", "--strict"]
        done = subprocess.run(command, cwd=work, env=environment, check=False)  # noqa: S603
        problems += check(work / "site") if done.returncode == 0 else ["zensical build failed"]
        if not problems:
            (work / "site/404.html").write_text(MISSING, encoding="utf-8")
            shutil.rmtree(output, ignore_errors=True)
            shutil.copytree(work / "site", output)
    print(*problems, sep="\n", end="\n" * bool(problems), file=sys.stderr)
    if options.publish and not problems:
        list_versions(options.publish)
    return int(bool(problems))


def package_version() -> str:
    """Return the version of the package, without importing it."""
    return _VERSION.search((ROOT / "ssp_lp/__init__.py").read_text(encoding="utf-8"))[1]


def assemble(work: Path, version: str, selector: bool) -> list[str]:
    """Write the sources of the site and its configuration to a folder; return dead links."""
    shutil.copytree(ROOT / "docs", work / "docs", ignore=shutil.ignore_patterns("*.py", "*.yml"))
    for package in ("ssp_lp", "formulations"):
        (work / package).symlink_to(ROOT / package)
    shutil.copy(HERE / "docstrings.py", work)
    sources = {
        path.relative_to(ROOT / "docs").as_posix(): path.relative_to(ROOT).as_posix()
        for path in (ROOT / "docs").rglob("*.md")
    }
    sources |= ADOPTED
    texts = {page: (ROOT / path).read_text(encoding="utf-8") for page, path in sources.items()}
    for page, path in STORIES.items():
        texts[page] = page_of(ROOT / path, (work / "docs" / page).parent)
    titles = {page: _HEADING.search(text)[1] for page, text in texts.items()}
    problems = []
    for page, text in texts.items():
        at = page, (sources | STORIES)[page], titles, problems
        text = _LINK.sub(lambda found, at=at: _led(found, *at), text)
        head = f"---\n{HEADS[page]}\n---\n\n" if page in HEADS else ""
        (work / "docs" / page).parent.mkdir(parents=True, exist_ok=True)
        (work / "docs" / page).write_text(head + text, encoding="utf-8")
    config = (HERE / "mkdocs.yml").read_text(encoding="utf-8")
    config += f"copyright: ssp-lp {version}, MIT licence\n"
    if selector:
        config += "extra: {version: {provider: mike}}\n"
    (work / "mkdocs.yml").write_text(config, encoding="utf-8")
    return problems


def _led(
    found: re.Match[str], page: str, source: str, titles: dict[str, str], problems: list[str]
) -> str:
    """Return a link as the site needs it; note it if it leads nowhere."""
    shown, words, target = found.groups()
    if target.startswith(("https://", "http://", "#")):
        return found[0]
    path, mark, anchor = target.partition("#")
    meant = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    adopted = {original: page for page, original in (ADOPTED | STORIES).items()}
    inside = meant.removeprefix("docs/") if meant.startswith("docs/") else None
    place = adopted.get(meant, inside)
    if place is None:
        if not (ROOT / meant).exists():
            problems.append(f"{source}: the link to {path} leads nowhere")
        return words
    if words.endswith(".md") and place in titles:
        shown = f"[{titles[place]}]"
    return f"{shown}({posixpath.relpath(place, posixpath.dirname(page) or '.')}{mark}{anchor})"


def check(site: Path) -> list[str]:
    """Return what is wrong with a built site: dead links, things fetched, formulas left over."""
    pages = {path: path.read_text(encoding="utf-8") for path in sorted(site.rglob("*.html"))}
    names = {path: set(_NAME.findall(text)) for path, text in pages.items()}
    problems = []
    for path, text in pages.items():
        page = path.relative_to(site).as_posix()
        problems += [
            f"{page} fetches from elsewhere: {found[0]}" for found in _FETCHED.finditer(text)
        ]
        problems += [f"{page}: {wrong}" for wrong in _leftovers(text)]
        for target in _TARGET.findall(text) if page != "404.html" else ():
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            there = there / "index.html" if there.is_dir() else there
            fragment = unquote(parts.fragment)
            if not there.exists() or (fragment and there in names and fragment not in names[there]):
                problems.append(f"{page}: the link to {target} leads nowhere")
    index = (site / "search.json").read_text(encoding="utf-8")
    problems += [f"the search does not find {word!r}" for word in FOUND if word not in index]
    return problems


def _leftovers(text: str) -> Iterator[str]:
    """Yield what a browser would take for a tag, <goal, x>, every lone $, and quotations."""
    for article in _ARTICLE.findall(text):
        if "<blockquote" in article:
            yield "a line that begins with > has become a quotation"
        for found in re.finditer(r"<[a-z_ ]+,[^<]{0,20}", article):
            yield f"{found[0]} stands outside of code"
        for found in re.finditer(r".{0,30}\$.{0,30}", _CODE.sub("", article)):
            yield f"no formula begins or ends at the $ of {found[0]!r}"


def list_versions(folder: Path) -> None:
    """List the versions in a folder for the site's menu; its front page leads to the newest."""
    versions = sorted(
        (path.parent.name for path in folder.glob("*/index.html")),
        key=lambda name: [int(number) for number in re.findall(r"\d+", name)],
        reverse=True,
    )
    listed = [{"version": name, "title": name, "aliases": []} for name in versions]
    listed[0]["aliases"] = ["latest"]
    (folder / "versions.json").write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
    front = f'<!doctype html><meta http-equiv="refresh" content="0; url={versions[0]}/">\n'
    (folder / "index.html").write_text(front, encoding="utf-8")
    (folder / "404.html").write_text(MISSING, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
