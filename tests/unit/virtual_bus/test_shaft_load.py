"""A load over time that the simulated shaft bears by itself, and how a master begins it."""

import random
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters
from servobench.virtual_bus.drive.load_object import LoadTable
from tests.motors import LING

FloatArray = NDArray[np.float64]
RATE_HZ = 16_000
FREE = replace(LING, coulomb_friction_nm=0.0, viscous_friction_nm_s=0.0)


def drawn_points(points: int) -> tuple[FloatArray, FloatArray]:
    draw = random.Random(7)
    times = np.cumsum([draw.uniform(1e-4, 2e-2) for _ in range(points)])
    return times, np.array([draw.uniform(-0.5, 0.5) for _ in range(points)])


def table(times: FloatArray, torques: FloatArray) -> LoadTable:
    return LoadTable(times.tobytes(), torques.tobytes())


@pytest.mark.parametrize("held", [False, True])
def test_each_period_bears_the_load_of_its_middle(held: bool) -> None:
    (times, torques), begins = drawn_points(40), Instant(12_345_678)
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=0.0))
    firmware.advance_to(begins)
    firmware.bear(table(times, torques), held, begins)
    for tick in range(firmware.ticks + 1, firmware.ticks + 9_000):
        firmware.advance_to(Instant(-(-tick * NS_PER_S // RATE_HZ)))
        middle_s = (tick - 0.5) / RATE_HZ - begins / NS_PER_S
        place = max(0, int(np.searchsorted(times, middle_s, "right")) - 1)
        wanted = torques[place] if held else np.interp(middle_s, times, torques)
        if middle_s < 0.0:
            wanted = 0.0
        assert firmware.inner.load_nm == pytest.approx(wanted, abs=1e-12)
    assert middle_s > times[-1], "the end was reached"


@pytest.mark.parametrize("chunk", [1, 7, 16, 1000])
def test_a_free_shaft_turns_by_the_integral_of_the_load(chunk: int) -> None:
    """However many periods are run at once: omega = -1/J times the integral."""
    points, torques = drawn_points(40)
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=0.0))
    firmware.bear(table(points, torques), begins_at=Instant(0))
    until_s = float(points[-1])
    while firmware.ticks < until_s * RATE_HZ:
        firmware.advance_to(Instant(firmware.tick_at + chunk * 62_500 + 1))
    times = np.linspace(0.0, firmware.ticks / RATE_HZ, 400_001)
    impulse = float(np.trapezoid(np.interp(times, points, torques), times))
    assert firmware.speed_rad_s == pytest.approx(-impulse / FREE.inertia_kg_m2, abs=2e-3)
    assert abs(firmware.speed_rad_s) > 1.0


def test_a_million_points_are_found_as_ten_are() -> None:
    times: FloatArray = np.linspace(0.0, 999.999, 1_000_000)
    load = table(times, np.sin(times))
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=0.0))
    for at_s in (-1.0, 0.0, 0.0005, 123.4567, 999.9985, 5000.0):
        began_ns = firmware.tick_at
        firmware.bear(load, begins_at=Instant(began_ns - round(at_s * NS_PER_S)))
        for _ in range(16):
            before_ns = firmware.tick_at
            firmware.advance_to(Instant(before_ns + NS_PER_S // RATE_HZ + 1))
            middle_s = at_s + (0.5 * (before_ns + firmware.tick_at) - began_ns) / NS_PER_S
            wanted = 0.0 if middle_s < 0.0 else np.interp(middle_s, times, np.sin(times))
            assert firmware.inner.load_nm == pytest.approx(wanted, abs=1e-8)


def test_other_points_have_another_number() -> None:
    times, torques = drawn_points(5)
    number = table(times, torques).number
    moved = table(times, torques + np.eye(5)[3] * 1e-9).number
    later = table(times + 1e-9, torques).number
    assert len({number, moved, later, 0}) == 4
    assert table(times.copy(), torques.copy()).number == number
