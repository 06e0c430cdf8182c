"""What befalls a SocketCAN adapter: told in words, used where it may pass, an end where it cannot. A socket
that says what Linux says (seen on its own driver of an emulated controller)."""

import errno
import os
import socket
from collections.abc import Iterator
from struct import pack
from typing import Any

import can
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock, wall_between
from servobench.drivers.wire.frame_port import ERROR_FLAG, EchoBasis, WireFrame
from servobench.drivers.wire.socketcan import SocketcanPort
from servobench.drivers.wire.socketcan_stamps import (
    SO_RXQ_OVFL,
    SO_TIMESTAMPING,
    SO_TIMESTAMPING_NEW,
    SO_TIMESTAMPNS,
    SO_TIMESTAMPNS_NEW,
    FrameStamps,
    WallStamps,
    parse_ancillary,
)

Ancillary = list[tuple[int, int, bytes]]
OWN = 0x800
"""MSG_CONFIRM."""


class Socket(socket.socket):
    """What the kernel brings, in order: frames, or the number of an error; and what it says to a sender."""

    def __init__(self) -> None:
        ready, self._other = socket.socketpair()
        super().__init__(fileno=ready.detach())
        self.brought: list[tuple[bytes, Ancillary, int] | int] = []
        self.refuses = 0
        self.sent: list[bytes] = []

    def bring(self, word: int, data: bytes = b"", ancillary: Ancillary | None = None, flags: int = 0) -> None:
        self.brought.append((pack("=IB3x8s", word, len(data), data), ancillary or [], flags))
        self._other.send(b".")

    def bring_error(self, number: int) -> None:
        self.brought.append(number)
        self._other.send(b".")

    def recvmsg(self, *_sizes: int) -> Any:
        self.recv(1)
        item = self.brought.pop(0)
        if isinstance(item, int):
            raise OSError(item, os.strerror(item))
        return *item, None

    def send(self, data: Any, *_flags: int) -> int:
        if self.refuses:
            raise OSError(self.refuses, os.strerror(self.refuses))
        self.sent.append(bytes(data))
        return len(data)

    def close(self) -> None:
        self._other.close()
        super().close()


@pytest.fixture(name="kernel")
def kernel_socket() -> Iterator[Socket]:
    kernel = Socket()
    yield kernel
    kernel.close()


def told(port: SocketcanPort) -> list[str]:
    return [trouble.text for trouble in port.troubles]


