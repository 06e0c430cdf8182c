"""A drive that has to be told how its motor commutates, and CiA 402-2's cyclic synchronous torque mode with
commutation angle, by frames; where the rotor is, the core tells.
"""

import math
from dataclasses import replace
from typing import Final

import pytest

from servobench.design.motor import Commutation
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.drive.commutation import COMMUTATION
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import MotionBench

ANGLE: Final = 0x60EA
OFFSET, SWAPPED, POLE_PAIRS, TOLD = 1, 2, 3, 4
WITH_ANGLE, CST = Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE, Mode.CYCLIC_SYNCHRONOUS_TORQUE
RUBBING: Final = replace(LING, coulomb_friction_nm=0.05)
DEVICE_STATE: Final = 0x0800_0022


def bench(mode: Mode, *, enabled: bool = True, **true: float | bool | int | None) -> MotionBench:
    commutation = Commutation(**true)  # type: ignore[arg-type]
    return MotionBench(mode, motor=replace(RUBBING, commutation=commutation), enabled=enabled)


def raw(degrees: float) -> int:
    return round(degrees / 360.0 * 65536) % 65536


def rotor_deg(of: MotionBench) -> float:
    inner = of.servo.drive.firmware.inner
    return math.degrees(LING.pole_pairs * inner.angle_rad) % 360.0


def settled(of: MotionBench, *degrees: float) -> float:
    """The rotor's electrical angle, with the field at the last of these angles."""
    for each in degrees:
        of.set(ANGLE, "H", raw(each))
        of.wait_ms(300)
    return rotor_deg(of)


def turned(of: MotionBench, per_thousand: int) -> float:
    """Turns in 50 ms of torque from rest."""
    before = of.turns
    of.set(0x6071, "h", per_thousand)
    of.wait_ms(50)
    of.set(0x6071, "h", 0)
    return of.turns - before


@pytest.mark.parametrize("swapped", [False, True])
def test_a_positive_torque_turns_the_rotor_a_quarter_of_a_turn_ahead_of_60eah(swapped: bool) -> None:
    """CiA 402-2, cyclic synchronous torque mode with commutation angle: 6071h at the angle of 60EAh, whatever
    the drive takes for the rotor's; of a motor with swapped lines the rotor is at the mirrored one."""
    of = bench(WITH_ANGLE, offset_rad=2.0, lines_swapped=swapped)
    of.set(0x6071, "h", 300)
    way = -1.0 if swapped else 1.0
    for field in (60.0, 120.0):
        place = settled(of, *(field / 4.0 * part for part in range(1, 5)))
        assert math.remainder(place - way * (field + 90.0), 360.0) == pytest.approx(0.0, abs=10.0)
    of.set(0x6071, "h", -300)
    place = settled(of, 150.0, 180.0)
    assert math.remainder(place - way * 90.0, 360.0) == pytest.approx(0.0, abs=10.0), "a quarter behind it"


def test_an_offset_that_is_half_a_turn_off_reverses_the_torque_until_it_is_told() -> None:
    of = bench(CST, offset_rad=math.pi)
    assert turned(of, 100) < -0.01
    of.control(0x00)  # to rest by friction: a ramp would turn it faster and faster
    of.wait_ms(1000)
    of.set(COMMUTATION, "H", raw(180.0), OFFSET)
    of.enable()
    assert turned(of, 100) > 0.01
    assert of.write(COMMUTATION, "H", 0, OFFSET) == DEVICE_STATE, "not while it is enabled"


def test_what_is_told_rightly_gives_the_torque_of_a_drive_that_needs_no_telling() -> None:
    plain = MotionBench(CST, motor=RUBBING)
    of = bench(CST, enabled=False, offset_rad=1.0, lines_swapped=True, pole_pairs_set=3)
    assert of.read(COMMUTATION, "B", POLE_PAIRS) == 3
    told = ((OFFSET, "H", raw(math.degrees(1.0))), (SWAPPED, "B", 1), (POLE_PAIRS, "B", 4))
    for sub, code, value in told:
        of.set(COMMUTATION, code, value, sub)
    of.enable()
    assert turned(of, 100) == pytest.approx(turned(plain, 100), rel=1e-3)
    shown = of.read(COMMUTATION, "H", TOLD) / 65536 * 360.0
    assert math.remainder(shown - rotor_deg(of), 360.0) == pytest.approx(0.0, abs=0.1)


def test_the_angle_is_the_drive_s_own_again_in_any_other_mode_and_while_it_stops() -> None:
    of = bench(WITH_ANGLE)
    of.set(0x6071, "h", 300)
    assert settled(of, 20.0, 40.0) == pytest.approx(130.0, abs=10.0)
    of.set(0x6060, "b", CST)
    assert turned(of, 300) > 0.05, "at the angle of the field it would stand"
    of.set(0x6060, "b", WITH_ANGLE)
    of.set(0x6071, "h", 300)
    of.wait_ms(20)
    of.control(0x02)
    of.wait_ms(300)
    assert of.state is State.SWITCH_ON_DISABLED, "a quick stop came to its end"


def test_no_torque_is_made_towards_the_end_of_the_axis() -> None:
    of = bench(WITH_ANGLE)
    of.set(0x6071, "h", 300)
    of.fit(2, positive=-1.0)
    for degrees in range(0, 360, 30):
        settled(of, degrees)
    inner = of.servo.drive.firmware.inner
    assert math.hypot(inner.current_d_a, inner.current_q_a) < 0.1, "it had 300 thousandths"


def test_a_drive_that_needs_no_telling_has_neither_the_mode_nor_the_objects() -> None:
    plain = SimulatedServo(1, LING)
    assert not {ANGLE, COMMUTATION} & {entry.index for entry in plain.dictionary}
    assert not plain.dictionary.variable(0x6502).value & 1 << 10


def test_a_maker_s_objects_are_in_force_where_its_file_names_them() -> None:
    """Synapticon: 2001h is the offset, 4096 a turn, 2003h:5 "motor phases inverted", 2003h:1 pole pairs."""

    def synapticon(dictionary: ObjectDictionary) -> None:
        dictionary.conceal(COMMUTATION)
        dictionary.variable(0x1018, 1).default = 0x22D2
        dictionary.add(0x2001, "Commutation angle offset", DataType.INTEGER16, default=-1024)
        motor = dictionary.add_record(0x2003, "Motor specific settings")
        motor.add(1, "Pole pairs", DataType.UNSIGNED8, default=5)
        motor.add(5, "Motor phases inverted", DataType.UNSIGNED8, default=1)

    motor = replace(LING, commutation=Commutation(-0.5 * math.pi, lines_swapped=True))
    of = SimulatedServo(1, motor, vendor=synapticon)
    of.start(Instant(0))
    inner = of.drive.firmware.inner
    assert inner.commutation_ahead_rad == pytest.approx(0.0)
    assert (inner.lines_mirrored, inner.commutation_pole_pairs) == (0, 5.0)
    of.dictionary.download(0x2003, 5, b"\0")
    assert inner.lines_mirrored == 1
