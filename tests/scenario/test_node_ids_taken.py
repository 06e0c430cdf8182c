"""A simulated drive does not take a node-ID that somebody on the bus has."""

import os
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from servobench.drivers.errors import AnswersTwice, BadInput, PeerFault
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.execution.simulated_drives import refuse_taken
from servobench.hil.pytest_plugin import StartDrive
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.hosted import DriveProcess
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.child_python import python_command
from tests.scenario.processes import BENCH

pytestmark = [pytest.mark.servo_bus("hub"), pytest.mark.xdist_group("real time")]

PATIENCE = 10 * NS_PER_S


@pytest.fixture
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[BusLink, HubBus]]:
    """A link and somebody else, on a hub of this test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    one, other = HubBus(f"taken-{os.getpid()}"), HubBus(f"taken-{os.getpid()}")
    yield BusLink(one, MonotonicClock(), StampSource.MONOTONIC, "hub:test"), other
    one.shutdown()
    other.shutdown()


def look(link: BusLink, *nodes: int, force: bool = False) -> tuple[list[str], int]:
    """What is said, and how many frames are sent."""
    said: list[str] = []
    refuse_taken(link, MonotonicClock(), nodes, said.append, force)
    return said, link.sent_frames


def test_who_answers_is_named_and_refused(servo_process: StartDrive, servo_bus: str) -> None:
    servo_process(1)
    with pytest.raises(PeerFault, match=r"node 1 is there: .+ answers"):
        servo_process(2, 1)
    bus = can.Bus(interface="hub", channel=servo_bus.removeprefix("hub:"))
    try:
        link = BusLink(bus, MonotonicClock(), StampSource.MONOTONIC, servo_bus)
        with pytest.raises(BadInput) as caught:
            look(link, 1)
        assert caught.value.key == ""
        assert caught.value.source == "--node"
        (said,), _ = look(link, 1, force=True)
        assert said.startswith(f"forced: joining {servo_bus} although node 1 is there")
        assert look(link, 3)[0] == []
    finally:
        bus.shutdown()


def test_who_is_only_heard_is_refused_too(two: tuple[BusLink, HubBus]) -> None:
    link, other = two
    beats = other.send_periodic(can.Message(arbitration_id=0x702, data=b"\x05", is_extended_id=False), 0.05)
    with pytest.raises(BadInput, match="node 2 is there: a heartbeat was heard"):
        look(link, 1, 2)
    beats.stop()


def test_a_master_alone_is_no_node(two: tuple[BusLink, HubBus]) -> None:
    link, other = two
    request = can.Message(arbitration_id=0x602, data=bytes.fromhex("4000100000000000"), is_extended_id=False)
    asks = other.send_periodic(request, 0.05)
    said, sent = look(link, 2)
    asks.stop()
    assert said == []
    assert sent >= 2


def test_nobody_is_asked_on_a_hub_on_which_nobody_is(two: tuple[BusLink, HubBus]) -> None:
    link, other = two
    other.shutdown()
    ends_at = MonotonicClock().now() + PATIENCE
    while not link.bus.status().alone:  # type: ignore[attr-defined]
        assert MonotonicClock().now() < ends_at, "the hub has not noticed who left"
    assert look(link, 1) == ([], 0)


def test_two_that_were_forced_on_one_id_are_named_by_the_bench(
    servo_bench: BenchRunner, servo_process: StartDrive, servo_bus: str, tmp_path: Path
) -> None:
    servo_process(1)
    twin = DriveProcess(
        python_command("servobench.hil.cli", "simulate", "--bus", servo_bus, "--node", "1", "--force"),
        tmp_path / "twin",
    )
    try:
        run = servo_bench(BENCH, ends_in=AnswersTwice)
        assert "two devices are likely to have the node id 1" in str(run.error)
        assert len(run.wire.find("601#*", sent=True)) < 500
        assert "forced: joining" in twin.said
    finally:
        twin.stop()
