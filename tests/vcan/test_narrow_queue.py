"""Commands through the short transmit queue of an interface with 1 Mbit/s: ENOBUFS as the kernel gives it."""

import errno
import json
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from struct import pack

import pytest

from tests.draws import few_of
from tests.scenario.processes import simulated_drive
from tests.warm.start import hil

COMMAND_LIMIT_S = 180
TC = ("tc", "qdisc")
BURST = 200


@pytest.fixture(params=few_of([1, 10], 1))
def narrow(request: pytest.FixtureRequest, channel: str) -> Iterator[str]:
    """SPEC of the bus, whose queue has so many places while the test lasts."""
    if os.geteuid() or shutil.which(TC[0]) is None:
        pytest.skip("setting a queue needs root, and tc of iproute2")
    queue = ("dev", channel, "root")
    rate = ("netem", "rate", "1mbit", "limit", str(request.param))
    subprocess.run([*TC, "replace", *queue, *rate], check=True, timeout=COMMAND_LIMIT_S)
    yield f"socketcan:{channel}"
    subprocess.run([*TC, "del", *queue], check=True, timeout=COMMAND_LIMIT_S)


def test_the_queue_is_full_after_a_few_frames(narrow: str, channel: str) -> None:
    assert narrow
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((channel,))
        with pytest.raises(OSError, match="No buffer space") as refused:
            _send_burst(raw)
    assert refused.value.errno == errno.ENOBUFS


def _send_burst(raw: socket.socket) -> None:
    for _ in range(BURST):
        raw.send(pack("=IB3x8s", 0x7F0, 8, b""))


def test_a_scan_finds_who_is_there(narrow: str) -> None:
    with simulated_drive(narrow):
        ended = _hil("scan", "--bus", narrow, "--listen", "0.2", "--json")
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    nodes = [(node["node_id"], node["profile"]) for node in found["bus"]["nodes"]]
    assert nodes == [(1, "servo drive (CiA 402)")]
    assert narrow in [link["spec"] for link in found["adapters"]["can_links"]]


def test_a_dry_run_of_commissioning_reads_all_that_it_needs(narrow: str, tmp_path: Path) -> None:
    with simulated_drive(narrow):
        ended = _hil(
            "commission", "--bus", narrow, "--node", "1", "--out", str(tmp_path), "--dry-run", "--yes"
        )
    assert ended.returncode == 0, ended.stderr
    assert "The drive was never enabled." in ended.stdout + ended.stderr


def _hil(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*hil(), *words], capture_output=True, text=True, timeout=COMMAND_LIMIT_S, check=False
    )
