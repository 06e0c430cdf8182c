"""One drive under measurement: its set-up, its torques, and its axis in the loop.

Torques are small and alternate in sign; every command can be distinguished from its neighbours.
"""

import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.canopen.pdo_budget import LOAD_LIMIT_PERCENT, budget_of
from servobench.drivers.cia402.drive_setup import DriveSettings, read_scaling
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import DEMAND, STATUS, PlanWish, features_of, status_timer_ms
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, Mode
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, TransferAborted
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Clock, Duration
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile
from servobench.hil.configuration.config import Foreign, Guard
from servobench.hil.execution.assembly import command_duration, shortest_transit
from servobench.hil.execution.segments import timing_without_bench
from servobench.hil.loop.axis import Axis, AxisParts
from servobench.hil.loop.cycle_record import ROW, CycleRecord, row_of
from servobench.hil.loop.loop import LoopTiming
from servobench.hil.loop.protocol import Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.safety import SafetyGuard, TorqueLimits
from servobench.hil.loop.scenario import Quantity, ReferenceProfile
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.measuring.stages import ProbedDrive
from servobench.hil.measuring.stamp_probe import StampFigures, find_stamp
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.virtual_bus.hosting.injection import Faults

HORIZON: Final = 50
"""Cycles after which a reading or a command is lost: more than the 20 of a bench, so that a slow gateway is
measured as slow, not as lossy."""
SETTLE: Final = Duration(50 * NS_PER_MS)
"""Between the SYNCs by which a drive's clock is learnt, and after the last cycle."""
BLIND: Final = Duration(100 * NS_PER_MS)
"""An enabled drive is stopped after this time without a reading, or without a command."""
HEARTBEAT_MS: Final = 50
"""20 frames a second are no load on a bus under measurement."""
WATCH_ENABLED_MS: Final = 150
"""Three heartbeats fit into it."""
WATCH_DISABLED_MS: Final = 1000
"""A drive at rest need not be noticed at once."""
POSITION_EVERY: Final = (1, 4, 10)
"""SYNCs per position and torque demand: the first value possible on the bus. For an enabled drive the demand
is needed with every one, or a lost command would be seen less often than one that acts."""
_MODE: Final = Mode.CYCLIC_SYNCHRONOUS_TORQUE
TORQUE_SHARE: Final = 0.03
"""Share of the rated torque: thirty steps of 6071h, hardly more than the friction of most motors."""
STEPS_MIN: Final = 8
"""Distinct magnitudes: with fewer, commands that are four cycles apart may be equal."""
CALM_SHARE: Final = 0.25
"""Share of the speed limit: beyond it torques only brake, instead of changing their sign."""


@dataclass(frozen=True, slots=True)
class MeasureRequest:
    """A checked command line."""

    bus: str
    nodes: tuple[int, ...]
    cycles: int
    period_us: int
    bitrate_bit_s: int
    enable: bool
    """Enable the drives and command small torques."""
    speed_max_rad_s: float
    """Speed at which an enabled drive is stopped."""
    torque_max_nm: float | None = None
    """Largest torque; None: :data:`TORQUE_SHARE` of the rated one."""
    motor: PmsmParameters | None = None
    """Motor of the drives of a simulated bus."""
    faults: Faults | None = None
    seed: int = 0
    allow: tuple[Foreign, ...] = Guard().allow
    """Frames that others may send, as in ``[guard]`` of a bench."""

    @property
    def period(self) -> Duration:
        """Between two SYNCs."""
        return Duration(self.period_us * NS_PER_US)


def timing_of(request: MeasureRequest) -> LoopTiming:
    """Return the timing of the loop of a measurement."""
    settle = Duration(max(10 * request.period, SETTLE))
    return timing_without_bench(request.period, request.bitrate_bit_s, settle)


def affordable(request: MeasureRequest) -> tuple[bool, int]:
    """Return whether 6074h may be sent on change, and with how many SYNCs the position comes.

    Raises BadInput if the bus has no room for the minimum.
    """
    for changes in (True, False) if request.enable else (False,):
        for every in POSITION_EVERY[:1] if request.enable else POSITION_EVERY:
            plans = [_plan(node, changes=changes, every=every) for node in request.nodes]
            budget = budget_of(plans, request.period, request.bitrate_bit_s)
            if budget.load_percent <= LOAD_LIMIT_PERCENT:
                return changes, every
    shortest_us = request.period_us
    while budget.load_percent > LOAD_LIMIT_PERCENT:  # a longer cycle has more frames that go by their timers
        shortest_us = max(
            shortest_us + 1, math.ceil(budget.busy_ns * 100.0 / (LOAD_LIMIT_PERCENT * NS_PER_US))
        )
        budget = budget_of(plans, Duration(shortest_us * NS_PER_US), request.bitrate_bit_s)
    expected = f"at least {shortest_us}, so that the PDOs take {LOAD_LIMIT_PERCENT:g} % of the bus"
    raise BadInput("--period-us", "", request.period_us, expected, "or fewer nodes at a time")


