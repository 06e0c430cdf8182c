"""A certificate's figures where they begin to count: errors are constant, so that every gain is exact."""

from dataclasses import replace

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.rows.recording_plan import AxisPlan, CertifiedPlan
from servobench.hil.rows.records import Rows
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_certificate_meter import AXIS, CERTIFIED, REFERENCE_RAD_S, SETTLING, exact, meter_of

STRETCH = 200
"""Cycles of 1 ms, of which the first hundred settle."""
OFFSET_RAD_S = 3.0


def stretches(*loads_and_errors: tuple[float, float]) -> Rows:
    """Of one load and speed error each."""
    load = np.repeat([load for load, _ in loads_and_errors], STRETCH)
    error = np.repeat([error for _, error in loads_and_errors], STRETCH)
    return exact(plain_rows(load.size, REFERENCE_RAD_S, REFERENCE_RAD_S - error, load))


def step(gain: float, torque_nm: float = 0.5) -> Rows:
    return stretches((0.0, OFFSET_RAD_S), (torque_nm, OFFSET_RAD_S + gain * torque_nm))


def seen(rows: Rows, axis: AxisPlan = AXIS) -> tuple[float | None, float | None]:
    meter = meter_of(rows, axis=axis)
    return meter.gain_seen, meter.gain_least


def certified(**changes: object) -> AxisPlan:
    plan: CertifiedPlan = replace(CERTIFIED, **changes)  # type: ignore[arg-type]
    return replace(AXIS, certified=plan)


def test_the_figures_of_a_run_are_whole() -> None:
    assert meter_of(step(12.0)).figures() == {
        "action_delay_us": {"certified": 800.0, "seen": 500.0, "seen_at_most": 500.0},
        "losses_together": {"certified": 2, "seen": 0, "seen_at_most": 0},
        "gain_rad_s_nm": {"certified": 17.0, "seen": 12.0, "seen_at_least": 12.0},
        "current_bandwidth_hz": {"certified": [504.0, 1269.0], "drive": 800.0},
        "commands_at_a_limit": 0,
        "premises_left": [],
        "premises_unknown": [],
        "state": "kept",
    }


def test_before_the_first_row_nothing_is_known() -> None:
    unknown = {
        "action_delay_us": {"certified": None, "seen": None, "seen_at_most": None},
        "losses_together": {"certified": None, "seen": 0, "seen_at_most": 0},
        "gain_rad_s_nm": {"certified": None, "seen": None, "seen_at_least": None},
        "current_bandwidth_hz": {"certified": None, "drive": None},
        "commands_at_a_limit": 0,
        "premises_left": [],
        "premises_unknown": [],
        "state": "not measured",
    }
    bare = replace(AXIS, certified=CertifiedPlan(period_us=1_000))
    meter = meter_of(plain_rows(0), axis=bare)
    assert meter.figures() == unknown
    assert meter_of().figures()["premises_unknown"] == ["delay: from sample to actuator nothing was measured"]


@pytest.mark.parametrize("torque_nm", [0.5, -0.5, 0.25, -0.25])
def test_the_gain_is_the_error_about_its_mean_over_the_step(torque_nm: float) -> None:
    assert seen(step(12.0, torque_nm)) == (12.0, 12.0)
    assert seen(step(-12.0, torque_nm)) == (12.0, 12.0)


@pytest.mark.parametrize(("gains", "most"), [((12.0, 4.0), 12.0), ((4.0, 12.0), 12.0), ((0.0, 0.0), 0.0)])
def test_of_several_steps_the_largest_gain_counts(gains: tuple[float, float], most: float) -> None:
    first, second = gains
    loaded = OFFSET_RAD_S + 0.5 * first
    rows = stretches((0.0, OFFSET_RAD_S), (0.5, loaded), (0.25, loaded - 0.25 * second))
    assert seen(rows) == (most, most)


