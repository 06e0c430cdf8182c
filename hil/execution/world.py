"""The bus of a run with its clock: simulated with the drives on it, or real with the drives elsewhere."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import can

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.errors import BadInput, BenchError, BusDown, NoAnswer, PeerFault
from servobench.drivers.timebase import Clock, Duration, Instant, MonotonicClock, wall_clock_offset
from servobench.drivers.wire.adapters import BusSpec, open_bus, shared_bus
from servobench.drivers.wire.attached import advice_on
from servobench.drivers.wire.frame_port import FrameTap
from servobench.drivers.wire.link import BusLink, StampSource, Tap
from servobench.hil.configuration.config import BackgroundTables, BenchConfig, BusSegment
from servobench.virtual_bus.bus.disturbance import BusError
from servobench.virtual_bus.bus.error_message import error_frame_of
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.core.native import BusLoad
from servobench.virtual_bus.device.background import background_nodes
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.faults.fault_log import FaultLog
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.faults.frame_fault import Side
from servobench.virtual_bus.faults.outage_bus import OutageBus
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.hosting.faulty_device import FaultyDevice
from servobench.virtual_bus.hosting.injection import Faults, Injection, refuse_misplaced
from servobench.virtual_bus.timeline import PacedTimeline, SimulatedClock, Timeline


@dataclass(frozen=True, slots=True)
class World:
    """The environment of a run."""

    link: BusLink
    clock: Clock
    real_time: bool
    """True if time passes by itself: a full recording ring then loses rows instead of waiting."""
    faults: "WorldFaults"
    load_percent: Callable[[Instant, Instant], float]
    """Bus load between two instants, percent: exact on a simulated segment, the busiest if there are several;
    else from the frames seen."""
    wall_offset: Duration | None
    """Wall clock minus the world's clock; None in simulated time."""
    error_frames: Callable[[], int]
    """Returns the number of error frames on the bus so far, as far as visible."""
    tap_errors: Callable[[Tap], None]
    """Passes error frames to a tap, as extended frames with CAN_ERR_FLAG; nothing if none are visible."""
    further: "tuple[FurtherSegment, ...]" = ()
    """The segments after the first one, in the order of the plan."""
    wait: Callable[[Instant], object] = bool
    """With several segments: let time pass until a frame for the host arrives on any, or until an instant."""
    trouble: Callable[[], str] = str
    """The adapter's counts of lost frames and the like, in words; empty if there are none."""

    settings: Callable[[], Sequence[str]] = tuple
    """Looks at the adapter: unsuitable settings, each with the command that fixes it. Runs a program."""

    def tell_troubles(self, tell: Callable[[Instant, str, str], None]) -> None:
        """Report adapter events to ``tell`` from now on: instant, level and text; unsuitable settings at
        once."""
        for note in self.settings():
            tell(self.clock.now(), "WARN", note)
        for link in self._links():
            link.on_trouble = lambda text, at: tell(at, "WARN", text)

    def explained(self, error: BenchError, cure: str = "") -> BenchError:
        """Return ``error``; for a bus or drive fault with ``cure``, and the cure for the adapter's present
        state."""
        if isinstance(error, PeerFault):
            _add_to_remedy(error, [cure, *(link.cure for link in self._links())])
        return error

    @contextmanager
    def settings_told(self) -> Iterator[None]:
        """Add the adapter's unsuitable settings to a bus or drive fault in the context: those that became so
        meanwhile and, if nothing was heard, all. It is to end after the drives have been released."""
        before = self.settings()
        try:
            yield
        except PeerFault as error:
            silent = isinstance(error, BusDown | NoAnswer)
            _add_to_remedy(error, [each for each in self.settings() if silent or each not in before])
            raise

    def _links(self) -> list[BusLink]:
        return [self.link, *[segment.link for segment in self.further]]


def _add_to_remedy(error: PeerFault, cures: Sequence[str]) -> None:
    error.remedy = "; ".join(dict.fromkeys(filter(None, [error.remedy, *cures])))


@dataclass(frozen=True, slots=True)
class FurtherSegment:
    """One further segment."""

    name: str
    link: BusLink
    tap_errors: Callable[[Tap], None]


