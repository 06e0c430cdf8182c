"""What is in a picture of a page, by its pixels alone."""

import io
from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Final, NamedTuple

import matplotlib.image
import numpy as np
from numpy.typing import NDArray

from tests.colour_sight import apart

Color = tuple[int, int, int]
CURVES: Final[Mapping[str, Color]] = {
    "speed": (108, 148, 251),
    "error": (252, 170, 0),
    "torque": (73, 212, 138),
    "delay": (204, 206, 20),
    "clock": (84, 58, 250),
}
"""What a line of a plot is drawn in, and below limits and bars: as a person sees them on the pages."""
LIMIT: Final[Color] = (185, 35, 8)
REFERENCE: Final[Color] = (176, 197, 227)
BARS: Final[Mapping[str, Color]] = {"fault": (255, 250, 70), "red": (215, 35, 10), "good": (21, 101, 192)}
"""Of lanes."""
DARK, LIGHT = (13, 16, 17), (255, 255, 255)
"""Grounds."""
_COLUMN: Final = 1344 / 1920
"""So much of the width have lanes and plots; the rest is text."""
_TOP: Final = 60
"""Above are the viewer's own menus, px."""
_ALIKE: Final = 0.995
"""Cosine of two colours seen from the background: an edge is a mixture of both, and is alike."""
_SAME: Final = 0.9999
"""That of a colour that is not mixed with another line's."""
_WHOLE: Final = 0.95
"""Of the brightest pixels: those that are not mixed with the ground; of a thin line the dot in its legend."""
_COVERED: Final = 0.96
"""Of a line that others lie on: reference and estimate nearly hide a measured speed that is the same."""
_FAINT, _BRIGHT = 0.35, 0.6
"""What is mixed thinner with the background is not looked at; lines are brighter than the bars of lanes."""
_BAR_PX, _BAND_PX = 12, 40
"""A bar of a lane is 28 px high, text and lines less than 12, a curve of many cycles more than 40."""
_EDGE_PX: Final = 4
"""So much of a bar lies above its words."""
_CURSOR: Final = 60.0
"""By so much the cursor is brighter than what it covers."""
_LINE_PX: Final = 100
"""A limit is drawn for longer, the dot of a legend for shorter."""
_GAP_PX: Final = 6
"""20 ms of two seconds are some 11 px; a curve leaves out 2 px where it is steep."""
_EDGE: Final = 0.15
"""So much of the width may be before the first cycle, or covered by the legend."""
_GAP: Final = 0.13
"""And so much be missing: from the last cycle to the dot in the legend, or where another line covers it."""
_INK: Final = 0.02
_APART: Final = 40.0
"""CIELAB, to the eye that tells them apart worst."""
_LINES_APART: Final = 36.0
"""Likewise for lines, of which the thinnest cover 0.95 of a pixel: the ground in it brings colours 40 apart
within 38 of each other."""
_NEVER_TOGETHER: Final = {"the error", "the delay"}
"""Curves that are in no plot together; colours of others may be, in one plot of some axes."""


class Reach(NamedTuple):
    """How far a line goes through the column of plots, parts of its width."""

    first: float
    last: float
    gap: float
    """The longest stretch without it."""


