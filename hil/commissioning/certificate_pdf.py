"""The certificate as PDF, by matplotlib: tables of wrapped cells on A4, text that can be searched."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from servobench.hil.commissioning.certificate import SIGNATURES, CertificateTable, FiledCertificate, hash_line

_WIDTH_PT, _HEIGHT_PT = 595.0, 842.0
_MARGIN_PT: Final = 48.0
_FOOT_PT: Final = 60.0
_SIZE_PT: Final = 8.0
_LINE_PT: Final = 11.0
_GAP_PT: Final = 6.0
"""Between columns."""
_BLUE, _RED, _GREY = "#1565c0", "#b3202a", "#8a8f98"
_SIGN_PT: Final = 90.0


class _Pages:
    """Pages filled from above."""

    def __init__(self) -> None:
        self.figures: list[Figure] = []
        self._y = 0.0
        self._turn()

    def text(self, words: str, x_pt: float = 0.0, size: float = _SIZE_PT, **options: Any) -> None:
        """Write one line at the present height."""
        self.figures[-1].text(
            (_MARGIN_PT + x_pt) / _WIDTH_PT, self._y / _HEIGHT_PT, words,
            fontsize=size, va="top", parse_math=False, **options,
        )  # fmt: skip

    def down(self, points: float) -> None:
        """Go on below."""
        self._y -= points

    def room(self, points: float) -> None:
        """Turn the page if less is left."""
        if self._y - points < _FOOT_PT:
            self._turn()

    def rule(self, color: str = _GREY) -> None:
        """Draw a line at the present height."""
        y = self._y / _HEIGHT_PT
        ends = [_MARGIN_PT / _WIDTH_PT, 1.0 - _MARGIN_PT / _WIDTH_PT]
        line = mpl.lines.Line2D(ends, [y, y], color=color, linewidth=0.5)
        self.figures[-1].add_artist(line)

    def _turn(self) -> None:
        self.figures.append(Figure(figsize=(_WIDTH_PT / 72.0, _HEIGHT_PT / 72.0)))
        self._y = _HEIGHT_PT - _MARGIN_PT


def write_pdf(made: FiledCertificate, path: Path) -> None:
    """Raises OSError."""
    with mpl.rc_context({"pdf.fonttype": 42}), PdfPages(path, metadata={"Title": made.title}) as sink:
        for figure in pages_of(made):
            sink.savefig(figure)


def pages_of(made: FiledCertificate) -> list[Figure]:
    """Return the pages, A4."""
    pages = _Pages()
    pages.text(made.title, size=13.0, weight="bold")
    pages.down(24.0)
    for line in _wrapped(made.verdict, _inner_pt(), 11.0, "bold"):
        pages.text(line, size=11.0, weight="bold", color=_BLUE if made.verdict == "PASSED" else _RED)
        pages.down(15.0)
    for sheet in made.sheets:
        if sheet.rows or sheet.empty:
            _put(pages, sheet)
    pages.room(_SIGN_PT + 3 * _LINE_PT)
    pages.down(_LINE_PT)
    for line in _wrapped(hash_line(made), _inner_pt()):
        pages.text(line)
        pages.down(_LINE_PT)
    _put_signatures(pages)
    _put_feet(pages.figures, made)
    return pages.figures


def _put(pages: _Pages, sheet: CertificateTable) -> None:
    pages.room(5 * _LINE_PT)
    pages.down(_LINE_PT)
    pages.text(sheet.title, size=10.0, weight="bold")
    pages.down(16.0)
    if not sheet.rows:
        pages.text(sheet.empty)
        pages.down(_LINE_PT)
        return
    if any(sheet.heads):
        _put_row(pages, sheet, sheet.heads, weight="bold")
    for row in sheet.rows:
        _put_row(pages, sheet, row)


def _put_row(pages: _Pages, sheet: CertificateTable, row: Sequence[str], **options: Any) -> None:
    weight = str(options.get("weight", "normal"))
    cells = [
        _wrapped(cell, share * _inner_pt() - _GAP_PT, weight=weight)
        for cell, share in zip(row, sheet.widths, strict=True)
    ]
    lines = max(map(len, cells))
    pages.room(lines * _LINE_PT + 4.0)
    for place in range(lines):
        x_pt = 0.0
        for cell, share in zip(cells, sheet.widths, strict=True):
            if place < len(cell):
                pages.text(cell[place], x_pt, **options)
            x_pt += share * _inner_pt()
        pages.down(_LINE_PT)
    pages.rule()
    pages.down(3.0)


def _put_signatures(pages: _Pages) -> None:
    pages.down(_SIGN_PT / 2)
    pages.rule("black")
    pages.down(3.0)
    for place, words in enumerate(SIGNATURES):
        pages.text(words, place * _inner_pt() / len(SIGNATURES))


def _put_feet(figures: Sequence[Figure], made: FiledCertificate) -> None:
    for number, figure in enumerate(figures, start=1):
        text = f"{made.title}; {made.manifest_sha256[:16]}...; page {number} of {len(figures)}"
        figure.text(
            _MARGIN_PT / _WIDTH_PT, 30.0 / _HEIGHT_PT, text, fontsize=6.5, color=_GREY, parse_math=False
        )


def _wrapped(text: str, width_pt: float, size: float = _SIZE_PT, weight: str = "normal") -> list[str]:
    """Lines of ``text`` that are at most so wide; a longer word is cut."""

    def width(words: str) -> float:
        return size * sum(_advance_em(letter, weight) for letter in words)

    lines, line = list[str](), ""
    for word in text.split():
        if line and width(f"{line} {word}") > width_pt:
            lines.append(line)
            line = ""
        rest = f"{line} {word}".strip()
        while width(rest) > width_pt and len(rest) > 1:
            fits = next(length for length in range(len(rest), 0, -1) if width(rest[:length]) <= width_pt)
            lines.append(rest[:fits])
            rest = rest[fits:]
        line = rest
    return [*lines, line]


@cache
def _advance_em(letter: str, weight: str) -> float:
    """Return the advance of a letter in the font's size; kerning brings letters closer, never apart."""
    font = FontProperties(size=100.0, weight=weight)
    one, two = (
        text_to_path.get_text_width_height_descent(words, font, ismath=False)[0]
        for words in (f"|{letter}|", "||")
    )
    return float(one - two) / 100.0


def _inner_pt() -> float:
    return _WIDTH_PT - 2 * _MARGIN_PT