@pytest.mark.parametrize(("readings", "gain"), [(19, None), (20, 12.0)])
def test_twenty_settled_readings_make_a_steady_run(readings: int, gain: float | None) -> None:
    assert seen(step(12.0)[STRETCH // 2 - readings :]) == (gain, gain)


@pytest.mark.parametrize(("rated_nm", "gain"), [(None, 12.0), (50.0, 12.0), (50.01, None)])
def test_a_step_is_a_hundredth_of_the_rated_torque_at_least(
    rated_nm: float | None, gain: float | None
) -> None:
    assert seen(step(12.0), replace(AXIS, rated_torque_nm=rated_nm)) == (gain, gain)


def test_a_reading_counts_for_the_mean_from_the_settling_time_on() -> None:
    """The last reading that does not may be anything."""
    rows = step(12.0)
    last = SETTLING // NS_PER_MS - 1
    rows["velocity_rad_s"][last] -= 50.0
    assert seen(rows) == (12.0, 12.0)
    rows["velocity_rad_s"][last + 1] -= 50.0
    gain, least = seen(rows)
    assert gain is not None
    assert gain != 12.0
    assert least == 0.0, "so much noise may make all of it"


@pytest.mark.parametrize(("gain", "told"), [(17.0, False), (17.5, True)])
def test_a_gain_beyond_the_certified_one_is_told_once_with_its_instant(gain: float, told: bool) -> None:
    rows = step(gain)
    text = f"the gain from load to speed error is {gain:g} rad/s per N m, certified 17"
    for lost in (0, 1):
        rows["fate"][STRETCH : STRETCH + lost] = 1
        meter = meter_of(rows)
        at = (STRETCH + lost) * NS_PER_MS
        assert meter.take_exceeded() == ((at, text) if told else None)
        assert meter.take_exceeded() is None
    assert meter_of(step(gain)).figures()["state"] == ("exceeded" if told else "kept")


def test_a_certificate_without_a_gain_is_not_exceeded() -> None:
    meter = meter_of(step(1_000.0), axis=certified(gain=None))
    assert (meter.take_exceeded(), meter.gain_seen) == (None, 1_000.0)
    assert meter.figures()["state"] == "not measured"


def test_readings_that_did_not_come_are_in_no_figure() -> None:
    rows = step(12.0)
    rows["velocity_rad_s"][::3] = 1e6
    rows["fate"][::3] = 1
    assert seen(rows) == (12.0, 12.0)
    rows["fate"][STRETCH:] = 1
    assert seen(rows) == (None, None)


@pytest.mark.parametrize(
    ("torque_nm", "limited"), [(5.0, 1), (-5.0, 1), (5.0 * (1.0 - 1e-10), 1), (4.99999, 0), (float("nan"), 0)]
)
def test_a_command_is_at_a_limit_but_for_rounding(torque_nm: float, limited: int) -> None:
    rows = step(12.0)
    rows["command_torque_nm"][STRETCH + 5] = torque_nm
    assert meter_of(rows).figures()["commands_at_a_limit"] == limited
    before = step(12.0)
    before["command_torque_nm"][STRETCH - 5] = torque_nm
    assert meter_of(before).figures()["commands_at_a_limit"] == 0


def test_every_command_counts_of_which_the_drive_tells_a_limit() -> None:
    """Bit 11 of the statusword, CiA 402-2; a reading without one tells nothing."""
    rows = step(12.0)
    rows["statusword"][STRETCH - 2 : STRETCH + 3] |= 1 << 11
    assert meter_of(rows).figures()["commands_at_a_limit"] == 3
    rows["statusword"][STRETCH] = NOTHING
    assert meter_of(rows).figures()["commands_at_a_limit"] == 2
    rows["command_torque_nm"][STRETCH + 1] = 5.0
    assert meter_of(rows).figures()["commands_at_a_limit"] == 3, "by both"


def test_a_step_of_the_command_is_from_the_one_before_whatever_the_stretch() -> None:
    rows = step(12.0)
    rows["command_torque_nm"][STRETCH - 1 :] = 2.0
    axis = certified(torque_step_max_nm=1.0)
    for size in (1, STRETCH, 2 * STRETCH):
        meter = meter_of(*[rows[at : at + size] for at in range(0, rows.size, size)], axis=axis)
        assert meter.figures()["commands_at_a_limit"] == 0, "it changed before the load did"
    rows["command_torque_nm"][-1] = 3.0
    meter = meter_of(rows, axis=axis)
    assert meter.figures()["premises_left"] == ["saturation: 1 commands at a limit after a load step"]


@pytest.mark.parametrize(
    ("changes", "left"),
    [
        ({"delay_us": 500.0}, []),
        ({"delay_us": 499.9}, ["delay: 500.0 us from sample to actuator, made for 499.9 us"]),
        ({"delay_us": 510.0, "samples_alone": True}, []),
        (
            {"delay_us": 510.1, "samples_alone": True},
            ["constant delay: 500.0 us from sample to actuator, certified for 510.1 us alone"],
        ),
        ({"age_us": 1_500.0}, []),
        ({"age_us": 1_499.0}, ["age: a sample that acts for 1500.0 us, made for at most 1499 us"]),
        ({"left": ("inertia: of another motor",)}, ["inertia: of another motor"]),
    ],
)
def test_premises_are_left_by_the_least_that_is_too_much(changes: dict[str, object], left: list[str]) -> None:
    meter = meter_of(step(12.0), axis=certified(**changes))
    figures = meter.figures()
    assert (figures["premises_left"], figures["premises_unknown"]) == (left, [])
    assert figures["state"] == ("premise left" if left else "kept")
