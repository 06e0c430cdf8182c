"""The bench's SocketCAN bus on the kernel's interface: frames both ways, stamps, floods and lacks."""

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec, socketcan_links
from servobench.drivers.wire.attached import can_links
from servobench.drivers.wire.frame_port import EchoBasis, WireFrame
from servobench.drivers.wire.link import BusLink
from servobench.drivers.wire.socketcan import StampedSocketcanBus
from tests.draws import few_of
from tests.ports import fetched

PATIENCE_NS = 10 * NS_PER_S
FLOOD = 3000
SLACK_NS = 100 * NS_PER_MS
"""Between a system call and the kernel's stamp: it may put off what the call has begun. A tenth of a step."""


@pytest.fixture
def pair(channel: str) -> Iterator[tuple[StampedSocketcanBus, StampedSocketcanBus]]:
    """Two participants on the same interface."""
    with ExitStack() as stack:
        yield (
            stack.enter_context(StampedSocketcanBus(channel)),
            stack.enter_context(StampedSocketcanBus(channel)),
        )


def soon(clock: MonotonicClock) -> Instant:
    return Instant(clock.now() + PATIENCE_NS)


@pytest.mark.parametrize(
    "frame",
    [
        WireFrame(0x080),
        WireFrame(0x181, bytes(range(8))),
        WireFrame(0x12345678, b"\x01\x02", extended=True),
        WireFrame(0x701, b"", remote=True, remote_length=1),
    ],
)
def test_frames_arrive_as_sent(
    pair: tuple[StampedSocketcanBus, StampedSocketcanBus], frame: WireFrame
) -> None:
    sender, receiver = pair
    clock = MonotonicClock()
    before = clock.now()
    sender.frame_port.transmit(frame)
    received = fetched(receiver, soon(clock))
    assert received is not None
    assert received[0] == frame
    assert before - NS_PER_MS <= received[1] <= clock.now()


def test_the_wait_ends_at_its_deadline(pair: tuple[StampedSocketcanBus, StampedSocketcanBus]) -> None:
    clock = MonotonicClock()
    until = Instant(clock.now() + 5 * NS_PER_MS)
    assert fetched(pair[1], until) is None
    assert clock.now() >= until


def test_a_flood_is_kept(pair: tuple[StampedSocketcanBus, StampedSocketcanBus]) -> None:
    sender, receiver = pair
    for number in range(FLOOD):
        sender.frame_port.transmit(WireFrame(0x100 + number % 8, number.to_bytes(4, "little")))
    clock = MonotonicClock()
    seen = 0
    while (received := fetched(receiver, clock.now())) is not None:
        assert int.from_bytes(received[0].data, "little") == seen
        seen += 1
    assert (seen, receiver.frame_port.lost_frames) == (FLOOD, 0)


def test_the_link_takes_the_lean_path(channel: str) -> None:
    opened = open_bus(parse_bus_spec(f"socketcan:{channel}"), 1_000_000)
    try:
        assert opened.bus.frame_port.echoes is EchoBasis.KERNEL  # type: ignore[attr-defined]
        clock = MonotonicClock()
        link = BusLink(opened.bus, clock, opened.stamps, opened.name)
        with can.Bus(interface="socketcan", channel=channel) as other:
            sent_at = link.send(0x80, b"")
            message = other.recv(10.0)
            assert message is not None
            assert message.arbitration_id == 0x80
            other.send(can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False))
        received = link.recv(soon(clock))
        assert received is not None
        assert received[:2] == (0x181, b"\x01")
        assert sent_at <= received[2] <= clock.now()
    finally:
        opened.bus.shutdown()


def test_the_interface_is_listed_as_usable(channel: str) -> None:
    usable = [adapter.spec for adapter in socketcan_links() if adapter.usable]
    assert f"socketcan:{channel}" in usable


def test_the_interface_is_listed_with_its_kind(channel: str) -> None:
    (link,) = [link for link in can_links() if link.name == channel]
    assert link.up
    assert link.kind in ("vcan", "can")


def test_a_missing_interface_names_the_command() -> None:
    with pytest.raises(BusDown, match=r"cannot open socketcan:vcan77.*ip link add dev vcan77 type vcan"):
        open_bus(parse_bus_spec("socketcan:vcan77"), 1_000_000)


def in_uml() -> bool:
    """Whether this kernel is User Mode Linux, whose clock is its own and may be set."""
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text(encoding="ascii")


@pytest.mark.skipif(
    not in_uml(), reason="sets the wall clock: only inside User Mode Linux, which has its own"
)
@pytest.mark.parametrize("step_s", few_of([-30, 3600, -3600, 30], 2))
def test_a_step_of_the_wall_clock_moves_no_stamp(channel: str, step_s: int) -> None:
    """Frames before and after the step, all read after it; the echoes of the sender too. A step back by less
    than ``date`` takes could be no step, as stamps then still rise."""
    clock = MonotonicClock()
    handed = []
    with (
        StampedSocketcanBus(channel, receive_own_messages=True) as sender,
        StampedSocketcanBus(channel) as receiver,
    ):
        for _ in range(3):
            for bus in (sender, receiver):
                assert bus.frame_port.receive(clock.now()) is None
            for number in range(40):
                if number == 20:
                    subprocess.run(
                        ["date", "--set", f"{step_s:+d} seconds"], check=True, stdout=subprocess.DEVNULL
                    )
                before = clock.now()
                sender.frame_port.transmit(WireFrame(0x100 + number))
                handed.append((before, clock.now()))
            for bus in (sender, receiver):
                for number, (before, after) in enumerate(handed):
                    received = fetched(bus, soon(clock))
                    assert received is not None
                    assert received[0].can_id == 0x100 + number
                    assert before - SLACK_NS <= received[1] <= after + SLACK_NS
            handed.clear()
