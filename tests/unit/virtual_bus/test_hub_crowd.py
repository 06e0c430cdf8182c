"""Clients that hurt nobody: too slow, too many, of no use, or still starting.

Real time, as this is what is tested; every wait is bounded by a deadline and ends as soon as it may.
"""

import os
import resource
import socket
from pathlib import Path

import can
import pytest

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import HubPlace
from servobench.virtual_bus.frame import Frame
from tests.ports import fetched
from tests.unit.virtual_bus.hub_processes import PATIENCE_S, broker_process, join

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("real time"), pytest.mark.usefixtures("runtime")]


def flood(sender: HubBus, listener: HubBus, frames: int) -> None:
    """Numbered frames without data, some 50 us each; ``listener`` takes them all."""
    sent = heard = 0
    while sent < frames:
        try:
            sender.frame_port.transmit(Frame(sent % 0x800))
            sent += 1
        except can.CanOperationError:
            heard += listener.recv(PATIENCE_S) is not None
        while fetched(listener, Instant(0)) is not None:
            heard += 1
    while heard < sent:
        assert listener.recv(PATIENCE_S) is not None
        heard += 1


FULL_SOCKET = 4_000
"""Frames that fill the socket of a client for certain: it holds some 3000 in batches and 280 one by one."""


@pytest.mark.parametrize("batches", [False, True])
def test_client_that_takes_no_more_frames_is_dropped_and_the_others_go_on(
    place: HubPlace, buses: list[HubBus], batches: bool
) -> None:
    """Half a second of a full bus."""
    sender, listener = join(buses), join(buses, batches=batches)
    sleeper = join(buses, batches=batches)
    flood(sender, listener, FULL_SOCKET)
    for _ in range(FULL_SOCKET):
        assert sleeper.recv(PATIENCE_S) is not None
    flood(sender, listener, 12_000)
    taken: list[can.Message] = []
    with pytest.raises(can.CanOperationError, match="not taking its frames"):
        taken.extend(sleeper)
    assert 0 < len(taken) < 12_000
    assert "did not take its frames" in place.log.read_text()


@pytest.mark.parametrize("batches", [False, True])
def test_client_that_joins_a_busy_bus_and_starts_slowly_has_the_newest_frames(
    place: HubPlace, buses: list[HubBus], batches: bool
) -> None:
    """As a bench does that joins, then waits for its logger, for longer than an outbox lasts."""
    sender, listener = join(buses), join(buses, batches=batches)
    starter = join(buses, batches=batches)
    frames = 20_000
    flood(sender, listener, frames)
    sender.frame_port.transmit(Frame(0x7FF, b"last"))
    numbers = []
    while (message := starter.recv(PATIENCE_S)) is not None and message.data != b"last":
        numbers.append(message.arbitration_id)
    newest = numbers[-4_000:]
    assert newest == [number % 0x800 for number in range(frames - 4_000, frames)]
    assert len(numbers) < frames
    assert "has not begun to read" in place.log.read_text()


def test_client_that_sends_garbage_is_dropped(place: HubPlace, buses: list[HubBus]) -> None:
    one, other = join(buses), join(buses)
    rogue = join(buses)
    rogue._socket.send(b"\xff" * 22)
    with pytest.raises(can.CanOperationError, match="hub is gone"):
        rogue.recv(PATIENCE_S)
    one.frame_port.transmit(Frame(0x100))
    assert other.recv(PATIENCE_S) is not None
    assert "malformed" in place.log.read_text()


def test_client_that_only_knocks_holds_up_nobody(place: HubPlace, buses: list[HubBus]) -> None:
    one = join(buses)
    silent = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    silent.connect(str(place.socket))
    other = join(buses)
    one.frame_port.transmit(Frame(0x100))
    assert other.recv(PATIENCE_S) is not None
    silent.close()


def test_a_crowd_of_idle_connections_keeps_nobody_from_the_hub(place: HubPlace, buses: list[HubBus]) -> None:
    """More than a process may watch by ``select``, and more than the hub keeps."""
    one = join(buses)
    process = broker_process(place)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 2_048), hard))
    idle: list[socket.socket] = []
    joined: list[HubBus] = []
    try:
        for number in range(1_100):
            idle.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            idle[-1].connect(str(place.socket))
            if number % 110 == 0:
                joined.append(join(buses))
        join(buses).send(can.Message(arbitration_id=0x100, is_extended_id=False))
        for each in (one, *joined):
            heard = each.recv(PATIENCE_S)
            assert heard is not None
            assert heard.arbitration_id == 0x100
        assert broker_process(place) == process
        assert len(os.listdir(f"/proc/{process}/fd")) < 600
        assert "said no hello" in place.log.read_text()
        assert len(place.log.read_text().splitlines()) <= 100
    finally:
        for connection in idle:
            connection.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_clients_that_come_and_go_leave_nothing_in_the_hub(place: HubPlace, buses: list[HubBus]) -> None:
    """Its process collects no garbage."""
    join(buses)

    def come_and_go(times: int) -> int:
        for _ in range(times):
            with HubBus("bench", receive_own_messages=True):
                pass
        return int(Path(f"/proc/{broker_process(place)}/statm").read_text().split()[1])

    pages = come_and_go(100)
    assert come_and_go(300) - pages < 100


def test_a_process_with_more_descriptors_than_select_takes_is_a_client_too(buses: list[HubBus]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 2048:
        pytest.skip("no more descriptors than select takes are allowed here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2048), hard))
    held = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
    try:
        one, other = join(buses), join(buses)
        assert one.fileno() >= 1024
        assert other.recv(0.002) is None, "in time"
        for number in range(200):
            one.send(can.Message(arbitration_id=number, is_extended_id=False), timeout=PATIENCE_S)
        heard = [message.arbitration_id for _ in range(200) if (message := other.recv(PATIENCE_S))]
        assert heard == list(range(200))
    finally:
        for descriptor in held:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
