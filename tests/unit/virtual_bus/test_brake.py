"""A holding brake that takes its time: how far a hanging load sags, by closed forms."""

import math
from dataclasses import replace
from typing import Any

import pytest

from servobench.design.mechanism import Mechanism, PlacedLoad
from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.machine import MACHINE
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import ENABLED, STO, MotionBench

HANGING_NM = 0.8
FREE = replace(LING, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)
LOADED = replace(FREE, mechanism=Mechanism(load=PlacedLoad(hanging_nm=HANGING_NM)))
J = FREE.inertia_kg_m2


def fallen_rad(firmware: Firmware) -> float:
    inner = firmware.inner
    return -(inner.turns * math.tau + inner.angle_rad)


@pytest.mark.parametrize("close_ms", [0, 20, 75])
@pytest.mark.parametrize("brake_nm", [1.0, 4.0])
def test_a_load_falls_until_the_brake_holds_and_slips_until_it_rests(close_ms: int, brake_nm: float) -> None:
    """Free fall for the brake's time and the tick that asks for it, then what it has above the load."""
    firmware = Firmware(LOADED, FirmwareParameters(brake_torque_nm=brake_nm, brake_close_s=close_ms / 1000.0))
    firmware.start(Instant(0))
    firmware.advance_to(Instant(3000 * NS_PER_MS))
    falls_s = close_ms / 1000.0 + firmware.tick_s
    speed = HANGING_NM / J * falls_s
    fallen = 0.5 * speed * falls_s + 0.5 * speed**2 / ((brake_nm - HANGING_NM) / J)
    assert firmware.inner.speed_rad_s == 0.0
    assert firmware.inner.brake_holds == 1.0
    assert fallen_rad(firmware) == pytest.approx(fallen, rel=1e-9)


def test_a_brake_that_is_too_weak_slips_for_ever() -> None:
    firmware = Firmware(LOADED, FirmwareParameters(brake_torque_nm=0.5))
    firmware.start(Instant(0))
    firmware.advance_to(Instant(100 * NS_PER_MS))
    slope = -(HANGING_NM - 0.5) / J
    assert firmware.inner.speed_rad_s == pytest.approx(slope * 0.1, rel=2e-3)


def test_a_brake_holds_against_the_motor_until_it_has_opened() -> None:
    firmware = Firmware(FREE, FirmwareParameters(brake_torque_nm=4.0, brake_open_s=0.04))
    firmware.start(Instant(0))
    firmware.advance_to(Instant(10 * NS_PER_MS))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(2.0)
    firmware.advance_to(Instant(49 * NS_PER_MS))
    assert firmware.inner.speed_rad_s == 0.0
    assert firmware.inner.torque_measured_nm == pytest.approx(2.0, rel=0.01)
    firmware.advance_to(Instant(60 * NS_PER_MS))
    assert firmware.inner.speed_rad_s == pytest.approx(2.0 / J * 0.00975, rel=0.02)


@pytest.mark.parametrize("close_ms", [0, 50])
def test_safe_torque_off_lets_a_held_load_sag(close_ms: int) -> None:
    """The drive holds the load at rest; STO takes its torque, and the brake's time is that of the fall."""
    drive = DriveParameters(brake_close_s=close_ms / 1000.0)
    motor = replace(LING, mechanism=Mechanism(load=PlacedLoad(hanging_nm=HANGING_NM)))
    bench = MotionBench(Mode.PROFILE_VELOCITY, drive, motor=motor, enabled=False)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(1500)
    assert abs(bench.turns_s) < 0.05
    before = bench.turns
    bench.set(MACHINE, "B", 1, STO)
    bench.wait_ms(400)
    assert bench.state is State.SWITCH_ON_DISABLED
    falls_s = close_ms / 1000.0
    speed = HANGING_NM / J * falls_s
    fallen = (0.5 * speed * falls_s + 0.5 * speed**2 / ((4.0 - HANGING_NM) / J)) / math.tau
    assert before - bench.turns == pytest.approx(fallen, rel=0.06, abs=0.001)


OUTPUTS, PHYSICAL, MASK = 0x60FE, 1, 2


def braked(**keys: Any) -> MotionBench:
    """A drive with a load that hangs, its brake driven by 60FEh."""
    drive = DriveParameters(brake_open_s=0.04, brake_close_s=0.05, brake_output=True, **keys)
    bench = MotionBench(Mode.PROFILE_VELOCITY, drive, motor=LOADED, enabled=False)
    bench.wait_ms(200)
    return bench


