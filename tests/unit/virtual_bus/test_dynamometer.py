"""The emulated instrument: its commands, its brake, and its line in simulated time."""

import pytest

from servobench.drivers.instruments.dynamometer import Dynamometer, DynamometerSettings, dialect
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.motor_file import LING2012
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.instruments.dynamometer import (
    RESPONSE_S,
    STEP_NS,
    Brake,
    Instrument,
    Shaft,
    TimelineLine,
)
from servobench.virtual_bus.instruments.serial_line import LineFaults
from servobench.virtual_bus.timeline import SimulatedClock, Timeline

RPM = 3.141592653589793 / 30.0


class FlyWheel(Shaft):
    """A shaft that nothing slows down."""

    def __init__(self, speed_rad_s: float = 1500 * RPM) -> None:
        self.speed = speed_rad_s
        self.braked_nm = 0.0

    def speed_rad_s(self, now: Instant) -> float:  # noqa: ARG002
        return self.speed

    def brake(self, torque_nm: float, now: Instant) -> None:  # noqa: ARG002
        self.braked_nm = torque_nm


def settle(brake: Brake, seconds: float = 1.0) -> None:
    for step in range(round(seconds * NS_PER_S / STEP_NS)):
        brake.step(Instant(step * STEP_NS))


def test_the_torque_follows_its_set_point_as_a_first_order_lag() -> None:
    shaft = FlyWheel()
    brake = Brake(shaft, torque_max_nm=5.0)
    brake.set_torque(1.0)
    settle(brake, RESPONSE_S)
    assert shaft.braked_nm == pytest.approx(1.0 - 2.718281828**-1.0, abs=0.02)
    settle(brake)
    assert brake.settled
    assert shaft.braked_nm == 1.0
    brake.set_torque(50.0)
    settle(brake)
    assert shaft.braked_nm == 5.0
    brake.set_torque(-1.0)
    settle(brake)
    assert shaft.braked_nm == 0.0


@pytest.mark.parametrize(
    ("kind", "ask", "on", "off", "said"),
    [
        ("magtrol_dsp7000", b"OD1\r\n", b"Q1,0.6\r\n", b"Q1\r\n", b"S  1500T0.600R\r\n"),
        ("magtrol_dsp6001", b"OD\r\n", b"Q0.6\r\n", b"Q\r\n", b"S 1500T0.600R\r\n"),
    ],
)
def test_commands_of_both_models(kind: str, ask: bytes, on: bytes, off: bytes, said: bytes) -> None:
    shaft = FlyWheel()
    instrument = Instrument(Brake(shaft, 5.0), kind)
    assert instrument.take(on, Instant(0)) == []
    settle(instrument.brake)
    assert instrument.take(ask, Instant(0)) == [said]
    shaft.speed = -300 * RPM
    assert instrument.take(ask, Instant(0))[0].endswith(b"T0.600L\r\n")
    instrument.take(off, Instant(0))
    settle(instrument.brake)
    assert b"T0.000" in instrument.take(ask, Instant(0))[0]
    shaft.speed = 0.0
    instrument.alarm = True
    assert instrument.take(ask, Instant(0))[0].endswith(b"T0.000A\r\n")
    assert instrument.misunderstood == 0


@pytest.mark.parametrize(
    "line",
    [
        b"od1\r\n",
        b"Q1,abc\r\n",
        b"Q1,-1\r\n",
        b"Q1,nan\r\n",
        b"OD2\r\n",
        b"Q3,1\r\n",
        b"\r\n",
        b"OD1 OD1\r\n",
    ],
)
def test_what_is_not_understood_is_counted_and_not_answered(line: bytes) -> None:
    instrument = Instrument(Brake(FlyWheel(), 5.0))
    assert instrument.take(line, Instant(0)) == []
    assert instrument.misunderstood == 1


def test_a_command_may_come_in_pieces_and_needs_both_of_its_ends() -> None:
    instrument = Instrument(Brake(FlyWheel(), 5.0))
    assert instrument.take(b"OD", Instant(0)) == []
    assert instrument.take(b"1\n", Instant(0)) == []
    assert instrument.take(b"OD1\r", Instant(0)) == []
    assert instrument.misunderstood == 0
    assert instrument.take(b"\nOD1\r\n", Instant(0)) != []
    assert instrument.misunderstood == 1


