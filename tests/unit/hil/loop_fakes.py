"""A master and drives on a made-up bus, for the tests of axis and loop: time is a number they own."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from heapq import heappop, heappush

from servobench.drivers.errors import DriveInFault
from servobench.drivers.exchange import Command, Drive, Master, Readback, Reading, SentCommand
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis
from servobench.hil.control.compensation import Arrival
from servobench.hil.loop.axis import Axis, AxisParts
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.loop import Actuation, Loop, LoopTiming
from servobench.hil.loop.pace import OwnSync
from servobench.hil.loop.protocol import (
    Compensator,
    Context,
    Controller,
    SetPoint,
    SpeedSetPoint,
    TorqueSetPoint,
)
from servobench.hil.loop.safety import SafetyGuard, SpeedLimits, TorqueLimits
from servobench.hil.loop.scenario import LevelStep, Quantity, ReferenceProfile
from servobench.hil.loop.syncs import SyncLog

PERIOD = Duration(NS_PER_MS)
SYNC_LATENCY = Duration(50_000)
TRANSIT = Duration(76_000)
COMMAND_LATENCY = Duration(90_000)
TIMING = LoopTiming(
    PERIOD, Duration(700_000), Duration(3 * NS_PER_MS), Actuation.ON_ARRIVAL, SYNC_LATENCY, COMMAND_LATENCY
)
DEVICE_CLOCK_OFFSET_NS = 987_654_321
OPERATION_ENABLED = 0x0627


def reading_at(
    received_at: Instant, device_time_ns: int | None = None, velocity_rad_s: float = 0.0
) -> Reading:
    """A reading whose other values were told with it."""
    return Reading(
        velocity_rad_s,
        device_time_ns,
        received_at,
        0.0,
        received_at,
        0.0,
        received_at,
        OPERATION_ENABLED,
        received_at,
    )


class FakeDrive(Drive):
    """Answers the n-th SYNC after ``delay(n)`` ns, or not at all if that is None."""

    def __init__(self, delay: Callable[[int], int | None]) -> None:
        self.delay = delay
        self.commands: list[Command] = []
        self.sent: list[SentCommand] = []
        self.readings: list[Reading] = []
        self.readbacks: list[Readback] = []
        self.velocity_rad_s = 0.0
        self.fault = ""
        self.has_clock = True

    def take_readings(self) -> list[Reading]:
        readings = list(self.readings)
        self.readings.clear()
        return readings

    def take_readbacks(self) -> list[Readback]:
        readbacks, self.readbacks = self.readbacks, []
        return readbacks

    def check(self) -> None:
        if self.fault:
            raise DriveInFault(self.fault)

    def write(self, command: Command) -> SentCommand | None:
        self.commands.append(command)
        handed_at = Instant(command.effective_at - COMMAND_LATENCY)
        self.sent.append(SentCommand(command.sequence, round(command.torque_nm * 1000), handed_at))
        return self.sent[-1]


class FakeBus(Master):
    """Clock and master in one: echoes and readings fall due in a heap."""

    def __init__(self, drives: list[FakeDrive], oversleep: Callable[[int], int] | None = None) -> None:
        super().__init__()
        self.drives = drives
        self.at = Instant(0)
        self.oversleep = oversleep
        self.handed_at: list[Instant] = []
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._entered = 0

    def now(self) -> Instant:
        return self.at

    def sleep_until(self, when: Instant) -> None:
        self.at = Instant(max(self.at, when))

    def call_at(self, at: int, what: Callable[[], None]) -> None:
        self._entered += 1
        heappush(self._due, (at, self._entered, what))

    def send_sync(self) -> Instant:
        self.sync_count += 1
        self.handed_at.append(self.at)
        self.sync_handed_at = [self.at]
        on_bus_at = Instant(self.at + SYNC_LATENCY)
        self.call_at(on_bus_at, lambda: self._echo(on_bus_at))
        self._answer(on_bus_at)
        return self.at

    def produce(self, instants: Iterable[int], hear: Callable[[Instant], None]) -> None:
        """Another node sends SYNCs that end on the bus at ``instants``."""
        for at in map(Instant, instants):
            self.call_at(at, partial(self._on_foreign_sync, at, hear))

    def _on_foreign_sync(self, at: Instant, hear: Callable[[Instant], None]) -> None:
        self.sync_count += 1
        hear(at)
        self._answer(at)

    def _answer(self, on_bus_at: Instant) -> None:
        for drive in self.drives:
            delay = drive.delay(self.sync_count)
            if delay is None:
                continue
            stamp = on_bus_at + DEVICE_CLOCK_OFFSET_NS if drive.has_clock else None
            reading = reading_at(Instant(on_bus_at + delay), stamp, drive.velocity_rad_s)
            self.call_at(reading.received_at, partial(drive.readings.append, reading))

    def _echo(self, at: Instant) -> None:
        if self.on_sync_echo is not None:
            self.on_sync_echo(at, UNTOLD)

    def withdraw(self) -> None:
        """There is room always."""

    def rest(self, until: Instant) -> None:
        self.pump(until)
        if self.oversleep is not None:
            self.at = Instant(self.at + self.oversleep(self.sync_count))

    def pump(self, until: Instant) -> None:
        while self.pump_one(until):
            pass

    def pump_one(self, until: Instant) -> bool:
        if self._due and self._due[0][0] <= max(until, self.at):
            at, _, what = heappop(self._due)
            self.at = Instant(max(self.at, at))
            what()
            return True
        self.at = Instant(max(self.at, until))
        return False


class Proportional(Controller):
    """Torque, or speed, equals speed error: shows what a command was computed from."""

    def __init__(self, quantity: Callable[[float], SetPoint] = TorqueSetPoint) -> None:
        self._quantity = quantity
        self.dropouts: list[int] = []
        """What each call was told."""

    def output(self, context: Context) -> SetPoint:
        self.dropouts.append(context.dropouts)
        error_rad_s = context.reference_rad_s - context.estimate.velocity_rad_s
        return self._quantity(error_rad_s)


def make_axis(
    drive: FakeDrive,
    records: list[CycleRecord],
    compensator: Compensator | None = None,
    limits: TorqueLimits | SpeedLimits | None = None,
    controller: Controller | None = None,
    *,
    syncs: SyncLog | None = None,
    told: list[str] | None = None,
) -> Axis:
    log = syncs or SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    tell = (told if told is not None else []).append
    parts = AxisParts(
        name="axis1",
        drive=drive,
        controller=controller
        or Proportional(SpeedSetPoint if isinstance(limits, SpeedLimits) else TorqueSetPoint),
        compensator=compensator or Arrival(),
        guard=SafetyGuard(limits or TorqueLimits(5.0, 200.0), 0.001),
        reference=ReferenceProfile([LevelStep(0.01, 2.0)]),
        load=ReferenceProfile([], Quantity.TORQUE),
        load_machine=None,
        syncs=log,
        transit=TRANSIT,
        deadline=Duration(2 * NS_PER_MS),
        horizon=10,
        tell=tell,
    )
    return Axis(0, parts, PERIOD, records.append)


def make_loop(
    bus: FakeBus,
    axes: list[Axis],
    stall: Callable[[Instant], Duration] | None = None,
    actuation: Actuation = Actuation.ON_ARRIVAL,
) -> Loop:
    """A loop whose SYNC log hears the bus's echoes; the axes share the log of the first."""
    log = axes[0].parts.syncs
    bus.on_sync_echo = log.came
    pace = OwnSync(bus, bus, PERIOD, [log], stall)
    return Loop(bus, bus, axes, pace, replace(TIMING, actuation=actuation))
