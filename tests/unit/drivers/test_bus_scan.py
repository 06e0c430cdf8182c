"""Who is on a bus, and who has no node-ID yet: on a simulated segment in simulated time."""

from collections.abc import Sequence

import pytest

from servobench.drivers.canopen.bus_scan import BusScan, NodeFound
from servobench.drivers.canopen.lss import BOOT_NS, LssAddress, LssMaster
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import FramePort
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.hearing import Hearing

UNCONFIGURED = 255


class DeafPort(FramePort):
    """Each ``every``-th frame is not heard."""

    def __init__(self, inner: FramePort, every: int) -> None:
        super().__init__()
        self._inner, self._every, self._count = inner, every, 0

    def receive(self, until: Instant) -> Frame | None:
        while (frame := self._inner.receive(until)) is not None:
            self._count += 1
            if self._count % self._every:
                self.came_at = self._inner.came_at
                break
        return frame

    def transmit(self, frame: Frame) -> None:
        self._inner.transmit(frame)


class Bench:
    """A segment with simulated drives and a master that may be hard of hearing."""

    def __init__(self, nodes: Sequence[int] = (), drop_every: int = 0) -> None:
        self.timeline = Timeline()
        self.segment = CanSegment(self.timeline)
        self.frames: list[Frame] = []
        self.segment.add_monitor(lambda frame, _at: self.frames.append(frame))
        bus = SimulatedBus(segment=self.segment)
        if drop_every:
            bus.frame_port = DeafPort(bus.frame_port, drop_every)  # type: ignore[assignment]
        clock = SimulatedClock(self.timeline)
        self.network = CanopenNetwork(
            BusLink(bus, clock, StampSource.MONOTONIC, "simulated"), clock, writes=RIG
        )
        self.servos = [self.add(node) for node in nodes]
        self.network.pump(Instant(NS_PER_MS))

    def add(self, node: int, serial_number: int | None = None, boot_ns: int = 0) -> SimulatedServo:
        servo = SimulatedServo(node, LING2012.parameters)
        servo.follow_boot_time(lambda: boot_ns)
        if serial_number is not None:
            identity = servo.dictionary.variable(0x1018, 4)
            identity.value = identity.default = serial_number
        AttachedDevice(servo, self.segment)
        return servo

    def scan(self, listen_s: float = 1.0) -> BusScan:
        scan = BusScan(self.network)
        scan.listen(Duration(round(listen_s * NS_PER_S)))
        return scan


def heartbeat_of(bench: Bench, node: int, period_ms: int) -> None:
    bench.network.download(node, 0x1017, 0, period_ms.to_bytes(2, "little"))


def test_nodes_are_found_with_what_they_say_of_themselves() -> None:
    bench = Bench([1, 5, 127])
    heartbeat_of(bench, 5, 100)
    scan = bench.scan()
    assert list(scan.nodes) == [5], "only the node with a heartbeat can be heard"
    scan.probe()
    found = scan.found()
    assert [node.node_id for node in found] == [1, 5, 127]
    either = "operational or pre-operational"
    assert [node.nmt_state for node in found] == [either, "pre-operational", either]
    for node in found:
        assert node.device_type == 0x00020192
        assert node.profile == "servo drive (CiA 402)"
        assert node.error_register == 0
        assert node.serial_number == node.node_id
        assert "servobench" in node.name
        assert node.note == ""
    assert found[1].heartbeat_ms == 100
    assert found[1].heard["heartbeat"] >= 9


def test_a_node_that_boots_while_it_is_asked_is_read_once_it_has() -> None:
    bench = Bench([1])
    bench.add(9, boot_ns=2 * NS_PER_S)
    scan = bench.scan(0.1)
    scan.probe()
    scan.read_booted()
    assert list(scan.nodes) == [1], "it is silent"
    bench.network.pump(Instant(2 * NS_PER_S + 10 * NS_PER_MS))
    bench.frames.clear()
    scan.read_booted()
    assert [node.serial_number for node in scan.found()] == [1, 9]
    assert {frame.can_id for frame in bench.frames} == {0x589, 0x609}, "nobody is read twice"


def test_listening_sends_nothing() -> None:
    bench = Bench([1])
    bench.frames.clear()
    bench.scan()
    assert bench.frames == []


def test_a_node_that_comes_after_another_master_has_asked_for_it_says_why_it_was_not_read() -> None:
    bench = Bench([1])
    other = bench.segment.attach("other master", Listener())
    asked_at = Instant(bench.timeline.now + NS_PER_MS)
    bench.timeline.call_at(asked_at, lambda _now: other.send(Frame(0x605, bytes.fromhex("4018100100000000"))))
    scan = bench.scan()
    bench.add(5, boot_ns=NS_PER_S)
    scan.probe()
    bench.network.pump(Instant(bench.timeline.now + 2 * NS_PER_S))
    scan.read_booted()
    assert [node.note for node in scan.found()] == ["", "not asked: another master uses its SDO channel"]


def test_asking_takes_a_small_part_of_the_bus_and_leaves_states_alone() -> None:
    bench = Bench([1])
    scan = bench.scan(0.1)
    bench.frames.clear()
    began = bench.timeline.now
    scan.probe()
    assert bench.segment.load_percent(began, bench.timeline.now) < 15.0
    assert {frame.can_id & 0x780 for frame in bench.frames} == {0x580, 0x600}
    commands = {frame.data[0] >> 5 for frame in bench.frames if frame.can_id & 0x780 == 0x600}
    assert commands <= {2, 3}, "something other than an upload was asked for"


