"""All that injects the faults of one plan, or of a recorded run: on frames, on the wire, nodes and the host.

program given the plan     side = "host", or none           side = "drive"
hil run, simulated bus     at the host's connection         at each drive's connection
hil run, real-time bus     at the host's connection         refused
hil simulate               none: at its own connection;     at its own connection
                           "host": refused
"""

from collections.abc import Callable, Sequence
from functools import partial

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.faults.fates import FateSource, RecordedFaults, ReplayedFates
from servobench.virtual_bus.faults.fault_injector import Disturber, FaultInjector, disturber
from servobench.virtual_bus.faults.fault_log import KIND_CODES, FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_streams import uniform_stream
from servobench.virtual_bus.faults.frame_fault import Side
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.mangler import DrawnSignals, Mangler, ReplayedSignals
from servobench.virtual_bus.faults.node_faults import DrawnNode, Events, node_source
from servobench.virtual_bus.faults.outage_bus import KINDS as OUTAGES
from servobench.virtual_bus.faults.outage_bus import Outages
from servobench.virtual_bus.hosting.faulty_device import FaultyDevice

_STALL = KIND_CODES[HostStall.kind]

LateBy = Callable[[int, int], int]
"""By how much the action of that number (from 0) at that time since time zero (ns) comes late, ns."""


def drawn_stalls(stalls: Sequence[HostStall], seed: int, link: str) -> LateBy:
    """By the tables of a plan; ``link`` tells the benches' buses apart."""
    tables = [
        Events(stall.events(partial(uniform_stream, seed, f"{link}/host/{stall.kind}/{place}")))
        for place, stall in enumerate(stalls)
    ]

    def late_by(_n: int, elapsed_ns: int) -> int:
        total = 0
        for table in tables:
            longest = 0
            while table.next_at() <= elapsed_ns:
                longest = max(longest, table.take().a)
            total += longest
        return total

    return late_by


def recorded_stalls(recorded: RecordedFaults) -> LateBy:
    """Return the stalls of a recorded run, action by action."""
    late = {entry.n: entry.a for entry in recorded.entries if entry.code == _STALL}
    return lambda n, _elapsed_ns: late.get(n, 0)


Faults = FaultPlan | RecordedFaults


class Injection:
    """The parts that ``faults`` needs, with the random streams of ``seed``.

    ``log``: takes what is injected. ``error_frames``: the bus is a segment that a :class:`Disturber` can
    disturb. ``is_host``: whether the port of that name on the segment is the host's.
    """

    def __init__(
        self,
        faults: Faults,
        seed: int,
        log: FaultLog | None = None,
        error_frames: bool = False,
        is_host: Callable[[str], bool] = bool,
        link: str = "bus",
        side: Side = "host",
    ) -> None:
        """``link``: tells the segments of a bench apart; each has random streams of its own. ``side``: whose
        connection the bus is."""
        self.log = log
        self.fates = _fates(faults, seed, log, error_frames, link, side)
        """Fates of frames at the bus; None if there are no faults."""
        self.outages = Outages.of(faults, seed, link, log) if side == "host" else None
        """Outages of the host's adapter; None if there are none."""
        self._late_by = _late_by(faults, seed, link)
        self._zero: Instant | None = None
        """Since when the host may be late."""
        self._actions = 0
        self._link = link
        self._side = side
        self.disturber: Disturber | None = disturber(faults, seed, log, is_host) if error_frames else None
        self._faults = faults
        self._seed = seed
        self._devices: list[FaultyDevice] = []
        self._wakes: list[Callable[[], None]] = []

    def wrap(self, device: CanopenDevice) -> CanopenDevice | FaultyDevice:
        """``device`` with what befalls it; itself, if nothing does. Raises BadInput if it cannot fail so."""
        node = device.node_id
        source = node_source(self._faults, node, self._seed)
        fates = self._fates_at(node)
        if source is None:
            if fates is None:
                return device
            source = DrawnNode(FaultPlan(), node, self._seed)
        if source.needs_drive:
            # A host of other devices does without it.
            from servobench.virtual_bus.drive.servo import ServoApplication

            if not isinstance(device.application, ServoApplication):
                expected = "a simulated drive, with a motor inside"
                raise BadInput("fault plan", source.needs_drive, f"node {node}", expected)
        made = FaultyDevice(device, source, self.log, fates)
        self._devices.append(made)
        return made

    def _fates_at(self, node: int) -> FateSource | None:
        """Return the fates of frames at the connection of that drive; at a drive's own bus they are the bus's
        already."""
        faults = self._faults
        if self._side == "drive":
            return None
        if isinstance(faults, RecordedFaults):
            return _replayed(faults, self.log, node) if node in faults.drives_struck else None
        plan = faults.at_drive(node)
        link = f"{self._link}/drive {node}"
        inner = FaultInjector(plan, self._seed, link, log=self.log, node=node)
        return _mangled(inner, plan, self._seed, link, node)

    @property
    def stalls_host(self) -> bool:
        """True if the plan has stalls of the host."""
        return self._late_by is not None

    def host_stall(self, now: Instant) -> Duration:
        """For how long the host, which should act at ``now``, sleeps instead. To be asked once an action."""
        if self._late_by is None or self._zero is None:
            return Duration(0)
        n, elapsed_ns = self._actions, now - self._zero
        self._actions = n + 1
        late_ns = self._late_by(n, elapsed_ns)
        if late_ns and self.log is not None:
            self.log.note(_STALL, elapsed_ns, 0, 0, n, late_ns)
        return Duration(late_ns)

    def on_start(self, wake: Callable[[], None]) -> None:
        """Call ``wake`` at the plan's time zero: a device may have other wishes then."""
        self._wakes.append(wake)

    def start(self, now: Instant) -> None:
        """Time zero is ``now``. The frames' faults are started by the bus that wears them."""
        if self.disturber is not None:
            self.disturber.start(now)
        if self.outages is not None:
            self.outages.start(now)
        self._zero, self._actions = now, 0
        for device in self._devices:
            device.start_faults(now)
        for wake in self._wakes:
            wake()

    def stop(self) -> None:
        """No frame is touched any more, and nothing new strikes a node."""
        if self.disturber is not None:
            self.disturber.stop()
        if self.outages is not None:
            self.outages.stop()
        self._zero = None
        for device in self._devices:
            device.stop_faults()

    def finish(self) -> None:
        """Let the log's sink have what it has not got yet."""
        if self.log is not None:
            self.log.flush()


