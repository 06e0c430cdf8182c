"""Shared state of the steps of a commissioning: the drive, the limits, and the findings so far."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeVar

from canopen.objectdictionary import ObjectDictionary

from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.drive_setup import DriveSettings, read_scaling
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.state_control import FAULTY
from servobench.drivers.errors import BusDown, PeerFault
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.sheets.fitness import told_by_sheet
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant, duration_s
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE, DrivePort
from servobench.hil.commissioning.exercise import EnergyMeter, Exerciser
from servobench.hil.commissioning.findings import Findings, StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.lapses import HostGaps, advise, lapses, passing_cause
from servobench.hil.commissioning.ramps import set_ramps, within_ramps, write_moves
from servobench.hil.commissioning.recording import SessionLog
from servobench.hil.commissioning.request import CommissionRequest, MotionLimits, cautious
from servobench.hil.configuration.config import Guard
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.execution.segments import timing_without_bench
from servobench.hil.execution.world import World
from servobench.hil.loop.loop import LoopTiming
from servobench.hil.loop.scenario import Quantity
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.restoring.journal import JournaledNetwork, ObjectKey

P = ParamSpec("P")
T = TypeVar("T")

ENABLE_LIMIT_S: Final = 3.0
"""A drive that charges its DC link or releases a brake takes a second or two."""
STOP_LIMIT: Final = Duration(5 * NS_PER_S)
"""More than the longest stop tolerated, 2 s from the speed limit."""
PERIODS_US: Final = (1000, 2000, 4000, 5000, 10_000, 20_000)
"""The longer ones are for a bus without room for the PDOs of 1 ms."""
SETTLE: Final = Duration(20 * NS_PER_MS)
"""Between the SYNCs by which a drive's clock is learnt: no late reading may pass for a later answer."""
_IGNORED: Final = Duration(40 * NS_PER_MS)
"""Four reads of a demand by SDO, each 10 ms: a drive that ignores its set-points for less leaves no figure of
an exercise of seconds wrong."""
_IGNORED_CYCLES: Final = 10
"""At a long period; half of them are more than a command takes to act."""
_SERVED_S: Final = 0.01
"""How soon the end of a fit is seen."""
BUS_LOAD_MAX_PERCENT: Final = 70.0
"""Worst case of stuffing included; the rest is for SDO, heartbeats and other nodes."""


def _command_timeout_ms(period: Duration) -> int:
    """Return how long a drive may ignore the commands of an exercise."""
    return max(_IGNORED, _IGNORED_CYCLES * period) // NS_PER_MS


class EmergencyStopped(Interrupted):
    """A key was hit while the shaft could turn."""

    exit_status = 3


