"""What the drive tells by itself or with a SYNC: the torque demand 6074h, and the statusword on change."""

from collections.abc import Sequence
from itertools import pairwise
from struct import unpack

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State, Status, state_of
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.motion_bench import ENABLED, MotionBench

DEMAND, STAMP, STATUS = 0x6074_0010, 0x1013_0020, 0x6041_0010
TPDO3, TPDO4 = 0x381, 0x481


class TellingBench(MotionBench):
    """CST enabled, RPDO1 with controlword and torque; notes what the drive sends, and when."""

    def __init__(self, kind: int = 255) -> None:
        self.told: list[tuple[Instant, int, bytes]] = []
        super().__init__(Mode.CYCLIC_SYNCHRONOUS_TORQUE, DriveParameters(clock_offset_us=0))
        self.map_rpdo(1, 0x6040_0010, 0x6071_0010, kind=kind)

    def torque(self, raw: int, controlword: int = ENABLED) -> None:
        """RPDO1."""
        self.send(1, "Hh", controlword, raw)

    def receive(self, frame: Frame) -> list[Frame]:
        return self._noted(super().receive(frame))

    def wait_ms(self, milliseconds: float) -> None:
        end = Instant(self.now + round(milliseconds * NS_PER_MS))
        while (due := self.servo.wake_at) is not None and due <= end:
            self.now = max(self.now, due)
            self._noted(self.servo.wake(self.now))
        self.now = end
        self._noted(self.servo.wake(end))

    def _noted(self, frames: Sequence[Frame]) -> list[Frame]:
        self.told += [(self.now, frame.can_id, frame.data) for frame in frames]
        return list(frames)

    def demands(self, cob_id: int = TPDO3) -> list[tuple[int, int]]:
        """Torque demand and stamp, us, of each such TPDO."""
        return [unpack("<hI", data) for _, can_id, data in self.told if can_id == cob_id]

    @property
    def now_us(self) -> int:
        """On a clock that was 0 at power-on."""
        return self.now // NS_PER_US


def test_a_sync_tells_the_set_point_that_came_before_it_with_no_tick_between() -> None:
    bench = TellingBench()
    bench.map_tpdo(3, DEMAND, STAMP, kind=1)
    for raw in (100, -250):
        bench.wait_ms(1.01)
        ticks = bench.servo.drive.firmware.ticks
        bench.torque(raw)
        bench.sync()
        assert bench.servo.drive.firmware.ticks == ticks
        assert bench.demands()[-1] == (raw, bench.now_us)


def test_the_demand_is_target_and_offset_inside_the_limits() -> None:
    bench = TellingBench()
    bench.set(Object.TORQUE_OFFSET, "h", 30)
    bench.set(Object.MAX_TORQUE, "H", 400)
    for raw, demand in ((200, 230), (390, 400), (-600, -400)):
        bench.torque(raw)
        assert bench.read(Object.TORQUE_DEMAND, "h") == demand


def test_in_front_of_the_speed_limit_the_demand_is_what_the_last_tick_made() -> None:
    bench = TellingBench()
    bench.set(Object.MAX_MOTOR_SPEED, "I", 300)
    bench.torque(800)
    for _ in range(20):
        bench.wait_ms(3)
        demand = bench.read(Object.TORQUE_DEMAND, "h")
        made = bench.servo.drive.firmware.inner.torque_demand_nm / bench.servo.drive.objects.torque_unit_nm
        assert demand == round(made)
    assert bench.statusword & Status.INTERNAL_LIMIT_ACTIVE
    assert demand < 300, "friction alone is left"


def test_the_demand_of_a_drive_that_is_off_or_stopping() -> None:
    bench = TellingBench()
    bench.torque(500)
    bench.wait_ms(30)
    bench.torque(500, controlword=0x02)
    assert bench.read(Object.TORQUE_DEMAND, "h") == 500, "the ramp begins with the next tick"
    bench.wait_ms(1)
    assert bench.read(Object.TORQUE_DEMAND, "h") < 0, "quick stop brakes"
    bench.torque(500, controlword=0x00)
    assert bench.read(Object.TORQUE_DEMAND, "h") == 0


def test_a_command_that_changes_the_demand_is_told_at_its_arrival() -> None:
    bench = TellingBench()
    bench.map_tpdo(3, DEMAND, STAMP)
    bench.told.clear()
    expected = []
    for raw, tells in ((100, True), (100, False), (120, True), (0, True)):
        bench.wait_ms(1.01)
        bench.torque(raw)
        expected += [(raw, bench.now_us)] * tells
    assert bench.demands() == expected


def test_a_synchronous_command_is_told_at_the_sync_that_lets_it_act() -> None:
    bench = TellingBench(kind=1)
    bench.map_tpdo(3, DEMAND, STAMP)
    bench.map_tpdo(4, DEMAND, STAMP, kind=1)
    bench.torque(150)
    bench.sync()
    bench.told.clear()
    bench.wait_ms(1)
    bench.torque(-40)
    assert bench.told == []
    bench.wait_ms(0.3)
    bench.sync()
    acted_us = bench.now_us
    assert bench.demands(TPDO3) == [(-40, acted_us)]
    assert bench.demands(TPDO4) == [(150, acted_us)], "what was in force until this SYNC"
    bench.wait_ms(1)
    bench.sync()
    assert bench.demands(TPDO4)[-1] == (-40, bench.now_us)


