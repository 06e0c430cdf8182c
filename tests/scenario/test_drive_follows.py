"""A drive that does not follow its commands is noticed at once, named, and stopped or told of.

Witnesses: the bus itself, and the simulated shaft, which no record of the bench knows of.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from servobench.drivers.cia402.profile import Mode
from servobench.drivers.errors import DriveInFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.loop.cycle_record import COMMAND_FATES
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from servobench.hil.verdict.verdict import ExitStatus
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.draws import few_pairs
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES

LING2012 = EXAMPLES / "ling2012.toml"
AT_S = 0.4
PERIOD_NS = NS_PER_MS
CYCLES_MAX = 3
"""In which the bench reacts to the frame that tells it."""
QUICK_STOP = "201#0200...."
SYNC = 0x080
STAY_AWAY = 110
"""Cycles: a tenth longer than the drive's own timer of 100 ms."""
READ_S = 0.056
"""Two reads by SDO, a fourth of 110 cycles apart, in whole cycles."""
SAME_S = {("speed_vl", "last"): 0.25, ("speed_vl", "zero"): 0.12}
"""Set-points of whole r/min stay the same for so long, which proves nothing of a drive that goes on with it.
One that follows none is on its way to rest by its own ramp for so long."""
NOT_FOLLOWED = [fate.value for fate in COMMAND_FATES].index("not followed")
MODES = {"pv": Mode.PROFILE_VELOCITY, "pp": Mode.PROFILE_POSITION, "pt": Mode.PROFILE_TORQUE}


class Shaft:
    """A device that sends nothing, and reads the speed of the first drive's shaft every millisecond."""

    def __init__(self, drives: Sequence[SimulatedServo]) -> None:
        self.wake_at: Instant | None = None
        self._speeds: list[tuple[Instant, float]] = []
        self._sync_at = Instant(0)
        self._drives = drives

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        if frame.can_id == SYNC:
            self._sync_at = now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self._speeds.append((now, self._drives[0].drive.firmware.speed_rad_s / RAD_S_PER_RPM))
        self.wake_at = Instant(now + NS_PER_MS)
        return ()

    def rpm(self, last_s: float) -> Any:
        """(n,) of the last seconds before its supply went."""
        end = self._speeds[-1][0] - last_s * NS_PER_S
        return np.array([speed for at, speed in self._speeds if at > end])

    def between(self, run: Run, from_s: float, until_s: float) -> Any:
        """(n,) of [from_s, until_s) after the first cycle of the run, which has seen the last SYNC too."""
        zero = self._sync_at - run.wire.find("080#", sent=True)[-1].at
        first, end = (zero + limit * NS_PER_S for limit in (from_s, until_s))
        return np.array([speed for at, speed in self._speeds if first <= at < end])


def run(
    bench: BenchRunner, faults: dict[str, Any], changes: dict[str, Any], *, ends: bool, file: str = "ling2012"
) -> tuple[Run, Shaft]:
    drives: list[SimulatedServo] = []
    shaft = Shaft(drives)
    with beside_the_bench(shaft, seen=drives.append):
        ended = bench(
            EXAMPLES / f"{file}.toml", changes, faults=faults, ends_in=DriveInFault if ends else None
        )
    return ended, shaft


def events(run: Run, part: str) -> list[tuple[int, str]]:
    return [(event["at_ns"], event["text"]) for event in run.events if part in event.get("text", "")]


def mode_change(mode: str, **more: float) -> dict[str, Any]:
    return {"mode_change": [{"nodes": [1], "mode": mode, "at_s": AT_S, **more}]}


def deaf(**more: Any) -> dict[str, Any]:
    return {"ignored_commands": [{"nodes": [1], "at_s": AT_S, **more}]}