class Session:
    """One commissioning under way."""

    def __init__(
        self,
        request: CommissionRequest,
        world: World,
        network: JournaledNetwork,
        dialog: Dialog,
        stop: EmergencyStop,
        sheet: LoadedDictionary | None,
        log: SessionLog,
    ) -> None:
        self.request = request
        self.log = log
        self.world = world
        self.network = network
        self.dialog = dialog
        self.stop = stop
        self.dictionary: ObjectDictionary | None = None if sheet is None else sheet.dictionary
        self.sheet_told = None if sheet is None else told_by_sheet(sheet)
        self.capability = None if self.sheet_told is None else self.sheet_told.capability
        self.drive = ServoDrive(network, request.node, "drive")
        self.objects = self.drive.objects
        rules = Guard(allow=request.allow)
        self.drives = DriveSession(world, {None: network}, [self.drive], rules, self._tell)
        self.found = Findings()
        self.configured = False
        self.energy = EnergyMeter()
        self.disturbed = False
        """True if the last attempt at a step failed: the drive's state is unknown."""
        self.kept: set[ObjectKey] = set()
        """Objects that hold at the end what a step has found."""
        self.gaps = HostGaps(network, request.heartbeat_timeout_ms)
        self._port: DrivePort | None = None

    def _tell(self, at: Instant, level: str, text: str) -> None:
        """Report an observation of the guard."""
        self.log.event(level, text, at)
        self.dialog.tell(f"    {text}")

    def write_log(self) -> None:
        """Write the recording to disk; a disabled drive does not have to wait."""
        if self.drive.enabled:
            self.log.write()
        else:
            self.meanwhile(self.log.write)

    def begin_attempt(self) -> None:
        """Begin an attempt at a step, with its own bound on the work, and with a drive that is set up: one
        that fell out of it, as its host was silent for a while, is set up again.

        Only a fault that the host's own silence or an exercise causes is reset. Raises PeerFault.
        """
        self.energy = EnergyMeter()
        self.gaps.begin()
        if not self.configured:
            return
        codes = self._codes()
        cause = passing_cause(codes)
        if self.drive.control.read_state() in FAULTY and cause is not None:
            self.drive.reset_fault(self.deadline(ENABLE_LIMIT_S))
            self.dialog.tell(f"    the fault {codes[-1]:04X}h, {cause}, is reset")
        faults = lapses(self.drive, self.request.heartbeat_ms)
        if faults or self.disturbed:
            if faults:
                self.dialog.tell(f"    the drive is set up again: {'; '.join(faults)}")
            self.configure()
        self.disturbed = False

    def end_attempt(self, failure: PeerFault | None) -> PeerFault | None:
        """Return the cause of a failed attempt: the host's own silence takes precedence."""
        failure = self.gaps.cause_of(failure)
        if self.configured:
            advise(failure, self._codes())
        self.disturbed = failure is not None
        return failure

    def _codes(self) -> list[int]:
        return [emergency.code for emergency in self.drive.control.emergencies if emergency.code]

    # ---- time -----------------------------------------------------------------------------------------

    @property
    def clock_now(self) -> Instant:
        """Now, on the bench's clock."""
        return self.network.clock.now()

    def wait(self, seconds: float) -> None:
        """Let time pass; frames and heartbeats continue."""
        self.network.pump(Instant(self.clock_now + duration_s(seconds)))

    def deadline(self, seconds: float) -> Instant:
        """Return the instant ``seconds`` from now."""
        return self.network.deadline_after(duration_s(seconds))

    def idle(self) -> None:
        """Pass time while the user thinks."""
        self.wait(0.02)
        self.check_stop()

    def check_stop(self) -> None:
        """Raise Interrupted if the end is requested."""
        if self.stop():
            if self.stop.key:
                raise EmergencyStopped("emergency stop by a key")
            raise Interrupted(f"ended by {self.stop.asked_by}")

    # ---- the drive ------------------------------------------------------------------------------------

    @property
    def limits(self) -> MotionLimits:
        """The host's limits; reduced for a drive that does not notice the loss of its host, or has slow
        ramps."""
        assert self.found.limits is not None, "the step 'limits' comes first"
        limits = cautious(self.found.limits) if self.unwatched else self.found.limits
        return within_ramps(self.found, limits)

    @property
    def unwatched(self) -> bool:
        """True if the drive has no means to watch its host; accepted with ``--unwatched`` only."""
        return self.configured and not self.drive.error_control.host_watched

    @property
    def told(self) -> Scaling:
        """The units by the drive's own objects."""
        assert self.found.told is not None, "the step 'units' comes first"
        return self.found.told

    @property
    def units(self) -> Scaling:
        """The units known so far."""
        return self.found.scaling

    @property
    def position_rad(self) -> float:
        """One raw unit of the position, as known so far."""
        return self.units.position_rad

    @property
    def velocity_rad_s(self) -> float:
        """One raw unit of the velocity, as known so far."""
        return self.units.velocity_rad_s

    @property
    def acceleration_rad_s2(self) -> float:
        """One raw unit of the accelerations, as known so far."""
        return self.units.acceleration_rad_s2

    @property
    def rated_torque_nm(self) -> float:
        """The rated torque, as known so far."""
        return self.units.rated_torque_nm

    @property
    def mechanics(self) -> Mechanics:
        """The identified inertia and friction."""
        assert self.found.mechanics is not None, "the step 'mechanics' comes first"
        return self.found.mechanics

    @property
    def port(self) -> DrivePort:
        """The drive as exercises command it."""
        assert self._port is not None, "the drive is configured first"
        return self._port

    def torque_mode(self) -> Mode | None:
        """Return a mode in which torque is commanded; None if the drive has none."""
        mode = self.motion_mode()
        return mode if mode is not None and QUANTITY_OF_MODE[mode] is Quantity.TORQUE else None

    def motion_mode(self) -> Mode | None:
        """Return the mode for exercises: torque if available, else speed, else position."""
        return next((mode for mode in QUANTITY_OF_MODE if mode in self.found.modes), None)

    def configure(self, mode: Mode | None = None, plan: PdoPlan | None = None) -> list[str]:
        """Write set-up, limits and PDO plan; the drive must be disabled. Return notes on what it did not
        take.

        Exercises compare torque and position with the speed of the same SYNC: the plan is a coherent one.
        """
        mode = mode or self.motion_mode()
        if mode is None:
            raise StepFailed("the drive has no mode in which the bench could move it")
        request, findings = self.request, self.found
        settings = DriveSettings(
            sync_period_ns=findings.period,
            plan=plan,
            capability=self.capability,
            mode=mode,
            coherent=True,
            command_timeout_ms=_command_timeout_ms(findings.period),
            drive_heartbeat_ms=request.heartbeat_ms,
            drive_heartbeat_timeout_ms=request.heartbeat_timeout_ms,
            host_heartbeat_ms=request.heartbeat_ms,
            host_heartbeat_timeout_ms=request.heartbeat_timeout_ms,
            unwatched=request.unwatched,
            torque_max_nm=self.limits.torque_nm,
            speed_max_rad_s=self.limits.speed_rad_s * 1.3,
            set_acceleration_rad_s2=self.limits.acceleration_rad_s2,
            quick_stop_deceleration_rad_s2=findings.quick_stop_rad_s2,
            quick_stop_option=findings.quick_stop_option,
            scale=findings.override,
        )
        notes = self.drive.configure(settings)
        findings.plan = self.drive.plan
        first, self.configured = not self.configured, True
        if first and self.unwatched:
            return self.configure(mode, plan)  # with the limits of such a drive
        braking_rad_s2 = math.inf
        if mode is Mode.PROFILE_POSITION:
            braking_rad_s2, refused = write_moves(self.objects, self.limits, self.drive.assembler.scaling)
            notes += refused
        notes += set_ramps(self.objects, findings, mode, self.most_told)
        self._port = DrivePort(self.drive, mode, findings.period / NS_PER_S, braking_rad_s2)
        self.drives.guard.arm({}, findings.period)
        return notes

    def most_told(self, index: int) -> int | None:
        """Return the greatest value of an object by the data sheet; None if it has none."""
        entry = None if self.dictionary is None else self.dictionary.get(index)
        return getattr(entry, "max", None)

    def choose_period(self, mode: Mode) -> tuple[Duration, float]:
        """Return the shortest period possible on the bus, ns, and its load in percent."""
        plan = mode_plan(self.request.node, PlanWish(mode, coherent=True))
        asked_us = self.request.period_us
        for period_us in (asked_us,) if asked_us is not None else PERIODS_US:
            period = Duration(period_us * NS_PER_US)
            load = budget_of([plan], period, self.request.bitrate_bit_s).load_percent
            if load <= BUS_LOAD_MAX_PERCENT:
                return period, load
        raise StepFailed(
            f"the PDOs would take {load:.0f} % of the bus",
            f"at a period of {period_us} us and {self.request.bitrate_bit_s} bit/s",
            "give a longer period, or a higher bit rate",
        )

    def timing(self) -> LoopTiming:
        """Return the loop's times."""
        settle = Duration(max(3 * self.found.period, SETTLE))
        return timing_without_bench(self.found.period, self.request.bitrate_bit_s, settle)

    @contextmanager
    def enabled(self) -> Iterator[None]:
        """Inside, the drive is enabled, and a key stops it; afterwards it is at rest and disabled."""
        self.check_temperature()
        with self.gaps.while_enabled(), self.stop.armed():
            try:
                self.drives.enable(self.drive, ENABLE_LIMIT_S)
                yield
                self.check_stop()
            finally:
                self.calm()

    @contextmanager
    def exercising(self, limits: MotionLimits | None = None) -> Iterator[Exerciser]:
        """Inside, the drive is enabled, with an exerciser; see :meth:`enabled`."""
        within = limits or self.limits
        with self.enabled():
            yield Exerciser(
                self.network, self.port, self.timing(), within,
                self.stop, self.check_stop, self.energy, self.drives,
            )  # fmt: skip

    def check_temperature(self) -> None:
        """Raise StepFailed if the drive is hotter than the nameplate allows; no check without a limit."""
        told, limit_c = self.request.nameplate.temperature, self.request.nameplate.limits.temperature_max_c
        if told is None:
            return
        raw = self.objects.read_if_there(told.index, told.sub, "i")
        if raw is None:
            raise StepFailed(
                f"{told.index:04X}h:{told.sub:02X} tells no temperature", "", "mend the nameplate file"
            )
        if raw * told.celsius > limit_c:
            raise StepFailed(
                f"the drive is at {raw * told.celsius:.1f} C", f"{limit_c:g} C are allowed", "let it cool"
            )

    def calm(self) -> None:
        """Bring the drive to rest and disable it; its errors are shown and passed on."""
        try:
            self.drive.quick_stop(self.network.deadline_after(STOP_LIMIT))
        except BusDown:
            raise
        except PeerFault as error:
            self.dialog.tell(f"  while stopping: {error}")

    def meanwhile(self, work: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Run ``work``, which takes its time: a fit, a design, a picture. The drive is disabled.

        In real time the bus is served by this thread meanwhile, so that the drive hears its host; ``work``
        has a separate thread, and must not touch the session. While a drive is enabled only the loop that
        commands it sends its heartbeat: RuntimeError.
        """
        if self.drive.enabled:
            raise RuntimeError("the drive is enabled: its host has no time for anything else")
        if not self.world.real_time:
            return work(*args, **options)
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(work, *args, **options)
            while not future.done():
                self.wait(_SERVED_S)
        return future.result()

    def overridden(self, **changes: Any) -> None:
        """Set better factors or signs; they act from the next :meth:`configure` on."""
        self.found.override = replace(self.found.override, **changes)
        self.found.units = read_scaling(self.objects, self.found.override)

    def picture(
        self, outcome: StepOutcome, name: str, draw: Callable[Concatenate[Path, P], None],
        *figures: P.args, **options: P.kwargs,
    ) -> None:  # fmt: skip
        """Draw a plot into the folder of the report, and show it there. The drive is disabled."""
        folder = self.request.out / "plots"
        folder.mkdir(parents=True, exist_ok=True)
        self.meanwhile(draw, folder / f"{name}.png", *figures, **options)
        outcome.pictures.append(f"plots/{name}.png")
