"""The bench's SocketCAN bus on a real controller's driver: its queue, its settings, and its being gone."""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.drivers.wire.attached import can_links, link_advice
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.drivers.wire.link import BusLink
from servobench.drivers.wire.socketcan import StampedSocketcanBus
from tests.can.conftest import CHANNELS
from tests.scenario.processes import HIL, simulated_drive
from tests.vcan.conftest import is_up

PATIENCE_MS = 30_000
BURST = 300
CLOCK = MonotonicClock()

IpLink = Callable[..., None]


@pytest.fixture(name="link")
def bench_link(channel: str) -> Iterator[BusLink]:
    """The bench's way to the bus."""
    with StampedSocketcanBus(channel, receive_own_messages=True) as bus:
        yield BusLink(bus, CLOCK, name=channel)


@pytest.fixture(name="peer")
def peer_bus(other: str) -> Iterator[can.BusABC]:
    """python-can's own class at the other end."""
    with can.Bus(interface="socketcan", channel=other, ignore_config=True) as bus:
        yield bus


def _none() -> list[int]:
    return []


def after(ms: int) -> Instant:
    return Instant(CLOCK.now() + ms * NS_PER_MS)


def heard(peer: can.BusABC, can_id: int, wanted: int) -> int:
    """The number of frames with an identifier, until so many came or patience ends.

    An emulated controller hands over what the test before sent as late as it likes.
    """
    ends, came = after(PATIENCE_MS), 0
    while came < wanted and CLOCK.now() < ends:
        message = peer.recv(1.0)
        came += message is not None and not message.is_error_frame and message.arbitration_id == can_id
    return came


@pytest.mark.parametrize("length", [10, 1])
def test_a_burst_goes_out_whole_through_a_short_queue(link: BusLink, ip_link: IpLink, length: int) -> None:
    """Witness: the echoes, by which the driver confirms what was on the bus. The other controller may not
    keep up with an emulated bus, on which a frame takes no time."""
    ip_link("txqueuelen", str(length))
    wanted = [0x601 + number % 127 for number in range(BURST)]
    for can_id in wanted:
        link.send(can_id, bytes(8))
    link.send(0x080, b"")
    ends, came = after(PATIENCE_MS), _none()
    while len(came) <= BURST and CLOCK.now() < ends:
        if link.fetch(after(100)) and link.last_own:
            came.append(link.last_id)
    assert link.sent_frames == BURST + 1
    assert [can_id for can_id in came if can_id != 0x080] == wanted
    assert came.count(0x080) == 1


def test_own_frames_come_back_confirmed_and_stamped(link: BusLink) -> None:
    before = CLOCK.now()
    link.send(0x080, b"")
    assert link.fetch(after(5000))
    assert (link.last_id, link.last_own) == (0x080, True)
    assert link.echoes in (EchoBasis.KERNEL, EchoBasis.HARDWARE)
    assert before <= link.last_at <= CLOCK.now()


def test_an_interface_that_is_down_for_a_while_is_told_and_works_again(
    link: BusLink, peer: can.BusABC, ip_link: IpLink
) -> None:
    told: list[str] = []
    link.on_trouble = lambda text, _at: told.append(text)
    link.send(0x201, b"\1")
    link.recv(after(100))
    ip_link("down")
    link.recv(after(50))
    link.send(0x201, b"\2")
    link.recv(after(50))
    link.send(0x201, b"\3")
    ip_link("up")
    deadline = after(PATIENCE_MS)
    while link.needs_watching and CLOCK.now() < deadline:
        link.recv(after(10))
    link.recv(after(100))
    assert (link.sent_frames, link.unsent_frames) == (2, 1)
    text = "\n".join(told)
    assert all(part in text for part in ("is down", "takes no frames", "is up again", "takes frames again"))
    assert heard(peer, 0x201, 2) == 2


def test_an_interface_that_stays_down_is_an_end_with_its_reason(link: BusLink, ip_link: IpLink) -> None:
    ip_link("down")
    link.send(0x201, b"\2")
    with pytest.raises(BusDown, match="has taken no frame for a second"):
        link.recv(after(20_000))


def test_what_is_set_is_seen_and_what_does_not_fit_is_named(channel: str, ip_link: IpLink) -> None:
    ip_link("down")
    ip_link("type", "can", "bitrate", "500000", "restart-ms", "0")
    ip_link("up", "txqueuelen", "1")
    (found,) = [each for each in can_links() if each.name == channel]
    assert (found.bitrate_bit_s, found.restart_ms, found.queue_length) == (500_000, 0, 1)
    advice = "\n".join(link_advice(found, 1_000_000))
    assert all(part in advice for part in ("the bench to 1000000", "restart-ms 100", "txqueuelen 10"))


@pytest.mark.long
@pytest.mark.parametrize("length", [10, 1])
def test_a_scan_finds_who_is_there_through_a_short_queue(
    channel: str, other: str, ip_link: IpLink, length: int
) -> None:
    ip_link("txqueuelen", str(length))
    with simulated_drive(f"socketcan:{other}"):
        ended = subprocess.run(
            [*HIL, "scan", "--bus", f"socketcan:{channel}", "--json"],
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
    assert ended.returncode == 0, ended.stderr
    assert [node["node_id"] for node in json.loads(ended.stdout)["bus"]["nodes"]] == [1]


def test_an_adapter_that_is_pulled_out_is_an_end_and_comes_back(channel: str, link: BusLink) -> None:
    device = Path("/sys/class/net", channel, "device").resolve()
    if not (device / "remove").exists():
        pytest.skip("no card on a PCI bus")
    (device / "remove").write_text("1")
    try:
        with pytest.raises(BusDown, match="the adapter was unplugged"):
            link.recv(after(5000))
    finally:
        Path("/sys/bus/pci/rescan").write_text("1")
        ends = after(PATIENCE_MS)
        while not Path("/sys/class/net", channel).exists() and CLOCK.now() < ends:
            CLOCK.sleep_until(after(100))
        command = [
            "ip",
            "link",
            "set",
            channel,
            "up",
            "type",
            "can",
            "bitrate",
            "1000000",
            "restart-ms",
            "100",
        ]
        subprocess.run(command, check=True, timeout=60)
    assert all(map(is_up, CHANNELS))
