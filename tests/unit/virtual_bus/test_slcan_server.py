"""An emulated adapter between a pseudo-terminal and a bus that the test holds in its hands."""

import os
import select
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import MonotonicClock
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.slcan_protocol import SlcanStatus
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.serial_line import LineFaults, PseudoTerminal
from servobench.virtual_bus.instruments.slcan_server import (
    AdapterServer,
    BusCan,
    open_far_side,
    serve_adapter,
)

BITRATE = 1_000_000
_CARRIED_S = 0.02
"""Within which a terminal carries what was written to it, on a busy machine too."""
RIGHT, WRONG = b"S8\rO\r", b"S6\rO\r"
"""LAWICEL: S8 is 1 Mbit/s, S6 500 kbit/s; O opens."""


class Bus(can.BusABC):
    """What came and what was sent; ``full``: it takes no more. Always ready: nobody waits for it."""

    def __init__(self) -> None:
        self.channel_info, self._is_shutdown = "made up", True
        self.come: deque[can.Message | can.CanError] = deque()
        self.sent: list[can.Message] = []
        self.full = False
        self._ready, self._bell = os.pipe()
        os.write(self._bell, b".")
        super().__init__("made up")

    def bring(self, message: can.Message | can.CanError) -> None:
        self.come.append(message)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout == 0, "it must not wait here: the terminal may have something"
        if not self.come:
            return None
        came = self.come.popleft()
        if isinstance(came, can.CanError):
            raise came
        return came

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert timeout is None
        if self.full:
            raise can.CanOperationError("full")
        self.sent.append(msg)

    def fileno(self) -> int:
        return self._ready

    def shutdown(self) -> None:
        os.close(self._ready)
        os.close(self._bell)
        super().shutdown()


class Host:
    """The program at the serial port."""

    def __init__(self, faults: LineFaults | None = None) -> None:
        self.bus = Bus()
        self.terminal = PseudoTerminal()
        self.port = os.open(self.terminal.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.server = AdapterServer(self.bus, BITRATE, self.terminal, MonotonicClock(), faults)

    def turn(self, turns: int = 1) -> None:
        left = iter([False] * turns + [True])
        self.server.serve(lambda: next(left))

    def ask(self, text: bytes) -> bytes:
        os.write(self.port, text)
        self.turn(2)
        return self.read()

    def read(self) -> bytes:
        """All that came: the kernel may carry what the server wrote to the terminal a little later."""
        came = b""
        while select.select([self.port], [], [], _CARRIED_S)[0]:
            came += os.read(self.port, 65536)
        return came

    def close(self) -> None:
        os.close(self.port)
        self.terminal.unplug()
        self.bus.shutdown()


@pytest.fixture
def host() -> Iterator[Host]:
    host = Host()
    yield host
    host.close()


def told(host: Host) -> SlcanStatus:
    answer = host.ask(b"F\r")
    assert answer[:1] == b"F"
    assert answer[-1:] == b"\r"
    return SlcanStatus(int(answer[1:3], 16))


def test_frames_go_both_ways_while_it_is_open(host: Host) -> None:
    host.bus.bring(can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False))
    host.turn()
    assert host.read() == b"", "not before it is open"
    assert host.ask(RIGHT) == b"\r\r"
    host.bus.bring(can.Message(arbitration_id=0x181, data=b"\x01\xab", is_extended_id=False))
    host.bus.bring(can.Message(arbitration_id=0x12345, data=b"", is_extended_id=True))
    host.turn()
    assert host.read() == b"t181201AB\rT000123450\r"
    assert host.ask(b"t2012CAFE\r") == b"z\r"
    (sent,) = host.bus.sent
    assert (sent.arbitration_id, bytes(sent.data), sent.is_extended_id) == (0x201, b"\xca\xfe", False)


def test_frames_of_can_fd_do_not_come_through(host: Host) -> None:
    host.ask(RIGHT)
    host.bus.bring(can.Message(arbitration_id=0x181, data=bytes(12), is_extended_id=False, is_fd=True))
    host.turn()
    assert host.read() == b""


