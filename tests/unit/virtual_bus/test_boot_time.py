"""A simulated drive that was reset takes its time to boot, as a real one does: what a tap on the bus sees."""

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.motors import LING

RESETS = pytest.mark.parametrize("reset", [0x81, 0x82])
BOOT_UP = Frame(0x705, b"\x00")
UPLOAD = bytes.fromhex("4000100000000000")
FRAME_NS = NS_PER_MS // 4


class Tap:
    """A drive on a segment, and every frame of it with the instant at which it ended."""

    def __init__(self, drive: DriveParameters) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline)
        self.servo = SimulatedServo(5, LING, drive)
        AttachedDevice(self.servo, segment)
        self._master = segment.attach("master", Listener())
        self.seen: list[tuple[Instant, Frame]] = []
        segment.add_monitor(lambda frame, at: self.seen.append((at, frame)))
        self.pass_ms(1)

    def state(self) -> NmtState:
        return self.servo.state

    def pass_ms(self, milliseconds: int) -> None:
        self.timeline.run_until(Instant(self.timeline.now + milliseconds * NS_PER_MS))

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> None:
        self._master.send(Frame(can_id, data, remote=remote))
        self.pass_ms(1)

    def told(self, since: Instant) -> list[tuple[Instant, Frame]]:
        """What the drive sent: no identifier of its own is the master's."""
        theirs = (0x000, 0x080, 0x205, 0x605)
        return [(at, frame) for at, frame in self.seen if at >= since and frame.can_id not in theirs]


@RESETS
def test_nothing_is_heard_of_it_until_its_boot_up(reset: int) -> None:
    tap = Tap(DriveParameters())
    tap.send(0x000, b"\x01\x05")
    began = tap.timeline.now
    tap.send(0x000, bytes([reset, 5]))
    for _ in range(9):
        tap.send(0x605, UPLOAD)
        tap.send(0x080)
        tap.send(0x205, b"\x0f\x00\x00\x00")
        tap.send(0x000, b"\x01\x05")
    assert tap.state() is NmtState.INITIALISING
    tap.pass_ms(60)
    ((at, frame),) = tap.told(began)
    assert frame == BOOT_UP
    assert 40 * NS_PER_MS <= at - began <= 40 * NS_PER_MS + FRAME_NS
    assert tap.state() is NmtState.PRE_OPERATIONAL, "the start it was sent while it booted went by"
    tap.send(0x605, UPLOAD)
    assert tap.seen[-1][1].can_id == 0x585


@RESETS
def test_its_heartbeat_goes_on_a_period_after_the_boot_up(reset: int) -> None:
    tap = Tap(DriveParameters(heartbeat_ms=15))
    tap.pass_ms(40)
    began = tap.timeline.now
    tap.send(0x000, bytes([reset, 5]))
    tap.pass_ms(80)
    told = tap.told(began)
    assert [frame.data for _, frame in told] == [b"\x00", b"\x7f", b"\x7f"]
    boot_up, first, second = (at for at, _ in told)
    assert first - boot_up == second - first == 15 * NS_PER_MS


@RESETS
def test_a_second_reset_while_it_boots_is_not_heard(reset: int) -> None:
    tap = Tap(DriveParameters())
    began = tap.timeline.now
    tap.send(0x000, bytes([reset, 5]))
    tap.pass_ms(20)
    tap.send(0x000, bytes([reset, 5]))
    tap.pass_ms(80)
    ((at, frame),) = tap.told(began)
    assert (frame, at - began < 41 * NS_PER_MS) == (BOOT_UP, True)


def test_power_that_comes_back_while_it_boots_begins_anew() -> None:
    servo = SimulatedServo(5, LING)
    assert list(servo.start(Instant(0))) == [BOOT_UP]
    assert not servo.receive(Frame(0x000, b"\x81\x05"), Instant(NS_PER_MS))
    assert list(servo.start(Instant(2 * NS_PER_MS))) == [BOOT_UP]
    assert not [frame for ms in range(3, 60) for frame in servo.wake(Instant(ms * NS_PER_MS))]
