"""A bus without room for a frame: it waits in the link, by its urgency, and what is stale is given up."""

import errno
from random import Random
from typing import Any, Final

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import FramePort, WireFrame
from servobench.drivers.wire.link import BusLink
from tests.draws import few_of

FRAME_NS: Final = 130 * NS_PER_US
"""A frame of 8 bytes at 1 Mbit/s."""
SYNC, RPDO, SDO = 0x080, 0x201, 0x601


class NarrowPort(FramePort):
    """A transmit queue of ``places``, and a wire that takes a frame every ``FRAME_NS`` unless it is cut."""

    def __init__(self, places: int) -> None:
        super().__init__()
        self.places, self.now = places, Instant(0)
        self.code = errno.ENOBUFS
        self.cut = False
        self.flood_ns = self.phase_ns = 0
        """Period of another program that sends: in a twentieth of each there is room, for one frame."""
        self._last_room = -1
        self.offers = 0
        self.queued: list[WireFrame] = []
        self.wire: list[tuple[int, WireFrame]] = []
        self._free_at = 0

    def _carry(self) -> None:
        """Bring the wire up to now."""
        while self.queued and not self.cut and self._free_at + FRAME_NS <= self.now:
            self._free_at += FRAME_NS
            self.wire.append((self._free_at, self.queued.pop(0)))
        if self.cut or not self.queued:
            self._free_at = self.now

    def receive(self, until: Instant) -> WireFrame | None:
        self.now = max(self.now, until)
        self._carry()
        return None

    def transmit(self, frame: WireFrame) -> None:
        self.offers += 1
        self._carry()
        if len(self.queued) >= self.places or (self.flood_ns and not self._finds_room()):
            raise can.CanOperationError("full", self.code)
        self.queued.append(frame)

    def _finds_room(self) -> bool:
        number, rest = divmod(self.now + self.phase_ns, self.flood_ns)
        room = rest < self.flood_ns // 20 and number > self._last_room
        self._last_room = number if room else self._last_room
        return room


class NarrowBus(can.BusABC):
    """Its own clock as well."""

    def __init__(self, places: int) -> None:
        super().__init__(channel="narrow")
        self.channel_info = "narrow"
        self.frame_port = NarrowPort(places)

    def now(self) -> Instant:
        return self.frame_port.now

    def sleep_until(self, when: Instant) -> None:
        self.frame_port.receive(when)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.fixture(name="made", params=[1, 10])
def made_with(request: pytest.FixtureRequest) -> Any:
    bus = NarrowBus(request.param)
    yield bus.frame_port, BusLink(bus, bus)
    bus.shutdown()


def test_a_burst_of_requests_goes_out_whole_and_in_order(made: tuple[NarrowPort, BusLink]) -> None:
    port, link = made
    seen: list[int] = []
    link.tap(lambda _way, can_id, _data, _extended, _remote, _at: seen.append(can_id))
    for node in range(1, 128):
        link.send(0x600 + node, bytes(8))
    assert link.needs_watching
    link.recv(Instant(127 * FRAME_NS + NS_PER_MS))
    assert [frame.can_id for _, frame in port.wire] == [0x600 + node for node in range(1, 128)] == seen
    assert (link.sent_frames, link.unsent_frames, link.needs_watching) == (127, 0, False)
    last_at, _ = port.wire[-1]
    assert last_at <= 129 * FRAME_NS, "the wire never waited for the link"


def test_a_bus_that_takes_nothing_is_offered_frames_ever_more_seldom(
    made: tuple[NarrowPort, BusLink],
) -> None:
    """Each 0.5 to 1 ms, which leaves others time on the bench's processor."""
    port, link = made
    port.cut = True
    for node in range(1, 21):
        link.send(0x600 + node, bytes(8))
    link.recv(Instant(900 * NS_PER_MS))
    assert 1150 <= port.offers < 1250
    port.cut = False
    link.recv(Instant(905 * NS_PER_MS))
    assert (link.sent_frames, link.needs_watching) == (20, False)


@pytest.mark.parametrize("period_us", [250, 500, 1000, 2000])
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.6, 0.9])
def test_retries_are_in_step_with_no_flood(
    made: tuple[NarrowPort, BusLink], period_us: int, phase: float
) -> None:
    """Another program leaves room for a twentieth of each of its periods: a hundred requests go out within
    ten seconds, and the bus is not taken for one that is down."""
    port, link = made
    port.flood_ns = period_us * NS_PER_US
    port.phase_ns = round(phase * port.flood_ns)
    for node in range(1, 101):
        link.send(0x600 + node, bytes(8))
    link.recv(Instant(10 * NS_PER_S))
    assert (link.sent_frames, link.unsent_frames, link.needs_watching) == (100, 0, False)


def test_what_a_loop_sends_goes_before_what_somebody_asks(made: tuple[NarrowPort, BusLink]) -> None:
    port, link = made
    for node in range(1, 60):
        link.send(0x600 + node, bytes(8))
    for can_id, data in ((RPDO, b"\1\2"), (SYNC, b""), (0x000, b"\2\1")):
        link.send(can_id, data)
    link.recv(Instant(100 * FRAME_NS))
    order = [frame.can_id for _, frame in port.wire]
    first = order.index(0x000)
    assert order[first : first + 3] == [0x000, RPDO, SYNC]
    assert first <= port.places + 1


