"""Set-points on their way into the loops: 6062h of the whole drive beside scipy's splines and a filter
computed apart; the torque's filters beside scipy's."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import bilinear, lfilter

from servobench.design.statespace import StateSpace
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, Status
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.set_point_path import Interpolation, Notch, SetPointPath
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import COUNTS, ENABLED, MotionBench

PERIOD_MS = 8
FloatArray = NDArray[np.float64]
TARGETS = np.concatenate([np.zeros(2), 0.2 * np.sin(np.arange(25) * 0.4), np.full(4, 0.05)])
"""Set-points, turns, one each 8 ms; the last ones stand."""


def demands(
    path: SetPointPath, mode: Mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
) -> tuple[FloatArray, FloatArray]:
    """6062h in turns after each motion period, and when it was, ms from the first set-point."""
    bench = MotionBench(mode, DriveParameters(path=path), enabled=False)
    bench.set(Object.INTERPOLATION_TIME_PERIOD, "B", PERIOD_MS, 1)
    bench.map_rpdo(2, 0x6040_0010, 0x607A_0020)
    bench.enable()
    bench.wait_ms(1.0 - bench.now % 1_000_000 / 1e6)
    told: list[float] = []
    for target in TARGETS:
        bench.send(2, "Hi", ENABLED, round(target * COUNTS))
        for _ in range(PERIOD_MS):
            bench.wait_ms(1)
            told.append(bench.read(Object.POSITION_DEMAND_VALUE, "i") / COUNTS)
    return np.array(told), np.arange(1.0, len(told) + 1.0)


def joined(at_ms: FloatArray, cubic: bool) -> FloatArray:
    """Each set-point reached 8 ms after it came, from where the one before was."""
    knots_ms = np.arange(len(TARGETS) + 1) * float(PERIOD_MS)
    places = np.concatenate([[0.0], np.round(TARGETS * COUNTS) / COUNTS])
    if not cubic:
        return np.asarray(np.interp(at_ms, knots_ms, places))
    slopes = np.concatenate([[0.0], np.diff(places) / PERIOD_MS])
    return np.asarray(CubicHermiteSpline(knots_ms, places, slopes)(at_ms))


@pytest.mark.parametrize("kind", [Interpolation.LINEAR, Interpolation.CUBIC])
def test_set_points_are_joined_as_the_drive_does_it(kind: Interpolation) -> None:
    told, at_ms = demands(SetPointPath(kind))
    assert told == pytest.approx(joined(at_ms, kind is Interpolation.CUBIC), abs=1.01 / COUNTS)


def test_a_cubic_has_no_corners() -> None:
    """Its second difference is below that of the lines, whose slope jumps at each set-point."""

    def jump(kind: Interpolation) -> float:
        return float(np.abs(np.diff(demands(SetPointPath(kind))[0], 2)).max())

    assert jump(Interpolation.CUBIC) < 0.75 * jump(Interpolation.LINEAR)


def test_without_interpolation_a_set_point_is_there_at_once() -> None:
    told, _ = demands(SetPointPath(Interpolation.NONE))
    assert told == pytest.approx(np.repeat(np.round(TARGETS * COUNTS) / COUNTS, PERIOD_MS), abs=1.01 / COUNTS)


@pytest.mark.parametrize("corner_hz", [5.0, 60.0])
@pytest.mark.parametrize("kind", list(Interpolation))
def test_a_filter_follows_as_computed_apart(kind: Interpolation, corner_hz: float) -> None:
    bare, _ = demands(SetPointPath(kind))
    told, _ = demands(SetPointPath(kind, corner_hz))
    gain = 1.0 / (1.0 + 1000.0 / (math.tau * corner_hz))
    assert told == pytest.approx(lfilter([gain], [1.0, gain - 1.0], bare), abs=1.6 / COUNTS)


def speeds_of(path: SetPointPath) -> Sequence[float]:
    bench = MotionBench(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, DriveParameters(path=path))
    bench.speed(5.0)
    told = []
    for _ in range(80):
        bench.wait_ms(1)
        told.append(bench.servo.drive.firmware.inner.speed_demand_rad_s / math.tau)
    return told


def test_a_filter_of_speeds_takes_its_time() -> None:
    """First order: 63 % after 1 / (2 pi 20 Hz), 8 ms."""
    told = np.array(speeds_of(SetPointPath(filter_hz=20.0)))
    gain = 1.0 / (1.0 + 1000.0 / (math.tau * 20.0))
    expected = 5.0 * (1.0 - (1.0 - gain) ** np.arange(1, 81))
    assert told[20:] == pytest.approx(expected[20:], abs=0.15)
    assert told[7] < 0.7 * speeds_of(SetPointPath())[7]


# ---- torque ------------------------------------------------------------------------------------------------

RATE_HZ = 16_000


def currents(path: SetPointPath, demands_nm: FloatArray) -> FloatArray:
    """What the current loops are asked for, N m, at each tick: by a controller that passes its error on."""
    passes = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1), 1.0 / RATE_HZ)
    free = replace(
        LING, viscous_friction_nm_s=0.0, flux_linkage_wb=1e-3, inductance_q_h=1.0, inductance_d_h=1.0
    )
    firmware = Firmware(free, FirmwareParameters(path=path, controller_q=passes, brake_torque_nm=0.0))
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    inner, asked = firmware.inner, []
    for tick, demand_nm in enumerate(demands_nm):
        firmware.demand_torque(float(demand_nm))
        firmware.advance_to(Instant(math.ceil((tick + 1) * NS_PER_S / RATE_HZ)))
        speed = free.pole_pairs * inner.speed_measured_rad_s
        emf_v = speed * (free.flux_linkage_wb + free.inductance_d_h * inner.current_d_measured_a)
        asked.append(
            (inner.next_voltage_q_v - emf_v + inner.current_q_measured_a) * free.torque_constant_nm_a
        )
    return np.array(asked)


@pytest.mark.parametrize("corner_hz", [None, 300.0])
@pytest.mark.parametrize("notch", [None, Notch(134.0, 0.05, 1.0), Notch(900.0, 0.0, 0.3)])
def test_the_torques_filters_are_scipys(notch: Notch | None, corner_hz: float | None) -> None:
    """A low pass by Euler's backward rule, and the bilinear transform of the notch at its own frequency."""
    demands_nm = np.random.default_rng(43).uniform(-1.0, 1.0, 300) * 1e-3
    found = currents(SetPointPath(torque_filter_hz=corner_hz, notch=notch), demands_nm)
    expected = demands_nm
    if corner_hz is not None:
        gain = 1.0 / (1.0 + RATE_HZ / (math.tau * corner_hz))
        expected = lfilter([gain], [1.0, gain - 1.0], expected)
    if notch is not None:
        w = 2.0 * RATE_HZ * math.tan(math.pi * notch.frequency_hz / RATE_HZ)
        wide = notch.width * w
        expected = lfilter(*bilinear([1.0, notch.depth * wide, w * w], [1.0, wide, w * w], RATE_HZ), expected)
    assert found == pytest.approx(np.asarray(expected), abs=1e-9)


