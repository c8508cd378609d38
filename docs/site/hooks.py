"""The site from the repository's own pages: the README is its first, links follow, nothing leaks.

Pages outside of docs/ become pages of the site, links between pages lead to where those are in it,
and links to other files of the repository become plain words. A page that would fetch a script, a
style, a font or a picture from elsewhere is warned of, which is an error under ``--strict``. So is
a formula that cannot be drawn: formulas become MathML, which browsers draw themselves.
"""

import html as markup
import logging
import posixpath
import re
from pathlib import Path

from math_core import LatexError, LatexToMathML
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]

ADOPTED = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "examples.md": "examples/README.md",
}
"""Pages of the site that lie elsewhere in the repository."""

_LINK = re.compile(r"(!?\[((?:[^\]`]|`[^`]*`)+)\])\(([^)\s]+)\)")
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)[^>]*\ssrc=\"(https?:|//)|<link(?![^>]*rel=\"canonical\")[^>]*"
    r"\shref=\"(https?:|//)|@import|url\((?:\"|')?(?:https?:|//)"
)
_FORMULA = re.compile(
    r"<(?P<tag>span|div) class=\"arithmatex\">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>", re.DOTALL
)
_CODE = re.compile(r"<(code|pre|math)\b.*?</\1>", re.DOTALL)
_CONVERTER = LatexToMathML(fancy_error=False)

_log = logging.getLogger("mkdocs.hooks")


def on_files(files, config):
    """Add the pages that lie elsewhere."""
    for page, source in ADOPTED.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Let links lead to pages of the site."""
    here = page.file.src_uri
    source = ADOPTED.get(here, f"docs/{here}")
    return _LINK.sub(lambda found: _led(found, here, source, files), markdown)


def _led(found, here, source, files):
    """A link as the site needs it."""
    shown, words, target = found.groups()
    if target.startswith(("https://", "http://", "#")):
        return found[0]
    path, mark, anchor = target.partition("#")
    meant = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    pages = {original: page for page, original in ADOPTED.items()}
    known = pages.get(meant, meant.removeprefix("docs/") if meant.startswith("docs/") else None)
    if known is None:
        if not (ROOT / meant).exists():
            _log.warning("%s: the link to %s leads nowhere", source, target)
        return words
    if words.endswith(".md") and files.get_file_from_path(known) is not None:
        shown = f"[{files.get_file_from_path(known).page.title}]"
    return f"{shown}({posixpath.relpath(known, posixpath.dirname(here) or '.')}{mark}{anchor})"


def on_page_content(html, page, config, files):
    """Draw formulas; refuse what a browser would take for a tag, <goal, x>, and a lone $."""
    here = page.file.src_uri
    for found in re.finditer(r"<[a-z_ ]+,[^<]{0,20}", html):
        _log.warning("%s: %s stands outside of code", here, found[0])
    html = _FORMULA.sub(lambda found: _drawn(found["latex"], found["tag"] == "div", here), html)
    for found in re.finditer(r".{0,30}\$.{0,30}", _CODE.sub("", html)):
        _log.warning("%s: no formula begins or ends at the $ of %r", here, found[0])
    return html


def _drawn(escaped, displayed, here):
    """A formula as MathML, in a box of its own where it is displayed."""
    latex = markup.unescape(escaped).strip()
    try:
        drawn = _CONVERTER.convert_with_local_state(latex, displaystyle=displayed)
    except LatexError as error:
        _log.warning("%s: the formula %s cannot be drawn: %s", here, latex, error)
        return f"<code>{escaped}</code>"
    return f'<div class="formula">{drawn}</div>' if displayed else drawn


def on_post_page(output, page, config):
    """Refuse what a reader without a network would lack."""
    for found in _FETCHED.finditer(output):
        _log.warning("%s fetches from elsewhere: %s", page.file.src_uri, found[0][:120])
    return output
