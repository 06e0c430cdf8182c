"""By what the pages of a run are scaled, and which limits are lines in them: counted by hand."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.recording.whole_figures import WholeFigures, in_view
from servobench.hil.reviewing.envelope import Envelope
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.verdict.metrics import VerdictLimits
from tests.unit.hil.recording_tools import plan_for

STEP: Final = 100_000
"""ns; each row has a bucket of its own then."""
BEGIN, END = 0, 50 * STEP


def signal(*values: float) -> Envelope:
    made = Envelope()
    made.add(STEP * np.arange(len(values)), np.array(values, float))
    return made


def meter(
    *errors: float,
    settling: Sequence[tuple[int, int]] = (),
    peak: float | None = None,
    loaded: Sequence[tuple[int, int, float]] = (),
) -> dict[str, Any]:
    """Of an error; of a speed the largest reference is ``peak``, and ``loaded`` where a load changed."""
    told = {"counted": signal(*errors), "settling": list(settling)}
    return told if peak is None else {**told, "reference_peak": peak, "loaded": list(loaded)}


def figures(
    signals: Mapping[str, Sequence[float]] | None = None,
    speed: dict[str, Any] | None = None,
    position: dict[str, Any] | None = None,
    axis: AxisPlan | None = None,
    **limits: float | None,
) -> WholeFigures:
    """Of one axis with a deadline of 2 ms. ``signals``: by the path below it."""
    one = axis or AxisPlan("axis1", 1.0, rated_torque_nm=2.0)
    plan = replace(plan_for(Path()), review=ReviewPlan((one,), VerdictLimits(**limits)))
    seen = Review(plan.review)
    for shown, told in ((seen.errors[0], speed), (seen.positions[0], position)):
        for name, value in (told or meter()).items():
            setattr(shown, name, value)
    envelopes = {f"/axis1/{path}": signal(*values) for path, values in (signals or {}).items()}
    return WholeFigures(plan, envelopes, seen)


@pytest.mark.parametrize(
    ("limit", "signal_", "shown"), [(4.0, 1.0, True), (4.1, 1.0, False), (0.0, 0.0, True)]
)
def test_a_limit_four_times_the_signal_is_in_view(limit: float, signal_: float, shown: bool) -> None:
    assert in_view(limit, signal_) is shown


@pytest.mark.parametrize(
    ("signals", "ranges"),
    [
        ({}, {}),
        ({"speed/measured": [5.0, 5.0]}, {}),
        ({"speed/measured": [0.0, 8.0], "speed/reference": [2.0, 10.0]}, {"axis1/speed": (-1.5, 11.5)}),
        ({"speed/estimate": [0.0, 80.0]}, {}),
        (
            {"torque/measured": [-1.0], "torque/command": [0.0], "torque/load": [1.0], "torque/brake": [3.0]},
            {"axis1/torque": (-1.6, 3.6)},
        ),
        ({"position/measured": [0.0], "position/reference": [1.0]}, {"axis1/position": (-0.15, 1.15)}),
        # the deadline of 2000 us is in view from 500 us on
        ({"delay/delay": [300.0, 500.0]}, {"axis1/delay": (-160.0, 2300.0)}),
        ({"delay/delay": [300.0, 499.0]}, {"axis1/delay": (-0.08 * 499.0, 1.15 * 499.0)}),
        ({"delay/delay": [-1000.0, 3000.0]}, {"axis1/delay": (-1150.0, 3450.0)}),
        ({"delay/delay": [-100.0, 3000.0]}, {"axis1/delay": (-240.0, 3450.0)}),
        ({"delay/delay": [-5.0, -3.0]}, {"axis1/delay": (-5.75, -3.45)}),
    ],
)
def test_plots_are_as_wide_as_what_is_drawn(
    signals: dict[str, list[float]], ranges: dict[str, tuple[float, float]]
) -> None:
    found = figures(signals).ranges()
    assert list(found) == list(ranges)
    for plot, low_high in ranges.items():
        assert found[plot] == pytest.approx(low_high)


RPM: Final = RPM_PER_RAD_S


@pytest.mark.parametrize(
    ("errors", "percent", "reach"),
    [
        ([1.0], None, 1.0 * RPM),
        ([-1.0, 0.5], None, 1.0 * RPM),
        # 10 % of 20 rad/s are 2; 10 % of 50 are 5, too far away
        ([1.0], 10.0, 2.0 * RPM),
        ([3.0], 10.0, 3.0 * RPM),
        # of 100 rows 98 are within 1: the peak counts up to four times that
        ([1.0] * 98 + [3.9, 3.9], None, 3.9 * RPM),
        ([1.0] * 98 + [50.0, 50.0], None, 4.0 * RPM),
        ([1.0] * 97 + [50.0] * 3, None, 50.0 * RPM),
        ([0.0] * 98 + [7.0, 7.0], None, 7.0 * RPM),
    ],
)
def test_an_error_is_as_wide_as_what_counts_of_it(
    errors: list[float], percent: float | None, reach: float
) -> None:
    found = figures(speed=meter(*errors, peak=20.0), speed_error_peak_percent_max=percent).ranges()
    assert list(found) == ["axis1/error"]
    low, high = found["axis1/error"]
    # with a margin of 0.15 on each side, or up to the next power of ten where that has more than three steps
    most = 1.3 * reach
    decade = 10.0 ** np.floor(np.log10(most))
    expected = 13.0 * decade if most > 3.0 * decade else most
    assert (low, high) == pytest.approx((-expected, expected))


def test_an_error_of_nothing_has_no_range_and_a_far_limit_widens_none() -> None:
    assert figures(speed=meter(0.0, 0.0, peak=20.0)).ranges() == {}
    found = figures(position=meter(0.1), position_error_peak_rad_max=0.41).ranges()
    assert found == {"axis1/position_error": pytest.approx((-0.13, 0.13))}
    found = figures(position=meter(0.1), position_error_peak_rad_max=0.2).ranges()
    assert found == {"axis1/position_error": pytest.approx((-0.26, 0.26))}


LIMITED: Final = AxisPlan("axis1", 1.0, rated_torque_nm=2.0, torque_max_nm=5.0, speed_max_rad_s=100.0)


def lines(found: WholeFigures) -> dict[str, tuple[list[int], list[float]]]:
    """Times in steps."""
    return {
        path: ((times // STEP).tolist(), values.tolist())
        for path, (times, values) in found.limit_lines(BEGIN, END).items()
    }


@pytest.mark.parametrize(("delay", "drawn"), [(500.0, True), (499.0, False)])
def test_the_deadline_is_a_line_where_delays_come_near(delay: float, drawn: bool) -> None:
    expected = {"/axis1/delay/deadline": ([0, 50], [2000.0, 2000.0])}
    assert lines(figures({"delay/delay": [10.0, delay]})) == (expected if drawn else {})


@pytest.mark.parametrize(
    ("path", "value", "limit"),
    [
        ("torque/measured", 4200.0, 5000.0),
        ("torque/command", -4200.0, 5000.0),
        ("torque/load", 4200.0, 5000.0),
        ("torque/brake", 4200.0, 5000.0),
        ("speed/measured", -800.0, 100.0 * RPM),
        ("speed/reference", 800.0, 100.0 * RPM),
    ],
)
def test_a_limit_of_the_drive_is_a_line_where_it_is_nearly_reached(
    path: str, value: float, limit: float
) -> None:
    """Up to 1.2 times the signal: from 4167 mN m and 796 r/min on."""
    plot = path.partition("/")[0]
    found = lines(figures({path: [0.0, value]}, axis=LIMITED))
    assert found == {
        f"/axis1/{plot}/most": ([0, 50], [limit, limit]),
        f"/axis1/{plot}/least": ([0, 50], [-limit, -limit]),
    }
    assert lines(figures({path: [0.0, 0.98 * value]}, axis=LIMITED)) == {}
    assert lines(figures({path: [0.0, value]})) == {}, "without a limit"


def test_a_limit_after_a_load_is_a_line_where_it_counts_alone_and_beside_the_other() -> None:
    """5 % of 20 rad/s from step 10 to 30, but not while the speed settles; 10 % of the peak elsewhere."""
    loaded = [(10 * STEP, 30 * STEP, 20.0)]
    speed = meter(0.5, peak=20.0, settling=[(15 * STEP, 20 * STEP)], loaded=loaded)
    alone = figures(speed=speed, after_load_percent_max=5.0)
    times, values = alone.limit_lines(BEGIN, END)["/axis1/error/most"]
    assert (times // STEP).tolist() == [10, 15, 15, 20, 30]
    assert values[[0, 1, 3, 4]] == pytest.approx([RPM] * 4)
    assert np.isnan(values[2])
    assert alone.remarks()["axis1/error"] == " · limit ±9.55 after load"
    both = figures(speed=speed, after_load_percent_max=5.0, speed_error_peak_percent_max=10.0)
    times, values = both.limit_lines(BEGIN, END)["/axis1/error/least"]
    shown = [None if np.isnan(value) else round(-value / RPM, 6) for value in values]
    assert (times // STEP).tolist() == [0, 10, 10, 10, 15, 15, 20, 30, 30, 30, 50]
    assert shown == [2.0, 2.0, None, 1.0, 1.0, None, 1.0, 1.0, None, 2.0, 2.0]
    assert both.remarks()["axis1/error"] == " · limit ±19.1, 9.55 after load"


def test_a_position_s_limit_is_a_line_in_its_own_unit() -> None:
    found = lines(figures(position=meter(0.1), position_error_peak_rad_max=0.3))
    assert found == {
        "/axis1/position_error/most": ([0, 50], [0.3, 0.3]),
        "/axis1/position_error/least": ([0, 50], [-0.3, -0.3]),
    }
