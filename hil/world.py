"""The bus of a run with its clock: simulated with the drives on it, or real with the drives elsewhere."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.adapters import BusSpec, open_bus
from drivers.errors import BadInput
from drivers.link import BusLink, StampSource
from drivers.timebase import Clock, Duration, Instant, MonotonicClock, wall_clock_offset
from virtual_bus.can_bus.bit_length import INTERMISSION_BITS, bits_duration, frame_bits
from virtual_bus.can_bus.bus_load import BusLoad
from virtual_bus.fault_injection.fault_plan import FaultPlan
from virtual_bus.fault_injection.faulty_bus import FaultyBus, Side
from virtual_bus.faults import FaultInjector
from virtual_bus.frame import Device, Frame
from virtual_bus.hosting import attach_to_segment
from virtual_bus.pacing import PacedTimeline
from virtual_bus.segment import Segment
from virtual_bus.simulated_bus import SimulatedBus
from virtual_bus.timeline import SimulatedClock, Timeline


@dataclass(frozen=True, slots=True)
class World:
    """What a run has to do with."""

    link: BusLink
    clock: Clock
    real_time: bool
    """Whether time passes by itself: a full recording ring then loses rows instead of waiting."""
    faults: FaultyBus | None
    load_percent: Callable[[Instant, Instant], float]
    """Bus load between two instants, percent: exact on a simulated segment, else from the frames seen."""
    wall_offset: Duration
    """Wall clock minus the world's clock; 0 in simulated time."""


@dataclass(frozen=True, slots=True)
class WorldPlan:
    """Which world to make."""

    spec: BusSpec
    bitrate_bit_s: int
    paced: bool
    """Simulated time at the pace of the wall clock."""
    faults: FaultPlan | None
    seed: int
    side: Side = "host"


def check_time(spec: BusSpec, time: str | None) -> bool:
    """Whether the run is to be paced; ``time``: the option ``--time``, None if not given.

    Raises BadInput for simulated time on a bus that others share.
    """
    if spec.simulated:
        return time == "real"
    if time == "simulated":
        raise BadInput(
            "--time", "", time, f"'real' on the bus '{spec}'", "simulated time needs --bus simulated"
        )
    return False


@contextmanager
def open_world(plan: WorldPlan, devices: Sequence[Device]) -> Iterator[World]:
    """Make the world and close it again; ``devices`` live on a simulated segment and nowhere else."""
    injector = FaultInjector(plan.faults, plan.seed) if plan.faults is not None else None
    if plan.spec.simulated:
        timeline = PacedTimeline(MonotonicClock()) if plan.paced else Timeline()
        segment = Segment(timeline, plan.bitrate_bit_s)
        bus = SimulatedBus(segment=segment)
        clock: Clock = SimulatedClock(timeline)
        faults = FaultyBus(bus, injector, clock, plan.side, Duration(0)) if injector else None
        link = BusLink(faults or bus, clock, StampSource.MONOTONIC, str(plan.spec))
        for device in devices:
            attach_to_segment(device, segment, timeline)
        world = World(link, clock, plan.paced, faults, segment.load_percent, Duration(0))
    else:
        world = _real_world(plan, injector)
    try:
        yield world
    finally:
        world.link.bus.shutdown()


def _real_world(plan: WorldPlan, injector: FaultInjector | None) -> World:
    clock = MonotonicClock()
    opened = open_bus(plan.spec, plan.bitrate_bit_s)
    wall_offset = wall_clock_offset()
    offsets = {StampSource.MONOTONIC: Duration(0), StampSource.WALL_CLOCK: wall_offset}
    faults = None
    if injector is not None:
        faults = FaultyBus(opened.bus, injector, clock, plan.side, offsets.get(opened.stamps))
    link = BusLink(faults or opened.bus, clock, opened.stamps, str(plan.spec))
    meter = LoadMeter(plan.bitrate_bit_s)
    link.tap(meter.count)
    return World(link, clock, True, faults, meter.load_percent, wall_offset)


class LoadMeter:
    """Bus load from the frames that a link sends and receives.

    Frames that this adapter does not see, error frames among them, are missing from it.
    """

    def __init__(self, bitrate_bit_s: int) -> None:
        self._bitrate_bit_s = bitrate_bit_s
        self._load = BusLoad()
        self._end = Instant(0)

    def count(
        self, _direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Take one frame in; fits ``BusLink.tap``."""
        bits = frame_bits(Frame(can_id, data, extended, remote)) + INTERMISSION_BITS
        self._end = max(self._end, at)
        self._load.add(bits_duration(bits, self._bitrate_bit_s), self._end)

    def load_percent(self, since: Instant, until: Instant) -> float:
        """Share of [since, until] that the frames took at the bus's bit rate, percent."""
        return self._load.percent(since, until)
