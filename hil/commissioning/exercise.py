"""One stretch of motion: the bench's own loop around a drive, under host limits, recorded in memory."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import LimitExceeded, PeerFault
from servobench.drivers.exchange import Command, SpeedCommand
from servobench.drivers.timebase import NS_PER_S, Duration, Instant, duration_s
from servobench.hil.commissioning.drive_port import DrivePort
from servobench.hil.commissioning.excitation import SpeedReference, TimedSpeed, TimedTorque
from servobench.hil.commissioning.findings import StepFailed
from servobench.hil.commissioning.identify import Array
from servobench.hil.commissioning.outside import refuse_outside
from servobench.hil.commissioning.request import MotionLimits
from servobench.hil.control.compensation import Arrival
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.execution.segments import sync_log
from servobench.hil.loop.axis import Axis, AxisParts
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.loop import LoopTiming
from servobench.hil.loop.pace import OwnSync
from servobench.hil.loop.protocol import Context, Controller, SetPoint
from servobench.hil.loop.safety import SafetyGuard, SpeedLimits, TorqueLimits
from servobench.hil.loop.samples import Dropout, DropoutCause, StateEstimate
from servobench.hil.loop.scenario import Quantity, ReferenceProfile, Segment
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.reviewing.network_meter import runs_of

BLIND_MAX_S: Final = 0.1
"""The exercise ends after this time without a reading."""
_HORIZON: Final = 20
"""Cycles after which a reading or a command is lost, as in a bench."""
OVERSPEED: Final = 1.3
"""Overshoot of the commanded speed at which the host stops the shaft."""


@dataclass(frozen=True, slots=True)
class Recording:
    """The samples; SI units, times in s from the first SYNC."""

    time: Array
    """Sampling instants, by the drive's stamp if it has one."""
    position: Array
    velocity: Array
    torque: Array
    """The drive's 6077h; without it, the command in effect."""
    sync_to_reading_us: Array
    """End of the SYNC on an idle bus to the arrival of its reading."""
    cycles: int
    lost: int
    """Readings that never came."""
    losses_in_a_row: tuple[int, ...]
    """How often exactly 1, 2, ... readings were lost, late or stale in a row."""
    speed_given: Array = field(default_factory=lambda: np.zeros(0))
    """Speed sent in the cycle of each sample; NaN in a torque mode."""

    @property
    def speed(self) -> Array:
        """Smoothed derivative of the position."""
        return smooth_speed(self.time, self.position)


def smooth_speed(time: Array, position: Array, half: int = 4) -> Array:
    """Return the slope of a straight line through each sample and its ``half`` neighbours on either side."""
    if len(time) < 2 * half + 1:
        return np.gradient(position, time) if len(time) > 1 else np.zeros_like(time)
    windows_t = np.lib.stride_tricks.sliding_window_view(time, 2 * half + 1)
    windows_p = np.lib.stride_tricks.sliding_window_view(position, 2 * half + 1)
    t = windows_t - windows_t.mean(axis=1, keepdims=True)
    p = windows_p - windows_p.mean(axis=1, keepdims=True)
    slope = (t * p).sum(axis=1) / (t * t).sum(axis=1)
    return np.concatenate([np.full(half, slope[0]), slope, np.full(half, slope[-1])])


class EnergyMeter:
    """Meters the work at the shaft in the exercises of one step, J."""

    __slots__ = ("spent_j",)

    def __init__(self) -> None:
        self.spent_j = 0.0


class Watched(Controller):
    """A controller with the host's limits on power, energy and position around it.

    Speed, torque, its slope and dropouts are the guard's. Raises LimitExceeded out of ``output``.
    """

    def __init__(self, inner: Controller, limits: MotionLimits, port: DrivePort, energy: EnergyMeter) -> None:
        self._inner = inner
        self._energy = energy
        self._limits = limits
        self._port = port
        self._first: StateEstimate | None = None
        self._last: StateEstimate | None = None
        self._commanded_nm = 0.0

    def output(self, context: Context) -> SetPoint:
        """Return the inner controller's set-point, after checking the limits."""
        if context.estimate.sequence:
            self._check(context.estimate)
        return self._inner.output(context)

    def update(self, context: Context, command: Command) -> None:
        """Update the inner controller."""
        self._commanded_nm = command.torque_nm
        self._inner.update(context, command)

    def _check(self, estimate: StateEstimate) -> None:
        limits = self._limits
        if self._first is None:
            self._first = estimate
        last, self._last = self._last, estimate
        travel = abs(estimate.position_rad - self._first.position_rad)
        if travel > limits.travel_rad:
            raise _exceeded("turned", travel / math.tau, limits.travel_rad / math.tau, "turns")
        commanded = self._port.commanded_rad
        if commanded is not None and abs(commanded - estimate.position_rad) > limits.following_rad:
            behind = abs(commanded - estimate.position_rad) / math.tau
            raise _exceeded("following error", behind, limits.following_rad / math.tau, "turns")
        if last is None or estimate.sequence == last.sequence:
            return
        passed_s = (estimate.valid_at - last.valid_at) / NS_PER_S
        path = estimate.position_rad - last.position_rad
        if passed_s > 0.0 and abs(path) > 0.05:
            speed = abs(path) / passed_s
            if speed > 1.5 * OVERSPEED * limits.speed_rad_s:
                raise _exceeded("speed by position", speed, limits.speed_rad_s, "rad/s")
        # By the position: the velocity's unit may be wrong until a step has looked at it.
        torque_nm = _told_or(estimate.torque_nm, self._commanded_nm)
        if math.isnan(torque_nm):  # neither told nor commanded: speed and path bound the work
            return
        power = abs(torque_nm * path) / passed_s if passed_s > 0.0 else 0.0
        if power > OVERSPEED * limits.power_w:
            raise _exceeded("power", power, limits.power_w, "W")
        energy = self._energy
        energy.spent_j += abs(torque_nm * path)
        if energy.spent_j > limits.energy_j:
            raise _exceeded("work in this step", energy.spent_j, limits.energy_j, "J")