def test_the_filters_of_the_torque_begin_anew_when_the_drive_is_switched_on() -> None:
    firmware = Firmware(LING, FirmwareParameters(path=SetPointPath(torque_filter_hz=5.0)))
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(2.0)
    firmware.advance_to(Instant(NS_PER_S // 4))
    assert firmware.inner.torque_measured_nm > 1.5
    firmware.control(InnerControl.OFF)
    firmware.advance_to(Instant(NS_PER_S // 4 + NS_PER_MS))
    firmware.control(InnerControl.TORQUE)
    firmware.advance_to(Instant(NS_PER_S // 4 + 2 * NS_PER_MS))
    assert abs(firmware.inner.torque_measured_nm) < 0.1


def test_a_notch_beyond_the_inner_loop_is_refused() -> None:
    with pytest.raises(ValueError, match="notch at 5000 Hz: below two fifths of the inner rate, 3200 Hz"):
        FirmwareParameters(inner_rate_hz=8_000, path=SetPointPath(notch=Notch(5_000.0)))


def test_a_torque_of_cst_is_reached_by_its_slope() -> None:
    """Up, and back through zero, by 6087h to a tick; at once in a drive that is not so."""
    course = {}
    for sloped in (True, False):
        bench = MotionBench(
            Mode.CYCLIC_SYNCHRONOUS_TORQUE,
            DriveParameters(path=SetPointPath(torque_slope=sloped)),
            enabled=False,
        )
        bench.set(Object.TORQUE_SLOPE, "I", 20_000)
        bench.map_rpdo(2, 0x6040_0010, 0x6071_0010)
        bench.enable()
        told = []
        for target in (300, -200):
            bench.send(2, "Hh", ENABLED, target)
            told += bench.watch(30, partial(bench.read, Object.TORQUE_DEMAND, "h"))
            assert not bench.statusword & Status.INTERNAL_LIMIT_ACTIVE
        course[sloped] = np.array(told)
    at_ms = np.arange(1.0, 31.0)
    up, down = np.minimum(20.0 * at_ms, 300.0), np.maximum(300.0 - 20.0 * at_ms, -200.0)
    assert course[True] == pytest.approx(np.concatenate([up, down]), abs=2 * 20.0 / 16.0)
    assert course[False] == pytest.approx(np.repeat([300.0, -200.0], 30), abs=1.0)


def test_the_slope_of_cst_is_left_with_its_mode() -> None:
    """Profile torque goes by 6087h as it is then."""
    drive = DriveParameters(path=SetPointPath(torque_slope=True))
    bench = MotionBench(Mode.CYCLIC_SYNCHRONOUS_TORQUE, drive, enabled=False)
    bench.set(Object.TORQUE_SLOPE, "I", 1_000)
    bench.enable()
    bench.set(Object.TORQUE_SLOPE, "I", 100_000)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_TORQUE)
    bench.wait_ms(2)
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.wait_ms(6)
    assert bench.read(Object.TORQUE_DEMAND, "h") == 300
