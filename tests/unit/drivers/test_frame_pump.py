"""The pump: echoes go to their handlers alone; while it rests, frames wait and keep their stamps."""

from collections.abc import Callable

import can
import pytest

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.canopen.frame_pump import FramePump
from servobench.drivers.timebase import NEVER, NS_PER_MS, Instant
from servobench.drivers.wire.frame_port import EchoBasis, FramePort, WireFrame
from servobench.drivers.wire.link import BusLink
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import SimulatedClock, Timeline

TPDO, RPDO = 0x181, 0x201
MS = NS_PER_MS


class Bench:
    """A pump on a simulated segment, with a peer; what it hands out is noted with the time then."""

    def __init__(self) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline)
        self.peer = segment.attach("peer", Listener())
        self.ended: list[tuple[int, Instant]] = []
        segment.add_monitor(lambda frame, at: self.ended.append((frame.can_id, at)))
        self.bus = SimulatedBus(segment=segment, receive_own_messages=True)
        self.clock = SimulatedClock(self.timeline)
        self.link = BusLink(self.bus, self.clock)
        self.others: list[tuple[int, Instant]] = []
        self.house: list[Instant] = []
        self.pump = FramePump(self.link, self.clock, self._other, self._keep_house)
        self.period = 0

    def _other(self, can_id: int, _data: bytes, at: Instant) -> None:
        self.others.append((can_id, at))

    def _keep_house(self, now: Instant) -> None:
        self.house.append(now)
        self.pump.housekeeping_at = Instant(now + self.period) if self.period else NEVER

    def peer_sends(self, at: int, can_id: int) -> None:
        self.timeline.call_at(Instant(at), lambda _now: self.peer.send(Frame(can_id)))


def test_an_echo_goes_to_its_handler_and_nowhere_else() -> None:
    bench = Bench()
    echoes: list[tuple[bytes, Instant, Instant]] = []
    frames: list[bytes] = []
    tapped: list[tuple[str, int]] = []
    bench.link.tap(lambda way, can_id, _data, _extended, _remote, _at: tapped.append((way, can_id)))
    bench.pump.echo_handlers[RPDO] = lambda *echo: echoes.append(echo)
    bench.pump.handlers[RPDO] = lambda data, _at: frames.append(data)
    handed_at = bench.link.send(RPDO, b"\x01")
    bench.link.send(0x601, b"\x02")
    bench.pump.pump(Instant(MS))
    assert echoes == [(b"\x01", bench.ended[0][1], handed_at)]
    assert (frames, bench.others) == ([], [])
    assert tapped == [("tx", RPDO), ("tx", 0x601)]
    assert (bench.link.sent_frames, bench.link.echoed_frames, bench.link.received_frames) == (2, 2, 0)


def test_a_sync_of_ours_is_told_with_its_end_and_one_of_another_master_is_not() -> None:
    bench = Bench()
    told: list[tuple[Instant, Instant]] = []
    bench.pump.send_sync()
    bench.pump.pump(Instant(MS))  # nobody wants to know yet
    bench.pump.on_sync_echo = lambda *echo: told.append(echo)
    handed_at = bench.pump.send_sync()
    bench.peer_sends(2 * MS, SYNC)
    bench.pump.pump(Instant(3 * MS))
    ends = [at for can_id, at in bench.ended if can_id == SYNC]
    assert len(ends) == 3
    assert told == [(ends[1], handed_at)]
    assert bench.others == [(SYNC, ends[2])]


def test_pump_one_returns_after_an_echo_as_after_any_frame() -> None:
    bench = Bench()
    bench.pump.send_sync()
    assert bench.pump.pump_one(Instant(MS))
    assert bench.link.last_own
    assert not bench.pump.pump_one(Instant(MS))


