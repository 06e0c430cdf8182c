"""A load over time that the simulated shaft bears by itself, and how a master begins it."""

import random
from dataclasses import replace

import numpy as np
import pytest

from drivers.timebase import NS_PER_S, Instant
from tests.motors import LING
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.firmware import Firmware, FirmwareParameters
from virtual_bus.drive.load_table import LoadTable, fill_loads
from virtual_bus.drive.motor_kernel import FloatArray

RATE_HZ = 16_000
FREE = replace(LING, coulomb_friction_nm=0.0, viscous_friction_nm_s=0.0)


def drawn_table(points: int) -> LoadTable:
    draw = random.Random(7)
    times = np.cumsum([draw.uniform(1e-4, 2e-2) for _ in range(points)])
    return LoadTable(times, np.array([draw.uniform(-0.5, 0.5) for _ in range(points)]))


@pytest.mark.parametrize("held", [False, True])
def test_each_period_bears_the_load_of_its_middle(held: bool) -> None:
    load, begins = drawn_table(40), Instant(12_345_678)
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=0.0))
    firmware.advance_to(begins)
    firmware.bear(load, held, begins)
    for tick in range(firmware.ticks + 1, firmware.ticks + 9_000):
        firmware.advance_to(Instant(-(-tick * NS_PER_S // RATE_HZ)))
        middle_s = (tick - 0.5) / RATE_HZ - begins / NS_PER_S
        place = max(0, int(np.searchsorted(load.times_s, middle_s, "right")) - 1)
        wanted = load.torques_nm[place] if held else np.interp(middle_s, load.times_s, load.torques_nm)
        if middle_s < 0.0:
            wanted = 0.0
        assert firmware.demand[kernel.D_LOAD] == pytest.approx(wanted, abs=1e-12)
    assert middle_s > load.times_s[-1], "the end was reached"


@pytest.mark.parametrize("chunk", [1, 7, 16, 1000])
def test_a_free_shaft_turns_by_the_integral_of_the_load(chunk: int) -> None:
    """However many periods are run at once: omega = -1/J times the integral."""
    load = drawn_table(40)
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=0.0))
    firmware.bear(load, begins_at=Instant(0))
    until_s = float(load.times_s[-1])
    while firmware.ticks < until_s * RATE_HZ:
        firmware.advance_to(Instant(firmware.tick_at + chunk * 62_500 + 1))
    times = np.linspace(0.0, firmware.ticks / RATE_HZ, 400_001)
    impulse = float(np.trapezoid(np.interp(times, load.times_s, load.torques_nm), times))
    assert firmware.speed_rad_s == pytest.approx(-impulse / FREE.inertia_kg_m2, abs=2e-3)
    assert abs(firmware.speed_rad_s) > 1.0


def test_a_million_points_are_found_as_ten_are() -> None:
    times: FloatArray = np.linspace(0.0, 999.999, 1_000_000)
    table, loads = LoadTable(times, np.sin(times)), np.zeros(16)
    place = 0
    for at_s in (-1.0, 0.0, 0.0005, 123.4567, 999.9985, 5000.0):
        place = fill_loads(loads, times, table.torques_nm, False, at_s, 62.5e-6, 16, place)
        asked = at_s + 62.5e-6 * np.arange(16)
        wanted = np.where(asked < 0.0, 0.0, np.interp(asked, times, table.torques_nm))
        np.testing.assert_allclose(loads, wanted, atol=1e-9)


def test_other_points_have_another_number() -> None:
    load = drawn_table(5)
    moved = LoadTable(load.times_s, load.torques_nm + np.eye(5)[3] * 1e-9)
    later = LoadTable(load.times_s + 1e-9, load.torques_nm)
    assert len({load.number, moved.number, later.number, 0}) == 4
    assert LoadTable(load.times_s.copy(), load.torques_nm.copy()).number == load.number