class WorldFaults:
    """The faults of a whole world, and the buses with frame faults; there may be none."""

    def __init__(self, parts: Sequence[tuple[Injection, FaultyBus | None]]) -> None:
        """``parts``: of each segment; empty without a fault plan."""
        self._parts = parts
        first = parts[0][0] if parts else None
        self.host_stall = first.host_stall if first is not None and first.stalls_host else None
        """Returns how long the host oversleeps an instant; None if it never does."""

    def wrap(self, device: CanopenDevice) -> CanopenDevice | FaultyDevice:
        """Return ``device`` with its faults on the first segment. Raises BadInput if it cannot fail so."""
        return self._parts[0][0].wrap(device) if self._parts else device

    def start(self, now: Instant) -> None:
        """Start time zero of the plan at ``now``."""
        for injection, bus in self._parts:
            if bus is not None:
                bus.start(now)
            injection.start(now)

    def stop(self) -> None:
        """Stop injecting new faults."""
        for injection, bus in self._parts:
            if bus is not None:
                bus.stop()
            injection.stop()

    def finish(self) -> None:
        """Flush entries to the log; also while the run goes on."""
        for injection, _ in self._parts:
            injection.finish()


@dataclass(frozen=True, slots=True)
class WorldPlan:
    """Description of a world."""

    spec: BusSpec
    bitrate_bit_s: int
    paced: bool = False
    """Simulated time at the pace of the wall clock."""
    faults: Faults | None = None
    seed: int = 0
    side: Side = "host"
    fault_log: FaultLog | None = None
    """Takes injected faults, for a recording."""
    background: BackgroundTables = ()
    """Other nodes' traffic on a simulated segment."""
    segments: tuple[BusSegment, ...] = ()
    """Further segments of a simulated bus."""
    segment_of: Mapping[int, str | None] = field(default_factory=dict)
    """By node, the name of its segment; default: the first one."""

    @classmethod
    def of_bench(
        cls, config: BenchConfig, spec: BusSpec, paced: bool, fault_log: FaultLog | None
    ) -> "WorldPlan":
        """Return the world for a bench, on the bus ``spec``."""
        return cls(
            spec,
            config.bus.bitrate_bit_s,
            paced,
            config.faults,
            config.bench.seed,
            fault_log=fault_log,
            background=config.bus.background,
            segments=config.bus.segment,
            segment_of={drive.node: drive.segment for drive in config.drive.values()},
        )


def check_time(spec: BusSpec, time: str | None, served: bool = False) -> bool:
    """Return True if the run is to be paced; ``time``: the option ``--time``, None if not given.

    Raises BadInput for simulated time on a bus that others share, or of a run that is ``served``.
    """
    if spec.simulated and served and time != "real":
        remedy = "--time real beside it, or afterwards hil view RUN --serve"
        raise BadInput("--serve", "", "simulated time", "a run in real time", remedy)
    if spec.simulated:
        return time == "real"
    if time == "simulated":
        raise BadInput(
            "--time", "", time, f"'real' on the bus '{spec}'", "simulated time needs --bus simulated"
        )
    return False


@contextmanager
def open_world(plan: WorldPlan, devices: Sequence[CanopenDevice]) -> Iterator[World]:
    """Make the world and close it again; ``devices`` exist on a simulated segment only."""
    world = _simulated_world(plan, devices) if plan.spec.simulated else _real_world(plan)
    try:
        yield world
    finally:
        for link in (world.link, *[segment.link for segment in world.further]):
            link.bus.shutdown()


@contextmanager
def drive_network(bus: str, bitrate_bit_s: int, writes: WriteList) -> Iterator[CanopenNetwork]:
    """Open a master on a bus with drives on it, which may write ``writes``.

    Raises BadInput for the simulated one, BusDown.
    """
    with drive_world(bus, bitrate_bit_s) as world:
        yield CanopenNetwork(world.link, world.clock, writes=writes)


@contextmanager
def drive_world(bus: str, bitrate_bit_s: int) -> Iterator[World]:
    """Open a bus with drives on it. Raises BadInput for the simulated one, BusDown."""
    spec = shared_bus(bus, "use hub:NAME and `hil simulate`", "a bus with a drive on it")
    with open_world(WorldPlan(spec, bitrate_bit_s), ()) as world:
        yield world