@pytest.mark.parametrize("mode", MODES)
def test_a_drive_that_leaves_its_mode_is_brought_to_rest_at_once(servo_bench: BenchRunner, mode: str) -> None:
    ended, shaft = run(servo_bench, mode_change(mode), {}, ends=True)
    shows = ended.wire.find(f"381#....{MODES[mode]:02X}", sent=False)[0]
    stop = ended.wire.find(QUICK_STOP, sent=True)[0]
    assert 0 < stop.at - shows.at <= CYCLES_MAX * PERIOD_NS
    left = f"left cyclic synchronous torque for {MODES[mode].title}"
    (told, *_) = events(ended, left)
    assert told[0] == shows.at
    assert left in str(ended.error)
    assert f"6061h is {MODES[mode]:d}, 10 was commanded" in str(ended.error)
    assert ended.verdict.exit_status == ExitStatus.PEER_FAULT
    assert f"axis1 {left} at 0.40" in ended.verdict.reason
    assert abs(shaft.rpm(0.02)).max() < 1.0, "it rests"


def test_a_drive_that_ignores_its_target_is_brought_to_rest_at_once(servo_bench: BenchRunner) -> None:
    ended, shaft = run(servo_bench, deaf(), {}, ends=True)
    shows = ended.wire.find("381#3702..", sent=False)[-1]
    stop = ended.wire.find(QUICK_STOP, sent=True)[0]
    assert 0 < stop.at - shows.at <= CYCLES_MAX * PERIOD_NS
    assert "ignores the commands of cyclic synchronous torque" in str(ended.error)
    assert "bit 12 of its statusword is 0" in str(ended.error)
    assert abs(shaft.rpm(0.02)).max() < 1.0, "it rests"


@pytest.mark.parametrize(
    ("file", "rpm", "faults"),
    [
        ("ling2012", 1500.0, mode_change("pv", duration_s=0.5)),
        ("ling2012", 1500.0, deaf(holds="zero", duration_s=0.5)),
        ("network_designed", 1000.0, mode_change("pv", duration_s=0.5)),
    ],
)
def test_a_drive_that_comes_back_is_driven_on_without_overspeed(
    servo_bench: BenchRunner, file: str, rpm: float, faults: dict[str, Any]
) -> None:
    tell = {"guard.on_mode": "tell", "load": {}}
    seen, shaft = run(servo_bench, faults, tell, ends=False, file=file)
    fates = seen.column("command_fate")
    away = np.flatnonzero(fates == NOT_FOLLOWED)
    period_s = seen.config.loop.period / NS_PER_S
    assert abs(away.size * period_s - 0.5) <= CYCLES_MAX * period_s
    assert away[0] * period_s == pytest.approx(AT_S, abs=CYCLES_MAX * period_s)
    assert np.diff(away).max() == 1, "it did not follow for one time"
    assert [text for _, text in events(seen, "again")] == ["axis1 follows cyclic synchronous torque again"]
    back = shaft.rpm(seen.config.bench.duration_s - AT_S - 0.5)
    assert back.max() <= 1.05 * rpm
    assert seen.config.bench.duration_s < 1.5 or abs(back[-300] / rpm - 1.0) < 0.02, "it is driven on"
    assert seen.verdict.exit_status == ExitStatus.PEER_FAULT
    assert f"and did not follow for {away.size} cycles" in seen.verdict.reason


@pytest.mark.parametrize(
    ("file", "holds"),
    few_pairs(["ling2012", "speed_vl", "position_csv", "position_csp"], ["last", "zero"], 1),
)
def test_set_points_that_a_drive_ignores_without_a_word_end_a_run(
    servo_bench: BenchRunner, holds: str, file: str
) -> None:
    """A drive whose RPDO timer is content, as the commands come."""
    faults = deaf(holds=holds, bit_12_cleared=False)
    ended, shaft = run(servo_bench, faults, {"load": {}}, ends=True, file=file)
    assert "no longer follows its commands" in str(ended.error)
    period_ns = ended.config.loop.period
    watched_s = STAY_AWAY * period_ns / NS_PER_S
    lasted_s = len(ended.rows) * period_ns / NS_PER_S - AT_S
    longest_s = watched_s + READ_S + SAME_S.get((file, holds), 0.0)
    assert lasted_s <= longest_s, "as long as commands may stay away, and until the next reads"
    assert abs(shaft.rpm(0.02)).max() < 1.0, "it rests"