def _told_or(torque_nm: float, commanded_nm: float) -> float:
    """Return the drive's torque, or the commanded one if it reports none; NaN if it is given speeds."""
    return commanded_nm if math.isnan(torque_nm) else torque_nm


def _exceeded(what: str, value: float, limit: float, unit: str) -> LimitExceeded:
    return LimitExceeded(f"{what}: {value:.4g} {unit} is beyond the limit of {limit:.4g} {unit}")


def torque_limits(limits: MotionLimits, period_s: float, guard_speed: bool) -> TorqueLimits:
    """Return the limits of a torque exercise; ``guard_speed``: check the velocity too, whose unit may be
    wrong."""
    return TorqueLimits(
        torque_max_nm=limits.torque_nm,
        speed_max_rad_s=_shaft_speed_max(limits, guard_speed),
        torque_slew_max_nm_s=limits.torque_slew_nm_s,
        dropouts_consecutive_max=_dropouts_max(period_s),
    )


def speed_limits(limits: MotionLimits, period_s: float, guard_speed: bool) -> SpeedLimits:
    """Return the limits of a speed exercise; see :func:`torque_limits`."""
    return SpeedLimits(
        set_point_max_rad_s=limits.speed_rad_s,
        speed_max_rad_s=_shaft_speed_max(limits, guard_speed),
        acceleration_max_rad_s2=limits.acceleration_rad_s2,
        dropouts_consecutive_max=_dropouts_max(period_s),
    )


def _shaft_speed_max(limits: MotionLimits, guard_speed: bool) -> float:
    return OVERSPEED * limits.speed_rad_s if guard_speed else math.inf


def _dropouts_max(period_s: float) -> int:
    return max(10, round(BLIND_MAX_S / period_s))


