"""A drive that hears no commands, no host or no SYNC any more comes to rest within the stated time.

The shaft's speed is the plant's own, read beside the bus at every millisecond of simulated time.
"""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from typer.testing import CliRunner

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.cli import app
from servobench.hil.execution import bench, world
from servobench.hil.rows.records_file import read_metadata
from servobench.hil.rows.run_files import EVENTS_FILE, RECORDS_FILE
from servobench.virtual_bus.drive.servo import ServoApplication, SimulatedServo
from servobench.virtual_bus.timeline import SimulatedClock
from tests.scenario.processes import EXAMPLES

LOST_AT_MS = 600
REST_RAD_S = 1.0
MARGIN_MS = 60
"""Beside the stated time: from the loss until the deadline begins to count, and the host's own SDO."""
LOSSES = {
    "commands": 'frames = ["pdo"]',
    "host": "nodes = [1]",
    "SYNC": 'frames = ["sync"]',
}


class Shaft:
    """Speed of the motor of node 1 over time, ms since power-on."""

    def __init__(self, drive: ServoApplication, clock: SimulatedClock) -> None:
        self.speeds: list[tuple[int, float]] = []
        self._drive = drive
        self._timeline = clock.timeline
        self._look(clock.timeline.now)

    def _look(self, now: Instant) -> None:
        self.speeds.append((now // NS_PER_MS, abs(self._drive.firmware.speed_rad_s)))
        self._timeline.post(Instant(now + NS_PER_MS), self._look)

    def rests_from(self) -> int:
        """The first millisecond from which on it rests."""
        turning = [at for at, speed in self.speeds if speed > REST_RAD_S]
        return turning[-1] + 1

    def turned_at(self, at_ms: int) -> float:
        return next(speed for at, speed in self.speeds if at >= at_ms)


def run(tmp_path: Path, loss: str, lacks: str) -> tuple[int, Shaft, list[dict[str, Any]], str]:
    """Exit status, the shaft, the events and the output of a bench whose drive loses ``loss``."""
    (tmp_path / "plan.toml").write_text(
        f'[[blackout]]\nside = "drive"\ndirection = "host_to_drive"\n{LOSSES[loss]}\n'
        f"from_s = {LOST_AT_MS / 1000}\nduration_s = 100.0\n"
    )
    text = (EXAMPLES / "ling2012.toml").read_text()
    text = text.replace("faults/demo.toml", str(tmp_path / "plan.toml"))
    text = text.replace("lacks = []", f"lacks = [{lacks}]").replace('"motors/', f'"{EXAMPLES}/motors/')
    text = text.replace(
        "[drive.axis1.limits]", "[drive.axis1.limits]\nquick_stop_deceleration_rpm_s = 50000.0"
    )
    (tmp_path / "bench.toml").write_text(text)
    shafts: list[Shaft] = []

    @contextmanager
    def open_world(plan: world.WorldPlan, devices: Sequence[SimulatedServo]) -> Iterator[world.World]:
        with original(plan, devices) as made:
            application, clock = devices[0].application, made.clock
            assert isinstance(application, ServoApplication)
            assert isinstance(clock, SimulatedClock)
            shafts.append(Shaft(application, clock))
            yield made

    original = world.open_world
    with patch.object(bench, "open_world", open_world):
        result = CliRunner().invoke(
            app, ["run", str(tmp_path / "bench.toml"), "--record", str(tmp_path / "run")]
        )
    events = [json.loads(line) for line in (tmp_path / "run" / EVENTS_FILE).read_text().splitlines()]
    return result.exit_code, shafts[0], events, result.output


@pytest.mark.parametrize(
    ("loss", "lacks"),
    [
        ("commands", ""),
        ("commands", '"1400:5"'),
        ("commands", '"1400:5", "6074"'),
        ("host", ""),
        ("host", '"1400:5"'),
        ("SYNC", ""),
    ],
)
def test_it_rests_in_time_and_the_run_says_so(tmp_path: Path, loss: str, lacks: str) -> None:
    status, shaft, events, output = run(tmp_path, loss, lacks)
    assert status == 3, output
    metadata = read_metadata(tmp_path / "run" / RECORDS_FILE)
    begun = int(metadata["first_cycle_bench_ns"]) // NS_PER_MS
    lost_at = begun + LOST_AT_MS
    assert shaft.turned_at(lost_at) > 100.0, "it turned when the commands were lost"
    stated = next(event["text"] for event in events if "and at rest within" in event.get("text", ""))
    timeout_ms, stop_ms = map(int, re.findall(r"(\d+) ms", stated)[:2])
    assert ("watched by the host by" in stated) is bool(lacks)
    assert shaft.rests_from() <= lost_at + timeout_ms + stop_ms + MARGIN_MS, stated
