"""Formulas as MathML, which browsers draw themselves: an extension of Python-Markdown."""

import html
import re
from xml.etree import ElementTree

from markdown import Markdown
from markdown.extensions import Extension
from markdown.postprocessors import Postprocessor
from math_core import LatexError, LatexToMathML

_FORMULA = re.compile(
    r"<(?P<tag>span|div) class=\"arithmatex\">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>", re.DOTALL
)
_CONVERTER = LatexToMathML(fancy_error=False)
_AFTER_RAW_HTML = 5  # postprocessors run by falling priority; the formulas are put in at 30


class _Formulas(Postprocessor):
    """Replace the formulas that `pymdownx.arithmatex` has marked."""

    def run(self, text: str) -> str:
        """Return the page with its formulas drawn."""
        return _FORMULA.sub(_drawn, text)


class FormulaExtension(Extension):
    """Draw every formula of a page when the page is built."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Register the postprocessor."""
        md.postprocessors.register(_Formulas(md), "formulas", _AFTER_RAW_HTML)


def makeExtension(**settings: object) -> FormulaExtension:  # noqa: N802
    """Return the extension; Python-Markdown looks for this name."""
    return FormulaExtension(**settings)


def _drawn(found: re.Match[str]) -> str:
    """Return a formula as MathML, in a box of its own where it is displayed."""
    displayed = found["tag"] == "div"
    latex = html.unescape(found["latex"]).strip()
    try:
        drawn = _CONVERTER.convert_with_local_state(latex, displaystyle=displayed)
    except LatexError as error:
        raise ValueError(f"cannot draw the formula {latex}: {error}") from error
    drawn = _with_plain_primes(drawn) if "\N{PRIME}" in drawn else drawn
    return f'<div class="formula">{drawn}</div>' if displayed else drawn


def _with_plain_primes(drawn: str) -> str:
    """Return a formula whose primes are no superscripts, which few fonts draw at a good height."""
    formula = ElementTree.fromstring(drawn)  # noqa: S314 (made by the converter)
    for place in list(formula.iter()):
        if place.tag not in ("msup", "msubsup") or place[-1].text != "\N{PRIME}":
            continue
        base, *below, prime = place
        prime.attrib.update({"class": "prime", "lspace": "0", "rspace": "0"})
        primed = ElementTree.Element("mrow")
        primed.extend([base, prime])
        place.tag, place[:] = ("msub", [primed, *below]) if below else ("mrow", [primed])
    return ElementTree.tostring(formula, encoding="unicode")