def software(ns: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, SO_TIMESTAMPNS, pack("=qq", *divmod(ns, NS_PER_S))


def hardware(ns: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, SO_TIMESTAMPING, pack("=qqqqqq", 0, 0, 0, 0, *divmod(ns, NS_PER_S))


def test_an_interface_that_goes_down_and_comes_up_is_no_end(kernel: Socket) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    kernel.bring_error(errno.ENETDOWN)
    assert port.receive(Instant(0)) is None
    kernel.refuses = errno.ENETDOWN
    for _ in range(2):
        with pytest.raises(can.CanOperationError, match="the interface is down") as refused:
            port.transmit(WireFrame(0x80))
        assert refused.value.error_code == errno.ENETDOWN
    assert port.cure == "ip link set can0 up"
    kernel.refuses = 0
    port.transmit(WireFrame(0x80))
    assert port.cure == ""
    assert told(port) == ["is down: nothing is sent or heard", "is up again"]


def test_what_waited_in_the_buffer_of_an_interface_that_is_down_does_not_make_it_up(kernel: Socket) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    _, before, _ = wall_between()
    kernel.bring_error(errno.ENETDOWN)
    kernel.bring(0x181, b"\1", [software(before)])
    assert port.receive(Instant(0)) is not None
    assert told(port) == ["is down: nothing is sent or heard"]
    _, after, _ = wall_between()
    kernel.bring(0x181, b"\2", [software(after)])
    assert port.receive(Instant(0)) is not None
    assert told(port)[1:] == ["is up again"]


@pytest.mark.parametrize("number", [errno.ENXIO, errno.ENODEV])
def test_an_adapter_that_was_unplugged_is_an_end_and_is_called_so(kernel: Socket, number: int) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    kernel.bring_error(number)
    with pytest.raises(can.CanOperationError, match="cannot receive: the adapter was unplugged"):
        port.receive(Instant(0))
    kernel.refuses = number
    with pytest.raises(can.CanOperationError, match="cannot transmit: the adapter was unplugged"):
        port.transmit(WireFrame(0x80))
    assert "hil scan tells the name" in port.cure


def test_a_full_queue_has_its_own_code(kernel: Socket) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    kernel.refuses = errno.ENOBUFS
    with pytest.raises(can.CanOperationError, match="transmit queue of the interface is full") as refused:
        port.transmit(WireFrame(0x80))
    assert refused.value.error_code == errno.ENOBUFS
    assert told(port) == []


def test_frames_that_the_kernel_dropped_are_told_each_time(kernel: Socket) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=False, channel="can0")
    for lost in (0, 3, 3, 10):
        kernel.bring(0x181, b"\1", [(socket.SOL_SOCKET, SO_RXQ_OVFL, pack("=I", lost))])
        port.receive(Instant(0))
    assert [text.split(":")[0] for text in told(port)] == ["dropped 3 frames", "dropped 7 frames"]
    assert port.lost_frames == 10


def test_a_controller_tells_its_state_once_however_many_errors_there_are(kernel: Socket) -> None:
    """Warning, passive, bus-off and restart, as linux/can/error.h has them; bus errors between them."""
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    states = ((0x004, 0x08), (0x004, 0x20), (0x040, 0), (0x100, 0), (0x004, 0x40))
    cures = []
    for classes, detail in states:
        for _ in range(20):
            kernel.bring(ERROR_FLAG | classes, bytes((0, detail, 0, 0, 0, 0, 0, 0)))
            kernel.bring(ERROR_FLAG | 0x088, bytes(8))
            frames = [port.receive(Instant(0)) for _ in range(2)]
            assert all(frame is not None and frame.can_id >= ERROR_FLAG for frame in frames)
        cures.append(port.cure)
    check = "check the cable, its terminations, the bit rates, and that another node is on"
    restart = "ip link set can0 down; ip link set can0 up"
    assert cures == ["", check, f"{check}, then {restart}", "", ""]
    assert [" ".join(text.split()[:7]) for text in told(port)] == [
        "tells of its controller: transmit warning",
        "tells of its controller: transmit error passive",
        "is bus-off: it sends and hears nothing",
        "was restarted after bus-off",
        "tells of its controller: error active",
    ]


@pytest.mark.parametrize(
    ("kinds", "layout"),
    [
        ((SO_TIMESTAMPNS, SO_TIMESTAMPING), "q"),
        ((SO_TIMESTAMPNS, SO_TIMESTAMPING), "i"),
        ((SO_TIMESTAMPNS_NEW, SO_TIMESTAMPING_NEW), "q"),
    ],
)
def test_times_of_32_and_64_bits_and_of_both_generations_are_read(
    kinds: tuple[int, int], layout: str
) -> None:
    brought = [
        (socket.SOL_SOCKET, kinds[0], pack(f"={layout * 2}", 1_700_000_000, 5)),
        (socket.SOL_SOCKET, kinds[1], pack(f"={layout * 6}", 9, 9, 9, 9, 42, 7)),
    ]
    for ancillary in (brought, brought[::-1]):
        assert parse_ancillary(ancillary) == FrameStamps(
            1_700_000_000 * NS_PER_S + 5, 42 * NS_PER_S + 7, None
        )


@pytest.mark.parametrize("off_s", [-6, 6])
def test_stamps_that_are_seconds_off_are_told_and_not_used(kernel: Socket, off_s: int) -> None:
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    for own in (False, True) * 3:
        _, wall, after = wall_between()
        kernel.bring(0x181, b"\1", [software(wall + off_s * NS_PER_S * own)], OWN * own)
        port.receive(Instant(0))
        assert abs(port.came_at - after) < 100 * NS_PER_MS
    assert told(port) == ["stamps frames far off its clock: such stamps are not used"]


def test_an_adapter_whose_own_stamps_jump_is_not_believed_any_more(kernel: Socket) -> None:
    """Echoes 6 s beside what others sent."""
    port = SocketcanPort(kernel, MonotonicClock(), receive_own=True, channel="can0")
    for number in range(12):
        own = bool(number % 2)
        _, wall, after = wall_between()
        stamps = [software(wall), hardware(77 + number * NS_PER_MS + 6 * NS_PER_S * own)]
        kernel.bring(0x181, b"\1", stamps, OWN * own)
        port.receive(Instant(0))
        assert abs(port.came_at - after) < 100 * NS_PER_MS
    assert told(port) == ["has stamps of its own that jump: the kernel's are used instead"]
    assert port.echoes is EchoBasis.KERNEL


@pytest.mark.parametrize("off_s", [-6, 6])
def test_in_place_of_a_stamp_that_is_seconds_off_stands_the_instant_of_fetching(off_s: int) -> None:
    stamps, epoch = WallStamps(), 1_700_000_000 * NS_PER_S
    for at in (NS_PER_S, NS_PER_S * 3 // 2):
        stamps.compare(at, at + epoch, at)
    stamps.emptied(NS_PER_S)
    now = Instant(NS_PER_S * 3 // 2)
    assert stamps.instant(now + epoch + off_s * NS_PER_S, now) == now
    assert stamps.far_off == 1
