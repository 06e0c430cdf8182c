"""The lanes of a run: where each stands, in which colours, and from when on each of its labels holds."""

from collections.abc import Sequence
from itertools import combinations
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.recording.lanes import (
    FaultWindows,
    dropout_lane,
    error_lane,
    in_order,
    lane_colors,
)
from servobench.hil.recording.page_series import AXIS_COLORS, LIMIT_SERIES, SERIES
from servobench.hil.reviewing.envelope import CodeLane, Envelope
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import LabelChange
from servobench.hil.verdict.metrics import VerdictLimits
from tests.colour_sight import apart, contrast

AXES: Final = ("axis1", "left arm")
RED, GOOD, AMBER, DIM, NOTHING = 0xD7230AFF, 0x1565C0FF, 0xFFFA46FF, 0x9C9FA4FF, 0x00000000


def test_lanes_are_ordered_by_what_they_tell() -> None:
    """A low screen cuts off the last."""
    tracks = [
        *(
            "verdict",
            "axis1 error",
            "left arm error",
            "axis1 dropouts",
            "injected loss",
            "axis1 link",
            "host",
        ),
        *("axis1 drive", "left arm drive", "phase"),
        *("axis1 mode", "axis2 drive", "drive"),
    ]
    assert in_order(sorted(tracks), AXES) == tracks


@pytest.mark.parametrize(
    ("track", "some"),
    [
        ("verdict", {"-": NOTHING, "Passed": GOOD, "Not passed": RED, "Completed, nothing was asked": DIM}),
        ("axis1 error", {"-": NOTHING, "Settling": DIM, "Not judged": DIM, "Kept": GOOD, "BEYOND": RED}),
        ("axis1 drive", {"Unknown": DIM, "Fault reaction active": RED, "Operation enabled": GOOD}),
        ("phase", {"Running": 0x2E7D6BFF, "Stopped": DIM}),
        ("axis1 link", {"OK": GOOD, "DEGRADED": AMBER, "DOWN": RED}),
        ("axis1 dropouts", {"-": NOTHING, "Lost": RED, "Lost, few": 0x6B1105FF, "Missed": 0x1E00FFFF}),
        ("host", {"In time": GOOD, "MISSED": RED}),
        ("injected loss", {"-": NOTHING, "Injected": AMBER}),
    ],
)
def test_what_is_wrong_is_red_and_what_is_well_is_blue(track: str, some: dict[str, int]) -> None:
    colors = lane_colors(track, AXES)
    assert {label: colors[label] for label in some} == some


def test_the_viewer_chooses_where_nobody_knows_the_labels() -> None:
    assert lane_colors("axis1 mode", AXES) == {}


def changes(*pairs: tuple[int, str]) -> list[LabelChange]:
    return [LabelChange(at, label) for at, label in pairs]


def test_dropouts_by_their_gravest_cause() -> None:
    lane = CodeLane()
    lane.add(np.arange(8) * NS_PER_MS, np.array([0, 1, 1, 0, 2, 3, 4, 0]))
    found = [(change.at / NS_PER_MS, change.label) for change in dropout_lane(lane)]
    assert found == [
        (0, "-"), (1, "Lost"), (3, "-"), (4, "Late"), (5, "Stale"), (6, "Missed"), (7, "-")
    ]  # fmt: skip


@pytest.mark.parametrize(("lost", "label"), [(0, "-"), (9, "Lost, few"), (10, "Lost")])
def test_less_than_a_tenth_of_a_stretch_is_few(lost: int, label: str) -> None:
    lane = CodeLane()
    codes = np.zeros(100, np.int64)
    codes[:lost] = 1
    lane.add(np.arange(100), codes)
    assert dropout_lane(lane) == changes((0, label))


# ---- injected faults ----------------------------------------------------------------------------------


def lanes(windows: Sequence[tuple[str, int, int | None]], first: int = 0, last: int = 400) -> dict[str, Any]:
    """``windows``: the track behind ``injected``, from when, and until when."""
    faults = FaultWindows()
    told = [(start, 0, f"injected {track}", "active") for track, start, _ in windows]
    told += [(end, 1, f"injected {track}", "-") for track, _, end in windows if end is not None]
    for at, _, track, label in sorted(told):
        faults.take(track, label, at)
    return dict(faults.lanes(first, last))