def steps_of(torque_max_nm: float | None, rated_torque_nm: float) -> int:
    """Return the number of steps of 6071h, thousandths of the rated torque, for commands.

    Raises BadInput for a bound that leaves fewer than :data:`STEPS_MIN`, or is beyond the rated torque.
    """
    if torque_max_nm is None:
        return round(1000.0 * TORQUE_SHARE)
    unit_nm = rated_torque_nm / 1000.0
    steps = int(torque_max_nm / unit_nm + 1e-9)
    if not STEPS_MIN <= steps <= 1000:
        raise BadInput(
            "--torque-max-nm",
            "",
            torque_max_nm,
            f"from {STEPS_MIN * unit_nm:g} N m, {STEPS_MIN} steps of the drive's torque, to the rated"
            f" {rated_torque_nm:g} N m",
        )
    return steps


class Excitation(Controller):
    """Commands torques of 1 to ``steps`` units, no magnitude twice within half as many cycles.

    The sign alternates, so that the speed stays constant; if it has drifted by more than :data:`CALM_SHARE`
    of its limit the torque brakes.
    """

    def __init__(self, steps: int, unit_nm: float, speed_max_rad_s: float, seed: int) -> None:
        self._unit_nm = unit_nm
        self._calm_rad_s = CALM_SHARE * speed_max_rad_s
        self._random = random.Random(seed)
        self._rested = list(range(1, steps + 1))
        self._recent: deque[int] = deque()
        self._kept_away = steps // 2
        self._sign = 1.0
        self._magnitude = 0
        self._draw()

    def output(self, context: Context) -> SetPoint:
        """Return the torque of this cycle."""
        sign, speed_rad_s = self._sign, context.estimate.velocity_rad_s
        if abs(speed_rad_s) > self._calm_rad_s:
            sign = -math.copysign(1.0, speed_rad_s)
        return TorqueSetPoint(sign * self._magnitude * self._unit_nm)

    def update(self, context: Context, command: Command) -> None:  # noqa: ARG002
        """Draw the next."""
        self._sign = -math.copysign(1.0, command.torque_nm)
        self._draw()

    def _draw(self) -> None:
        self._magnitude = self._rested.pop(self._random.randrange(len(self._rested)))
        self._recent.append(self._magnitude)
        if len(self._recent) > self._kept_away:
            self._rested.append(self._recent.popleft())


