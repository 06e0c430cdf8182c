"""The gains of a simulated drive's own loops as objects, by frames; what is in force, the core tells."""

import math
import struct
from typing import Final

import pytest

from servobench.drivers.canopen.objects301 import Cia301, DataType
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.parameter_storage import SAVE
from servobench.virtual_bus.drive.loop_gains import LOOP_GAINS
from servobench.virtual_bus.drive.power_stage import current_per_rms
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import MotionBench

CURRENT_P, CURRENT_P_D, CURRENT_I, SPEED_P, SPEED_I, POSITION_P = range(1, 7)
CSV, CSP = Mode.CYCLIC_SYNCHRONOUS_VELOCITY, Mode.CYCLIC_SYNCHRONOUS_POSITION
GAINS: Final = DriveParameters(gain_objects=True)
TOO_LOW, INVALID = 0x0609_0032, 0x0609_0030


def bench(mode: Mode = CSV, drive: DriveParameters = GAINS) -> MotionBench:
    return MotionBench(mode, drive)


def held(of: MotionBench, sub: int) -> float:
    raw = struct.pack("<I", of.read(LOOP_GAINS, "I", sub))
    return float(struct.unpack("<f", raw)[0])


def put(of: MotionBench, sub: int, value: float) -> int | None:
    return of.write(LOOP_GAINS, "I", struct.unpack("<I", struct.pack("<f", value))[0], sub)


def in_force(of: MotionBench) -> tuple[float, ...]:
    inner = of.servo.drive.firmware.inner
    return inner.gain_q, inner.gain_d, inner.integral_gain, inner.speed_gain, inner.speed_integral_gain


def test_a_drive_has_the_objects_only_where_they_are_asked_for() -> None:
    assert LOOP_GAINS not in {entry.index for entry in SimulatedServo(1, LING).dictionary}


def test_they_tell_the_gains_that_the_drive_was_made_with() -> None:
    """PI with pole cancellation: alpha L and alpha R with alpha = 2 pi 800; speed loop of 30 Hz: w J and
    w^2 J / 4; position loop w / 4."""
    of = bench()
    alpha, w = math.tau * 800.0, math.tau * 30.0
    expected = (
        alpha * LING.inductance_q_h,
        alpha * LING.inductance_d_h,
        alpha * LING.resistance_ohm,
        w * LING.inertia_kg_m2,
        w * w * LING.inertia_kg_m2 / 4.0,
        w / 4.0,
    )
    assert [held(of, sub) for sub in range(1, 7)] == pytest.approx(expected, rel=1e-6)


def test_until_one_is_written_the_loops_are_those_of_any_other_drive() -> None:
    ours, plain = bench(), bench(drive=DriveParameters())
    assert in_force(ours) == in_force(plain)
    for of in (ours, plain):
        of.speed(5.0)
        of.wait_ms(50)
    assert ours.turns == plain.turns


def test_each_acts_at_once_and_alone() -> None:
    of = bench()
    before = in_force(of)
    for sub in range(1, 6):
        place = (CURRENT_P, CURRENT_P_D, CURRENT_I, SPEED_P, SPEED_I).index(sub)
        assert put(of, sub, 1.5 * held(of, sub)) is None
        after = in_force(of)
        assert after[place] == pytest.approx(1.5 * before[place], rel=1e-6)
        assert after[:place] + after[place + 1 :] == before[:place] + before[place + 1 :]
        before = after
    inner = of.servo.drive.firmware.inner
    assert inner.per_gain_q * inner.gain_q == pytest.approx(1.0)
    assert inner.per_gain_d * inner.gain_d == pytest.approx(1.0)


def test_a_stiffer_speed_loop_yields_less_to_a_load() -> None:
    def lost(factor: float) -> float:
        of = bench()
        assert put(of, SPEED_P, factor * held(of, SPEED_P)) is None
        of.speed(5.0)
        of.wait_ms(200)
        before = of.speed_rad_s
        of.servo.drive.firmware.brake_shaft(0.2)
        of.wait_ms(8)
        return before - of.speed_rad_s

    assert 0.0 < lost(4.0) < 0.6 * lost(1.0)


