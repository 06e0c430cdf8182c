"""The SLCAN bus against a scripted adapter on a pseudo-terminal: what a healthy emulation never does."""

import os
import random
import threading
import tty
from collections.abc import Callable, Iterator

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.drivers.wire.frame_port import WireFrame
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.drivers.wire.slcan import REFUSALS_MAX, SlcanBus
from servobench.drivers.wire.slcan_protocol import SlcanStatus
from tests.ports import fetched

CLOCK = MonotonicClock()


def until(seconds: float) -> Instant:
    return Instant(CLOCK.now() + round(seconds * NS_PER_S))


class ScriptedAdapter:
    """Answers each line as ``answer`` says; what it was sent is in ``lines``."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.lines: list[bytes] = []
        self.answer = answer
        self._reading = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    def pull_out(self) -> None:
        if self._reading:
            self._reading = False
            os.write(self._slave, b"end\r")  # wakes the reader
            self._thread.join(5.0)
            os.close(self._master)
            os.close(self._slave)

    def _run(self) -> None:
        rest = b""
        while self._reading:
            rest += os.read(self._master, 4096)
            *lines, rest = rest.split(b"\r")
            for line in lines:
                self.lines.append(line)
                reply = self.answer(line)
                if reply and self._reading:
                    self.say(reply)


def healthy(line: bytes) -> bytes:
    if line[:1] in (b"V", b"N"):
        return line[:1] + b"1013\r"
    if line[:1] == b"F":
        return b"F00\r"
    return b"z\r" if line[:1] == b"t" else b"\r"


@pytest.fixture
def scripted() -> Iterator[Callable[[Callable[[bytes], bytes]], ScriptedAdapter]]:
    made: list[ScriptedAdapter] = []

    def make(answer: Callable[[bytes], bytes]) -> ScriptedAdapter:
        adapter = ScriptedAdapter(answer)
        made.append(adapter)
        return adapter

    yield make
    for adapter in made:
        adapter.pull_out()


Make = Callable[[Callable[[bytes], bytes]], ScriptedAdapter]


def test_opening_sets_the_bit_rate_of_the_manual_and_opens(scripted: Make) -> None:
    adapter = scripted(healthy)
    bus = SlcanBus(adapter.path, bitrate=800_000)
    bus.shutdown()
    adapter.pull_out()
    commands = [line for line in adapter.lines if line]
    assert commands[:5] == [b"C", b"V", b"N", b"S7", b"X1"]
    assert commands[5] == b"O"
    assert commands[6] == b"C"
    assert bus.version == "1013"
    assert bus.acknowledges


def test_listening_only_opens_so_and_sends_nothing(scripted: Make) -> None:
    adapter = scripted(healthy)
    with SlcanBus(adapter.path, listen_only=True) as bus:
        assert b"L" in adapter.lines
        assert b"O" not in adapter.lines
        with pytest.raises(can.CanOperationError, match="only listens"):
            bus.frame_port.transmit(WireFrame(0x80))


def test_a_port_where_nobody_answers_is_named(scripted: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servobench.drivers.wire.slcan.OPENING_ATTEMPTS", 1)
    adapter = scripted(lambda line: b"")
    with pytest.raises(BusDown, match=r"no SLCAN adapter answers on /dev/pts/.*line speed"):
        open_bus(parse_bus_spec(f"slcan:{adapter.path}"), 500_000)


def test_a_refused_bit_rate_is_told(scripted: Make) -> None:
    adapter = scripted(lambda line: b"\a" if line[:1] == b"S" else healthy(line))
    with pytest.raises(can.CanInitializationError, match="refuses its bit rate: it was answered with BEL"):
        SlcanBus(adapter.path, bitrate=500_000)
    with pytest.raises(can.CanInitializationError, match="has no 750000 bit/s"):
        SlcanBus(adapter.path, bitrate=750_000)


def test_an_adapter_that_acknowledges_nothing_is_used_all_the_same(scripted: Make) -> None:
    adapter = scripted(lambda line: b"V1013\r" if line == b"V" else b"")
    with SlcanBus(adapter.path) as bus:
        assert not bus.acknowledges
        bus.frame_port.transmit(WireFrame(0x123, b"\x01"))
        adapter.say(b"t3211FF\r")
        received = fetched(bus, until(2.0))
        assert received is not None
        assert received[0] == WireFrame(0x321, b"\xff")
    assert b"t123101" in adapter.lines


def test_spoilt_lines_are_counted_and_the_frames_between_them_come(scripted: Make) -> None:
    adapter = scripted(healthy)
    with SlcanBus(adapter.path) as bus:
        adapter.say(b"t10\rt1001\xff\xff\rt10021133\rqqq\re1a\rsb256256\rt20")
        adapter.say(b"001234\r")
        frames = [fetched(bus, until(2.0)) for _ in range(2)]
        assert [frame[0] for frame in frames if frame] == [WireFrame(0x100, b"\x11\x33"), WireFrame(0x200)]
        assert bus.malformed_lines == 3
        assert bus.error_reports == 2
        assert bus.trouble() == "3 spoilt lines from the adapter, 2 error reports of the adapter"


def test_no_noise_from_the_port_raises_or_hides_what_follows(scripted: Make) -> None:
    source = random.Random(11)
    adapter = scripted(healthy)
    with SlcanBus(adapter.path) as bus:
        for _ in range(50):
            adapter.say(source.randbytes(200))
            while fetched(bus, until(0.001)) is not None:
                pass
        adapter.say(b"\rt70117F\r")
        frames = []
        while (received := fetched(bus, until(0.5))) is not None:
            frames.append(received[0])
        assert frames[-1] == WireFrame(0x701, b"\x7f")
        assert bus.malformed_lines > 10


def test_one_refused_frame_is_counted_and_its_reason_asked_for(scripted: Make) -> None:
    refused = b"t123101"

    def answer(line: bytes) -> bytes:
        if line == refused:
            return b"\a"
        return b"F22\r" if line == b"F" else healthy(line)

    adapter = scripted(answer)
    with SlcanBus(adapter.path, receive_own_messages=True) as bus:
        bus.frame_port.transmit(WireFrame(0x123, b"\x01"))
        bus.frame_port.transmit(WireFrame(0x124))
        received = fetched(bus, until(2.0))
        assert received is not None
        assert received[0] == WireFrame(0x124), "the refused frame came back, or another was taken for it"
        assert bus.status() == SlcanStatus.TRANSMIT_FIFO_FULL | SlcanStatus.ERROR_PASSIVE
        assert bus.refused_frames == 1
        assert bus.state is can.BusState.PASSIVE


def test_an_adapter_that_refuses_everything_is_a_failed_bus(scripted: Make) -> None:
    adapter = scripted(
        lambda line: b"\a" if line[:1] == b"t" else b"FA2\r" if line == b"F" else healthy(line)
    )
    bus = SlcanBus(adapter.path)

    def keep_sending() -> None:
        link = BusLink(bus, CLOCK, StampSource.MONOTONIC, f"slcan:{adapter.path}")
        for _ in range(2 * REFUSALS_MAX):
            link.send(0x123, b"")
        while link.recv(until(2.0)) is not None:
            pass

    with pytest.raises(BusDown, match=r"refused 64 frames.*its transmit queue is full"):
        keep_sending()
    bus.shutdown()


def test_lost_answers_do_not_shift_the_later_ones(scripted: Make) -> None:
    swallowed = {b"t101"}

    def answer(line: bytes) -> bytes:
        return b"" if line[:4] in swallowed else healthy(line)

    adapter = scripted(answer)
    with SlcanBus(adapter.path, receive_own_messages=True) as bus:
        bus.frame_port.transmit(WireFrame(0x101))
        assert bus.status() == SlcanStatus(0)
        bus.frame_port.transmit(WireFrame(0x102))
        received = fetched(bus, until(2.0))
        assert received is not None
        assert received[0].can_id == 0x102


def test_an_adapter_that_takes_nothing_more_is_a_full_queue_and_never_a_wait(scripted: Make) -> None:
    adapter = scripted(healthy)
    bus = SlcanBus(adapter.path)
    going_on = threading.Event()
    adapter.answer = lambda line: b"" if going_on.wait(30.0) else b"\a"

    def flood() -> None:
        for _ in range(4000):
            bus.frame_port.transmit(WireFrame(0x123, bytes(8)))

    with pytest.raises(can.CanOperationError, match="transmit queue is full"):
        flood()
    going_on.set()
    bus.shutdown()


def test_an_adapter_pulled_out_is_told_by_recv_and_send(scripted: Make) -> None:
    adapter = scripted(healthy)
    bus = SlcanBus(adapter.path)
    adapter.pull_out()
    with pytest.raises(can.CanOperationError, match="the adapter was unplugged; /dev/pts/"):
        bus.recv(1.0)
    with pytest.raises(can.CanOperationError, match="the adapter was unplugged"):
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    bus.shutdown()
