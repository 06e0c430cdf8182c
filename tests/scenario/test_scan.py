"""``hil scan`` as a user types it: nodes on a hub, also over serial, and a node-ID for the one without."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.scenario.processes import START_LIMIT_S, hub_name, serving, simulated_drive
from tests.scenario.serial_processes import adapter_process
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")


def scan(*options: str) -> tuple[int, dict[str, Any], str]:
    command = [*hil(), "scan", "--json", *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=START_LIMIT_S, check=False)
    found = json.loads(ended.stdout) if ended.stdout.strip() else {}
    assert "Traceback" not in ended.stderr
    return ended.returncode, found, ended.stderr


def test_nodes_on_a_hub_and_a_node_id_for_the_one_that_has_none() -> None:
    bus = hub_name("scan")
    with simulated_drive(bus, "--node", "5"), serving(["simulate", "--bus", bus, "--node", "unconfigured"]):
        status, found, said = scan("--bus", bus, "--listen", "0.2")
        assert status == 0, said
        report = found["bus"]
        assert report["bitrate_bit_s"] == 1_000_000
        assert [node["node_id"] for node in report["nodes"]] == [1, 5]
        assert {node["profile"] for node in report["nodes"]} == {"servo drive (CiA 402)"}
        assert bus.removeprefix("hub:") in found["adapters"]["hubs"]
        (nameless,) = report["unconfigured"]
        assert nameless["product_code"] == 0x00010402
        status, _, said = scan("--bus", bus, "--listen", "0.2", "--assign", "5")
        assert status == 2
        assert "a node-ID that nobody has; on the bus are 1, 5" in said
        status, found, said = scan("--bus", bus, "--listen", "0.2", "--assign", "7")
        assert status == 0, said
        assert [node["node_id"] for node in found["bus"]["nodes"]] == [1, 5, 7]
        assert found["bus"]["assigned"][0]["node_id"] == 7
        assert found["bus"]["unconfigured"] == []
        status, _, said = scan("--bus", bus, "--listen", "0.2", "--assign", "8")
        assert status == 3
        assert "no device without node-ID" in said


def test_several_without_node_id_that_say_yes_to_everything_once_found() -> None:
    bus = hub_name("yes")
    nameless = ("--node", "unconfigured:3", "--serial", "0x20", "--faults", "examples/faults/lss.toml")
    with serving(["simulate", "--bus", bus, *nameless]):
        status, found, said = scan("--bus", bus, "--listen", "0.2")
        assert status == 0, said
        assert [device["serial_number"] for device in found["bus"]["unconfigured"]] == [0x20, 0x21, 0x22]
        status, found, said = scan("--bus", bus, "--listen", "0.2", "--assign", "5,6")
        assert status == 0, said
        given = found["bus"]["assigned"]
        assert [(device["node_id"], device["serial_number"]) for device in given] == [(5, 0x20), (6, 0x21)]
        assert [device["serial_number"] for device in found["bus"]["unconfigured"]] == [0x22]
        assert [node["serial_number"] for node in found["bus"]["nodes"]] == [0x20, 0x21]


def test_through_a_serial_adapter_whose_bit_rate_is_found_by_listening(tmp_path: Path) -> None:
    bus = hub_name("scan-serial")
    background = tmp_path / "plc.toml"
    background.write_text("[[background]]\ncan_id = 0x190\nperiod_us = 10_000\n")
    options = ("--bitrate", "250000", "--background", str(background))
    with simulated_drive(bus, *options), adapter_process(bus) as adapter:
        status, found, said = scan("--bus", adapter.bus, "--listen", "0.2")
        assert status == 0, said
        report = found["bus"]
        assert report["bitrate_bit_s"] == 250_000
        assert report["bitrate_detected"]
        assert report["running"]
        assert 1 in [node["node_id"] for node in report["nodes"]]
        status, found, said = scan("--bus", adapter.bus, "--passive", "--listen", "0.2")
        assert status == 0, said
        assert [node["node_id"] for node in found["bus"]["nodes"]] == [0x10]
        assert found["bus"]["nodes"][0]["device_type"] is None


def test_without_a_bus_only_this_machine_is_looked_at() -> None:
    status, found, said = scan()
    assert status == 0, said
    assert found["bus"] is None
    assert set(found["adapters"]) == {"can_links", "serial_ports", "others", "hubs"}
    status, _, said = scan("--assign", "3")
    assert status == 2
    assert "--bus" in said


def test_a_silent_bus_needs_its_bit_rate_to_be_given() -> None:
    bus = hub_name("quiet")
    with simulated_drive(bus), adapter_process(bus) as adapter:
        status, _, said = scan("--bus", adapter.bus)
    assert status == 3
    assert "nothing is being sent on the bus" in said
    assert "--bitrate" in said