class Subject:
    """One drive under measurement."""

    def __init__(self, drive: ServoDrive, clock: Clock, request: MeasureRequest) -> None:
        self.drive = drive
        self.probe = ProbedDrive(drive, clock)
        self.identity = ""
        self.stamp: StampFigures | None = None
        """Properties of its counter; None if it has none."""
        self._profile: StampProfile = STANDARD_STAMP
        self.notes: list[str] = []
        self.configured = False
        """True if something may have been written."""
        self.tells_demand = False
        """True: 6074h comes with the SYNC."""
        self._tells_changes = False
        """True: 6074h comes on change."""
        self._steps = 0
        """Number of steps of 6071h for commands."""
        self._request = request
        self._timing = timing_of(request)
        self._memory = bytearray(request.cycles * ROW.size)
        self._filled = 0

    @property
    def rows(self) -> Rows:
        """The cycles, in their order."""
        return np.frombuffer(self._memory, ROW_DTYPE, self._filled // ROW.size)

    def find_stamp(self, network: CanopenNetwork) -> None:
        """Examine its stamp, by SYNCs and SDO; the drive is connected. Raises NoAnswer and AnswersTwice."""
        drive = self.drive
        if drive.identity is not None:
            self._profile = drive.identity.stamp.if_there(drive.objects.read_if_there)
        self.stamp = find_stamp(network, drive.node_id, self._profile.key, self._request.seed)
        if self.stamp is not None and self.stamp.at_sync is not False:
            self._profile = replace(self._profile, latched="arrival")

    def _stamp_resolution(self) -> Duration:
        """Return the resolution found; a whole period, so that it is not used, for an unusable counter."""
        profile, found, period = self._profile, self.stamp, self._timing.period
        if found is None or found.unit_us is None or found.resolution_us is None:
            return period if found is not None else profile.resolution_at(self._request.bitrate_bit_s)
        same = round(found.unit_us * NS_PER_US) == profile.unit_ns
        return Duration(round(found.resolution_us * NS_PER_US)) if same else period

    def configure(self, *, changes: bool, every: int) -> None:
        """Map PDOs and set the drive up; one that does not take the fullest plan gets a lesser one.

        ``changes``, ``every``: see :func:`affordable`. Raises BadInput for a bound of torque that it cannot
        follow, PeerFault for a drive that cannot be measured.
        """
        request, drive = self._request, self.drive
        scaling = read_scaling(drive.objects, ScaleOverride())
        self._steps = steps_of(request.torque_max_nm, scaling.rated_torque_nm)
        settings = self._settings(self._steps * scaling.torque_nm, every)
        self.configured = True
        stamp = self._profile
        able = all(drive.objects.read_if_there(*key) is not None for key in (stamp.key, DEMAND))
        if changes and able and stamp.of_events:
            self._tells_changes = self._configure_fully(settings)
        elif request.enable and able:
            self.notes.append("no room on the bus for 6074h on change: a longer period, or fewer nodes")
        if not self._tells_changes:
            self.notes += drive.configure(settings)
        assert drive.plan is not None
        assert drive.control.set_point is not None
        self.tells_demand = features_of(drive.plan).demand
        if not request.enable:
            # Whoever else enables the drive: each command takes the voltage away again.
            drive.control.set_point.hold(Object.CONTROLWORD, CONTROLWORDS[DriveCommand.DISABLE_VOLTAGE])

    def join(self, number: int, syncs: SyncLog, say: Callable[[str], None]) -> Axis:
        """Return the axis of the drive, the ``number``-th on the bus; it is configured."""
        request, timing, drive = self._request, self._timing, self.drive
        period = timing.period
        unit_nm = drive.rated_torque_nm / 1000.0
        assert drive.plan is not None

        def tell(text: str) -> None:
            self.notes.append(text)
            say(f"{drive.name}: {text}")

        parts = AxisParts(
            name=drive.name,
            drive=self.probe,
            controller=Excitation(self._steps, unit_nm, request.speed_max_rad_s, request.seed + number),
            compensator=self.probe.decision,
            guard=SafetyGuard(self._limits(unit_nm), period / NS_PER_S),
            reference=ReferenceProfile([]),
            load=ReferenceProfile([], Quantity.TORQUE),
            load_machine=None,
            syncs=syncs,
            transit=shortest_transit(drive.reading_bytes, request.bitrate_bit_s),
            stamp_resolution=self._stamp_resolution(),
            stamped_at_arrival=not self._profile.of_events,
            deadline=Duration(HORIZON * period),
            horizon=HORIZON,
            tell=tell,
            status_timer=drive.plan.timer_of(*STATUS),
            acts_later=Duration(number * command_duration(request.bitrate_bit_s, "cst")),
        )
        axis = Axis(number, parts, period, self._record)
        if self._tells_changes:
            self.probe.map = axis.by_stamp.clock
        return axis

    def _record(self, record: CycleRecord) -> None:
        """Keep a cycle; the memory was allocated before, so that none waits for it."""
        end = self._filled + ROW.size
        self._memory[self._filled : end] = row_of(record)
        self._filled = end

    def _limits(self, unit_nm: float) -> TorqueLimits:
        """Return the limits. A disabled drive is not stopped, even if its shaft is turned or few readings
        come."""
        request, period = self._request, self._timing.period
        return TorqueLimits(
            torque_max_nm=self._steps * unit_nm,
            speed_max_rad_s=request.speed_max_rad_s if request.enable else math.inf,
            dropouts_consecutive_max=_blind(period) // period if request.enable else request.cycles,
        )

    def _settings(self, torque_max_nm: float, every: int) -> DriveSettings:
        enable, period = self._request.enable, self._timing.period
        watch_ms = WATCH_ENABLED_MS if enable else WATCH_DISABLED_MS
        return DriveSettings(
            sync_period_ns=period,
            mode=_MODE,
            position_every_cycles=every,
            command_timeout_ms=_blind(period) // NS_PER_MS if enable else None,
            drive_heartbeat_ms=HEARTBEAT_MS,
            drive_heartbeat_timeout_ms=watch_ms,
            host_heartbeat_ms=HEARTBEAT_MS,
            host_heartbeat_timeout_ms=watch_ms,
            unwatched=not enable,
            torque_max_nm=torque_max_nm,
            speed_max_rad_s=self._request.speed_max_rad_s if enable else None,
        )

    def _configure_fully(self, settings: DriveSettings) -> bool:
        """Configure with 6074h and its stamp on change; False if the drive does not take that."""
        plan = _plan(self.drive.node_id, changes=True, every=settings.position_every_cycles)
        try:
            self.notes += self.drive.configure(replace(settings, plan=plan))
        except (TransferAborted, SettingRefused) as error:
            self.notes.append(f"no 6074h on change: {error}")
            return False
        return True


def _blind(period: Duration) -> Duration:
    """Return how long an enabled drive may go on without a reading, or without a command."""
    return Duration(max(BLIND, 10 * period))


def _plan(node: int, *, changes: bool, every: int) -> PdoPlan:
    wish = PlanWish(_MODE, position_every_cycles=every, status_timer_ms=status_timer_ms(WATCH_ENABLED_MS))
    return mode_plan(node, wish, demand_changes=changes)
