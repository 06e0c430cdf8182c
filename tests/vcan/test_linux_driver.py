"""Linux's own driver of serial CAN adapters, at an emulated one: the controller's states, its carrier and its
bit rate are the kernel's (drivers/net/can/dev), no test's.
"""

import errno
import fcntl
import os
import select
import socket
import subprocess
import termios
import threading
import tty
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
FLOOD_ID, COMMANDS = 0x7FF, range(0x201, 0x209)
"""Fewer than the interface's queue holds."""


@contextmanager
def driver_of(port: str, bitrate: int = RATE) -> Iterator[str]:
    """The kernel's interface of the adapter at ``port``, up."""
    if os.geteuid():
        pytest.skip("a line discipline needs root")
    line = os.open(port, os.O_RDWR | os.O_NOCTTY)
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
    with driver_of(adapter.port) as name, bench_on(name) as (link, told):
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

    def strike(_watching: Observer, _command: int) -> None:
        adapter.terminal.write(STATES[-1][0])

    with driver_of(adapter.port) as name:
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


def test_another_program_that_fills_the_queue_leaves_the_bench_room_and_the_right_of_way() -> None:
    """The adapter takes nothing: the terminal's buffers are full, and then the interface's queue."""
    far, port = os.openpty()
    tty.setraw(port)
    opens = threading.Thread(target=_read_until, args=(far, b"O\r"), daemon=True)
    opens.start()
    try:
        with driver_of(os.ttyname(port)) as name, bench_on(name) as (link, told):
            opens.join(PATIENCE_MS / 1000)
            before = _flood_until_refused(name)
            for can_id in COMMANDS:
                link.send(can_id, b"")
            assert (link.sent_frames, link.needs_watching, told) == (len(COMMANDS), False, [])
            ids = _ids_at(far, before + len(COMMANDS))
    finally:
        os.close(far)
        os.close(port)
    overtaken = len(ids) - 1 - max(ids.index(can_id) for can_id in COMMANDS)
    assert overtaken >= len(COMMANDS), "frames of the other that had waited for longer"


def _flood_until_refused(name: str) -> int:
    """How many frames a program got rid of that offers them as fast as it can, until half a second brought
    it no room."""
    sent, refused = 0, 0
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as other:
        other.bind((name,))
        while refused < 50:
            try:
                other.send(pack("=IB3x8x", FLOOD_ID, 0), socket.MSG_DONTWAIT)
                sent, refused = sent + 1, 0
            except OSError as error:
                if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                    raise
                refused += 1
                CLOCK.sleep_until(after(10))
    return sent


def _read_until(terminal: int, words: bytes) -> None:
    text = b""
    while words not in text:
        text += os.read(terminal, 64)


def _ids_at(terminal: int, wanted: int) -> list[int]:
    """Identifiers of so many frames, as the driver writes them there."""
    ends, text = after(PATIENCE_MS), b""
    while text.count(b"t") < wanted and CLOCK.now() < ends:
        if select.select([terminal], [], [], 0.1)[0]:
            text += os.read(terminal, 4096)
    return [int(line[1:4], 16) for line in text.split(b"\r") if line.startswith(b"t") and len(line) > 3]


def test_a_serial_adapter_that_is_pulled_out_is_an_end(adapter: RunningAdapter) -> None:
    with driver_of(adapter.port) as name, bench_on(name) as (link, _):
        adapter.terminal.unplug()
        with pytest.raises(BusDown, match="the adapter was unplugged"):
            link.recv(after(PATIENCE_MS))


def test_another_bit_rate_than_the_wire_has_is_named_before_anything_moves(
    channel: str, adapter: RunningAdapter, peer: can.BusABC, tmp_path: Path
) -> None:
    with driver_of(adapter.port, RATE // 2) as name, simulated_drive(f"socketcan:{channel}"):
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


def test_a_bit_rate_that_is_changed_in_a_run_ends_it_and_is_named(
    channel: str, adapter: RunningAdapter, tmp_path: Path
) -> None:
    far, batch = f"socketcan:{channel}", tmp_path / "commands"
    with driver_of(adapter.port) as name, simulated_drive(far):
        anew = f"link set {name} up type can bitrate {RATE // 2}"
        batch.write_text(f"link set {name} down\n{anew}\n", encoding="utf-8")

        def strike(_watching: Observer, _command: int) -> None:
            run_tool("ip", "-batch", str(batch))

        ended = struck(far, tmp_path, strike, passes=False, adapter=name)
    assert ended.status == 3, ended
    assert f"{name} is set to 500000 bit/s, the bench to 1000000 (bus.bitrate_bit_s)" in ended.said
    assert f"ip link set {name} up type can bitrate 1000000" in ended.said
    print(f"at rest after {ended.rest_s:.2f} s; {ended.missed} missed, {ended.lost} lost or late")


def _ids(peer: can.BusABC) -> set[int]:
    """What has come since the last time."""
    return {message.arbitration_id for message in iter(lambda: peer.recv(0.0), None)}
