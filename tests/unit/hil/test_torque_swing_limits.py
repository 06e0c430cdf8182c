"""Where a torque begins to swing: each limit met, and missed by a little; lines against Parseval."""

from typing import Any

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.reviewing.torque_swing import BLOCK, WINDOW, Swing, TorqueSwingMeter, strongest_line
from servobench.hil.rows.recording_plan import AxisPlan
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_torque_swing import AXIS, RATED_NM, SETTLING, Array, meter_of, rows_with

STEADY = SETTLING // NS_PER_MS
"""Cycles of 1 ms before the first that counts."""
NYQUIST = np.where(np.arange(WINDOW) % 2 == 0, 1.0, -1.0)


def near(value: float) -> Any:
    return pytest.approx(value)


def sine(periods: int, amplitude: float = 1.0, count: int = WINDOW) -> Array:
    """So many periods in a window."""
    wave: Array = amplitude * np.sin(2.0 * np.pi * periods * np.arange(count) / WINDOW + 0.3)
    return wave


@pytest.mark.parametrize("periods", [1, 16, 100, WINDOW // 2 - 1])
def test_a_sine_has_all_its_power_in_its_line_and_the_two_beside_it(periods: int) -> None:
    assert strongest_line(5.0 + sine(periods)) == (periods, near(1.0))


def test_power_is_one_sided() -> None:
    """A sine has half the square of its amplitude as its power, what alternates the whole square."""
    assert strongest_line(NYQUIST) == (WINDOW // 2, near(1.0))
    assert strongest_line(NYQUIST + sine(40)) == (WINDOW // 2, near(2.0 / 3.0))
    two = strongest_line(sine(40, 2.0) + sine(80, 1.0))
    assert two == (40, near(4.0 / 5.0))


def test_what_does_not_move_has_no_line() -> None:
    assert strongest_line(np.full(WINDOW, 3.0)) == (0, 0.0)
    assert strongest_line(np.zeros(BLOCK)) == (0, 0.0)


def swings(torque: Array) -> list[Swing]:
    """Of torques that count from the first on."""
    return meter_of(rows_with(np.concatenate([np.zeros(STEADY), torque]))).take_swings()


def at_block(number: int) -> int:
    """When the last cycle of a block was due, counted from 1."""
    return SETTLING + (number * BLOCK - 1) * NS_PER_MS


@pytest.mark.parametrize(
    ("share", "at"), [(0.0499, None), (0.0501, 4), (0.2499, 4), (0.2501, 1)], ids=lambda value: f"{value}"
)
def test_a_line_is_told_by_its_window_and_more_than_noise_at_once(share: float, at: int | None) -> None:
    told = swings(share * RATED_NM * NYQUIST)
    assert [each.at for each in told] == ([] if at is None else [at_block(at)])
    for each in told:
        assert each.rms_nm == pytest.approx(share * RATED_NM)
        assert each.frequency_hz == pytest.approx(500.0)
        assert each.share == pytest.approx(1.0)


@pytest.mark.parametrize(("periods", "told"), [(15, False), (16, True)])
def test_a_line_has_sixteen_periods_in_a_window_at_least(periods: int, told: bool) -> None:
    found = swings(sine(periods, 0.1 * RATED_NM))
    assert [each.at for each in found] == [at_block(4)] * told
    for each in found:
        assert each.frequency_hz == pytest.approx(1_000.0 * periods / WINDOW)


@pytest.mark.parametrize(("other", "told"), [(0.9, False), (0.5, True)])
def test_three_quarters_of_the_power_are_in_the_line(other: float, told: bool) -> None:
    """Of two sines the larger has 1 / (1 + other^2): 55 and 80 %."""
    found = swings(0.1 * RATED_NM * (sine(40) + other * sine(90)))
    assert [each.share for each in found] == [pytest.approx(1.0 / (1.0 + other**2))] * told


def test_the_window_ends_with_the_block_that_is_judged() -> None:
    """Four still blocks, then four that swing."""
    quiet = np.zeros(4 * BLOCK)
    (swing,) = swings(np.concatenate([quiet, 0.1 * RATED_NM * NYQUIST]))
    assert at_block(5) <= swing.at <= at_block(8)
    assert (swing.at - SETTLING + NS_PER_MS) % (BLOCK * NS_PER_MS) == 0
    assert swing.frequency_hz == pytest.approx(500.0, abs=1_000.0 / WINDOW)


def test_the_largest_block_is_the_first_of_its_size() -> None:
    blocks = [np.zeros(BLOCK), *(0.04 * RATED_NM * NYQUIST[:BLOCK],) * 2, 0.02 * NYQUIST[:BLOCK]]
    meter = meter_of(rows_with(np.concatenate([np.zeros(STEADY), *blocks])))
    assert (meter.worst.value, meter.worst.at) == (near(0.04 * RATED_NM), at_block(2))


@pytest.mark.parametrize(("count", "rms"), [(BLOCK - 1, None), (BLOCK, 1.0)])
def test_a_block_counts_when_it_is_whole(count: int, rms: float | None) -> None:
    meter = meter_of(rows_with(np.concatenate([np.zeros(STEADY), NYQUIST[:count]])))
    assert (meter.worst.value, meter.worst.at) == (rms, None if rms is None else at_block(1))


def test_without_a_rated_torque_nothing_is_told() -> None:
    meter = TorqueSwingMeter(AxisPlan("axis1", 1.0), SETTLING)
    meter.add(rows_with(100.0 * np.resize(NYQUIST, 1_000)))
    assert (meter.worst.value, meter.take_swings()) == (100.0, [])


def test_no_rows_and_rows_without_a_command_are_nothing() -> None:
    meter = TorqueSwingMeter(AXIS, SETTLING)
    meter.add(plain_rows(0))
    rows = rows_with(np.resize(NYQUIST, 1_000))
    rows["command_expires_at"] = np.iinfo(np.int64).min
    meter.add(rows)
    assert (meter.worst.value, meter.worst.at, meter.take_swings()) == (None, None, [])


def test_after_a_change_a_swing_is_told_again() -> None:
    rows = rows_with(np.resize(NYQUIST, 2 * (STEADY + BLOCK)))
    rows["load_torque_nm"][STEADY + BLOCK :] = 0.5
    second = at_block(1) + (STEADY + BLOCK) * NS_PER_MS
    assert [each.at for each in meter_of(rows).take_swings()] == [at_block(1), second]


def test_a_swing_is_told_in_words() -> None:
    assert Swing(0, 1.23456, 123.456, 0.876).describe() == (
        "the torque swings by 1.23 N m rms about its mean while speed and load stay, 88 % of it at 123 Hz: a "
        "limit cycle, unless the load swings so"
    )
