"""The hub between processes: starting, leaving, and what one participant's death does to the others.

Real time, as this is what is tested; every wait is bounded by a deadline and ends as soon as it may.
"""

import os
import select
import signal
import socket
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import can
import pytest

from servobench.drivers.timebase import Instant, instant_after
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import (
    HubPlace,
    checked_name,
    known_hubs,
    runtime_directory,
    try_lock,
)
from servobench.virtual_bus.bus.hub_protocol import Hello, encode_hello
from servobench.virtual_bus.frame import Frame
from tests.ports import fetched
from tests.unit.virtual_bus.hub_processes import (
    CLOCK,
    PATIENCE_S,
    REPOSITORY,
    broker_process,
    end,
    join,
    participant,
    wait_for_end,
)

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("real time"), pytest.mark.usefixtures("runtime")]


def test_processes_that_join_at_once_share_one_broker(buses: list[HubBus]) -> None:
    report = "message = bus.recv(10); print(message.arbitration_id, bus._socket.getsockopt(1, 17))"
    source = (
        "import can\nbus = can.Bus(interface='hub', channel='bench', ignore_config=True)\n"
        f"print('joined', flush=True)\n{report}\nbus.shutdown()\n"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", source], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "joined\n"
    bus = join(buses)
    bus.frame_port.transmit(Frame(0x155))
    answers = [end(process) for process in processes]
    assert len(set(answers)) == 1  # one broker (SO_PEERCRED), and all heard the frame
    assert answers[0].startswith("341 ")


def test_frame_goes_from_process_to_process_with_its_monotonic_end(buses: list[HubBus]) -> None:
    echo = participant("message = bus.recv(10); message.arbitration_id += 1; bus.send(message)")
    bus = join(buses)
    before = CLOCK.now()
    bus.frame_port.transmit(Frame(0x100, b"\x00" * 8))
    received = fetched(bus, instant_after(before, PATIENCE_S))
    assert received is not None
    frame, at = received
    assert frame == Frame(0x101, b"\x00" * 8)
    assert before + 2 * 111_000 < at < CLOCK.now()
    end(echo)


@pytest.mark.parametrize("batches", [False, True])
def test_an_own_frame_comes_back_with_the_end_that_others_saw(buses: list[HubBus], batches: bool) -> None:
    one, other = join(buses, receive_own_messages=True, batches=batches), join(buses, batches=batches)
    for can_id in range(0x100, 0x120):
        one.frame_port.transmit(Frame(can_id))
    patience = instant_after(CLOCK.now(), PATIENCE_S)
    echoes = [fetched(one, patience) for _ in range(0x20)]
    assert echoes == [fetched(other, patience) for _ in range(0x20)]
    assert one.frame_port.came_own
    assert not other.frame_port.came_own
    assert (one.frame_port.echoes, other.frame_port.echoes) == (EchoBasis.BUS, EchoBasis.NONE)


def test_frames_of_one_packet_wait_for_the_reader_without_its_socket(buses: list[HubBus]) -> None:
    """Stopped, the broker has many frames to send when it goes on."""
    one, other = join(buses), join(buses, batches=True)
    broker = broker_process(HubPlace("bench"))
    os.kill(broker, signal.SIGSTOP)
    for number in range(20):
        one.frame_port.transmit(Frame(0x100 + number))
    os.kill(broker, signal.SIGCONT)
    patience = instant_after(CLOCK.now(), PATIENCE_S)
    got = [fetched(other, patience) for _ in range(20)]
    assert [each and each[0].can_id for each in got] == [0x100 + number for number in range(20)]
    assert fetched(other, Instant(0)) is None


def test_second_bit_rate_is_refused_in_words(buses: list[HubBus]) -> None:
    join(buses, bitrate=500_000)
    with pytest.raises(can.CanInitializationError, match="runs at 500000 bit/s, and 1000000 bit/s was asked"):
        join(buses, bitrate=1_000_000)
    assert join(buses).bitrate_bit_s == 500_000  # who names none takes the hub's
    assert join(buses, bitrate=500_000).bitrate_bit_s == 500_000


def test_a_process_whose_clock_is_another_one_is_refused(buses: list[HubBus]) -> None:
    join(buses)
    away = ["unshare", "-T", "--monotonic", "100"]
    if subprocess.run([*away, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this user, or this machine, has no time namespaces")
    joining = [sys.executable, "-c", "import can; can.Bus(interface='hub', channel='bench')"]
    done = subprocess.run(
        [*away, *joining], cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=60
    )
    assert "CanInitializationError: hub 'bench': its clock" in done.stderr


def test_killed_broker_is_reported_and_replaced(place: HubPlace, buses: list[HubBus]) -> None:
    bus = join(buses)
    first = broker_process(place)
    os.kill(first, signal.SIGKILL)
    wait_for_end(first)
    with pytest.raises(can.CanOperationError, match="hub is gone"):
        bus.recv(PATIENCE_S)
    with pytest.raises(can.CanOperationError, match="hub is gone"):
        bus.frame_port.transmit(Frame(0x100))
    one, other = join(buses), join(buses)
    assert broker_process(place) != first
    one.frame_port.transmit(Frame(0x100))
    assert other.recv(PATIENCE_S) is not None


def test_waiting_client_notices_the_end_of_its_broker(place: HubPlace, buses: list[HubBus]) -> None:
    bus = join(buses)
    killer = subprocess.Popen(["sh", "-c", f"sleep 0.05; kill -9 {broker_process(place)}"])
    with pytest.raises(can.CanOperationError, match="hub is gone"):
        bus.recv(PATIENCE_S)
    killer.wait(PATIENCE_S)


def test_killed_client_harms_nobody_and_its_frames_still_go_out(buses: list[HubBus]) -> None:
    """It dies with a full transmit queue, more frames under way to the broker, and one unread."""
    one, other = join(buses), join(buses)
    flood = "for n in range(600): bus.send(can.Message(arbitration_id=n, data=bytes(8)), timeout=10)"
    victim = participant(f"{flood}\nprint('sent', flush=True)\nsys.stdin.read()")
    one.frame_port.transmit(Frame(0x000))
    assert victim.stdout is not None
    assert victim.stdout.readline() == "sent\n"
    victim.kill()
    end(victim)
    for number in range(600):
        message = one.recv(PATIENCE_S)
        assert message is not None
        assert message.arbitration_id == number
    other.frame_port.transmit(Frame(0x123))
    last = one.recv(PATIENCE_S)
    assert last is not None
    assert last.arbitration_id == 0x123


def test_program_of_another_version_is_told_so(place: HubPlace, buses: list[HubBus]) -> None:
    join(buses)
    packet = bytearray(encode_hello(Hello(0, False)))
    packet[4] = 7
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.settimeout(PATIENCE_S)
        stranger.connect(str(place.socket))
        stranger.send(packet)
        assert b"client version 7" in stranger.recv(512)
        assert stranger.recv(512) == b""


def test_broker_leaves_after_its_last_client_and_not_before(place: HubPlace) -> None:
    bus = HubBus("bench")
    process = broker_process(place)
    bus.shutdown()
    again = HubBus("bench")  # within the two seconds: still the same one
    assert broker_process(place) == process
    again.shutdown()
    wait_for_end(process)
    assert list(runtime_directory().iterdir()) == []
    assert known_hubs() == []


@pytest.mark.parametrize("accepted", [False, True])
def test_broker_that_leaves_while_a_client_knocks_is_replaced(
    place: HubPlace, buses: list[HubBus], accepted: bool
) -> None:
    """The knock is in the backlog, or was heard, of a listener that closes without ever answering."""
    leaving = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    leaving.bind(str(place.socket))
    leaving.listen(1)
    with ThreadPoolExecutor(1) as joining:
        joined = joining.submit(join, buses)
        select.select([leaving], [], [], PATIENCE_S)
        if accepted:
            connection, _ = leaving.accept()
            connection.recv(512)
            connection.close()
        leaving.close()
        one = joined.result(PATIENCE_S)
    other = join(buses)
    one.frame_port.transmit(Frame(0x100))
    assert other.recv(PATIENCE_S) is not None


def test_no_second_broker_beside_one_that_lives(place: HubPlace, buses: list[HubBus]) -> None:
    alive = try_lock(place.alive)
    assert alive is not None
    with pytest.raises(can.CanInitializationError, match="ended at once"):
        join(buses)
    assert not place.socket.exists()
    os.close(alive)


def test_broker_that_cannot_start_says_why(buses: list[HubBus], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(can.CanInitializationError, match="broker failed"):
        join(buses)
    assert list(runtime_directory().iterdir()) == []


def test_hubs_of_different_names_are_different_buses(buses: list[HubBus]) -> None:
    one = join(buses)
    stranger = HubBus("other")
    buses.append(stranger)
    assert known_hubs() == ["bench", "other"]
    one.frame_port.transmit(Frame(0x100))
    assert stranger.recv(0.02) is None


def test_hub_is_the_users_own() -> None:
    directory = runtime_directory()
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    directory.chmod(0o755)
    with pytest.raises(can.CanInitializationError, match="mode 0700"):
        HubBus("bench")


@pytest.mark.parametrize("name", ["", ".", "..", "../other", "a/b", "-x", "a b", "ü", "x" * 49, "a\n"])
def test_bad_names_are_refused(name: str) -> None:
    with pytest.raises(can.CanInitializationError, match="expected 1 to 48 letters"):
        checked_name(name)


def test_a_file_in_the_place_of_the_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "servobench").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(can.CanInitializationError, match="expected a directory"):
        HubBus("bench")
    assert known_hubs() == []


@pytest.mark.parametrize("name", ["bench", "a", "axis-1.test_2", "x" * 48])
def test_good_names_pass(name: str) -> None:
    assert checked_name(name) == name


def test_path_too_long_for_a_socket_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    with pytest.raises(can.CanInitializationError, match="too long for a socket"):
        HubBus("bench")


def test_unusable_runtime_directory_falls_back_to_tmp(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in ("/nowhere", "relative", ""):
        monkeypatch.setenv("XDG_RUNTIME_DIR", value)
        assert runtime_directory() == Path(f"/tmp/servobench-{os.getuid()}")


def test_notifier_thread_of_python_can_works(buses: list[HubBus]) -> None:
    one, other = join(buses), join(buses)
    reader = can.BufferedReader()
    notifier = can.Notifier(other, [reader], timeout=0.05)
    one.frame_port.transmit(Frame(0x181, b"\x01"))
    message = reader.get_message(PATIENCE_S)
    notifier.stop()
    assert message is not None
    assert message.arbitration_id == 0x181


def test_running_hub_is_found_by_detection(buses: list[HubBus]) -> None:
    join(buses)
    assert can.detect_available_configs("hub") == [{"interface": "hub", "channel": "bench"}]