def _fates(
    faults: Faults, seed: int, log: FaultLog | None, error_frames: bool, link: str, side: Side
) -> FateSource | None:
    if isinstance(faults, RecordedFaults):
        return _replayed(faults, log)
    here = faults.at(side)
    return _mangled(FaultInjector(here, seed, link, error_frames, log), here, seed, link)


def _replayed(recorded: RecordedFaults, log: FaultLog | None, node: int = 0) -> FateSource:
    fates, signals = ReplayedFates(recorded, log, node), ReplayedSignals(recorded.entries, node)
    return fates if signals.idle else Mangler(signals, fates, log, node)


def _mangled(inner: FateSource, plan: FaultPlan, seed: int, link: str, node: int = 0) -> FateSource | None:
    """``inner``, behind what alters signals; None if neither has anything to do."""
    if plan.signals:
        return Mangler(DrawnSignals(plan.signals, seed, link), inner, inner.log, node)
    return inner if plan.faults else None


def _late_by(faults: Faults, seed: int, link: str) -> LateBy | None:
    if isinstance(faults, RecordedFaults):
        return recorded_stalls(faults)
    return drawn_stalls(faults.host_stalls, seed, link) if faults.host_stalls else None


def refuse_misplaced(faults: Faults, side: Side, bus: str) -> None:
    """Raise BadInput if something of ``faults`` cannot act at ``side``'s connection to a real-time ``bus``.

    At the host's: what befalls nodes, and frames at a drive's connection. At a drive's: frames at the host's
    connection, and its adapter. At neither: lateness of the host.
    """
    if isinstance(faults, RecordedFaults):
        kinds, sides = faults.node_kinds, ["side"] if faults.drives_struck else []
    else:
        kinds = tuple(fault.kind for fault in (*faults.host_stalls, *faults.node_faults, *faults.outages))
        sides = [f"{kind}.side" for kind, where in faults.sides if where != side]
    nodes = [kind for kind in kinds if kind not in OUTAGES]
    if side == "drive" and len(nodes) < len(kinds):
        kind = next(kind for kind in kinds if kind in OUTAGES)
        remedy = "give these faults to the bench: hil run"
        raise BadInput("fault plan", kind, bus, "faults that the drives can have", remedy)
    if HostStall.kind in nodes:
        expected = "the bus 'simulated', in whose time the host can be late"
        raise BadInput("fault plan", HostStall.kind, bus, expected, "run it with --bus simulated")
    if side == "host" and (nodes or sides):
        expected = "the bus 'simulated', where the bench makes the drives itself"
        remedy = "give these faults to the drives: hil simulate --faults FILE"
        raise BadInput("fault plan", [*nodes, *sides][0], bus, expected, remedy)
    if sides:
        expected = 'side = "drive", or no side: the drives cannot act at the host\'s connection'
        raise BadInput("fault plan", sides[0], bus, expected, "give these faults to the bench: hil run")
