"""``hil simulate --background``: other nodes' frames beside the simulated drives, in real time."""

from collections import Counter
from pathlib import Path

import can
import pytest

from servobench.drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock
from servobench.hil.configuration.config import load_background
from servobench.hil.verdict.verdict import ExitStatus
from servobench.virtual_bus.device.background import CATCH_UP_MAX
from tests.scenario.processes import EXAMPLES, hub_name, run_command, simulated_drive
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")

TRAFFIC = EXAMPLES / "background" / "plc.toml"
LISTEN_FOR = Duration(NS_PER_S)


def heard_on(bus_name: str, duration: Duration) -> Counter[int]:
    """How many frames of each identifier there were."""
    found: Counter[int] = Counter()
    clock = MonotonicClock()
    with can.Bus(interface="hub", channel=bus_name, ignore_config=True) as bus:
        until = Instant(clock.now() + duration)
        while (left := until - clock.now()) > 0:
            message = bus.recv(left / NS_PER_S)
            if message is not None:
                found[message.arbitration_id] += 1
    return found


def test_the_traffic_of_a_file_is_on_the_bus_beside_the_drive() -> None:
    bus = hub_name("background")
    with simulated_drive(bus, "--background", str(TRAFFIC)):
        found = heard_on(bus.removeprefix("hub:"), LISTEN_FOR)
    for stream in load_background(TRAFFIC):
        expected = LISTEN_FOR / stream.period
        # a process that was held up makes up for it, and random arrivals scatter
        assert 0.4 * expected - 2 <= found[stream.can_id] <= 1.4 * expected + CATCH_UP_MAX


def test_a_file_with_a_fault_is_refused_with_its_place(tmp_path: Path) -> None:
    wrong = tmp_path / "traffic.toml"
    wrong.write_text("[[background]]\ncan_id = 0x900\nperiod_us = 1000\n")
    command = [*hil(), "simulate", "--bus", hub_name("refused"), "--node", "1", "--background", str(wrong)]
    done = run_command(command)
    assert done.returncode == ExitStatus.BAD_INPUT, done.stderr
    assert "traffic.toml" in done.stderr
    assert "0x7FF" in done.stderr
