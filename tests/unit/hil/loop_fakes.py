"""A master and drives on a made-up bus, for the tests of axis and loop: time is a number they own."""

from collections.abc import Callable
from heapq import heappop, heappush

from drivers.errors import DriveInFault
from drivers.exchange import Command, Drive, Master, Reading
from drivers.timebase import NS_PER_MS, Duration, Instant
from hil.axis import Axis, AxisParts
from hil.clock_map import ClockMap
from hil.compensation import Arrival, Compensator
from hil.delay import DelayMeter
from hil.loop import Actuation, LoopTiming
from hil.safety import SafetyGuard, SafetyLimits
from hil.samples import CycleRecord, StateEstimate
from hil.scenario import LoadProfile, SpeedProfile, Step

PERIOD = Duration(NS_PER_MS)
SYNC_LATENCY = Duration(50_000)
TIMING = LoopTiming(
    PERIOD, Duration(700_000), Duration(3 * NS_PER_MS), Actuation.ON_ARRIVAL, SYNC_LATENCY, Duration(90_000)
)
DEVICE_CLOCK_OFFSET_NS = 987_654_321


class FakeDrive(Drive):
    """Answers each SYNC after ``delay(sequence)`` ns, or not at all if that is None."""

    def __init__(self, delay: Callable[[int], int | None]) -> None:
        self.delay = delay
        self.commands: list[Command] = []
        self.readings: list[Reading] = []
        self.velocity_rad_s = 0.0
        self.fault = ""

    def take_readings(self) -> list[Reading]:
        readings, self.readings = self.readings, []
        return readings

    def check(self) -> None:
        if self.fault:
            raise DriveInFault(self.fault)

    def write(self, command: Command) -> Instant:
        self.commands.append(command)
        return Instant(command.effective_at - 90_000)


class FakeBus(Master):
    """Clock and master in one: readings fall due in a heap."""

    def __init__(self, drives: list[FakeDrive], oversleep: Callable[[int], int] | None = None) -> None:
        super().__init__()
        self.drives = drives
        self.at = Instant(0)
        self.oversleep = oversleep
        self._due: list[tuple[int, int, FakeDrive, Reading]] = []
        self._entered = 0

    def now(self) -> Instant:
        return self.at

    def sleep_until(self, when: Instant) -> None:
        self.pump(when)

    def send_sync(self) -> Instant:
        self.sync_count += 1
        for drive in self.drives:
            delay = drive.delay(self.sync_count)
            if delay is None:
                continue
            sampled_at = self.at + SYNC_LATENCY
            received_at = Instant(sampled_at + delay)
            stamp = sampled_at + DEVICE_CLOCK_OFFSET_NS
            reading = Reading(self.sync_count, 0.0, drive.velocity_rad_s, 0.0, 0x0627, stamp, received_at)
            self._entered += 1
            heappush(self._due, (received_at, self._entered, drive, reading))
        return self.at

    def pump(self, until: Instant) -> None:
        while self.pump_one(until):
            pass
        if self.oversleep is not None:
            self.at = Instant(self.at + self.oversleep(self.sync_count))

    def pump_one(self, until: Instant) -> bool:
        if self._due and self._due[0][0] <= until:
            at, _, drive, reading = heappop(self._due)
            self.at = Instant(max(self.at, at))
            drive.readings.append(reading._replace(sequence=self.sync_count))
            return True
        self.at = Instant(max(self.at, until))
        return False


class Proportional:
    """Torque equals speed error: shows what a command was computed from."""

    def output(self, estimate: StateEstimate, reference_rad_s: float) -> float:
        return reference_rad_s - estimate.velocity_rad_s

    def update(self, estimate: StateEstimate, command: Command) -> None:
        """Static."""


def make_axis(
    drive: FakeDrive,
    records: list[CycleRecord],
    compensator: Compensator | None = None,
    limits: SafetyLimits | None = None,
) -> Axis:
    parts = AxisParts(
        name="axis1",
        drive=drive,
        controller=Proportional(),
        compensator=compensator or Arrival(),
        guard=SafetyGuard(limits or SafetyLimits(5.0, 200.0), 0.001),
        reference=SpeedProfile([Step(0.01, 2.0)]),
        load=LoadProfile([]),
        load_machine=None,
        clock_map=ClockMap(SYNC_LATENCY),
        meter=DelayMeter(Duration(2 * NS_PER_MS), 10),
    )
    return Axis(0, parts, PERIOD, SYNC_LATENCY, records.append)
