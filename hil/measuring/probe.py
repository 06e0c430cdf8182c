"""Takes the loop's own times: around the drive, and at the beginning of a decision."""

from bisect import bisect_right
from collections.abc import Sequence
from typing import Final, NamedTuple

from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.exchange import Command, Drive, Readback, Reading, SentCommand
from servobench.drivers.timebase import Clock, Instant
from servobench.hil.control.compensation import Arrival
from servobench.hil.loop.axis_roles import Compensator
from servobench.hil.loop.clock_map import ClockMap
from servobench.hil.loop.context import Context
from servobench.hil.loop.samples import Sample, StateEstimate

BEFORE_NS: Final = 2_000
"""A demand that changed this shortly before its command was on the bus belongs to it: a stamp of 1013h is
rounded down to a microsecond, and the map of the clock errs by as much. An earlier change belongs to another
command."""


class TimedDemandChange(NamedTuple):
    """A change of torque demand reported by a drive, on the host's clock."""

    demand_raw: int
    at: Instant
    error_ns: int
    """Error of the map of the drive's clock."""


class ProbedDrive(Drive):
    """The drive of an axis, noting when the loop took readings and sent commands."""

    def __init__(self, drive: ServoDrive, clock: Clock) -> None:
        self.drive = drive
        self.map: ClockMap | None = None
        """Map of the drive's clock; None for a drive whose demand changes are not placed."""
        self.to_user_code_ns: list[int] = []
        """From the bus stamp of each reading until the loop has it."""
        self.computation_ns: list[int] = []
        """From the beginning of each decision until its command is handed over."""
        self.sent: list[SentCommand] = []
        """Every command; its echo may still come."""
        self.changes: list[TimedDemandChange] = []
        self.decision = DecisionProbe(clock)
        self._now = clock.now

    def begin(self) -> None:
        """Discard everything before the first cycle."""
        for notes in (self.to_user_code_ns, self.computation_ns, self.sent, self.changes):
            notes.clear()
        self.drive.take_demand_changes()

    def take_readings(self) -> list[Reading]:
        readings = self.drive.take_readings()
        if readings:
            now = self._now()
            self.to_user_code_ns += [now - reading.received_at for reading in readings]
        if self.map is not None and self.map.ready:
            for change in self.drive.take_demand_changes():
                at = self.map.place(change.device_time_ns)
                self.changes.append(TimedDemandChange(change.demand_raw, at, self.map.error_ns))
        return readings

    def take_readbacks(self) -> list[Readback]:
        return self.drive.take_readbacks()

    def write(self, command: Command) -> SentCommand | None:
        sent = self.drive.write(command)
        if sent is not None:
            self.sent.append(sent)
            self.computation_ns.append(sent.handed_at - self.decision.began_at)
        return sent

    def check(self) -> None:
        self.drive.check()


class DecisionProbe(Compensator):
    """A compensator: the newest sample at once; it notes when a decision began by requesting it."""

    def __init__(self, clock: Clock) -> None:
        self.began_at = Instant(0)
        self._now = clock.now
        self._arrival = Arrival()

    def receive(self, sample: Sample) -> None:
        """Take a sample; see :class:`servobench.hil.control.compensation.Arrival`."""
        self._arrival.receive(sample)

    def estimate(self, context: Context) -> StateEstimate:
        """Return the estimate; see :class:`servobench.hil.control.compensation.Arrival`."""
        self.began_at = self._now()
        return self._arrival.estimate(context)


def acting(sent: Sequence[SentCommand], changes: Sequence[TimedDemandChange]) -> dict[int, TimedDemandChange]:
    """Return by cycle when its command began to act.

    A change belongs to the newest command of its value under way then. Values repeat only after many cycles,
    see :class:`servobench.hil.measuring.subject.Excitation`; a command late by as many counts as the later
    one. A value reported twice for one command counts the first time.
    """
    by_value: dict[int, list[SentCommand]] = {}
    for command in sent:
        by_value.setdefault(command.raw, []).append(command)
    began: dict[int, TimedDemandChange] = {}
    for change in changes:
        candidates = by_value.get(change.demand_raw, [])
        place = bisect_right(candidates, change.at + BEFORE_NS + change.error_ns, key=on_its_way)
        if place:
            began.setdefault(candidates[place - 1].sequence, change)
    return began


def on_its_way(command: SentCommand) -> int:
    """Return when it was on the bus, or at least handed over."""
    return command.handed_at if command.on_bus_at is None else command.on_bus_at