class Picture:
    """Of a page; lengths in px are those of one of 1920 x 1080."""

    def __init__(self, pixels: NDArray[np.float64], ground: Color = DARK) -> None:
        """``pixels``: (height, width, 3), 0 to 255."""
        self.ground = ground
        self._ground = np.array(ground, np.float64)
        self._scale: float = pixels.shape[0] / 1080
        self._column = pixels[self._px(_TOP) :, : round(pixels.shape[1] * _COLUMN)] - self._ground

    @classmethod
    def of_png(cls, png: bytes, ground: Color = DARK) -> "Picture":
        """As ``hil picture`` writes it, or a browser."""
        return cls(matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3] * 255.0, ground)

    def ink(self) -> float:
        """How much of the column of plots is not background, 0 to 1."""
        return float((np.abs(self._column).max(axis=2) > 30.0).mean())

    def reach(self, color: Color) -> Reach | None:
        """Of a line; None: it is nowhere."""
        width = self._column.shape[1]
        least = _COVERED if color == CURVES["speed"] else _ALIKE
        columns = np.flatnonzero(self._alike(color, least, _BRIGHT).any(axis=0))
        if not columns.size:
            return None
        gap = int(np.diff(columns).max(initial=0))
        return Reach(columns[0] / width, columns[-1] / width, gap / width)

    def gap_px(self, color: Color) -> int:
        """How wide the widest gap in a curve is, left of its legend."""
        columns = np.flatnonzero(self._alike(color, _ALIKE).any(axis=0))
        shown = columns[columns < (1.0 - _EDGE) * self._column.shape[1]]
        return round((int(np.diff(shown).max(initial=1)) - 1) / self._scale)

    def bar_px(self, color: Color) -> int:
        """How wide the bars of lanes in a colour are, all together."""
        return int(self._bars(self._alike(color)).any(axis=0).sum())

    def drawn_bar(self, color: Color) -> NDArray[np.float64] | None:
        """The colour that bars are drawn in which are asked for in this one; None: there are none."""
        return self._drawn(self._bars(self._alike(color)))

    def drawn_line(self, color: Color) -> NDArray[np.float64] | None:
        """The colour that lines are drawn in, where they cover a pixel; None: there are none."""
        alike = self._alike(color, _SAME, _BRIGHT)
        return self._drawn(alike & ~self._bars(alike))

    def line_px(self, color: Color) -> int:
        """How long the longest level line in a colour is."""
        alike = self._alike(color)
        return round(int((alike & ~self._bars(alike)).sum(axis=1).max()) / self._scale)

    def bar_rows(self, color: Color) -> slice | None:
        """Rows of the upper edge of the last lane with bars in a colour, above their words; None: no lane."""
        high = self._px(_BAR_PX)
        rows = np.flatnonzero(self._alike(color).sum(axis=1) > high)
        lanes = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        found = [each for each in lanes if each.size >= high]
        return slice(int(found[-1][1]), int(found[-1][1]) + self._px(_EDGE_PX)) if found else None

    def bars(self, color: Color, rows: slice) -> list[tuple[int, int]]:
        """First column of each bar of a lane, and the one behind its last."""
        alike = self._alike(color)[rows].all(axis=0)
        edges = np.flatnonzero(np.diff(alike, prepend=False, append=False))
        return [(int(first), int(behind)) for first, behind in edges.reshape(-1, 2)]

    def curve_rows(self, color: Color) -> slice:
        """Rows of the plot of a curve, those of a legend's dot among them."""
        rows = np.flatnonzero(self._alike(color, _ALIKE, _BRIGHT).any(axis=1))
        return slice(int(rows[0]), int(rows[-1]) + 1)

    def curve_columns(self, color: Color, rows: slice) -> NDArray[np.int64]:
        """Columns that a curve goes through, left of its legend."""
        found: NDArray[np.int64] = np.flatnonzero(self._alike(color, _ALIKE, _BRIGHT)[rows].any(axis=0))
        shown: NDArray[np.int64] = found[found < (1.0 - _EDGE) * self._column.shape[1]]
        return shown

    def cursor(self, other: "Picture", rows: slice) -> tuple[float, float]:
        """Columns of the cursor in these rows: here, and in another picture that differs by it alone."""
        ink = np.linalg.norm(self._column[rows], axis=2) - np.linalg.norm(other._column[rows], axis=2)
        brighter = [(sign * ink > _CURSOR).mean(axis=0) for sign in (1.0, -1.0)]
        here, there = (np.flatnonzero(each > 0.5 * each.max()) for each in brighter)
        return float(here.mean()), float(there.mean())

    def _bars(self, alike: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Those pixels that are of a bar, above its words."""
        bars = np.zeros_like(alike)
        edges = np.diff(alike.astype(np.int8), axis=0, prepend=0, append=0)
        columns, begins = np.nonzero(edges.T == 1)
        _, ends = np.nonzero(edges.T == -1)
        tall = ends - begins
        for place in np.flatnonzero((tall >= self._px(_BAR_PX)) & (tall <= self._px(_BAND_PX))):
            bars[begins[place] : ends[place], columns[place]] = True
        return bars

    def _drawn(self, among: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        colors = self._column[among]
        if len(colors) < self._px(_LINE_PX):
            return None
        length = np.linalg.norm(colors, axis=1)
        kinds, counts = np.unique(colors[length >= _WHOLE * length.max()], axis=0, return_counts=True)
        drawn: NDArray[np.float64] = kinds[counts.argmax()] + self._ground
        return drawn

    def _px(self, length: float) -> int:
        return round(length * self._scale)

    def _alike(self, color: Color, least: float = _ALIKE, faint: float = _FAINT) -> NDArray[np.bool_]:
        sought = np.array(color) - self._ground
        length = np.linalg.norm(self._column, axis=2)
        alike = self._column @ sought >= least * length * np.linalg.norm(sought)
        found: NDArray[np.bool_] = alike & (length >= faint * np.linalg.norm(sought))
        return found


def complaints(picture: Picture, lines: tuple[str, ...], seen: Mapping[str, bool]) -> list[str]:
    """What is wrong with a picture.

    ``lines``: curves that have to go through the whole width. ``seen``: by bar, "limit", and "gap" in the
    curve of delays: whether it has to be there, or must not be.
    """
    found = [] if picture.ink() >= _INK else [f"blank but for {picture.ink():.1%}"]
    for name in lines:
        reach = picture.reach(CURVES[name])
        if reach is None:
            found.append(f"no {name}")
        elif reach.first > _EDGE or reach.last < 1 - _EDGE or reach.gap > _GAP:
            found.append(f"{name} from {reach.first:.0%} to {reach.last:.0%}, a gap of {reach.gap:.0%}")
    for name, wanted in seen.items():
        if name == "gap":
            there, what = picture.gap_px(CURVES["delay"]) >= _GAP_PX, "gap"
        elif name == "limit":
            there, what = picture.line_px(LIMIT) >= _LINE_PX, "limit line"
        else:
            there, what = picture.bar_px(BARS[name]) > 0, f"{name} bar"
        if there != wanted:
            found.append(f"{'no' if wanted else 'a'} {what}")
    return found + list(confused(picture))


def confused(picture: Picture) -> Iterator[str]:
    """Which colours of a picture, as it has them, are near to each other for the colour-blind."""
    bars = {
        f"{name} bars": drawn
        for name, color in BARS.items()
        if (drawn := picture.drawn_bar(color)) is not None
    }
    lines = {**CURVES, "limit": LIMIT, "reference": REFERENCE}
    curves = {
        f"the {name}": drawn
        for name, color in lines.items()
        if (drawn := picture.drawn_line(color)) is not None
    }
    for each, least in ((bars, _APART), (curves, _LINES_APART)):
        for (one, its), (other, others) in combinations(each.items(), 2):
            if {one, other} != _NEVER_TOGETHER and apart(its, others) < least:
                yield f"{one} and {other} {apart(its, others):.0f} apart to the colour-blind"
    for name, drawn in bars.items():
        if apart(drawn, picture.ground) < _APART:
            yield f"{name} {apart(drawn, picture.ground):.0f} from the ground to the colour-blind"
