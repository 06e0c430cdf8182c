"""Each check finds what it is for in a picture made by hand, and nothing in one that is as it should be."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.virtual_bus.faults.register import TABLES
from tests.pictures.cases import cases
from tests.pictures.pixels import BARS, CURVES, LIMIT, Color, Picture, complaints
from tests.pictures.window import Burst, untrue

Pixels = NDArray[np.float64]
WIDTH = 1344
"""Of lanes and plots."""


def page() -> Pixels:
    """Two curves from end to end, a limit, and lanes, beside them text."""
    pixels = np.full((1080, 1920, 3), (13.0, 16.0, 17.0))
    pixels[100:1000, 1400:1900] = 120.0
    bar(pixels, "good", 120, 100, 1300)
    bar(pixels, "fault", 160, 700, 712)
    for row, name in ((500, "error"), (700, "torque")):
        line(pixels, CURVES[name], row, 60, 1200)
        pixels[row - 30 : row - 20, 1250:1260] = CURVES[name]  # the dot in its legend
    line(pixels, LIMIT, 450, 60, 1200)
    pixels[300:900, 20:24] = 200.0
    pixels[900:1060, 100:1200:4] = 90.0
    return pixels


def bar(pixels: Pixels, name: str, row: int, begin: int, end: int) -> None:
    """As the viewer draws them, darker than the colour that is asked for."""
    pixels[row : row + 28, begin:end] = np.array(BARS[name]) * 0.78


def line(pixels: Pixels, color: Color, row: int, begin: int, end: int) -> None:
    """With an edge that is mixed with the background."""
    pixels[row, begin:end] = color
    pixels[row + 1, begin:end] = 0.4 * np.array(color) + 0.6 * np.array((13.0, 16.0, 17.0))


LINES = ("error", "torque")
SEEN = {"fault": True, "good": True, "red": False, "limit": True}


def test_a_page_as_it_should_be() -> None:
    assert complaints(Picture(page()), LINES, SEEN) == []


@pytest.mark.parametrize(("begin", "end", "gap"), [(700, 705, False), (700, 712, True), (1150, 1240, False)])
def test_a_gap_in_a_curve_is_seen_left_of_its_legend(begin: int, end: int, gap: bool) -> None:
    pixels = page()
    line(pixels, CURVES["delay"], 800, 60, 1240)
    pixels[800:802, begin:end] = (13.0, 16.0, 17.0)
    assert complaints(Picture(pixels), (), {"gap": gap}) == []
    assert complaints(Picture(pixels), (), {"gap": not gap}) == ["a gap" if gap else "no gap"]


def blank(pixels: Pixels) -> None:
    pixels[:, :WIDTH] = (13.0, 16.0, 17.0)


def half_empty(pixels: Pixels) -> None:
    pixels[470:530, 60:700] = (13.0, 16.0, 17.0)


def half_empty_at_the_end(pixels: Pixels) -> None:
    pixels[470:530, 600:1240] = (13.0, 16.0, 17.0)


def without_a_curve(pixels: Pixels) -> None:
    pixels[660:710, :WIDTH] = (13.0, 16.0, 17.0)


def without_a_fault(pixels: Pixels) -> None:
    pixels[160:190, :WIDTH] = (13.0, 16.0, 17.0)


def with_a_red_bar(pixels: Pixels) -> None:
    bar(pixels, "red", 200, 400, 402)


def without_a_limit(pixels: Pixels) -> None:
    pixels[450:452] = (13.0, 16.0, 17.0)


def with_bars_that_are_hardly_there(pixels: Pixels) -> None:
    pixels[120:148, 100:1300] = np.array(BARS["good"]) * 0.55


def with_doubt_as_dark_as_what_is_bad(pixels: Pixels) -> None:
    pixels[160:188, 500:712] = np.array(BARS["fault"]) * 0.4
    bar(pixels, "red", 200, 400, 800)


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (with_bars_that_are_hardly_there, "from the ground to the colour-blind"),
        (with_doubt_as_dark_as_what_is_bad, "fault bars and red bars 10 apart to the colour-blind"),
        (blank, "blank but for"),
        (half_empty, "error from 52%"),
        (half_empty_at_the_end, "a gap of 48%"),
        (without_a_curve, "no torque"),
        (without_a_fault, "no fault bar"),
        (with_a_red_bar, "a red bar"),
        (without_a_limit, "no limit line"),
    ],
)
def test_what_is_wrong_is_found(spoil: Callable[[Pixels], None], found: str) -> None:
    pixels = page()
    spoil(pixels)
    assert found in "; ".join(complaints(Picture(pixels), LINES, SEEN))


# ---- a window -----------------------------------------------------------------------------------------

MARKS = (5 * NS_PER_MS, 15 * NS_PER_MS)
"""Of the cursor, at 300 and 900: a cycle of 1 ms is 60 px wide."""
BURST = Burst(8 * NS_PER_MS, 9 * NS_PER_MS)
"""From 480 to 600; the readings before and behind are at 420 and 600."""


def window(cursor: int, begin: int = 480, end: int = 600, gap: tuple[int, int] = (420, 600)) -> Picture:
    pixels = np.full((1080, 1920, 3), (13.0, 16.0, 17.0))
    bar(pixels, "red", 160, begin, end)
    for row, name in ((500, "error"), (700, "torque"), (900, "delay")):
        line(pixels, CURVES[name], row, 60, gap[0])
        line(pixels, CURVES[name], row, gap[1], 1340)
    pixels[90:1000, cursor] = 255.0
    return Picture(pixels)


@pytest.mark.parametrize(
    ("drawn", "found"),
    [
        ({}, []),
        ({"begin": 430, "end": 650}, []),  # less than a cycle
        ({"begin": 400}, ["a bar 1.3 ms from its rows at 0.008 s"]),
        ({"end": 700}, ["a bar 1.7 ms from its rows at 0.008 s"]),
        ({"end": 480}, ["no lane of dropouts"]),
        (
            {"gap": (540, 540)},
            [
                f"{name} goes on for 119 px where there was no reading"
                for name in ("error", "torque", "delay")
            ],
        ),
    ],
)
def test_a_bar_off_its_rows_and_a_line_across_a_gap_are_found(
    drawn: dict[str, Any], found: list[str]
) -> None:
    assert list(untrue(window(300, **drawn), window(900, **drawn), MARKS, [BURST])) == found


def test_every_kind_of_fault_and_every_limit_has_its_picture() -> None:
    names = [case.name for case in cases()]
    assert len(set(names)) == len(names)
    assert {f"fault-{kind}" for kind in TABLES} <= set(names)
    limits = set(VerdictLimits.__dataclass_fields__) - {"compute_us_max"}  # judged in real time alone
    assert {f"broken-{limit.removesuffix('_max')}" for limit in limits} <= set(names)
