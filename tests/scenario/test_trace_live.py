"""``hil trace --live`` on a hub: it hears a drive being asked, sends nothing, and ends at Ctrl-C."""

import json
import signal
import subprocess

import pytest

from tests.scenario.processes import START_LIMIT_S, hub_name, simulated_drive
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")


def test_a_bus_is_followed_until_ctrl_c() -> None:
    bus = hub_name("trace")
    with simulated_drive(bus, "--node", "5"):
        command = [*hil(), "trace", "--live", "--bus", bus, "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tracing:
            assert tracing.stderr is not None
            while "listening on" not in tracing.stderr.readline():
                assert tracing.poll() is None
            asked = [*hil(), "fault", "--bus", bus, "--node", "5", "--json"]
            subprocess.run(asked, capture_output=True, timeout=START_LIMIT_S, check=True)
            tracing.send_signal(signal.SIGINT)
            said, complaint = tracing.communicate(timeout=START_LIMIT_S)
    assert (tracing.returncode, "Traceback" in complaint) == (0, False), complaint
    entries = [json.loads(line) for line in said.splitlines()]
    state = [entry for entry in entries if entry.get("index") == 0x6041]
    assert state[0]["values"][0]["words"] == "switch on disabled"
    assert [entry["at_s"] for entry in entries] == sorted(entry["at_s"] for entry in entries)
