"""Linux's own driver of serial CAN adapters, at an emulated one: the controller's states, its carrier and its
bit rate are the kernel's (drivers/net/can/dev), no test's.
"""

import fcntl
import os
import subprocess
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import pack

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.drivers.wire.attached import can_links, link_advice
from servobench.drivers.wire.link import BusLink
from servobench.drivers.wire.socketcan import StampedSocketcanBus
from tests.contract.slcan_bench import RunningAdapter, running_adapter
from tests.scenario.processes import Observer, changed_bench, simulated_drive
from tests.vcan.adapter import CHECK, run_tool
from tests.vcan.struck_run import END_LIMIT_S, struck
from tests.warm.start import hil

CLOCK = MonotonicClock()
RATE = 1_000_000
PATIENCE_MS = 10_000
SILENCE_S = 0.3
_N_SLCAN, _SIOCGIFNAME = 17, 0x8910
"""linux/tty.h, linux/sockios.h"""
STATES = [
    (b"sw100100\r", "transmit warning"),
    (b"sp130130\r", "transmit error passive"),
    (b"sa000000\r", "error active"),
    (b"sb255255\r", "is bus-off"),
]
"""What an adapter's firmware says (drivers/net/can/slcan), and a part of what is told."""


@contextmanager
def driver_of(adapter: RunningAdapter, bitrate: int = RATE) -> Iterator[str]:
    """The kernel's interface of ``adapter``, up."""
    if os.geteuid():
        pytest.skip("a line discipline needs root")
    line = os.open(adapter.port, os.O_RDWR | os.O_NOCTTY)
    try:
        try:
            fcntl.ioctl(line, termios.TIOCSETD, pack("i", _N_SLCAN))
        except OSError:
            pytest.skip("this kernel has no slcan")
        name = fcntl.ioctl(line, _SIOCGIFNAME, bytes(16)).rstrip(b"\0").decode()
        run_tool("ip", "link", "set", name, "up", "type", "can", "bitrate", str(bitrate))
        yield name
    finally:
        os.close(line)


@pytest.fixture(name="adapter")
def adapter_on(channel: str) -> Iterator[RunningAdapter]:
    with running_adapter(f"socketcan:{channel}", RATE) as adapter:
        yield adapter


@pytest.fixture(name="peer")
def peer_bus(channel: str) -> Iterator[can.BusABC]:
    """Somebody at the other end of the adapter's bus."""
    with can.Bus(interface="socketcan", channel=channel, ignore_config=True) as bus:
        yield bus


@contextmanager
def bench_on(name: str) -> Iterator[tuple[BusLink, list[str]]]:
    """The bench's end, and what it tells of the adapter."""
    told: list[str] = []
    with StampedSocketcanBus(name, receive_own_messages=True) as bus:
        link = BusLink(bus, CLOCK, name=name)
        link.on_trouble = lambda text, _at: told.append(text)
        yield link, told


def after(ms: int) -> Instant:
    return Instant(CLOCK.now() + ms * NS_PER_MS)


def watch_until(link: BusLink, told: list[str], part: str) -> None:
    ends = after(PATIENCE_MS)
    while not any(part in text for text in told):
        assert CLOCK.now() < ends, told
        link.recv(after(10))


def test_what_the_driver_tells_of_its_controller_and_bus_off_without_restart(
    adapter: RunningAdapter, peer: can.BusABC
) -> None:
    """Off the bus the interface has no carrier: the kernel takes each frame, and drops it."""
    with driver_of(adapter) as name, bench_on(name) as (link, told):
        for line, part in STATES:
            adapter.terminal.write(line)
            watch_until(link, told, part)
        assert len(told) == len(STATES)
        carrier = Path("/sys/class/net", name, "operstate")
        ends = after(PATIENCE_MS)
        while carrier.read_text().strip() != "down":  # the kernel looks after it once a second
            assert CLOCK.now() < ends
            link.recv(after(10))
        link.send(0x201, b"\1")
        assert peer.recv(SILENCE_S) is None
        assert (link.sent_frames, link.unsent_frames) == (1, 0)
        run_tool("ip", "link", "set", name, "down")
        link.recv(after(50))
        run_tool("ip", "link", "set", name, "up")
        link.send(0x202, b"\2")
        watch_until(link, told, "is up again")
        heard = peer.recv(PATIENCE_MS / 1000)
        assert heard is not None
        assert heard.arbitration_id == 0x202


def test_bus_off_for_good_ends_a_run_and_what_it_says_brings_the_adapter_back(
    channel: str, adapter: RunningAdapter, peer: can.BusABC, tmp_path: Path
) -> None:
    """The driver has no restart: the kernel refuses ``restart-ms`` and ``type can restart``."""
    far = f"socketcan:{channel}"

    def strike(_watching: Observer) -> None:
        adapter.terminal.write(STATES[-1][0])

    with driver_of(adapter) as name:
        assert [link_advice(link, RATE) for link in can_links() if link.name == name] == [[]]
        with simulated_drive(far):
            ended = struck(far, tmp_path, strike, passes=False, adapter=name)
        cure = f"ip link set {name} down; ip link set {name} up"
        assert (ended.status, ended.rest_s is not None) == (3, True), ended
        assert "is bus-off" in ended.events
        assert f"{CHECK}, then {cure}" in ended.said
        run_tool("sh", "-c", cure)
        with bench_on(name) as (link, _):
            _ids(peer)
            link.send(0x202, b"\2")
            heard = peer.recv(PATIENCE_MS / 1000)
        assert heard is not None
        assert heard.arbitration_id == 0x202
        print(f"at rest after {ended.rest_s:.2f} s; {ended.missed} missed, {ended.lost} lost or late")


def test_a_serial_adapter_that_is_pulled_out_is_an_end(adapter: RunningAdapter) -> None:
    with driver_of(adapter) as name, bench_on(name) as (link, _):
        adapter.terminal.unplug()
        with pytest.raises(BusDown, match="the adapter was unplugged"):
            link.recv(after(PATIENCE_MS))


def test_another_bit_rate_than_the_wire_has_is_named_before_anything_moves(
    channel: str, adapter: RunningAdapter, peer: can.BusABC, tmp_path: Path
) -> None:
    with driver_of(adapter, RATE // 2) as name, simulated_drive(f"socketcan:{channel}"):
        _ids(peer)  # the drive has asked whether its node-ID is taken
        command = [*hil(), "run", str(changed_bench(tmp_path)), "--bus", f"socketcan:{name}"]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=END_LIMIT_S, check=False)
    assert ran.returncode == 3, ran.stderr
    assert "node 1" in ran.stderr
    assert "does not answer" in ran.stderr
    assert f"{name} is set to 500000 bit/s, the bench to 1000000 (bus.bitrate_bit_s)" in ran.stderr
    assert f"ip link set {name} up type can bitrate 1000000" in ran.stderr
    assert "enabling" not in ran.stderr
    assert 0x601 not in _ids(peer), "a request at another rate reached the wire"


def _ids(peer: can.BusABC) -> set[int]:
    """What has come since the last time."""
    return {message.arbitration_id for message in iter(lambda: peer.recv(0.0), None)}