@dataclass(frozen=True, slots=True)
class Exerciser:
    """Runs controllers on the drive, one exercise after the other."""

    network: CanopenNetwork
    port: DrivePort
    timing: LoopTiming
    limits: MotionLimits
    should_stop: Callable[[], bool]
    """Called each cycle."""
    check_stop: Callable[[], None]
    """Called then; raises the error that makes the caller stop the drive."""
    energy: EnergyMeter
    drives: DriveSession

    @property
    def period_s(self) -> float:
        """Period of the loop, s."""
        return self.timing.period / NS_PER_S

    def run(
        self,
        controller: Controller,
        duration: float,
        reference: list[Segment] | None = None,
        done: Callable[[], bool] = lambda: False,
        guard_speed: bool = True,
    ) -> Recording:
        """Run a torque controller for ``duration`` s, or until it is ``done``.

        Raises LimitExceeded or a fault of the drive, which then still turns: the caller stops it. TypeError
        for a drive that is given speeds.
        """
        limits = torque_limits(self.limits, self.period_s, guard_speed)
        return self._run(controller, limits, duration, reference or [], done)

    def run_speeds(
        self,
        duration: float,
        reference: list[Segment] | None = None,
        guard_speed: bool = True,
        added: Callable[[float], float] | None = None,
    ) -> Recording:
        """Run the speeds of ``reference`` and ``added``, otherwise like :meth:`run`. ValueError for a drive
        that is given torques."""
        limits = speed_limits(self.limits, self.period_s, guard_speed)
        controller = SpeedReference() if added is None else TimedSpeed(added, self.period_s)
        return self._run(controller, limits, duration, reference or [])

    def rest(self, duration: float) -> Recording:
        """Run with set-points of zero, torques or speeds; see :meth:`run`."""
        if self.port.quantity is Quantity.TORQUE:
            return self.run(TimedTorque(lambda _time: 0.0, self.period_s), duration)
        return self.run_speeds(duration)

    def _run(
        self,
        controller: Controller,
        safety: TorqueLimits | SpeedLimits,
        duration: float,
        reference: list[Segment],
        done: Callable[[], bool] = lambda: False,
    ) -> Recording:
        records: list[CycleRecord] = []
        syncs = sync_log(self.network, self.timing.sync_latency, self.timing.period)
        axis = self._axis(controller, safety, reference, syncs, records)
        pump, clock = self.network.frame_pump, self.network.clock
        pace = OwnSync(pump, clock, self.timing.period, [syncs])
        # A reading that is still on its way from before would be taken for the answer to the first SYNC.
        self.network.pump(Instant(clock.now() + self.timing.settle))
        self.port.take_readings()
        self.port.begin()
        try:
            loop = self.drives.cycle(pump, [axis], pace, self.timing, {None: syncs})
            loop.calibrate()
            loop.run(
                duration_s(duration),
                lambda: self.should_stop() or done(),
                lambda _at: None,
                lambda _done: None,
            )
        except PeerFault as error:
            self._refuse_outside(recording_of(records), error)
            raise
        finally:
            self.port.end()
        self.drives.guard.calm()  # the SYNCs of other steps are not counted
        self.check_stop()
        recording = recording_of(records)
        self._refuse_outside(recording)
        return recording

    def _refuse_outside(self, recording: Recording, ended_by: PeerFault | None = None) -> None:
        if self.port.quantity is not Quantity.TORQUE:
            return  # the drive's own loops turn the shaft by pulses that a reading of each cycle may miss
        rated_nm = self.port.drive.rated_torque_nm
        try:
            refuse_outside(recording.time, recording.position, recording.speed, recording.torque, rated_nm)
        except StepFailed as cause:
            raise cause from ended_by

    def _axis(
        self,
        controller: Controller,
        safety: TorqueLimits | SpeedLimits,
        reference: list[Segment],
        syncs: SyncLog,
        records: list[CycleRecord],
    ) -> Axis:
        limits, port, period = self.limits, self.port, self.timing.period
        parts = AxisParts(
            name=port.drive.name,
            drive=port,
            controller=Watched(controller, limits, port, self.energy),
            compensator=Arrival(),
            guard=SafetyGuard(safety, self.period_s),
            reference=ReferenceProfile(reference),
            load=ReferenceProfile([], Quantity.TORQUE),
            load_machine=None,
            syncs=syncs,
            transit=self.timing.sync_latency,  # less than a reading takes: no frame is shorter than a SYNC
            deadline=Duration(5 * period),
            horizon=_HORIZON,
            tell=_unsaid,
        )
        # A new axis each time: between exercises the clocks part too far for the rate of the last one.
        return Axis(0, parts, period, records.append)


def _unsaid(_text: str) -> None:
    """Ignore notes on the drive's clock: in an exercise of seconds its readings show them."""


def recording_of(records: list[CycleRecord]) -> Recording:
    """Convert the records of one axis to arrays."""
    rows = []
    delays_us = []
    missing: list[bool] = []
    lost = 0
    origin = records[0].due_at if records else Instant(0)
    acting_nm = sent_nm = 0.0
    given_rad_s = math.nan
    for record in records:
        observation = record.observation
        acting_nm = sent_nm  # a command acts from behind a SYNC to behind the next one
        if record.command is not None and record.sending is not None:
            sent_nm = record.command.torque_nm
            if isinstance(record.command, SpeedCommand):
                given_rad_s = record.command.speed_rad_s
        if isinstance(observation, Dropout):
            lost += observation.cause in (DropoutCause.LOST, DropoutCause.MISSED)
            missing.append(True)
            continue
        missing.append(False)
        reading = observation.reading
        rows.append(
            (
                (observation.sampled_at - origin) / NS_PER_S,
                reading.position_rad,
                reading.velocity_rad_s,
                _told_or(reading.torque_nm, acting_nm),
                given_rad_s,
            )
        )
        if record.sync_on_bus_at is not None:
            delays_us.append((reading.received_at - record.sync_on_bus_at) / 1e3)
    samples = np.array(rows, dtype=float).reshape(-1, 5)
    samples = samples[np.argsort(samples[:, 0], kind="stable")]
    return Recording(
        time=samples[:, 0].copy(),
        position=samples[:, 1].copy(),
        velocity=samples[:, 2].copy(),
        torque=samples[:, 3].copy(),
        sync_to_reading_us=np.array(delays_us, dtype=float),
        cycles=len(records),
        lost=lost,
        losses_in_a_row=runs_of(np.array(missing, dtype=bool)),
        speed_given=samples[:, 4].copy(),
    )
