"""Emulated SLCAN adapters whose CAN side is the kernel's virtual interface, and ``hil scan`` on it."""

import json
import subprocess
from collections.abc import Iterator
from typing import Any

import can
import pytest

from servobench.drivers.wire.attached import can_links
from servobench.drivers.wire.slcan import SlcanBus
from tests.contract.bus_suite import OpenBus
from tests.contract.slcan_bench import RunningAdapter, SlcanSuite
from tests.scenario.processes import HIL, START_LIMIT_S, simulated_drive


class TestSlcan(SlcanSuite):
    """Each participant a serial adapter of its own on one vcan interface."""

    @pytest.fixture
    def open_bus(self, channel: str) -> Iterator[OpenBus]:
        running: list[RunningAdapter] = []
        opened: list[can.BusABC] = []

        def open_one(**options: Any) -> can.BusABC:
            running.append(RunningAdapter(f"socketcan:{channel}"))
            opened.append(SlcanBus(running[-1].port, **options))
            return opened[-1]

        yield open_one
        for bus in opened:
            bus.shutdown()
        for adapter in running:
            adapter.close()


def test_the_interface_is_listed_with_its_kind(channel: str) -> None:
    (link,) = [link for link in can_links() if link.name == channel]
    assert link.up
    assert link.kind in ("vcan", "can")


def test_scan_finds_a_drive(channel: str) -> None:
    bus = f"socketcan:{channel}"
    with simulated_drive(bus):
        command = [*HIL, "scan", "--bus", bus, "--listen", "0.2", "--json"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=START_LIMIT_S, check=False)
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert [node["node_id"] for node in found["bus"]["nodes"]] == [1]
    assert found["bus"]["nodes"][0]["profile"] == "servo drive (CiA 402)"
    assert bus in [link["spec"] for link in found["adapters"]["can_links"]]