@pytest.mark.parametrize(
    ("windows", "lane"),
    [
        ([("loss: a", 10, 20)], [(0, "-"), (10, "Injected"), (20, "-")]),
        # to be seen, a fault is a 400th of the run wide at least
        ([("loss: a", 10, 10)], [(0, "-"), (10, "Injected"), (11, "-")]),
        ([("loss: a", 10, 20), ("loss: b", 15, 30)], [(0, "-"), (10, "Injected"), (30, "-")]),
        ([("loss: a", 10, 40), ("loss: b", 15, 30)], [(0, "-"), (10, "Injected"), (40, "-")]),
        ([("loss: a", 10, 20), ("loss: b", 20, 30)], [(0, "-"), (10, "Injected"), (30, "-")]),
        (
            [("loss: b", 21, 30), ("loss: a", 10, 20)],
            [(0, "-"), (10, "Injected"), (20, "-"), (21, "Injected"), (30, "-")],
        ),
        ([("loss: a", 390, None)], [(0, "-"), (390, "Injected"), (400, "-")]),
    ],
)
def test_faults_of_one_kind_share_a_lane_wherever_they_strike(
    windows: list[tuple[str, int, int | None]], lane: list[tuple[int, str]]
) -> None:
    assert lanes(windows) == {"injected loss": changes(*lane)}


def test_each_kind_has_its_own_lane_in_the_order_of_their_names() -> None:
    found = lanes([("loss: a", 10, 20), ("delay", 5, 7)], first=-100, last=0)
    assert list(found) == ["injected delay", "injected loss"]
    assert found["injected delay"] == changes((-100, "-"), (5, "Injected"), (7, "-"))


def test_a_fault_that_is_told_again_began_the_first_time_and_one_that_never_began_is_none() -> None:
    faults = FaultWindows()
    faults.take("injected loss", "active", 10)
    faults.take("injected loss", "more", 15)
    faults.take("injected loss", "-", 20)
    faults.take("injected loss", "-", 25)
    assert faults.lanes(0, 400) == {"injected loss": changes((0, "-"), (10, "Injected"), (20, "-"))}


BLACK, WHITE = 0, 255
VIEWERS = 0.78
"""Share of a bar's colour in what the viewer draws; the rest is its ground's."""


def rgb(rgba: int) -> tuple[int, int, int]:
    return rgba >> 24 & 255, rgba >> 16 & 255, rgba >> 8 & 255


@pytest.mark.parametrize(
    ("track", "labels"),
    [
        ("verdict", ("Passed", "Not passed")),
        ("axis1 drive", ("Operation enabled", "Fault reaction active")),
        ("axis1 drive", ("Operation enabled", "Fault")),
        ("axis1 link", ("OK", "DEGRADED", "DOWN")),
        ("host", ("In time", "MISSED")),
        ("limits", ("Kept", "BROKEN")),
        ("axis1 error", ("Kept", "BEYOND", "Settling")),
        ("axis1 dropouts", ("Lost", "Late", "Stale", "Missed")),
    ],
)
@pytest.mark.parametrize("ground", [BLACK, WHITE])
def test_good_and_bad_differ_for_the_colour_blind_too_as_the_viewer_draws_them(
    track: str, labels: Sequence[str], ground: int
) -> None:
    colors = [VIEWERS * np.array(rgb(lane_colors(track, AXES)[each])) for each in labels]
    drawn = [each + (1.0 - VIEWERS) * ground for each in colors]
    for one, other in combinations(drawn, 2):
        assert apart(one, other) >= 40.0
    for each, label in zip(drawn, labels, strict=True):
        assert apart(each, (ground,) * 3) >= (25.0 if label == "Settling" else 40.0)


DARK_GROUND, LIGHT_GROUND = (13, 16, 17), (255, 255, 255)
"""Grounds of the viewer's plots."""


