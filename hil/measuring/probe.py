"""Where the loop's own times are taken: around the drive, and at the beginning of a decision."""

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
"""A demand that changed so shortly before its command was on the bus is its own: a stamp of 1013h is rounded
down to a microsecond, and the map of the clock errs by as much. Longer before, it is another command's."""


class TimedDemandChange(NamedTuple):
    """A torque demand that a drive told when it changed, on the host's clock."""

    demand_raw: int
    at: Instant
    error_ns: int
    """Of the map of the drive's clock."""


class ProbedDrive(Drive):
    """The drive of an axis, with a note of when the loop took what came and sent what it decided."""

    def __init__(self, drive: ServoDrive, clock: Clock) -> None:
        self.drive = drive
        self.map: ClockMap | None = None
        """Of the drive's clock; None for a drive whose demand changes are not placed."""
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
        """Forget what was before the first cycle."""
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
    """A compensator: the newest sample at once, with a note of when a decision began by asking for it."""

    def __init__(self, clock: Clock) -> None:
        self.began_at = Instant(0)
        self._now = clock.now
        self._arrival = Arrival()

    def receive(self, sample: Sample) -> None:
        """As that of :class:`servobench.hil.control.compensation.Arrival`."""
        self._arrival.receive(sample)

    def estimate(self, context: Context) -> StateEstimate:
        """As that of :class:`servobench.hil.control.compensation.Arrival`."""
        self.began_at = self._now()
        return self._arrival.estimate(context)


def acting(sent: Sequence[SentCommand], changes: Sequence[TimedDemandChange]) -> dict[int, TimedDemandChange]:
    """By cycle: when its command began to act.

    A change belongs to the newest command of its value that was on its way then. Values come again only
    after many cycles, see :class:`servobench.hil.measuring.subject.Excitation`; a command late by as many is
    taken for the later one. A value told twice for one command counts the first time.
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
    """When it was on the bus, or at least handed over."""
    return command.handed_at if command.on_bus_at is None else command.on_bus_at
