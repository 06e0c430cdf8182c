"""A run whose adapter is struck: what the words are, where it ends, and how soon the drive rests.

The bench's adapter is a virtual interface of its own, joined with the drive's by the kernel's gateway: it may
be down, stuck or gone, and the bus goes on without it. A socket sends the error frames that a driver would.
"""

import json
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from struct import pack
from typing import Final

import pytest

from drivers.wire.identifiers import ERROR_FLAG
from tests.scenario.processes import (
    changed_bench,
    in_background,
    observer,
    simulated_drive,
    summary_of,
)
from tests.vcan.late_machine import NO_MATTER_HOW_LATE
from tests.warm.start import hil

ADAPTER: Final = "can7"
REST_LIMIT_S, END_LIMIT_S = 30.0, 200.0
WATCHED_CYCLES: Final = 200
"""Bench and drive mind a silence of 2 s: so long a busy machine takes for ``ip link`` at times."""
BUS_OFF, UNACKNOWLEDGED = (0x040, 0), (0x020, 0)
"""Class, and detail of the controller (linux/can/error.h)."""
CHECK: Final = "check the cable, its terminations, the bit rates, and that another node is on"


@pytest.fixture(name="far")
def far_end(channel: str) -> Iterator[str]:
    """SPEC of the bus with the drive, behind the gateway."""
    if os.geteuid() or shutil.which("cangw") is None or shutil.which("tc") is None:
        pytest.skip("an adapter of the tests' own needs root, cangw of can-utils and tc of iproute2")
    _run("ip", "link", "add", "dev", ADAPTER, "type", "vcan")
    try:
        _run("ip", "link", "set", ADAPTER, "up")
        for source, other in ((channel, ADAPTER), (ADAPTER, channel)):
            _run("cangw", "-A", "-s", source, "-d", other, "-e")
        with simulated_drive(f"socketcan:{channel}"):
            yield f"socketcan:{channel}"
    finally:
        subprocess.run(["ip", "link", "del", ADAPTER], check=False, capture_output=True, timeout=60)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, timeout=60)


def _error(what: tuple[int, int]) -> None:
    classes, detail = what
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as driver:
        driver.bind((ADAPTER,))
        driver.send(pack("=IB3x8s", ERROR_FLAG | classes, 8, bytes((0, detail))))


def _hold() -> None:
    """Let the adapter send nothing, its queue of ten frames full."""
    _run("tc", "qdisc", "replace", "dev", ADAPTER, "root", "netem", "delay", "200s", "limit", "10")


def _stuck(error: tuple[int, int]) -> None:
    _error(error)  # a full queue would take none
    _hold()


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended."""

    status: int
    said: str
    events: str


def struck(far: str, folder: Path, strike: Callable[[], None]) -> Ended:
    """A run that is struck once its drive turns."""
    limits = {key.removeprefix("verdict."): limit for key, limit in NO_MATTER_HOW_LATE.items()}
    bench = changed_bench(folder, dropouts_consecutive_max=WATCHED_CYCLES, duration_s=6.0, **limits)
    text = bench.read_text(encoding="utf-8")
    bench.write_text(text.replace("heartbeat_timeout_ms = 500", "heartbeat_timeout_ms = 2000"))
    record = folder / "run"
    command = ["run", str(bench), "--bus", f"socketcan:{ADAPTER}", "--record", str(record)]
    process = in_background([*hil(), *command])
    with observer(far) as watching:
        watching.until_turning(50.0)
        struck_at = watching.now()
        strike()
        watching.time_to_rest(struck_at, REST_LIMIT_S)
        _, said = process.communicate(timeout=END_LIMIT_S)
    verdict = summary_of(record)["verdict"]
    assert verdict["exit_status"] == process.returncode
    events = [json.loads(line) for line in (record / "events.jsonl").read_text().splitlines()]
    texts = "\n".join(str(event.get("text", "")) for event in events)
    return Ended(process.returncode, said, texts)


@pytest.mark.parametrize(
    ("strike", "cure", "events"),
    [
        pytest.param(
            lambda: _run("ip", "link", "set", ADAPTER, "down"),
            f"ip link set {ADAPTER} up",
            ["is down"],
            id="down for good",
        ),
        pytest.param(
            lambda: _stuck(BUS_OFF),
            f"ip link set {ADAPTER} type can restart",
            ["is bus-off", "takes no frames"],
            id="bus-off without restart-ms",
        ),
        pytest.param(
            lambda: _stuck(UNACKNOWLEDGED),
            CHECK,
            ["what nobody acknowledges", "takes no frames"],
            id="wrong bit rate, or no other node",
        ),
        pytest.param(
            lambda: _run("ip", "link", "del", ADAPTER), "hil scan tells the name", [], id="unplugged"
        ),
    ],
)
def test_what_stays_so_ends_the_run_with_the_drive_at_rest_and_says_what_mends_it(
    far: str, tmp_path: Path, strike: Callable[[], None], cure: str, events: list[str]
) -> None:
    ended = struck(far, tmp_path, strike)
    assert ended.status == 3, ended
    assert cure in ended.said
    assert all(text in ended.events for text in events), ended.events


@pytest.mark.usefixtures("far")
def test_an_adapter_that_is_back_under_another_name_is_named(tmp_path: Path) -> None:
    _run("ip", "link", "set", ADAPTER, "down")
    _run("ip", "link", "set", ADAPTER, "name", "can8")
    try:
        _run("ip", "link", "set", "can8", "up")
        command = [*hil(), "run", str(changed_bench(tmp_path)), "--bus", f"socketcan:{ADAPTER}"]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=END_LIMIT_S, check=False)
    finally:
        _run("ip", "link", "set", "can8", "down")
        _run("ip", "link", "set", "can8", "name", ADAPTER)
    assert ran.returncode == 3, ran.stderr
    assert "plug it in; there is socketcan:can8" in ran.stderr