@pytest.mark.parametrize(
    ("torque_nm", "text"), [(0.6, b"T0.600"), (12.34, b"T12.34"), (123.46, b"T123.5"), (1234.0, b"T1234.")]
)
def test_the_torque_has_five_characters_and_its_point(torque_nm: float, text: bytes) -> None:
    brake = Brake(FlyWheel(), 1e6)
    brake.torque_nm = torque_nm
    said = Instrument(brake).take(b"OD1\r\n", Instant(0))[0]
    assert said == b"S  1500" + text + b"R\r\n"


def driver_on(
    timeline: Timeline, instrument: Instrument, faults: LineFaults | None = None, seed: int = 0
) -> Dynamometer:
    line = TimelineLine(timeline, instrument, 9600, faults or LineFaults(), seed)
    settings = DynamometerSettings(9600, Duration(100 * NS_PER_MS), Duration(20 * NS_PER_MS))
    return Dynamometer(line, SimulatedClock(timeline), dialect("magtrol_dsp7000"), settings)


def pump(driver: Dynamometer, timeline: Timeline, seconds: float) -> None:
    for _ in range(round(seconds * 1000)):
        driver.pump(timeline.now)
        timeline.run_until(Instant(timeline.now + NS_PER_MS))


def test_in_simulated_time_a_reading_stands_where_it_was_taken() -> None:
    timeline, shaft = Timeline(), FlyWheel(0.0)
    driver = driver_on(timeline, Instrument(Brake(shaft, 5.0)))
    driver.connect(timeline.run_until)
    driver.take_readings()
    for _ in range(500):
        shaft.speed = timeline.now / NS_PER_S * 1000 * RPM  # speed tells the time
        driver.pump(timeline.now)
        timeline.run_until(Instant(timeline.now + NS_PER_MS))
    readings = driver.take_readings()
    assert len(readings) > 15
    for reading in readings:
        taken_at = reading.speed_rad_s / (1000 * RPM) * NS_PER_S
        assert abs(reading.at - taken_at) <= reading.error_ns + 2 * NS_PER_MS
        assert reading.error_ns < 3 * NS_PER_MS


def test_a_bad_line_costs_readings_and_the_same_ones_every_time() -> None:
    faults = LineFaults(garble=0.1, truncate=0.05, terminator=0.2, drop=0.05, noise=0.05)

    def run(seed: int) -> tuple[list[float], str]:
        timeline = Timeline()
        driver = driver_on(timeline, Instrument(Brake(FlyWheel(), 5.0)), faults, seed)
        driver.set_torque(0.6)
        pump(driver, timeline, 3.0)
        return [reading.torque_nm for reading in driver.take_readings()], str(driver.tally)

    torques, tally = run(5)
    assert len(torques) > 40
    assert "spoilt=0" not in tally
    assert run(5) == (torques, tally)
    assert run(6) != (torques, tally)


def test_the_brake_holds_the_shaft_of_a_simulated_drive_like_friction() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    servo = SimulatedServo(1, LING2012.parameters)
    AttachedDevice(servo, segment)
    timeline.run_until(Instant(NS_PER_MS))
    shaft = Shaft(servo)
    firmware = servo.drive.firmware
    inertia = LING2012.parameters.inertia_kg_m2
    # the drive's own holding brake is out of it: torque control at zero torque
    firmware.inner.brake_nm = 0.0
    firmware.inner.speed_rad_s = 100.0
    shaft.brake(0.5, timeline.now)
    began, speed = timeline.now, shaft.speed_rad_s(timeline.now)
    timeline.run_until(Instant(began + 50 * NS_PER_MS))
    slowed = (speed - shaft.speed_rad_s(timeline.now)) / 0.05
    assert slowed == pytest.approx((0.5 + 0.00185 * 85) / inertia, rel=0.05)
    timeline.run_until(Instant(began + NS_PER_S))
    assert shaft.speed_rad_s(timeline.now) == 0.0, "a brake turned the shaft backwards"