def set_brake(bench: MotionBench) -> int:
    """60FEh:1, bit 0."""
    return bench.read(OUTPUTS, "I", PHYSICAL) & 1


def test_an_output_tells_and_takes_what_the_coil_has() -> None:
    """Released by its master, the drive off, the load falls; set against a drive that holds it, it slips."""
    bench = braked()
    assert set_brake(bench) == 1
    bench.set(OUTPUTS, "I", 0, PHYSICAL)
    bench.wait_ms(100)
    assert set_brake(bench) == 1, "no mask, no output"
    before = bench.turns
    bench.set(OUTPUTS, "I", 1, MASK)
    assert set_brake(bench) == 1
    bench.wait_ms(1)
    assert set_brake(bench) == 0
    bench.wait_ms(139)
    falls_s = 0.1
    assert (before - bench.turns) * math.tau == pytest.approx(0.5 * HANGING_NM / J * falls_s**2, rel=0.01)
    bench.set(OUTPUTS, "I", 1, PHYSICAL)
    bench.wait_ms(400)
    held = bench.turns
    bench.wait_ms(200)
    assert bench.turns == held, "set again, it holds"
    bench.set(OUTPUTS, "I", 0, MASK)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(1)
    assert (bench.state, set_brake(bench)) == (State.OPERATION_ENABLED, 0), "the drive decides again"


@pytest.mark.parametrize("waits", [False, True])
def test_a_drive_that_waits_for_its_brake_lets_no_load_sag(waits: bool) -> None:
    bench = braked(brake_waits=waits)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    opens_ms = bench.wait_until(lambda: bench.state is State.OPERATION_ENABLED, 200)
    assert (39 <= opens_ms <= 42) if waits else opens_ms == 0
    bench.wait_ms(1500)
    assert (abs(bench.turns_s) < 0.05, set_brake(bench)) == (True, 0)
    before = bench.turns
    bench.control(0x07)  # disable operation: ramp, brake, then the power stage
    closes_ms = bench.wait_until(lambda: bench.state is State.SWITCHED_ON, 200)
    bench.wait_ms(400)
    sag = before - bench.turns
    assert set_brake(bench) == 1
    if waits:
        assert 50 <= closes_ms <= 60
        assert abs(sag) < 5e-4
        return
    speed = HANGING_NM / J * 0.05
    assert sag == pytest.approx((0.5 * speed * 0.05 + 0.5 * speed**2 / (3.2 / J)) / math.tau, rel=0.1)


@pytest.mark.parametrize("stops_first", [False, True])
def test_a_host_that_disables_before_the_drives_own_standstill_lets_no_load_sag(stops_first: bool) -> None:
    """Disable voltage, from a motor that holds its load or amidst its quick stop; at speed it coasts."""
    bench = braked(brake_waits=True)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(1500)
    before = bench.turns
    if stops_first:
        bench.control(0x02)
        bench.wait_ms(2)
    bench.control(0x00)
    assert not bench.shows(State.SWITCH_ON_DISABLED)
    closes_ms = bench.wait_until(lambda: bench.state is State.SWITCH_ON_DISABLED, 200)
    assert 45 <= closes_ms <= 65
    bench.wait_ms(400)
    assert abs(before - bench.turns) < 5e-4
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(60)
    bench.speed(20.0)
    bench.wait_ms(1500)
    bench.control(0x00)
    assert bench.shows(State.SWITCH_ON_DISABLED), "a turning shaft is not held"


def test_a_drive_that_waits_is_enabled_and_stopped_by_whatever_comes_meanwhile() -> None:
    bench = braked(brake_waits=True)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(10)
    bench.control(ENABLED)
    assert bench.shows(State.SWITCHED_ON), "said again, it does not follow sooner"
    bench.control(0x06)
    assert bench.shows(State.READY)
    before = bench.turns
    bench.wait_ms(300)
    assert before - bench.turns < 0.02, "the brake has hardly begun to open"
    for word in (0x07, ENABLED):
        bench.control(word)
    bench.wait_ms(60)
    assert bench.shows(State.OPERATION_ENABLED)
    bench.control(0x07)
    bench.wait_ms(20)
    bench.control(ENABLED)
    bench.wait_ms(60)
    assert (bench.state, set_brake(bench)) == (State.OPERATION_ENABLED, 0)
    before = bench.turns
    bench.set(MACHINE, "B", 1, STO)
    bench.wait_ms(400)
    assert before - bench.turns > 0.1, "safe torque off waits for nobody"
