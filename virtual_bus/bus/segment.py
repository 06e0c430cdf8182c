"""One CAN segment in simulated time: arbitration, exact frame time, frame spacing, load (core/segment.c).

Unless asked for something else, every frame is acknowledged and none is corrupted: disturbed frames,
error counters, bus-off, missing acknowledgement, unplugged nodes and the like are the business of
:mod:`servobench.virtual_bus.bus.error_handling`, which takes over once any of them is used.
"""

from typing import Self

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.bus.disturbance import Disturb, OnError
from servobench.virtual_bus.bus.error_handling import ErrorHandling
from servobench.virtual_bus.bus.listener import Listener
from servobench.virtual_bus.bus.port import Medium, Port
from servobench.virtual_bus.core.native import HostPlace
from servobench.virtual_bus.timeline import Timeline


class CanSegment(Medium):
    """A bus of one bit rate on a timeline, with any number of ports."""

    def __new__(cls, timeline: Timeline, bitrate: int = 1_000_000, acknowledged: bool = True) -> Self:  # noqa: ARG004
        return super().__new__(cls, timeline, bitrate)

    def __init__(self, timeline: Timeline, bitrate: int = 1_000_000, acknowledged: bool = True) -> None:  # noqa: ARG002
        """``acknowledged``: something that is no port acknowledges every frame; else another port has to."""
        self.acknowledged = acknowledged
        self.errors = 0
        """Attempts that ended in an error frame."""
        self.disturb: Disturb | None = None
        self.error_monitors: tuple[OnError, ...] = ()
        self._attached = 0
        if not acknowledged:
            self.handled()

    @property
    def busy_ns(self) -> Duration:
        """Time taken by completed frames and the intermission after each."""
        return self.load.busy_ns

    def load_percent(self, since: Instant, until: Instant) -> float:
        """Share of [since, until] that completed frames and intermissions took, percent."""
        return self.load.percent(since, until)

    def attach(self, name: str, owner: Listener | HostPlace) -> Port:
        """A port whose ``owner`` gets every other port's frame at its end of frame."""
        self._attached += 1
        port = Port(self, self._attached, name, owner)
        self.add_port(port)
        return port

    def set_disturb(self, judge: Disturb | None) -> None:
        """Ask ``judge`` at each attempt to send what disturbs it; None: nothing any more."""
        self.disturb = judge
        if judge is not None:
            self.handled()

    def add_error_monitor(self, on_error: OnError) -> None:
        """Show every error frame to ``on_error`` at its end."""
        self.error_monitors = (*self.error_monitors, on_error)

    def port(self, name: str) -> Port:
        """The port of that name. Raises LookupError if there is none or more than one."""
        named: list[Port] = [port for port in self.ports if port.name == name]
        if len(named) != 1:
            names = ", ".join(sorted(port.name for port in self.ports))
            raise LookupError(f"{len(named)} ports of the name {name!r}; there are {names or 'none'}")
        return named[0]

    def handled(self) -> ErrorHandling:
        """See :class:`Medium`."""
        handling: ErrorHandling | None = self.handling
        if handling is None:
            handling = ErrorHandling(self)
            handling.adopt()
        return handling