class _SimulatedSegment:
    """A segment with its devices, and the host's link to it."""

    def __init__(
        self, plan: WorldPlan, own: BusSegment | None, devices: Sequence[CanopenDevice], timeline: Timeline
    ) -> None:
        """``own``: None for the first one of the plan. ``devices``: of all segments."""
        name = None if own is None else own.name
        self.segment = segment = CanSegment(timeline, (own or plan).bitrate_bit_s)
        self.bus = bus = SimulatedBus(segment=segment, receive_own_messages=True)
        clock = SimulatedClock(timeline)
        self.injection: Injection | None = None
        self.faulty: FaultyBus | None = None
        if plan.faults is not None:
            self.injection = Injection(
                plan.faults,
                plan.seed,
                plan.fault_log,
                True,
                bus.frame_port.port.name.__eq__,
                name or "bus",
            )
            if self.injection.disturber is not None:
                segment.set_disturb(self.injection.disturber.disturb)
            if self.injection.fates is not None:
                self.faulty = FaultyBus(bus, self.injection.fates, clock, plan.side)
        for device in devices:
            if plan.segment_of.get(device.node_id) == name:
                self._attach(device)
        for other in background_nodes([entry.stream for entry in (own or plan).background], plan.seed):
            AttachedDevice(other, segment, f"background 0x{other.stream.can_id:X}")
        reached = _through_outages(self.faulty or bus, self.injection, clock, StampSource.MONOTONIC)
        self.link = BusLink(reached, clock, StampSource.MONOTONIC, name or str(plan.spec))

    def _attach(self, device: CanopenDevice) -> None:
        injection, segment = self.injection, self.segment
        node = device if injection is None else injection.wrap(device)
        attached = AttachedDevice(node, segment)
        if injection is not None and isinstance(node, FaultyDevice):
            node.controller = attached.port
            injection.on_start(attached.wake_now)

    def tap_errors(self, tap: Tap) -> None:
        """Pass error frames to ``tap``."""

        def show(error: BusError) -> None:
            frame = error_frame_of(error, self.bus.port.controller)
            tap("rx", frame.can_id, frame.data, True, False, error.at)

        self.segment.add_error_monitor(show)


class _Inboxes:
    """Frames waiting for the host on any of several segments."""

    def __init__(self, segments: Sequence[_SimulatedSegment]) -> None:
        self._inboxes = [each.bus.frame_port.received for each in segments]

    def __len__(self) -> int:
        return sum(map(len, self._inboxes))


def _simulated_world(plan: WorldPlan, devices: Sequence[CanopenDevice]) -> World:
    timeline = PacedTimeline(MonotonicClock()) if plan.paced else Timeline()
    segments = [_SimulatedSegment(plan, own, devices, timeline) for own in (None, *plan.segments)]
    inboxes = _Inboxes(segments)
    parts = [(each.injection, each.faulty) for each in segments if each.injection is not None]
    return World(
        segments[0].link,
        SimulatedClock(timeline),
        plan.paced,
        WorldFaults(parts),
        lambda since, until: max(each.segment.load_percent(since, until) for each in segments),
        None,
        lambda: sum(each.segment.errors for each in segments),
        segments[0].tap_errors,
        tuple(
            FurtherSegment(own.name, each.link, each.tap_errors)
            for own, each in zip(plan.segments, segments[1:], strict=True)
        ),
        lambda until: timeline.run_until_filled(until, inboxes),
    )


def _real_world(plan: WorldPlan) -> World:
    if plan.faults is not None:
        refuse_misplaced(plan.faults, plan.side, f"the bus {plan.spec}")
    if plan.background:
        raise BadInput(
            "bus.background",
            "",
            f"the bus {plan.spec}",
            "the bus 'simulated', which the bench makes itself",
            "send it from another process: hil simulate --background FILE",
        )
    if plan.segments:
        raise BadInput(
            "bus.segment", "", f"the bus {plan.spec}", "the bus 'simulated', which the bench makes itself"
        )
    clock = MonotonicClock()
    opened = open_bus(plan.spec, plan.bitrate_bit_s, for_link=plan.side == "host")
    wall_offset = wall_clock_offset()
    injection = None
    if plan.faults is not None:
        injection = Injection(plan.faults, plan.seed, plan.fault_log, side=plan.side)
    faulty = None
    if injection is not None and injection.fates is not None:
        faulty = FaultyBus(opened.bus, injection.fates, clock, plan.side, opened.stamps)
    reached = _through_outages(faulty or opened.bus, injection, clock, opened.stamps)
    link = BusLink(reached, clock, opened.stamps, str(plan.spec))
    seen = FrameTap()
    # what this adapter does not see, error frames among it, is missing from the load
    seen.native = load = BusLoad(plan.bitrate_bit_s)
    link.tap(seen)
    return World(
        link,
        clock,
        True,
        WorldFaults([] if injection is None else [(injection, faulty)]),
        load.percent,
        wall_offset,
        lambda: link.error_frames,
        lambda _tap: None,
        trouble=getattr(opened.bus, "trouble", str),
        settings=lambda: advice_on(plan.spec, plan.bitrate_bit_s),
    )


def _through_outages(
    bus: can.BusABC, injection: Injection | None, clock: Clock, stamps: StampSource
) -> can.BusABC:
    """Return ``bus``, or an adapter in front of it that fails now and then."""
    if injection is None or injection.outages is None:
        return bus
    return OutageBus(bus, injection.outages, clock, stamps)