def test_at_the_wrong_rate_it_hears_errors_and_gets_nothing_out(host: Host) -> None:
    assert host.ask(WRONG) == b"\r\r"
    assert told(host) == SlcanStatus(0)
    host.bus.bring(can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False))
    host.turn()
    assert host.read() == b""
    assert told(host) == SlcanStatus.BUS_ERROR
    assert told(host) == SlcanStatus(0), "telling clears them"
    assert host.ask(b"t2010\r") == b"z\r", "it is taken, and never gets out"
    assert host.bus.sent == []
    passive = SlcanStatus.BUS_ERROR | SlcanStatus.ERROR_WARNING | SlcanStatus.ERROR_PASSIVE
    assert told(host) == passive


def test_error_frames_are_told_as_bus_errors(host: Host) -> None:
    host.ask(RIGHT)
    host.bus.bring(can.Message(arbitration_id=0x88, data=bytes(8), is_error_frame=True, is_extended_id=False))
    host.turn()
    assert host.read() == b""
    assert told(host) == SlcanStatus.BUS_ERROR


def test_flags_that_were_asked_for_are_always_up() -> None:
    host = Host(LineFaults(status=int(SlcanStatus.ARBITRATION_LOST)))
    host.ask(RIGHT)
    for _ in range(2):
        assert told(host) == SlcanStatus.ARBITRATION_LOST
    host.close()


def test_a_bus_that_takes_nothing_has_the_frame_refused(host: Host) -> None:
    host.ask(RIGHT)
    host.bus.full = True
    assert host.ask(b"t2010\r") == b"\a"
    host.bus.full = False
    assert host.ask(b"t2010\r") == b"z\r"


def test_a_bus_that_goes_away_ends_it(host: Host) -> None:
    host.bus.bring(can.CanOperationError("the hub has ended"))
    with pytest.raises(BusDown, match="the hub has ended"):
        host.turn()


def test_unplugged_it_serves_no_more(host: Host) -> None:
    host.terminal.unplug()
    host.server.serve(lambda: False)


def test_its_queue_holds_so_many_frames_of_the_wrong_rate_and_empties_as_they_end() -> None:
    bus = Bus()
    controller = BusCan(bus, BITRATE)
    controller.open(BITRATE // 2, listen_only=False)
    frame = Frame(0x201, b"")
    assert [controller.send(frame) for _ in range(65)] == [True] * 64 + [False]
    controller.sent()
    assert controller.send(frame)
    assert not controller.send(frame)
    controller.open(BITRATE, listen_only=False)
    assert controller.flags() == SlcanStatus(0), "opened anew"
    assert controller.send(frame), "its queue is empty again"
    controller.sent()
    controller.sent()
    assert bus.sent[0].arbitration_id == 0x201
    assert len(bus.sent) == 1
    bus.shutdown()


def test_closing_empties_the_queue() -> None:
    bus = Bus()
    controller = BusCan(bus, BITRATE)
    controller.open(BITRATE // 2, listen_only=False)
    while controller.send(Frame(0x201, b"")):
        pass
    controller.close()
    assert controller.send(Frame(0x201, b""))
    bus.shutdown()


def test_who_cannot_join_the_bus_is_told() -> None:
    with pytest.raises((BusDown, BadInput)):
        open_far_side(parse_bus_spec("socketcan:no-such-interface"), None)


def test_as_a_process_it_tells_its_port_and_leaves_none_behind(tmp_path: Path) -> None:
    link = tmp_path / "adapter"
    heard: list[tuple[str, str]] = []
    serve_adapter(
        parse_bus_spec("virtual:far-side"),
        bitrate_bit_s=250_000,
        link=link,
        faults=LineFaults(),
        seed=1,
        clock=MonotonicClock(),
        stop=lambda: bool(heard) and link.is_symlink(),
        announce=lambda port, text: heard.append((port, text)),
    )
    ((port, text),) = heard
    assert port == str(link)
    assert f"--bus slcan:{link}" in text
    assert "250000 bit/s" in text
    assert not link.is_symlink()
