"""A drive that turns and is commanded no more: which of its watches brings it to rest, and when."""

from collections.abc import Callable
from struct import pack

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import AbortConnectionOption, State
from servobench.drivers.timebase import NS_PER_MS
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.servo_bench import ENABLE, SYNC, ServoBench

RPDO, HOST = 0x201, 0x7F
ENABLED, TORQUE = 0x0F, 300
DEADLINE_MS, HEARTBEAT_MS = 20, 50
RAMP_MS = 250
"""What the quick stop needs from the speed in these tests, and some more."""
DEADLINE, HEARTBEAT = 0x8250, 0x8130


class Commanded(ServoBench):
    """Cyclic synchronous torque at 1 kHz, watched by 1400h:05 and by the host's heartbeat."""

    def __init__(self, kind: int = 255, option: int | None = None) -> None:
        super().__init__()
        assert self.write(0x1400, "B", kind, 2) is None
        assert self.write(0x1400, "H", DEADLINE_MS, 5) is None
        assert self.write(0x1016, "I", HOST << 16 | HEARTBEAT_MS, 1) is None
        if option is not None:
            assert self.write(Object.ABORT_CONNECTION_OPTION, "h", option) is None
        for command in (*ENABLE, *ENABLE):  # a synchronous command acts with the next SYNC
            self.command(command, torque_raw=TORQUE)
            self.cycles(5)
        assert self.state is State.OPERATION_ENABLED
        self.cycles(100)
        assert self.speed_rad_s > 20.0

    def cycles(self, number: int, lost: Callable[[Frame], bool] = lambda _frame: False) -> None:
        """SYNC, command and heartbeat of so many milliseconds, but for those that are ``lost``."""
        for _ in range(number):
            command = Frame(RPDO, pack("<Hh", ENABLED, TORQUE))
            for frame in (SYNC, command, Frame(0x700 + HOST, b"\x05")):
                if not lost(frame):
                    self.receive(frame)
            self.wait_ms(1)

    def emergencies(self) -> list[int]:
        """Error codes."""
        return [int.from_bytes(frame.data[:2], "little") for frame in self.sent if frame.can_id == 0x81]

    def at_rest_after_ms(self, lost: Callable[[Frame], bool]) -> int:
        """How long the shaft goes on turning."""
        for passed in range(500):
            if abs(self.speed_rad_s) < 1.0:
                return passed
            self.cycles(1, lost)
        raise AssertionError(f"{self.speed_rad_s} rad/s after 500 ms, {self.state}")


def rpdos(frame: Frame) -> bool:
    return frame.can_id == RPDO


def everything(_frame: Frame) -> bool:
    return True


def syncs(frame: Frame) -> bool:
    return frame.can_id == 0x80


@pytest.mark.parametrize("kind", [255, 1])
@pytest.mark.parametrize(("lost", "told"), [(rpdos, [DEADLINE]), (everything, [DEADLINE, HEARTBEAT])])
def test_without_commands_the_drive_comes_to_rest_by_a_quick_stop(
    kind: int, lost: Callable[[Frame], bool], told: list[int]
) -> None:
    bench = Commanded(kind)
    bench.cycles(DEADLINE_MS - 2, lost)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.emergencies() == []
    bench.cycles(2, lost)
    assert bench.shows(State.QUICK_STOP)
    assert bench.emergencies() == [DEADLINE]
    assert bench.at_rest_after_ms(lost) < RAMP_MS
    bench.cycles(100, lost)
    assert bench.shows(State.SWITCH_ON_DISABLED)
    assert bench.speed_rad_s == 0.0
    assert bench.emergencies() == told


def test_commands_that_come_again_do_not_start_a_drive_that_has_stopped() -> None:
    bench = Commanded()
    bench.cycles(DEADLINE_MS + RAMP_MS, rpdos)
    assert bench.emergencies() == [DEADLINE]
    bench.cycles(50)
    assert bench.emergencies() == [DEADLINE, 0]
    assert bench.shows(State.SWITCH_ON_DISABLED)
    assert bench.speed_rad_s == 0.0


def test_one_command_in_time_is_enough() -> None:
    bench = Commanded()
    for _ in range(5):
        bench.cycles(DEADLINE_MS - 2, rpdos)
        bench.cycles(1)
    assert bench.state is State.OPERATION_ENABLED


@pytest.mark.parametrize(
    ("option", "state"),
    [(AbortConnectionOption.FAULT_SIGNAL, State.FAULT), (AbortConnectionOption.NO_ACTION, None)],
)
def test_the_reaction_is_that_of_6007(option: AbortConnectionOption, state: State | None) -> None:
    bench = Commanded(option=option)
    bench.cycles(DEADLINE_MS + RAMP_MS, rpdos)
    assert bench.emergencies()[0] == DEADLINE
    if state is None:
        assert bench.state is State.OPERATION_ENABLED
        assert bench.speed_rad_s > 20.0
    else:
        assert bench.state is state
        assert bench.read(Object.ERROR_CODE, "H") == DEADLINE
        assert bench.speed_rad_s == 0.0


@pytest.mark.parametrize("kind", [255, 1])
def test_a_lost_sync_is_not_the_drives_to_notice(kind: int) -> None:
    """Commands go on arriving, so no deadline passes, and synchronous ones act no more: the host, which gets
    no answer, has to stop the drive by SDO or by falling silent."""
    bench = Commanded(kind)
    bench.cycles(3 * HEARTBEAT_MS, syncs)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.emergencies() == []
    assert bench.write(Object.CONTROLWORD, "H", 0x02) is None
    assert bench.shows(State.QUICK_STOP)
    bench.wait_ms(RAMP_MS)
    assert bench.shows(State.SWITCH_ON_DISABLED)
    assert bench.speed_rad_s == 0.0


def test_the_time_from_the_last_command_to_the_brake_is_the_deadline() -> None:
    bench = Commanded()
    bench.receive(Frame(RPDO, pack("<Hh", ENABLED, TORQUE)))
    last = bench.now
    while bench.state is State.OPERATION_ENABLED:
        bench.wait_ms(0.1)
    assert bench.now - last == pytest.approx(DEADLINE_MS * NS_PER_MS, abs=NS_PER_MS / 10)