def test_the_position_loop_s_p_is_its_speed_over_its_error() -> None:
    """In CSP behind a steady set-point the shaft comes back the sooner the larger P is."""

    def left(gain: float) -> float:
        of = bench(CSP)
        assert put(of, POSITION_P, gain) is None
        begun = of.turns
        of.set(0x607A, "i", round((begun + 0.05) * 65_536))
        of.wait_ms(60)
        return abs(begun + 0.05 - of.turns)

    assert left(40.0) < 0.5 * left(10.0)


@pytest.mark.parametrize(("value", "abort"), [(-1.0, TOO_LOW), (math.nan, INVALID), (math.inf, INVALID)])
def test_a_gain_that_cannot_be_is_refused(value: float, abort: int) -> None:
    of = bench()
    before = in_force(of)
    assert put(of, SPEED_P, value) == abort
    assert in_force(of) == before


def test_what_1010h_has_stored_is_in_force_after_a_reset_and_what_it_has_not_is_gone() -> None:
    of = bench()
    made = in_force(of)
    assert put(of, SPEED_P, 2.0 * held(of, SPEED_P)) is None
    of.control(0x00)
    of.nmt(0x81)
    of.wait_ms(100)
    assert in_force(of) == made
    assert put(of, SPEED_P, 2.0 * held(of, SPEED_P)) is None
    of.set(Cia301.STORE_PARAMETERS, "I", SAVE, 1)
    of.nmt(0x81)
    of.wait_ms(100)
    assert in_force(of)[3] == pytest.approx(2.0 * made[3], rel=1e-6)
    assert in_force(of)[:3] == made[:3]


def epos4(dictionary: ObjectDictionary) -> None:
    dictionary.conceal(LOOP_GAINS)
    dictionary.variable(0x1018, 1).default = 0xFB
    dictionary.variable(Cia301.DEVICE_NAME).default = b"EPOS4"
    for index, subs in ((0x30A0, 2), (0x30A1, 3), (0x30A2, 2)):
        record = dictionary.add_record(index, "gains")
        for sub in range(1, subs + 1):
            record.add(sub, f"gain {sub}", DataType.UNSIGNED32, default=1000)
    motor = dictionary.add_record(0x3001, "Motor data")
    motor.add(5, "Torque constant", DataType.UNSIGNED32, default=50_000)


def test_a_maker_s_objects_are_in_force_in_the_maker_s_units() -> None:
    """maxon EPOS4: uV/A, uV/(A ms), uA s/rad, uA/rad, with 50 mN m per ampere of 3001h:5."""
    of = SimulatedServo(1, LING, GAINS, vendor=epos4)
    of.start(Instant(0))
    inner, variable = of.drive.firmware.inner, of.dictionary.variable
    made = inner.gain_q, inner.gain_d, inner.speed_gain
    assert variable(0x30A0, 1).value == round(inner.gain_q * 1e6)
    assert variable(0x30A0, 2).value == round(inner.integral_gain * 16_000 * 1e3)
    assert variable(0x30A2, 1).value == round(inner.speed_gain / 0.05 * 1e6)
    assert variable(0x30A2, 2).value == round(inner.speed_integral_gain / 0.05 * 1e6)
    assert variable(0x30A1, 1).value == 1000, "a position loop that asks for a current is not the drive's"
    of.dictionary.download(0x30A0, 1, (3_000_000).to_bytes(4, "little"))
    of.dictionary.download(0x30A2, 1, (400_000).to_bytes(4, "little"))
    assert (inner.gain_q, inner.gain_d) == pytest.approx((3.0, 3.0)), "one P for both axes"
    assert inner.speed_gain == pytest.approx(0.02)
    of.dictionary.download(0x30A0, 1, variable(0x30A0, 1).default.to_bytes(4, "little"))
    of.dictionary.download(0x30A2, 1, variable(0x30A2, 1).default.to_bytes(4, "little"))
    assert (inner.gain_q, inner.gain_d, inner.speed_gain) == made, "undone to the last digit"


def test_an_ampere_whose_constant_nobody_tells_is_an_rms_one() -> None:
    def silent(dictionary: ObjectDictionary) -> None:
        epos4(dictionary)
        dictionary.variable(0x3001, 5).default = 0

    of = SimulatedServo(1, LING, GAINS, vendor=silent)
    of.start(Instant(0))
    per_rms = LING.torque_constant_nm_a * current_per_rms(LING)
    assert of.dictionary.variable(0x30A2, 1).value == round(
        of.drive.firmware.inner.speed_gain / per_rms * 1e6
    )
