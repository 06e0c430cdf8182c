"""One axis of the loop: from its drive's readings to its next command, and the record of both."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from drivers.errors import LimitExceeded
from drivers.exchange import Command, Drive, Reading
from drivers.timebase import Duration, Instant
from hil.clock_map import ClockMap
from hil.compensation import Compensator
from hil.controllers import Controller
from hil.delay import DelayMeter, Fate
from hil.safety import SafetyGuard
from hil.samples import CycleRecord, Sample, StateEstimate
from hil.scenario import LoadProfile, SpeedProfile

NOT_SENT: Final = Instant(-1)
SYNCS_REMEMBERED: Final = 64

_new: Final = tuple.__new__
_COMMAND: Final = Command
_RECORD: Final = CycleRecord
_SAMPLE: Final = Sample
"""``_new(_SAMPLE, values)`` takes a third of the time of ``Sample(*values)``, for the path of every cycle."""


class LoadMachine(Protocol):
    """What puts a load on the shaft."""

    def set_torque(self, torque_nm: float) -> None:
        """Ask for a load torque, N m; positive opposes positive speed. Does not block."""
        ...


class Tick:
    """What all axes of a cycle share."""

    __slots__ = ("due_at", "sequence", "sync_sent_at", "time_s", "woke_at")

    def __init__(
        self, sequence: int, due_at: Instant, woke_at: Instant, sync_sent_at: Instant, time_s: float
    ) -> None:
        """``time_s``: since the run began."""
        self.sequence = sequence
        self.due_at = due_at
        self.woke_at = woke_at
        self.sync_sent_at = sync_sent_at
        self.time_s = time_s


class Decision:
    """What was done in one cycle, while the fate of its own reading may still be open."""

    __slots__ = ("command", "command_sent_at", "estimate", "load_torque_nm", "reference_rad_s", "tick")

    def __init__(
        self,
        tick: Tick,
        estimate: StateEstimate,
        reference_rad_s: float,
        load_torque_nm: float,
        command: Command,
        command_sent_at: Instant,
    ) -> None:
        self.tick = tick
        self.estimate = estimate
        self.reference_rad_s = reference_rad_s
        self.load_torque_nm = load_torque_nm
        self.command = command
        self.command_sent_at = command_sent_at


@dataclass(frozen=True, slots=True)
class AxisParts:
    """What an axis is put together from."""

    name: str
    drive: Drive
    controller: Controller
    compensator: Compensator
    guard: SafetyGuard
    reference: SpeedProfile
    load: LoadProfile
    load_machine: LoadMachine | None
    clock_map: ClockMap
    meter: DelayMeter


class Axis:
    """State of one axis from cycle to cycle."""

    def __init__(
        self,
        number: int,
        parts: AxisParts,
        period: Duration,
        sync_latency: Duration,
        record: Callable[[CycleRecord], None],
        acts_later: Duration = Duration(0),  # noqa: B008 - an int
    ) -> None:
        """``acts_later``: a command takes so much longer on this axis's segment than the loop reckons."""
        self.parts = parts
        self.meter = parts.meter
        self._number = number
        self._period = period
        self._sync_latency = sync_latency
        self._record = record
        self._acts_later = acts_later
        self._drive = parts.drive
        self._output = parts.controller.output
        self._update = parts.controller.update
        self._receive = parts.compensator.receive
        self._estimate = parts.compensator.estimate
        self._syncs: list[Tick] = []
        self._decisions: list[Decision] = []
        self._fresh = False
        self._load_nm = 0.0

    def calibrate(self, sync_sent_at: Instant) -> bool:
        """Take readings that can only answer the SYNC sent at ``sync_sent_at``; whether one came."""
        readings = self._drive.take_readings()
        for reading in readings:
            if reading.device_time_ns is not None:
                self.parts.clock_map.observe(sync_sent_at, reading.device_time_ns, reading.received_at)
            else:
                self.meter.learn(Duration(reading.received_at - sync_sent_at - self._sync_latency))
        return bool(readings)

    def begin(self, tick: Tick) -> None:
        """A SYNC has gone out."""
        syncs = self._syncs
        syncs.append(tick)
        if len(syncs) > SYNCS_REMEMBERED:
            syncs.pop(0)
        self.meter.sync_sent(tick.sequence, tick.due_at)

    def collect(self) -> None:
        """Take in what has arrived."""
        for reading in self._drive.take_readings():
            sample = self._place(reading)
            if sample is None:
                self.meter.unmatched += 1
            elif self.meter.arrived(sample):
                self._check(self.parts.guard.check_speed(reading.velocity_rad_s))
                self._receive(sample)
                self._fresh = True

    def has_expected(self, sequence: int, decide_after: Duration) -> bool:
        """Whether nothing more is to be expected before the decision of this cycle.

        A reading that usually takes longer than until the decision is awaited in a later cycle.
        """
        overdue = self.meter.typical_delay - decide_after
        behind = -(-overdue // self._period) if overdue > 0 else 0
        return self.meter.newest >= sequence - behind

    def decide(self, tick: Tick, apply_at: Instant) -> None:
        """Compute, limit and send the command of this cycle."""
        parts = self.parts
        apply_at = Instant(apply_at + self._acts_later)
        reference = parts.reference.value(tick.time_s)
        self._apply_load(parts.load.value(tick.time_s))
        estimate = self._estimate(apply_at)
        demand_nm = self._output(estimate, reference)
        torque_nm = parts.guard.limit(demand_nm)
        command = _new(_COMMAND, (tick.sequence, torque_nm, apply_at, Instant(apply_at + self._period)))
        self._check(parts.guard.check_cycle(self._fresh, demand_nm, estimate))
        self._fresh = False
        self._drive.check()
        sent_at = self._drive.write(command)
        self._update(estimate, command)
        self._decisions.append(Decision(tick, estimate, reference, self._load_nm, command, sent_at))

    def settle(self) -> None:
        """Record the cycles whose readings' fates are known."""
        for fate in self.meter.settle():
            self._finish(fate)

    def settle_all(self) -> None:
        """End of the run: record what is left."""
        for fate in self.meter.settle_all():
            if self._decisions:
                self._finish(fate)

    def _finish(self, fate: Fate) -> None:
        decision = self._decisions.pop(0)
        tick = decision.tick
        self._record(
            _new(
                _RECORD,
                (
                    tick.sequence,
                    self._number,
                    tick.due_at,
                    tick.woke_at,
                    tick.sync_sent_at,
                    fate.observation,
                    fate.delay,
                    decision.estimate,
                    decision.reference_rad_s,
                    decision.load_torque_nm,
                    decision.command,
                    decision.command_sent_at,
                ),
            )
        )

    def _place(self, reading: Reading) -> Sample | None:
        """Which SYNC a reading answers, and when it was taken; None if no remembered SYNC fits."""
        if reading.device_time_ns is None or not self.parts.clock_map.ready:
            return self._place_by_arrival(reading)
        sampled_at, error_ns = self.parts.clock_map.place(reading.device_time_ns)
        # A SYNC may be a quarter of a period late by the map's error or early by queueing.
        latest_sent_at = sampled_at + self._period // 4
        for tick in reversed(self._syncs):
            sent_at = tick.sync_sent_at
            if sent_at <= latest_sent_at:
                if sampled_at - sent_at > self._period:
                    return None
                self.parts.clock_map.observe(sent_at, reading.device_time_ns, reading.received_at)
                return _new(_SAMPLE, (tick.sequence, reading, sampled_at, error_ns))
        return None

    def _place_by_arrival(self, reading: Reading) -> Sample | None:
        """The SYNC of which a reading, after the usual delay, would have come nearest to this moment.

        A drive answers SYNCs in order, so those before the newest one answered are out. A delay that jumps
        by more than half a period is taken for one that is whole periods off.
        """
        usual = self.meter.typical_delay + self._sync_latency
        newest = self.meter.newest
        best_sequence, best_sent_at, best_miss = 0, Instant(0), -1
        for tick in reversed(self._syncs):
            sequence, sent_at = tick.sequence, tick.sync_sent_at
            age = reading.received_at - sent_at
            if age < 0:
                continue
            miss = abs(age - usual)
            if sequence <= newest or 0 <= best_miss < miss:
                break
            best_sequence, best_sent_at, best_miss = sequence, sent_at, miss
        if best_miss < 0:
            return None
        error_ns = reading.received_at - best_sent_at
        return Sample(best_sequence, reading, Instant(best_sent_at + self._sync_latency), error_ns)

    def _apply_load(self, torque_nm: float) -> None:
        if torque_nm != self._load_nm and self.parts.load_machine is not None:
            self.parts.load_machine.set_torque(torque_nm)
            self._load_nm = torque_nm

    def _check(self, reason: str | None) -> None:
        if reason is not None:
            raise LimitExceeded(f"{self.parts.name}: {reason}", remedy="the drive is being brought to rest")
