"""A run of a bench with its shaft watched at every tick of the drive, and a load on it at any instant."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution import bench, world
from servobench.hil.execution.bench import run_bench
from servobench.hil.execution.world import World, WorldPlan
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.timeline import Timeline

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ShaftRun:
    """What the shaft did."""

    rows: Rows
    times_s: Array
    """(n,) since power-on, of every inner tick."""
    speeds_rad_s: Array
    """(n,) of the shaft itself, behind no encoder."""
    load_at_s: float

    def peak_rad_s(self, within_s: float) -> float:
        """Largest deviation after the load step from the mean of the 50 ms before it."""
        before = (self.times_s > self.load_at_s - 0.05) & (self.times_s < self.load_at_s)
        after = (self.times_s >= self.load_at_s) & (self.times_s < self.load_at_s + within_s)
        return float(np.max(np.abs(self.speeds_rad_s[after] - np.mean(self.speeds_rad_s[before]))))

    def commands_nm(self, from_s: float, until_s: float) -> Array:
        """The torques sent between two instants since power-on."""
        at_s = self.rows["due_at"] / NS_PER_S
        return np.asarray(self.rows["command_torque_nm"][(at_s >= from_s) & (at_s < until_s)])


def run_watched(config: BenchConfig, load_at_s: float, load_nm: float) -> ShaftRun:
    """Run ``config``, of one axis, in simulated time; ``load_at_s``: since power-on, on no grid."""
    recorders: list[MemoryRecorder] = []
    seen: list[tuple[Instant, float]] = []

    def in_memory(plan: RecordingPlan) -> MemoryRecorder:
        recorders.append(MemoryRecorder(plan, keep_all=True))
        return recorders[-1]

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        (servo,) = (device for device in devices if isinstance(device, SimulatedServo))
        with world.open_world(plan, devices) as made:
            bus: Any = made.link.bus
            timeline: Timeline = getattr(bus, "inner", bus).segment.timeline
            _watch(timeline, servo, seen)
            timeline.post(Instant(round(load_at_s * NS_PER_S)), lambda _: _load(servo, load_nm))
            yield made

    with patch.object(bench, "open_world", open_world):
        run_bench(
            config,
            recording=in_memory,
        )
    times, speeds = zip(*seen, strict=True)
    return ShaftRun(recorders[0].rows(), np.array(times) / NS_PER_S, np.array(speeds), load_at_s)


def _watch(timeline: Timeline, servo: SimulatedServo, seen: list[tuple[Instant, float]]) -> None:
    """The inner grid begins at power-on: a little behind each tick, so that it has run."""
    step = NS_PER_S // servo.drive.firmware.parameters.inner_rate_hz

    def look(now: Instant) -> None:
        if servo.drive.firmware.ticks:
            servo.drive.advance(now)
        seen.append((now, servo.drive.firmware.inner.speed_rad_s))
        timeline.post(Instant(now + step), look)

    timeline.post(Instant(step + 1), look)


def _load(servo: SimulatedServo, load_nm: float) -> None:
    servo.drive.firmware.inner.load_nm += load_nm
