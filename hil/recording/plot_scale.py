"""How wide the range of a plot is, and how high the plot, so that its ticks have labels.

The viewer writes labels at the steps of one power of ten, and only where they find room; a plot with no label
but 0 cannot be read, and begins at another x than those above and below it.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final

Range = tuple[float, float]

COLUMN_PX: Final = 980
"""Height of the column of lanes and plots in a window of 1920 x 1080, as the viewer draws it."""
_STATES_PX, _LANE_PX, _STATES_PX_MAX = 72, 40, 490
"""Title and axis of the lanes, each lane, and what lanes may take at most."""
_PLOT_PX: Final = 58
"""Title and time axis of a plot."""
_TICK_PX: Final = 26
"""The viewer writes no labels closer than this."""
_BEYOND_LABEL: Final = 1.2
"""So far reaches a plot without room for its own labels beyond that of the next power of ten, which is then
whole."""
_MANTISSA_MAX: Final = 3.0
"""More ticks of the smaller power of ten would take the room of the other plots, where it is short."""
_MARGIN: Final = 0.15
"""Margin on each side, as a share of the range: a curve does not lie upon the frame."""


LANE_GUTTER: Final = 31 / 988
"""Share of a plot's width taken by labels like 1 000 at its left, which the lanes do not have."""
_COLUMN_WIDTH_PX: Final = 1344
_CHARACTER_PX, _SPACE_PX, _USUAL_PX = 7.6, 2.4, 4 * 7.6 + 2.4
"""Of a digit, of the space before three digits, and of the label 1 000."""


def gutter(low_high: Range | None) -> float:
    """Return by which share of its width a plot has to begin earlier, so that its time zero stands below that
    of one whose labels are like 1 000; negative where its own are wider."""
    if low_high is None:
        return 0.0
    decade = _decade(low_high)
    ends = math.ceil(low_high[0] / decade), math.floor(low_high[1] / decade)
    labels = (f"{end * decade:.{max(0, -round(math.log10(decade)))}f}" for end in ends)
    widths = (_CHARACTER_PX * len(label) + _SPACE_PX * (abs(float(label)) >= 1000) for label in labels)
    return (_USUAL_PX - max(widths)) / _COLUMN_WIDTH_PX


def lanes_px(lanes: int) -> float:
    """Return the height that so many lanes need."""
    return min(_STATES_PX + _LANE_PX * lanes, _STATES_PX_MAX)


def about(values: Iterable[float]) -> Range | None:
    """The range of values, with a margin; None: there are none, or one alone."""
    known = list(values)
    if not known or min(known) == max(known):
        return None
    margin = _MARGIN * (max(known) - min(known))
    return min(known) - margin, max(known) + margin


def around_zero(reach: float) -> Range:
    """For values up to ``reach`` by size, > 0."""
    most = (1.0 + 2.0 * _MARGIN) * reach
    decade = 10.0 ** math.floor(math.log10(most))
    if most > _MANTISSA_MAX * decade:
        most = (1.0 + 2.0 * _MARGIN) * 10.0 * decade
    return -most, most


def fitted(ranges: Sequence[Range | None], room_px: float) -> list[Range | None]:
    """Return the ranges of plots one below the other so that all have room for labels: where there is none,
    one reaches to the next power of ten, that of fewest ticks with which all fit."""
    chosen = list(ranges)
    while (missing_px := sum(map(_needed_px, chosen)) - room_px) > 0.0:
        coarser = {
            place: _coarser(each)
            for place, each in enumerate(chosen)
            if each is not None and _ticks(each) > _MANTISSA_MAX
        }
        saved_px = {place: _needed_px(chosen[place]) - _needed_px(each) for place, each in coarser.items()}
        if not saved_px:
            break
        enough = [place for place, px in saved_px.items() if px >= missing_px]
        place = min(enough, key=saved_px.__getitem__) if enough else max(saved_px, key=saved_px.__getitem__)
        chosen[place] = coarser[place]
    return chosen


def plot_heights(ranges: Sequence[Range | None], room_px: float, spare: Sequence[float]) -> list[float]:
    """Return the heights of plots one below the other, px; ``spare``: the shares in which they divide the
    room that none of them needs."""
    needed = [_needed_px(each) for each in ranges]
    left = max(0.0, room_px - sum(needed))
    return [each + left * part for each, part in zip(needed, spare, strict=True)]


def _needed_px(low_high: Range | None) -> float:
    return _PLOT_PX + _TICK_PX * _ticks(low_high)


def _coarser(low_high: Range) -> Range:
    """To a label of the next power of ten at the larger end."""
    low, high = low_high
    most = _BEYOND_LABEL * 10.0 * _decade(low_high)
    return (low, most) if high >= -low else (-most, high)


def _ticks(low_high: Range | None) -> float:
    """How many steps of the power of ten that its largest value has a range is high."""
    if low_high is None:
        return 2.0
    return (low_high[1] - low_high[0]) / _decade(low_high)


def _decade(low_high: Range) -> float:
    return float(10.0 ** math.floor(math.log10(max(map(abs, low_high)))))