def test_traffic_is_sorted_by_what_it_is() -> None:
    bench = Bench([])
    port = bench.segment.attach("others", Listener())
    for frame in (
        Frame(0x080),
        Frame(0x185, b"1"),
        Frame(0x7E5, bytes(8)),
        Frame(0x12345, b"", True),
        Frame(0x6E0),
    ):
        port.send(frame)
    scan = bench.scan(0.1)
    assert scan.traffic.broadcasts == {"SYNC": 1, "LSS request": 1}
    assert scan.traffic.by_node[5] == {"PDO": 1}
    assert scan.traffic.others == 2
    assert scan.traffic.running
    (five,) = scan.found()
    assert (five.node_id, five.nmt_state) == (5, "operational")


@pytest.mark.parametrize(
    ("device_type", "text"),
    [
        (0x00020192, "servo drive (CiA 402)"),
        (0x00040192, "stepper drive (CiA 402)"),
        (0x00000192, "drive (CiA 402)"),
        (0x000F0191, "I/O module (CiA 401)"),
        (0x00000196, "encoder (CiA 406)"),
        (0x00220811, "device of profile 2065 (0811h), no profile of CiA known here"),
        (0, "no standard profile"),
        (None, ""),
    ],
)
def test_device_types_in_words(device_type: int | None, text: str) -> None:
    assert NodeFound(1, device_type=device_type).profile == text


def test_devices_without_node_id_are_found_and_left_as_they_were() -> None:
    bench = Bench([1])
    bench.add(UNCONFIGURED, 0x80000001)
    bench.add(UNCONFIGURED, 0x00000002)
    master = LssMaster(bench.network)
    assert master.any_unconfigured()
    found = list(master.search())
    assert [address.serial_number for address in found] == [0x00000002, 0x80000001], "lowest number first"
    assert {address.product_code for address in found} == {0x00010402}
    assert list(master.search()) == found
    master.close()


def test_an_assigned_device_boots_with_its_node_id() -> None:
    bench = Bench([1])
    servo = bench.add(UNCONFIGURED, 77)
    master = LssMaster(bench.network)
    (address,) = master.search()
    bench.frames.clear()
    servo.follow_boot_time(lambda: 2 * NS_PER_S)
    assert master.assign(address, 9, store=True)
    assert bench.frames[-1] == Frame(0x709, b"\x00"), "it was left to boot, and not asked meanwhile"
    assert not master.any_unconfigured()
    assert list(master.search()) == []
    assert bench.network.upload(9, 0x1018, 4) == (77).to_bytes(4, "little")
    assert servo.node_id == 9


def test_once_the_last_device_has_its_node_id_the_search_only_asks_for_anybody() -> None:
    bench = Bench()
    bench.add(UNCONFIGURED, 77)
    master = LssMaster(bench.network)
    for address in master.search():
        assert master.assign(address, 9)
        bench.frames.clear()
    asked = [frame.data for frame in bench.frames if frame.can_id == 0x7E5 and frame.data[0] == 0x51]
    assert asked
    assert set(asked) == {bytes.fromhex("5100000000800000")}, "CiA 305: is anybody without node-ID?"


def test_a_device_that_does_not_boot_with_its_node_id_is_told() -> None:
    bench = Bench()
    bench.add(UNCONFIGURED, 77).follow_boot_time(lambda: 60 * NS_PER_S)
    master = LssMaster(bench.network)
    (address,) = master.search()
    began = bench.timeline.now
    assert not master.assign(address, 9)
    assert BOOT_NS <= bench.timeline.now - began < BOOT_NS + NS_PER_S


def test_a_search_gets_through_where_frames_are_lost() -> None:
    bench = Bench([], drop_every=40)
    bench.add(UNCONFIGURED, 0x12345678)
    (address,) = LssMaster(bench.network).search()
    assert address.serial_number == 0x12345678


def test_a_search_that_leads_nowhere_is_an_error() -> None:
    bench = Bench([])

    def answer(frame: Frame, _at: Instant) -> None:
        """Only ever says that it is there."""
        if frame.can_id == 0x7E5 and frame.data[5] == 0x80:
            scared.send(Frame(0x7E4, b"\x4f".ljust(8, b"\0")))

    scared = bench.segment.attach("scared", Hearing(answer))
    with pytest.raises(NoAnswer, match="but none was found"):
        list(LssMaster(bench.network).search())


def test_a_device_that_refuses_or_is_gone_is_named() -> None:
    bench = Bench([])
    bench.add(UNCONFIGURED, 3)
    master = LssMaster(bench.network)
    (address,) = master.search()
    with pytest.raises(PeerFault, match="refuses node-ID 200"):
        master.assign(address, 200)
    with pytest.raises(NoAnswer, match="serial 00000004h does not answer"):
        master.assign(LssAddress(*address[:3], 4), 9)
    assert master.any_unconfigured(), "the refused device was left in the configuration state"


def test_a_drive_is_waited_for_while_it_boots() -> None:
    bench = Bench()
    bench.add(5, boot_ns=3 * NS_PER_S)
    assert ServoDrive(bench.network, 5).connect(Instant(5 * NS_PER_S)).serial == 5
    assert 3 * NS_PER_S < bench.timeline.now < 4 * NS_PER_S
    bench.add(6, boot_ns=10 * NS_PER_S)
    with pytest.raises(NoAnswer):
        ServoDrive(bench.network, 6).connect(Instant(8 * NS_PER_S))
