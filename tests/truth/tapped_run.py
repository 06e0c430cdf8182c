"""A whole run of a bench in simulated time, in this process, with the taps in it and its rows kept."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final, cast
from unittest.mock import patch

from servobench.drivers.errors import BenchError
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution import bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.execution.world import World, WorldPlan
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from servobench.hil.rows.side_rows import TextEvent
from servobench.hil.verdict.summary import Summary
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.truth.adapter import Adapter, AdapterPort
from tests.truth.standstills import StandingDrive, Standstills
from tests.truth.taps import HostTap, TapLog, tap_drives


@dataclass(frozen=True, slots=True)
class TappedRun:
    """What a run said, and what happened."""

    rows: Rows
    """(n,) as recorded, all axes."""
    log: TapLog
    ended_by: str
    """The error that ended it before its time; empty if none did."""
    events: tuple[str, ...]
    """What it told, in order of time."""
    summary: Summary


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a run meets that no bench file says."""

    clock_starts_at_us: int | None = None
    """1013h of every drive at power-on; None: drawn from the seed of the bench."""
    adapter: Adapter | None = None
    """Between the loop and the bus; None: every stamp is the end of its frame."""
    standstills: Standstills | None = None
    """Of every drive; None: it never stands still."""


PLAIN: Final = Surroundings()


def run_with_taps(config: BenchConfig, surroundings: Surroundings = PLAIN) -> TappedRun:
    """Run ``config`` on its simulated bus."""
    log = TapLog()
    recorders: list[MemoryRecorder] = []
    summaries: list[Summary] = []
    inner = vars(bench)["open_world"]

    def in_memory(plan: RecordingPlan) -> MemoryRecorder:
        recorders.append(MemoryRecorder(plan, keep_all=True))
        return recorders[-1]

    @contextmanager
    def open_world(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        drives = [device for device in devices if isinstance(device, SimulatedServo)]
        taps: list[Any] = list(tap_drives(drives, log, surroundings.clock_starts_at_us))
        if (drawn := surroundings.standstills) is not None:
            taps = [StandingDrive(tap, drawn, plan.seed) for tap in taps]
        with inner(plan, cast("list[CanopenDevice]", taps)) as made:
            yield _tapped(made, log, surroundings.adapter, plan.seed)

    ended_by = ""
    with patch.object(bench, "open_world", open_world):
        try:
            run_bench(
                config,
                bus_spec="simulated",
                privileged=False,
                recording=in_memory,
                concluded=summaries.append,
            )
        except BenchError as error:
            if not recorders:
                raise
            ended_by = str(error)
    events, _ = recorders[0].told()
    return TappedRun(
        recorders[0].rows(),
        log,
        ended_by,
        tuple(event.text for event in events if isinstance(event, TextEvent)),
        summaries[-1],
    )


def _tapped(made: World, log: TapLog, adapter: Adapter | None, seed: int) -> World:
    """``made`` with a monitor on its segment, and an adapter and a tap in front of the loop's port."""
    if made.further:
        raise ValueError("the taps watch one segment")
    bus: Any = made.link.bus
    on_segment = bus
    while not hasattr(on_segment, "segment"):
        on_segment = on_segment.inner
    log.watch(on_segment.segment)
    if adapter is not None:
        bus.frame_port = AdapterPort(bus.frame_port, adapter, seed, made.clock.now)
    bus.frame_port = HostTap(bus.frame_port, log, made.clock.now)
    return replace(made, link=BusLink(bus, made.clock, StampSource.MONOTONIC, made.link.name))