@pytest.mark.parametrize(
    "plot", ["speed", "error", "position", "position_error", "torque", "delay", "commands", "clock"]
)
def test_lines_of_a_plot_differ_for_the_colour_blind_too_and_are_seen_on_both_grounds(plot: str) -> None:
    lines = {each.color for each in (*SERIES, *LIMIT_SERIES) if each.path.startswith(f"{plot}/")}
    for one, other in combinations(sorted(lines), 2):
        assert apart(one, other) >= 40.0
    for color in lines:
        assert contrast(color, DARK_GROUND) >= 2.9
        assert contrast(color, LIGHT_GROUND) >= 1.65


def test_axes_in_one_plot_differ_for_the_colour_blind_too() -> None:
    for one, other in combinations(AXIS_COLORS, 2):
        assert apart(one, other) >= 40.0


# ---- errors -------------------------------------------------------------------------------------------


class Meter:
    """An error over time, and when it did not count."""

    def __init__(self, errors: Sequence[float], settling: Sequence[tuple[int, int]], peak: float) -> None:
        self.counted, self.after_load, self.following = Envelope(), Envelope(), Envelope()
        self.settling = list(settling)
        self.loaded: list[tuple[int, int, float]] = []
        self.reference_peak = peak
        self._errors = errors
        if len(errors):
            self.counted.add(STEP * np.arange(len(errors)), np.array(errors))


ON_TIME: Final = SimpleNamespace(late=[], overshot=[])
STEP: Final = 100_000
"""ns; each row has a bucket of its own then."""


def judged(
    errors: Sequence[float],
    settling: Sequence[tuple[int, int]] = (),
    percent: float | None = 10.0,
    quantity: str = "speed",
    rad: float | None = None,
) -> list[tuple[float, str]]:
    """The lane of an error of an axis whose reference reaches 50 rad/s; times in steps."""
    meter = Meter(errors, [(a * STEP, b * STEP) for a, b in settling], 50.0)
    other = Meter([], [], 0.0)
    positions = quantity == "position"
    review = SimpleNamespace(
        errors=[other, Meter([], [], 50.0) if positions else meter],
        positions=[other, meter],
        steps=[ON_TIME, ON_TIME],
    )
    limits = VerdictLimits(speed_error_peak_percent_max=percent, position_error_peak_rad_max=rad)
    axes = (AxisPlan("a", 1.0), AxisPlan("b", 1.0, quantity=quantity))
    lane = error_lane(cast(Review, review), ReviewPlan(axes, limits), 1, 0, 10 * STEP)
    return [(change.at / STEP, change.label) for change in lane]


@pytest.mark.parametrize(
    ("errors", "settling", "lane"),
    [
        ([4.0, 5.0, 4.0], [], [(0, "Kept"), (0, "Kept"), (10, "-")]),
        ([4.0, 5.1, 4.0], [], [(0, "Kept"), (0, "Kept"), (1, "BEYOND"), (2, "Kept"), (10, "-")]),
        (
            [4.0] * 9,
            [(2, 5)],
            [(0, "Kept"), (0, "Kept"), (2, "Settling"), (5, "Kept"), (10, "-")],
        ),
        ([4.0] * 9, [(2, 10)], [(0, "Kept"), (0, "Kept"), (2, "Settling"), (10, "-")]),
        # what it was last judged to be holds again behind the window, wherever in it that changed
        (
            [4.0, 4.0, 4.0, 9.0, 9.0, 9.0, 9.0, 4.0],
            [(2, 5)],
            [
                (0, "Kept"),
                (0, "Kept"),
                (2, "Settling"),
                (5, "BEYOND"),
                (7, "Kept"),
                (10, "-"),
            ],
        ),
    ],
)
def test_an_error_is_kept_or_beyond_or_does_not_count(
    errors: list[float], settling: list[tuple[int, int]], lane: list[tuple[float, str]]
) -> None:
    """10 % of 50 rad/s."""
    assert judged(errors, settling) == lane
    limited_by_position = judged(errors, settling, None, "position", 5.0)
    assert limited_by_position == lane


