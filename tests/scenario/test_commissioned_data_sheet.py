"""``hil simulate --eds FILE.dcf`` without ``--node``: the DCF says which node it is."""

import signal
import subprocess
from pathlib import Path

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.timebase import MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.drivers.wire.link import BusLink
from tests.scenario.processes import START_LIMIT_S, hub_name, quiet_environment
from tests.unit.hil.test_device_files import DCF
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")


def test_a_dcf_brings_its_node_id_and_serial_number(tmp_path: Path) -> None:
    path, bus = tmp_path / "spindle.dcf", hub_name("dcf")
    path.write_text(DCF)
    command = [*hil(), "simulate", "--bus", bus, "--eds", str(path), "--bitrate", "500000"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=quiet_environment())
    try:
        assert process.stderr is not None
        said = next(line for line in process.stderr if "Ctrl-C ends it" in line)
        assert "node 9" in said
        opened = open_bus(parse_bus_spec(bus), 500_000)
        clock = MonotonicClock()
        network = CanopenNetwork(BusLink(opened.bus, clock, opened.stamps, bus), clock, 126)
        assert network.upload(9, 0x1018, 4) == (0x1234).to_bytes(4, "little")
        opened.bus.shutdown()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=START_LIMIT_S)
