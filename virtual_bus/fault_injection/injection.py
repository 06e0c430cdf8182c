"""All that injects the faults of one plan, or of a recorded run: on frames, on the wire, on nodes."""

from collections.abc import Callable

from drivers.errors import BadInput
from drivers.timebase import Instant
from virtual_bus.fault_injection.disturber import Disturber, disturber
from virtual_bus.fault_injection.fault_log import FaultLog
from virtual_bus.fault_injection.fault_plan import FaultPlan
from virtual_bus.fault_injection.faulty_device import FaultyDevice, SimulatedNode
from virtual_bus.fault_injection.node_faults import NODE_FAILS, node_source
from virtual_bus.fault_injection.replay import RecordedFaults, ReplayedFates
from virtual_bus.faults import FateSource, FaultInjector

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
    ) -> None:
        """``link``: tells the segments of a bench apart; each has random streams of its own."""
        self.log = log
        self.fates = _fates(faults, seed, log, error_frames, link)
        """What befalls frames; None if nothing does."""
        self.disturber: Disturber | None = disturber(faults, seed, log, is_host) if error_frames else None
        self._faults = faults
        self._seed = seed
        self._devices: list[FaultyDevice] = []
        self._wakes: list[Callable[[], None]] = []

    def wrap(self, device: SimulatedNode) -> SimulatedNode | FaultyDevice:
        """``device`` with what befalls it; itself, if nothing does. Raises BadInput if it cannot fail so."""
        source = node_source(self._faults, device.node_id, self._seed)
        if source is None:
            return device
        if source.fails and not hasattr(device.application, "fail"):
            found = f"node {device.node_id}"
            raise BadInput("fault plan", NODE_FAILS, found, "a simulated drive, with a motor inside")
        made = FaultyDevice(device, source, self.log)
        self._devices.append(made)
        return made

    def on_start(self, wake: Callable[[], None]) -> None:
        """Call ``wake`` at the plan's time zero: a device may have other wishes then."""
        self._wakes.append(wake)

    def start(self, now: Instant) -> None:
        """Time zero is ``now``. The frames' faults are started by the bus that wears them."""
        if self.disturber is not None:
            self.disturber.start(now)
        for device in self._devices:
            device.start_faults(now)
        for wake in self._wakes:
            wake()

    def stop(self) -> None:
        """No frame is touched any more, and nothing new strikes a node."""
        if self.disturber is not None:
            self.disturber.stop()
        for device in self._devices:
            device.stop_faults()

    def finish(self) -> None:
        """Let the log's sink have what it has not got yet."""
        if self.log is not None:
            self.log.flush()


def _fates(
    faults: Faults, seed: int, log: FaultLog | None, error_frames: bool, link: str
) -> FateSource | None:
    if isinstance(faults, RecordedFaults):
        return ReplayedFates(faults, log)
    if not faults.faults:
        return None
    return FaultInjector(faults, seed, link, error_frames, log)


def node_kinds(faults: Faults) -> tuple[str, ...]:
    """Kinds of faults of nodes themselves, which act only where the nodes are simulated."""
    if isinstance(faults, RecordedFaults):
        return faults.node_kinds
    return tuple(dict.fromkeys(fault.kind for fault in faults.node_faults))
