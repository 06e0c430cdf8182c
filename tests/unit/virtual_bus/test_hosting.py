"""Devices on a segment in simulated time, and on a python-can bus."""

import errno
import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import can
import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import FramePort
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.device_options import DeviceOptions
from servobench.virtual_bus.device.station import CommunicationLoss
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Device, Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice, serve
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.hearing import Hearing
from tests.motors import LING
from tests.unit.virtual_bus.device_bench import LEVEL, NODE, START, RecordingApplication

MS = 1_000_000


def device(node_id: int = NODE, heartbeat_ms: int = 0) -> CanopenDevice:
    return CanopenDevice(node_id, RecordingApplication(), DeviceOptions(heartbeat_ms=heartbeat_ms))


def losses_of_heartbeat(watcher: CanopenDevice) -> list[object]:
    application = watcher.application
    assert isinstance(application, RecordingApplication)
    return [call[-1] for call in application.calls if call[0] == "loss"]


def test_timers_of_an_attached_device_follow_the_timeline() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    seen: list[tuple[int, int]] = []
    segment.add_monitor(lambda frame, at: seen.append((frame.can_id, at // MS)))
    AttachedDevice(device(heartbeat_ms=10), segment)
    timeline.run_until(Instant(35 * MS))
    assert seen == [(0x705, 0), (0x705, 10), (0x705, 20), (0x705, 30)]


def test_deadline_that_is_put_off_does_not_fire_early() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    master = segment.attach("master", Listener())
    node = device()
    AttachedDevice(node, segment)
    master.send(Frame(0, bytes([START, 0])))
    master.send(Frame(0x600 + NODE, b"\x23\x16\x10\x01\x96\x00\x7f\x00"))
    for milliseconds in range(1, 1001, 50):
        timeline.run_until(Instant(milliseconds * MS))
        master.send(Frame(0x77F, b"\x05"))
    timeline.run_until(Instant(1100 * MS))
    before = node.state
    timeline.run_until(Instant(1102 * MS))
    assert (before, node.state) == (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL)


def test_two_devices_hear_each_other() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    watcher, watched = device(1), device(2, heartbeat_ms=10)
    AttachedDevice(watcher, segment)
    plugged = AttachedDevice(watched, segment)
    watcher.dictionary.download(0x1016, 1, (2 << 16 | 25).to_bytes(4, "little"))
    register = watcher.dictionary.variable(0x1001)
    timeline.run_until(Instant(100 * MS))
    before = register.value
    plugged.detach()
    timeline.run_until(Instant(200 * MS))
    assert (before, register.value) == (0, ErrorRegister.GENERIC | ErrorRegister.COMMUNICATION)


def test_device_that_is_plugged_in_again_boots_up_anew() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    seen: list[tuple[int, bytes]] = []
    segment.add_monitor(lambda frame, at: seen.append((at // MS, frame.data)))
    node = device(heartbeat_ms=10)
    plugged = AttachedDevice(node, segment)
    timeline.run_until(Instant(15 * MS))
    node.receive(Frame(0, bytes([START, 0])), timeline.now)
    plugged.detach()
    timeline.run_until(Instant(42 * MS))
    AttachedDevice(node, segment)
    timeline.run_until(Instant(55 * MS))
    assert seen == [(0, b"\x00"), (10, b"\x7f"), (42, b"\x00"), (52, b"\x7f")]


def test_full_queue_loses_frames_and_counts_them() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    node = device()
    attached = AttachedDevice(node, segment)
    for _ in range(300):
        node.dictionary.download(0x1017, 0, b"\x01\x00")
    attached.wake_now()
    assert attached.frames_lost == 300 + 1 - 256


def test_serve_on_a_python_can_bus() -> None:
    bus = SimulatedBus(channel="drive")
    clock = SimulatedClock(bus.timeline)
    master = bus.segment.attach("master", Hearing(lambda frame, _at: answers.append(frame)))
    answers: list[Frame] = []
    read = bytes([0x40, *LEVEL.to_bytes(2, "little"), 0, 0, 0, 0, 0])
    bus.timeline.post(Instant(5 * MS), lambda _now: master.send(Frame(0x605, read)))
    serve([device(heartbeat_ms=20)], bus, clock, lambda: clock.now() >= 50 * MS)
    bus.timeline.run_until(Instant(60 * MS))
    assert [frame.can_id for frame in answers] == [0x705, 0x585, 0x705, 0x705]
    assert answers[1].data[4:] == b"\x07\x00\x00\x00"
    bus.shutdown()


def test_served_devices_hear_each_other() -> None:
    bus = SimulatedBus(channel="drives")
    clock = SimulatedClock(bus.timeline)
    watcher, watched = device(1), device(2, heartbeat_ms=40)
    watcher.dictionary.variable(0x1016, 1).power_on = 2 << 16 | 25
    serve([watcher, watched], bus, clock, lambda: clock.now() >= 50 * MS)
    # 25 ms after each heartbeat, those at 0 and 40 ms: the second ended the first loss
    assert losses_of_heartbeat(watcher)[:2] == [25 * MS, 65 * MS]
    bus.shutdown()


def test_dead_bus_ends_with_a_clear_error() -> None:
    bus = SimulatedBus(channel="drive")
    clock = SimulatedClock(bus.timeline)
    bus.shutdown()
    with pytest.raises(BusDown, match="went away"):
        serve([device()], bus, clock, lambda: False)


class PlainBus(can.BusABC):
    """A bus that python-can alone knows, with no port of its own; ``simulated`` is behind it."""

    def __init__(self, channel: str = "drive") -> None:
        self.simulated = SimulatedBus(channel=channel)
        self.timeline = self.simulated.timeline
        self.segment = self.simulated.segment
        super().__init__(channel)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.simulated.recv(timeout)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.simulated.send(msg, timeout)

    def shutdown(self) -> None:
        super().shutdown()
        self.simulated.shutdown()


class FullBus(PlainBus):
    """An adapter whose transmit buffer is full."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        raise can.CanOperationError("no buffer space available", errno.ENOBUFS)


def test_full_adapter_loses_frames_and_goes_on() -> None:
    bus = FullBus(channel="drive")
    clock = SimulatedClock(bus.timeline)
    serve([device(heartbeat_ms=1)], bus, clock, lambda: clock.now() >= 5 * MS)
    assert clock.now() >= 5 * MS
    bus.shutdown()


def losses_told(node: CanopenDevice) -> list[object]:
    application = node.application
    assert isinstance(application, RecordingApplication)
    return [call[1] for call in application.calls if call[0] == "loss"]


def test_served_device_hears_that_its_adapter_went_bus_off_and_came_back() -> None:
    bus = SimulatedBus(channel="drive")
    clock, node = SimulatedClock(bus.timeline), device(heartbeat_ms=10)
    heard: list[tuple[int, bytes]] = []
    master = bus.segment.attach("master", Hearing(lambda frame, at: heard.append((at // MS, frame.data[:2]))))
    bus.timeline.post(Instant(2 * MS), lambda _now: master.send(Frame(0, bytes([START, 0]))))
    bus.timeline.post(Instant(25 * MS), lambda _now: bus.port.go_bus_off())
    bus.timeline.post(Instant(55 * MS), lambda _now: bus.port.recover())
    serve([node], bus, clock, lambda: clock.now() >= 85 * MS)
    assert losses_told(node) == [CommunicationLoss.BUS_OFF]
    assert (0, b"\x00") in heard
    assert [entry for entry in heard if 25 <= entry[0] < 55] == []
    assert [data for _, data in heard if data in (b"\x40\x81", b"\x00\x00")] == [b"\x40\x81", b"\x00\x00"]
    assert heard[-1] == (80, b"\x7f")
    bus.shutdown()


class TellingBus(PlainBus):
    """As SocketCAN: bus-off is told by error frames alone, and sending meanwhile is refused."""

    told: ClassVar[list[tuple[int, int]]] = []

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = super().recv(timeout)
        if self.told and self.timeline.now >= self.told[0][0]:
            _, identifier = self.told.pop(0)
            return can.Message(arbitration_id=identifier, is_error_frame=True, dlc=8, data=bytes(8))
        return message


@pytest.mark.parametrize("back", ["restarted", "a frame"])
def test_error_frames_tell_of_bus_off_where_the_bus_does_not(back: str) -> None:
    bus = TellingBus(channel="drive")
    bus.told[:] = [(25 * MS, 0x40)] + [(55 * MS, 0x100)] * (back == "restarted")
    clock, node = SimulatedClock(bus.timeline), device(heartbeat_ms=10)
    heard: list[tuple[int, bytes]] = []
    master = bus.segment.attach("master", Hearing(lambda frame, at: heard.append((at // MS, frame.data[:2]))))
    if back == "a frame":
        bus.timeline.post(Instant(55 * MS), lambda _now: master.send(Frame(0x123)))
    serve([node], bus, clock, lambda: clock.now() >= 85 * MS)
    assert losses_told(node) == [CommunicationLoss.BUS_OFF]
    assert [entry for entry in heard if 26 <= entry[0] < 55] == []
    assert b"\x40\x81" in [data for _, data in heard]
    assert heard[-1] == (80, b"\x7f")
    bus.shutdown()


class ManualClock:
    """A clock that its bus moves on."""

    def __init__(self) -> None:
        self.at = 0

    def now(self) -> Instant:
        return Instant(self.at)

    def sleep_until(self, when: Instant) -> None:
        self.at = max(self.at, when)


class LatePort(FramePort):
    """An adapter: frames with the stamps that they came with, read by a process that wakes late."""

    def __init__(self, clock: ManualClock, late_ns: int) -> None:
        super().__init__()
        self.coming: list[tuple[int, Frame, bool]] = []
        """Stamp, frame, whether it is an echo; in order."""
        self.sent: list[tuple[int, Frame]] = []
        self._clock = clock
        self._late_ns = late_ns

    def receive(self, until: Instant) -> Frame | None:
        clock, coming = self._clock, self.coming
        if not coming or coming[0][0] > max(until, clock.at):
            if clock.at < until:
                clock.at = until + self._late_ns
            if not coming or coming[0][0] > clock.at:
                return None
        stamp, frame, self.came_own = coming.pop(0)
        self.came_at = Instant(stamp)
        clock.at = max(clock.at, stamp + self._late_ns)
        return frame

    def transmit(self, frame: Frame) -> None:
        self.sent.append((self._clock.at, frame))


class LateBus(can.BusABC):
    """What goes around a :class:`LatePort`."""

    def __init__(self, late_ns: int) -> None:
        self.clock = ManualClock()
        self.frame_port = LatePort(self.clock, late_ns)
        super().__init__("late")

    def serve(self, devices: Sequence[Device], until_ms: float) -> list[tuple[int, Frame]]:
        """What the devices sent by then, and when."""
        serve(devices, self, self.clock, lambda: self.clock.at >= until_ms * MS)
        self.shutdown()
        return self.frame_port.sent

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


class Diary:
    """A device that notes what it is told, and wants to be woken every ``period_ns``."""

    def __init__(self, period_ns: int = 1 << 60) -> None:
        self.calls: list[tuple[str, int]] = []
        self._period_ns = period_ns

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at: Instant | None = Instant(now + self._period_ns)
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        self.calls.append((f"{frame.can_id:X}", now))
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self.calls.append(("wake", now))
        self.wake_at = Instant(now + self._period_ns)
        return ()


@pytest.mark.parametrize("late_ns", [0, 400_000, 3_700_000])
def test_a_drive_samples_at_the_sync_however_late_its_process_wakes(late_ns: int) -> None:
    """Beside a drive whose process is never late: the same stamps and the same motion, later."""

    def run(late: int) -> tuple[list[bytes], list[int]]:
        bus = LateBus(late)
        commands = [0x06, 0x07, *[0x0F] * 50]
        for n, controlword in enumerate(commands, start=2):
            bus.frame_port.coming += [
                (n * MS, Frame(0x80), False),
                (n * MS + 300_000, Frame(0x201, struct.pack("<Hh", controlword, 800)), False),
            ]
        bus.frame_port.coming.insert(0, (MS, Frame(0, bytes([START, 0])), False))
        sent = bus.serve([SimulatedServo(1, LING)], 60)
        told = [(at, frame.data) for at, frame in sent if frame.can_id in (0x181, 0x281)]
        return [data for _, data in told], [at for at, _ in told]

    (on_time, _), (late, left_at) = run(0), run(late_ns)
    assert late == on_time
    stamps = [struct.unpack_from("<I", data, 4)[0] for data in late[1::2]]
    assert {after - before for before, after in pairwise(stamps)} == {1000}
    assert struct.unpack_from("<i", late[-2], 2)[0] > 100_000, "the shaft turns, in 0.001 rev/min"
    assert all(at >= (n // 2 + 2) * MS + late_ns for n, at in enumerate(left_at))


def test_frames_and_timers_come_in_the_order_of_their_instants() -> None:
    bus = LateBus(5 * MS)
    bus.frame_port.coming = [(at, Frame(0x100), False) for at in (400_000, 1_600_000, 3_000_000)]
    diary = Diary(MS)
    bus.serve([diary], 10)
    assert diary.calls[:7] == [
        ("100", 400_000),
        ("wake", 1_000_000),
        ("100", 1_600_000),
        ("wake", 2_000_000),
        ("wake", 3_000_000),
        ("100", 3_000_000),
        ("wake", 4_000_000),
    ]


def test_time_runs_neither_backwards_nor_ahead_of_the_clock() -> None:
    bus = LateBus(0)
    stamps = (2_000_000, 1_500_000, 1_000_000, 2_500_000)
    bus.frame_port.coming = [(at, Frame(0x100), False) for at in stamps]
    diary = Diary()
    bus.serve([diary], 3)
    assert [at for _, at in diary.calls] == [2_000_000, 2_000_000, 2_000_000, 2_500_000]
    ahead = LateBus(-200_000)
    ahead.frame_port.coming = [(2_000_000, Frame(0x100), False)]
    diary = Diary()
    ahead.serve([diary], 3)
    assert diary.calls == [("100", 1_800_000)]


def test_a_process_that_stood_still_does_not_make_up_for_all_of_it() -> None:
    bus = LateBus(2_000 * MS)
    sent = bus.serve([device(heartbeat_ms=50)], 2_000)
    assert [frame.can_id for _, frame in sent] == [0x705] * 4, "boot-up, and 1.95 to 2.05 s"


def test_an_echo_is_no_frame_for_a_device() -> None:
    bus = LateBus(0)
    bus.frame_port.coming = [(MS, Frame(0x100), True), (2 * MS, Frame(0x101), False)]
    diary = Diary()
    bus.serve([diary], 3)
    assert [name for name, _ in diary.calls] == ["101"]