def test_the_links_recv_passes_over_echoes() -> None:
    bench = Bench()
    bench.link.send(RPDO, b"")
    bench.peer_sends(MS // 2, TPDO)
    received = bench.link.recv(Instant(MS))
    assert received is not None
    assert received[0] == TPDO
    assert bench.link.recv(Instant(MS)) is None


def served(serve: Callable[[Bench, Instant], None]) -> Bench:
    """The same 10 ms of traffic and housekeeping, served in one way or another."""
    bench = Bench()
    bench.period = 3 * MS + 1
    bench.pump.housekeeping_at = Instant(2 * MS)
    for number in range(20):
        bench.peer_sends(number * MS // 2 + 1000, TPDO + number)
    bench.pump.on_sync_echo = lambda at, _: bench.others.append((SYNC, at))
    for tick in range(1, 11):
        bench.pump.send_sync()
        serve(bench, Instant(tick * MS))
    return bench


def test_resting_hands_out_the_same_frames_with_the_same_stamps_as_pumping() -> None:
    resting = served(lambda bench, until: bench.pump.rest(until))
    pumping = served(lambda bench, until: bench.pump.pump(until))
    assert len(resting.others) == 30
    assert resting.others == pumping.others
    assert resting.house == pumping.house == [2 * MS + number * (3 * MS + 1) for number in range(3)]
    assert resting.timeline.now == 10 * MS


def test_frames_wait_while_the_pump_rests() -> None:
    bench = Bench()
    handled_at: list[Instant] = []
    bench.pump.handlers[TPDO] = lambda _data, _at: handled_at.append(bench.clock.now())
    for at in (100_000, 400_000):
        bench.peer_sends(at, TPDO)
    bench.pump.rest(Instant(MS))
    assert handled_at == [MS, MS]


class Sleeper:
    """A clock in real time, as far as the pump can tell: it moves in ``sleep_until`` and ``receive`` only."""

    def __init__(self) -> None:
        self.time = Instant(0)
        self.slept: list[int] = []

    def now(self) -> Instant:
        return self.time

    def sleep_until(self, when: Instant) -> None:
        self.slept.append(when)
        self.time = max(self.time, when)


class QueuePort(FramePort):
    """The queue of an adapter: frames that are there from some instant on."""

    def __init__(self, clock: Sleeper, arrivals: list[int]) -> None:
        super().__init__()
        self.echoes = EchoBasis.KERNEL
        self.waits = 0
        """Receptions that had to wait."""
        self._clock = clock
        self._arrivals = arrivals

    def receive(self, until: Instant) -> WireFrame | None:
        if not self._arrivals or self._arrivals[0] > max(until, self._clock.time):
            self.waits += until > self._clock.time
            self._clock.time = max(self._clock.time, until)
            return None
        self.waits += self._arrivals[0] > self._clock.time
        self.came_at = Instant(self._arrivals.pop(0))
        self._clock.time = max(self._clock.time, self.came_at)
        return WireFrame(TPDO)


class PortBus(can.BusABC):
    """A bus that is its port."""

    def __init__(self, port: FramePort) -> None:
        self.frame_port = port
        super().__init__(channel="port")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("watched", [False, True])
def test_one_sleep_to_the_tick_and_no_wait_for_a_frame_unless_the_bus_needs_watching(watched: bool) -> None:
    clock = Sleeper()
    port = QueuePort(clock, [200_000, 300_000, 900_000])
    port.needs_watching = watched
    bus = PortBus(port)
    stamps: list[Instant] = []
    pump = FramePump(BusLink(bus, clock), clock, lambda _id, _data, at: stamps.append(at), lambda _now: None)
    pump.rest(Instant(MS))
    assert stamps == [200_000, 300_000, 900_000]
    assert clock.time == MS
    assert clock.slept == ([] if watched else [MS])
    assert port.waits == (4 if watched else 0)
    bus.shutdown()


def test_housekeeping_is_done_in_the_middle_of_a_rest() -> None:
    clock = Sleeper()
    bus = PortBus(QueuePort(clock, [100_000, 500_000]))
    seen: list[tuple[str, Instant]] = []

    def keep_house(now: Instant) -> None:
        seen.append(("house", now))
        pump.housekeeping_at = NEVER

    pump = FramePump(
        BusLink(bus, clock), clock, lambda _id, _data, _at: seen.append(("frame", clock.time)), keep_house
    )
    pump.housekeeping_at = Instant(400_000)
    pump.rest(Instant(MS))
    assert seen == [("frame", 400_000), ("house", 400_000), ("frame", MS)]
    assert clock.slept == [400_000, MS]
    bus.shutdown()


def test_who_overhears_comes_after_whoever_takes_a_frame_now_or_later() -> None:
    bench, order = Bench(), list[str]()
    pump = bench.pump
    pump.overhear(TPDO, lambda _data, _at: order.append(f"overheard {len(bench.others)}"))

    def one_comes(at: int) -> list[str]:
        order.clear()
        bench.peer_sends(at, TPDO)
        pump.pump(Instant(at + MS))
        return [*order]

    assert one_comes(MS) == ["overheard 1"]
    pump.listen(TPDO, lambda _data, _at: order.append("taken"))
    assert one_comes(3 * MS) == ["taken", "overheard 1"]
    pump.listen(TPDO, None)
    assert one_comes(5 * MS) == ["overheard 2"]
    pump.listen(RPDO, lambda _data, _at: order.append("taken"))
    pump.listen(RPDO, None)
    assert RPDO not in pump.handlers