@pytest.mark.parametrize(
    ("peak", "after", "lane"),
    [
        (
            None,
            15.0,
            [
                (0, "Not judged"),
                (0, "Not judged"),
                (3, "Kept"),
                (4, "BEYOND"),
                (5, "Kept"),
                (7, "Not judged"),
            ],
        ),
        (10.0, 15.0, [(0, "Kept"), (0, "Kept"), (1, "BEYOND"), (2, "Kept"), (4, "BEYOND"), (5, "Kept")]),
        (10.0, 25.0, [(0, "Kept"), (0, "Kept"), (1, "BEYOND"), (2, "Kept")]),
        (None, None, [(0, "Not judged")]),
    ],
)
def test_an_error_after_a_load_is_held_against_its_own_limit(
    peak: float | None, after: float | None, lane: list[tuple[float, str]]
) -> None:
    """From the fourth cycle to the seventh, as shares of a reference of 20 rad/s; it reached 50."""
    meter = Meter([1.0, 6.0, 1.0, 1.0, 4.0, 1.0, 1.0, 1.0], [], 50.0)
    meter.after_load.add(STEP * np.arange(3, 7), np.array([1.0, 4.0, 1.0, 1.0]) / 20.0)
    limits = VerdictLimits(speed_error_peak_percent_max=peak, after_load_percent_max=after)
    review = SimpleNamespace(errors=[meter], positions=[Meter([], [], 0.0)], steps=[ON_TIME])
    found = error_lane(cast(Review, review), ReviewPlan((AxisPlan("a", 1.0),), limits), 0, 0, 10 * STEP)
    assert [(change.at / STEP, change.label) for change in found] == [*lane, (10, "-")]


def test_without_a_limit_nothing_is_judged() -> None:
    assert judged([9.0] * 3, [(1, 4)], None) == [
        (0, "Not judged"),
        (1, "Settling"),
        (4, "Not judged"),
        (10, "-"),
    ]
    assert judged([9.0], [], 10.0, "position", None) == [(0, "Not judged"), (10, "-")]


def test_what_breaks_a_limit_of_a_step_response_is_seen_while_it_settles() -> None:
    meter = Meter([4.0] * 9, [(2 * STEP, 8 * STEP)], 50.0)
    steps = SimpleNamespace(
        overshot=[(3 * STEP, 5 * STEP)], late=[(4 * STEP, 7 * STEP), (9 * STEP, 10 * STEP)]
    )
    review = SimpleNamespace(errors=[meter], positions=[Meter([], [], 0.0)], steps=[steps])
    limits = VerdictLimits(speed_error_peak_percent_max=10.0)
    found = error_lane(cast(Review, review), ReviewPlan((AxisPlan("a", 1.0),), limits), 0, 0, 10 * STEP)
    assert [(change.at // STEP, change.label) for change in found[2:]] == [
        (2, "Settling"),
        (3, "BEYOND"),
        (4, "LATE"),
        (7, "Settling"),
        (8, "Kept"),
        (9, "LATE"),
        (10, "-"),
    ]


@pytest.mark.parametrize("settles", [False, True])
def test_an_axis_that_follows_is_held_against_the_limit_of_that_too(settles: bool) -> None:
    meter = Meter([0.1] * 9, [(0, 9 * STEP)] if settles else [], 0.0)
    meter.following.add(STEP * np.arange(3), np.array([0.1, 0.3, 0.1]))
    review = SimpleNamespace(errors=[meter], positions=[meter], steps=[ON_TIME])
    limits = VerdictLimits(position_error_peak_rad_max=1.0, following_error_peak_rad_max=0.2)
    axes = (AxisPlan("a", 1.0, quantity="position"),)
    found = error_lane(cast(Review, review), ReviewPlan(axes, limits), 0, 0, 10 * STEP)
    beside = "Settling" if settles else "Kept"
    assert [
        (change.at // STEP, change.label) for change in found if change.label != "Kept" or not settles
    ] == [
        *([] if settles else [(0, "Kept")]),
        (0, beside),
        (1, "BEYOND"),
        (2, beside),
        (10, "-"),
    ]


@pytest.mark.parametrize(("windows", "shown"), [(100, True), (101, False)])
def test_of_more_windows_than_can_be_seen_none_is_shown(windows: int, shown: bool) -> None:
    found = judged([4.0], [(place, place) for place in range(windows)])
    assert any(label == "Settling" for _, label in found) is shown
    if not shown:
        assert found == [(0, "Kept"), (0, "Kept"), (10, "-")]
