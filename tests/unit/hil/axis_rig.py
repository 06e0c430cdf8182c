"""An axis that is taken through its cycles by hand, with the drive and the compensator that it has."""

import math
from collections.abc import Callable

from servobench.drivers.exchange import Command, DemandChange, Readback, Reading, SentCommand
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.delay import Tick
from servobench.hil.loop.protocol import Compensator, Context, Controller
from servobench.hil.loop.safety import TorqueLimits
from servobench.hil.loop.samples import AT_REST, Sample, StateEstimate
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import (
    COMMAND_LATENCY,
    DEVICE_CLOCK_OFFSET_NS,
    PERIOD,
    SYNC_LATENCY,
    FakeDrive,
    make_axis,
    reading_at,
)

DELAY = 250_000
DECIDED = 400_000
"""When a cycle is decided, from its SYNC on."""
TAUGHT = 3
"""SYNCs of calibration, the numbers -2, -1 and 0."""
HORIZON = 10


class TellingDrive(FakeDrive):
    """One whose frames come when a test says so, and that tells of its torque demand."""

    def __init__(self) -> None:
        super().__init__(lambda _number: None)
        self.changes: list[DemandChange] = []
        self.sends = True
        self.held_rad = 0.0

    def take_demand_changes(self) -> list[DemandChange]:
        changes, self.changes = self.changes, []
        return changes

    def write(self, command: Command) -> SentCommand | None:
        self.commands.append(command)
        if not self.sends:
            return None
        raw = 0 if math.isnan(command.torque_nm) else round(command.torque_nm * 1000)
        sent = SentCommand(command.sequence, raw, Instant(command.effective_at - COMMAND_LATENCY))
        sent.on_bus_at = command.effective_at
        return sent

    def held_position_rad(self) -> float:
        return self.held_rad


class Following(Compensator):
    """The speed of the newest sample, and notes of what it was told."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self._newest = AT_REST

    def reset(self) -> None:
        self.told.append("reset")

    def receive(self, sample: Sample) -> None:
        self.told.append(f"sample {sample.sequence}")
        speed = sample.reading.velocity_rad_s
        self._newest = StateEstimate(0.0, speed, 0.0, sample.sampled_at, sample.sequence)

    def estimate(self, context: Context) -> StateEstimate:
        self.told.append(f"estimate {context.sequence}")
        return self._newest

    def sent(self, command: Command) -> None:
        self.told.append(f"sent {command.sequence}")


class Rig:
    """An axis whose SYNC n ends at n periods; it has been calibrated."""

    def __init__(
        self,
        controller: Controller | None = None,
        limits: TorqueLimits | None = None,
        clock: bool = True,
        change: Callable[[Axis], Axis] = lambda axis: axis,
    ) -> None:
        self.records: list[CycleRecord] = []
        self.drive = TellingDrive()
        self.clock = clock
        self.log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
        self.compensator = Following()
        made = make_axis(self.drive, self.records, self.compensator, limits, controller, syncs=self.log)
        self.axis = change(made)
        for number in range(1 - TAUGHT, 1):
            self.sync(number)
            self.answer(number)
            assert self.axis.calibrate(self.log.marks[-1])

    @staticmethod
    def at(number: float) -> Instant:
        return Instant(round((1000 + number) * PERIOD))

    def sync(self, number: int, echoed: bool = True) -> None:
        at = self.at(number)
        self.log.handed(max(number, 0), Instant(at - SYNC_LATENCY))
        if echoed:
            self.log.came(at, Instant(at - SYNC_LATENCY))

    def answer(self, number: int, delay: int = DELAY, speed: float = 0.0) -> Reading:
        at = self.at(number)
        stamp = at + DEVICE_CLOCK_OFFSET_NS if self.clock else None
        reading = reading_at(Instant(at + delay), stamp, speed)
        self.drive.readings.append(reading)
        return reading

    def read_back(
        self, raw: int, number: int, readings: int, delay: int = DELAY + 20_000, in_reading: bool = False
    ) -> None:
        """0x6074 as of the SYNC ``number``, told after so many readings of the run."""
        at = Instant(self.at(number) + delay)
        self.drive.readbacks.append(Readback(raw, at, TAUGHT + readings, in_reading))

    def tick(self, number: int) -> Tick:
        at = self.at(number)
        return Tick(number, at, at, number * PERIOD / 1e9)

    def begin(self, number: int) -> Tick:
        self.sync(number)
        tick = self.tick(number)
        self.axis.begin(tick)
        return tick

    def decide(self, tick: Tick) -> None:
        now = Instant(tick.due_at + DECIDED)
        self.axis.decide(tick, now, Instant(now + COMMAND_LATENCY))

    def cycle(self, number: int, speed: float = 0.0, answered: bool = True) -> None:
        tick = self.begin(number)
        if answered:
            self.answer(number, speed=speed)
        self.axis.collect()
        self.decide(tick)
        self.axis.settle(number)
