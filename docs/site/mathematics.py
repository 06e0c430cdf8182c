"""Formulas of the pages, ``$...$`` and ``$$...$$``, as MathML, which browsers draw without a script."""

import html
import re

from latex2mathml.converter import convert

_MARKED = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
"""What pymdownx.arithmatex (generic) makes of a formula."""


def drawn(page: str) -> str:
    """Return the HTML of a page with its formulas as MathML; ValueError: one is not understood."""
    return _MARKED.sub(_mathml, page)


def _mathml(marked: re.Match[str]) -> str:
    latex = html.unescape(marked[3]).strip()
    made = convert(latex, display="block" if marked[2] == "[" else "inline")
    # An unknown command is passed through as a symbol.
    if "\\" in made or "merror" in made:
        raise ValueError(
            f"Formula {latex!r}: a command of LaTeX that latex2mathml does not know; write another"
        )
    return made