def test_of_a_command_the_newest_alone_is_sent_and_the_others_are_told(
    made: tuple[NarrowPort, BusLink],
) -> None:
    port, link = made
    unsent: list[tuple[int, int]] = []
    link.on_unsent = lambda can_id, at: unsent.append((can_id, at))
    told: list[str] = []
    link.on_trouble = lambda text, _at: told.append(text)
    port.cut = True
    asked = []
    for cycle in range(40):
        at = Instant(cycle * NS_PER_MS)
        link.recv(at)
        asked.append((link.send(SYNC, b""), link.send(RPDO, bytes([cycle]))))
    port.cut = False
    link.recv(Instant(60 * NS_PER_MS))
    sent = [frame for _, frame in port.wire]
    assert sent[-1] == WireFrame(RPDO, bytes([39]))
    assert link.sent_frames == len(sent)
    assert sorted(unsent) == sorted(
        (can_id, at)
        for pair in asked
        for can_id, at in zip((SYNC, RPDO), pair, strict=True)
        if at not in {frame.handed_at for frame in sent if frame.can_id == can_id}
    )
    assert link.unsent_frames == len(unsent) == 80 - len(sent)
    assert [text.split()[1] for text in told] == ["takes", "takes"]
    assert f"{len(unsent)} were given up" in told[1]


def test_what_may_wait_no_longer_is_given_up_and_the_rest_goes_out(made: tuple[NarrowPort, BusLink]) -> None:
    """As a SYNC of half a period ago, which would come just before the next."""
    port, link = made
    unsent: list[int] = []
    link.on_unsent = lambda can_id, _at: unsent.append(can_id)
    link.patience[SYNC] = Duration(NS_PER_MS)
    port.cut = True
    for _ in range(port.places):
        link.send(SDO, b"")
    link.send(SYNC, b"")
    link.send(RPDO, b"")
    link.recv(Instant(2 * NS_PER_MS))
    port.cut = False
    link.recv(Instant(20 * NS_PER_MS))
    assert [frame.can_id for _, frame in port.wire] == [*[SDO] * port.places, RPDO]
    assert unsent == [SYNC]


def test_what_is_withdrawn_is_told_and_goes_out_no_more(made: tuple[NarrowPort, BusLink]) -> None:
    """As the SYNC and the set-point of a run that ends, ahead of what stops the drive."""
    port, link = made
    unsent: list[int] = []
    link.on_unsent = lambda can_id, _at: unsent.append(can_id)
    told: list[str] = []
    link.on_trouble = lambda text, _at: told.append(text)
    port.cut = True
    for _ in range(port.places):
        link.send(SDO, b"")
    for can_id in (SYNC, RPDO):
        link.send(can_id, b"")
    link.withdraw({SYNC, RPDO})
    link.recv(Instant(NS_PER_MS))
    assert told[1] == "narrow is offered no more frames; 2 were given up meanwhile", "it takes none yet"
    for can_id in (0x000, 0x701, SDO):
        link.send(can_id, b"")
    link.withdraw({SYNC, RPDO})
    port.cut = False
    link.recv(Instant(20 * NS_PER_MS))
    assert [frame.can_id for _, frame in port.wire] == [*[SDO] * port.places, 0x000, 0x701, SDO]
    assert unsent == [SYNC, RPDO]
    assert told[-1] == "narrow takes frames again; 0 were given up meanwhile"


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.ENETDOWN])
def test_a_bus_that_takes_nothing_for_a_second_is_down(code: int) -> None:
    bus = NarrowBus(1)
    port, link = bus.frame_port, BusLink(bus, bus)
    port.cut, port.code = True, code
    link.send(SYNC, b"")
    link.send(RPDO, b"")
    link.recv(Instant(NS_PER_S - NS_PER_MS))
    with pytest.raises(BusDown, match="cannot send on narrow; it has taken no frame for a second"):
        link.recv(Instant(2 * NS_PER_S))
    assert port.now < NS_PER_S + 10 * NS_PER_MS
    bus.shutdown()


def test_another_failure_ends_at_once(made: tuple[NarrowPort, BusLink]) -> None:
    port, link = made
    port.cut, port.code = True, errno.ENXIO
    for _ in range(port.places):
        link.send(SYNC, b"")
    with pytest.raises(BusDown, match=r"full.*; check that the interface is up"):
        link.send(SYNC, b"")
    port.cure = "plug it in"
    with pytest.raises(BusDown, match=r"full.*; plug it in"):
        link.send(SYNC, b"")


@pytest.mark.parametrize("seed", few_of(range(20), 5))
def test_nothing_is_unaccounted_and_no_command_is_older_than_one_before_it(seed: int) -> None:
    """Drawn: sizes of the queue, cuts of the wire, and what is sent when."""
    draw = Random(seed)
    bus = NarrowBus(draw.choice((1, 2, 5, 10)))
    port, link = bus.frame_port, BusLink(bus, bus)
    unsent: list[tuple[int, int]] = []
    link.on_unsent = lambda can_id, at: unsent.append((can_id, at))
    handed: list[tuple[int, int]] = []
    for cycle in range(300):
        port.cut = draw.random() < 0.3
        link.recv(Instant(cycle * NS_PER_MS))
        for can_id in draw.sample((SYNC, RPDO, 0x302, SDO, SDO + 1, 0x000, 0x701), draw.randrange(6)):
            handed.append((can_id, link.send(can_id, bytes([cycle & 0xFF]))))
    port.cut = False
    link.recv(Instant(port.now + NS_PER_S))
    sent = [(frame.can_id, frame.handed_at) for _, frame in port.wire]
    assert sorted(sent + unsent) == sorted(handed)
    assert not {can_id for can_id, _ in unsent} & {SDO, SDO + 1, 0x000}
    for can_id in (SYNC, RPDO, 0x302, SDO, SDO + 1, 0x000, 0x701):
        instants = [at for one, at in sent if one == can_id]
        assert instants == sorted(instants)
    bus.shutdown()