def test_commands_faster_than_the_inhibit_time_are_told_once_with_the_latest() -> None:
    bench = TellingBench()
    bench.map_tpdo(3, DEMAND, STAMP, inhibit_ms=2)
    bench.wait_ms(5)
    bench.told.clear()
    first_us = bench.now_us
    for raw in (10, 20, 30):
        bench.torque(raw)
        bench.wait_ms(0.5)
    bench.wait_ms(5)
    assert bench.demands() == [(10, first_us), (30, first_us + 2_000)]


def test_a_demand_that_the_drive_changes_by_itself_is_told_too() -> None:
    bench = TellingBench()
    bench.map_tpdo(3, DEMAND, STAMP)
    bench.torque(500)
    bench.wait_ms(30)
    bench.told.clear()
    bench.set(Object.CONTROLWORD, "H", 0x00)
    assert bench.demands() == [(0, bench.now_us)]


def test_nothing_is_told_once_the_tpdo_is_off_or_mapped_anew() -> None:
    bench = TellingBench()

    def tells() -> int:
        bench.told.clear()
        bench.torque(100)
        bench.torque(0)
        return sum(1 for _, can_id, _ in bench.told if can_id == TPDO3)

    bench.map_tpdo(3, DEMAND, STAMP)
    assert tells() == 2
    bench.map_tpdo(3, STATUS)
    assert tells() == 0
    bench.map_tpdo(3, DEMAND, kind=254)
    assert tells() == 2
    bench.set(0x1802, "I", 0xC000_0381, 1)
    assert tells() == 0


def move_and_fail(bench: TellingBench) -> None:
    """Everything below changes: another mode, motion, a fault."""
    bench.torque(400)
    bench.wait_ms(20)
    bench.set(Object.MODES_OF_OPERATION, "b", int(Mode.PROFILE_VELOCITY))
    bench.servo.wake(bench.now)
    bench.servo.drive.fail(0x4310, ErrorRegister.TEMPERATURE)
    bench.wait_ms(20)


OBJECTS = {
    0x6061_0008: "b",
    0x603F_0010: "H",
    0x6064_0020: "i",
    0x606C_0020: "i",
    0x6077_0010: "h",
    0x6078_0010: "h",
}


@pytest.mark.parametrize("word", OBJECTS, ids=lambda word: f"{word >> 16:04X}h")
@pytest.mark.parametrize("kind", [254, 255])
def test_every_object_is_told_when_it_changes_and_only_then(kind: int, word: int) -> None:
    """CiA 301, 7.2.2.3 and 7.5.2.37: types 254 and 255."""
    bench = TellingBench()
    bench.map_tpdo(3, word, kind=kind)
    bench.wait_ms(5)
    move_and_fail(bench)
    values = [unpack("<" + OBJECTS[word], data)[0] for _, can_id, data in bench.told if can_id == TPDO3]
    assert len(values) > 1
    assert all(one != next_one for one, next_one in pairwise(values))
    assert values[-1] == bench.read(word >> 16, OBJECTS[word])


@pytest.mark.parametrize("word", OBJECTS, ids=lambda word: f"{word >> 16:04X}h")
def test_an_acyclic_synchronous_tpdo_goes_with_the_first_sync_after_a_change(word: int) -> None:
    """CiA 301, 7.2.2.2 and 7.5.2.37: type 0."""
    bench = TellingBench()
    bench.map_tpdo(3, word, kind=0)
    bench.sync()
    bench.wait_ms(5)
    bench.sync()
    bench.told.clear()
    move_and_fail(bench)
    assert [each for each in bench.told if each[1] == TPDO3] == []
    bench.sync()
    assert [each[:2] for each in bench.told if each[1] == TPDO3] == [(bench.now, TPDO3)]


def test_a_measured_value_is_looked_at_each_millisecond_and_held_by_the_inhibit_time() -> None:
    """CiA 301, 7.5.2.37, sub-index 3."""
    bench = TellingBench()
    bench.torque(400)
    for inhibit_ms, most in ((0.0, 41), (10.0, 5)):
        bench.map_tpdo(3, 0x6064_0020, inhibit_ms=inhibit_ms)
        bench.told.clear()
        bench.wait_ms(40)
        at = [instant for instant, can_id, _ in bench.told if can_id == TPDO3]
        assert most - 2 <= len(at) <= most
        assert all(late - soon >= max(inhibit_ms, 1.0) * NS_PER_MS for soon, late in pairwise(at))


def test_a_tpdo_of_states_asks_for_no_wake_of_its_own() -> None:
    bench = TellingBench()
    bench.map_tpdo(3, STATUS, 0x6061_0008, 0x603F_0010)
    due = bench.servo.wake_at
    assert due is not None
    assert due - bench.now > 10 * NS_PER_MS


@pytest.mark.parametrize("kind", [254, 255])
def test_the_statusword_is_told_on_change_held_by_the_inhibit_time_and_repeated_by_the_timer(
    kind: int,
) -> None:
    bench = TellingBench()
    bench.map_tpdo(3, STATUS, kind=kind, inhibit_ms=5, event_ms=40)
    bench.wait_ms(100)
    (last, _, _) = bench.told[-1]
    bench.told.clear()
    changed_ms = (bench.now - last) / NS_PER_MS
    bench.torque(0, controlword=0x00)
    bench.wait_ms(1)
    bench.torque(0, controlword=0x06)
    bench.wait_ms(95)
    told = [
        ((at - last) / NS_PER_MS, state_of(unpack("<H", data)[0]))
        for at, can_id, data in bench.told
        if can_id == TPDO3
    ]
    assert told[0] == (changed_ms, State.SWITCH_ON_DISABLED)
    assert told[1:] == [(changed_ms + 5 + 40 * n, State.READY) for n in range(3)]
