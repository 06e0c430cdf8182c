"""What is in a picture of a page, by its pixels alone."""

import io
from collections.abc import Mapping
from typing import Final, NamedTuple

import matplotlib.image
import numpy as np
from numpy.typing import NDArray

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
BARS: Final[Mapping[str, Color]] = {"fault": (217, 165, 32), "red": (179, 32, 42), "good": (21, 101, 192)}
"""Of lanes."""
_BACKGROUND: Final = np.array((13.0, 16.0, 17.0))
_COLUMN: Final = 1344 / 1920
"""So much of the width have lanes and plots; the rest is text."""
_TOP: Final = 60
"""Above are the viewer's own menus, px."""
_ALIKE: Final = 0.995
"""Cosine of two colours seen from the background: an edge is a mixture of both, and is alike."""
_COVERED: Final = 0.96
"""Of a line that others lie on: reference and estimate nearly hide a measured speed that is the same."""
_FAINT, _BRIGHT = 0.35, 0.6
"""What is mixed thinner with the background is not looked at; lines are brighter than the bars of lanes."""
_BAR_PX: Final = 12
"""A bar of a lane is 28 px high, text and lines less than this."""
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


class Reach(NamedTuple):
    """How far a line goes through the column of plots, parts of its width."""

    first: float
    last: float
    gap: float
    """The longest stretch without it."""


class Picture:
    """Of a page; lengths in px are those of one of 1920 x 1080."""

    def __init__(self, pixels: NDArray[np.float64]) -> None:
        """``pixels``: (height, width, 3), 0 to 255."""
        self._scale: float = pixels.shape[0] / 1080
        self._column = pixels[self._px(_TOP) :, : round(pixels.shape[1] * _COLUMN)] - _BACKGROUND

    @classmethod
    def of_png(cls, png: bytes) -> "Picture":
        """As ``hil picture`` writes it."""
        return cls(matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3] * 255.0)

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
        columns = np.flatnonzero(self._alike(color, _ALIKE, _BRIGHT).any(axis=0))
        shown = columns[columns < (1.0 - _EDGE) * self._column.shape[1]]
        return round((int(np.diff(shown).max(initial=1)) - 1) / self._scale)

    def bar_px(self, color: Color) -> int:
        """How wide the bars of lanes in a colour are, all together."""
        alike, high = self._alike(color), self._px(_BAR_PX)
        whole = np.ones_like(alike[high:])
        for row in range(high):
            whole &= alike[row : row - high]
        return int(whole.any(axis=0).sum())

    def line_px(self, color: Color) -> int:
        """How long the longest level line in a colour is."""
        return round(int(self._alike(color).sum(axis=1).max()) / self._scale)

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

    def _px(self, length: float) -> int:
        return round(length * self._scale)

    def _alike(self, color: Color, least: float = _ALIKE, faint: float = _FAINT) -> NDArray[np.bool_]:
        sought = np.array(color) - _BACKGROUND
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
    return found
