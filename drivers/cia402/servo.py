"""A CiA 402 servo drive, simulated or real: its set-up, states and modes, and its part in a loop."""

from dataclasses import replace
from typing import Final

from servobench.drivers.canopen.error_control import ErrorControl
from servobench.drivers.canopen.network import CHANGE_LIMIT, CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.drive_setup import (
    DriveSettings,
    Identity,
    map_observed,
    read_identity,
    read_scaling,
    write_limits,
    write_reactions,
)
from servobench.drivers.cia402.drive_watch import DriveWatch
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.mode_control import MODE_BITS, ModeControl
from servobench.drivers.cia402.motion import KEEP_HOMING, KEEP_PROFILE, HomingSetup, Motion, MoveProfile
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_mapping import map_pdos
from servobench.drivers.cia402.profile import DriveCommand, Mode, State, state_of
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.rest import REST_POLL, calms, resting_since
from servobench.drivers.cia402.setpoint import SetPointFrames
from servobench.drivers.cia402.state_control import FAULTY, StateControl
from servobench.drivers.cia402.supervision import CommandSupervision, Release, end_heartbeat
from servobench.drivers.cia402.velocity_mode import write_ramps
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.errors import BusDown, NoAnswer, PeerFault
from servobench.drivers.exchange import (
    Command,
    DemandChange,
    Drive,
    PositionCommand,
    Readback,
    Reading,
    SentCommand,
    SpeedCommand,
)
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant

RELEASE_LIMIT: Final = Duration(3 * NS_PER_S)
"""Allows for a ramp of nearly this length. A drive that turns on is left to its own watch over the host."""
_CONNECT_TRY_S: Final = 0.1
"""A drive that is present answers within milliseconds; one that boots is asked again soon."""
_SETTLE_NS: Final = 50 * NS_PER_MS
"""Time for an unconfirmed NMT command: devices carry it out within some milliseconds."""


class ServoDrive(Drive):
    """One drive: connect, configure, enable, exchange, stop, release.

        drive = ServoDrive(network, node_id=1, name="axis1")
        drive.connect(deadline); drive.configure(settings); drive.enable(deadline)
        each cycle: network.send_sync(), network.pump_one(until), drive.take_readings(), drive.write(command)
        at last: drive.release()

    Nothing runs by itself. Methods with a ``deadline`` pump the network until the drive has complied, or
    raise NoAnswer or DriveInFault. ``take_readings``, ``write`` and ``check`` never wait.
    """

    def __init__(self, network: CanopenNetwork, node_id: int, name: str = "") -> None:
        self.network = network
        self._now = network.clock.now
        self.node_id = node_id
        self.name = name or f"node {node_id}"
        self.objects = RemoteObjects(network, node_id)
        self.status = network.status(node_id)
        self.identity: Identity | None = None
        self.notes: list[str] = []
        """Objects that the drive lacks or holds otherwise, in words; from the last ``configure``."""
        self.unsent_commands = 0
        """Commands that had expired when ``write`` was called."""
        self.plan: PdoPlan | None = None
        """The PDO plan mapped; None before ``configure``."""
        self._told = LastStatusword()
        self.control = StateControl(self.objects, self.name, self._told)
        self.follow = FollowWatch()
        self.modes = ModeControl(self.control, self.follow)
        self.motion: Motion | None = None
        self._assembler: ReadingAssembler | None = None
        self.error_control = ErrorControl(self.objects)
        self.watch = DriveWatch(self.control, self.status, self._told, self.follow)
        self.supervision = CommandSupervision(self.objects)
        """Ended by everything that stops the drive. End those of several drives together: timers overlap."""

    # ---- set-up ---------------------------------------------------------------------------------------

    def connect(self, deadline: Instant) -> Identity:
        """Wait until the node answers, and read its identity. Raises NoAnswer, AnswersTwice, PeerFault."""
        while True:
            try:
                self.network.upload(self.node_id, Cia301.DEVICE_TYPE, timeout_s=_CONNECT_TRY_S, attempts=1)
                break
            except NoAnswer as error:
                if self._now() >= deadline:
                    raise self.network.nobody_there(self.node_id, self.control.title) from error
        self.identity = identity = read_identity(self.objects)
        self.network.refuse_two(self.node_id)
        self.control.make = (identity.vendor, identity.device_name)
        return identity

    def configure(self, settings: DriveSettings) -> list[str]:
        """Write PDO plan, heartbeats, reactions, limits and mode, and start the node (NMT operational).

        The master's heartbeat is started if it is not running. Returns :attr:`notes`. Raises SettingRefused
        or TransferAborted for an essential setting, DriveInFault if the drive is not available.
        """
        network = self.network
        watched = self.error_control.begin(settings.watch_times, unwatched=settings.unwatched)
        self.modes.require(settings.mode)  # before anything is asked for that only this mode needs
        if self.identity is not None:  # its next heartbeat is awaited below: these reads take no time
            stamp, read = self.identity.stamp, self.objects.read_if_there
            settings = replace(settings, stamp=stamp.if_there(read).as_it_counts(read))
        self._change_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL, settings)
        scaling = read_scaling(self.objects, settings.scale)
        notes = [*watched, *scaling.notes, *write_reactions(self.objects, settings.quick_stop_option)]
        notes += write_limits(self.objects, settings, scaling) + write_ramps(self.objects, settings, scaling)
        plan, pdo_notes = map_pdos(self.objects, settings)
        plan, observed_notes = map_observed(self.objects, plan, settings.observed)
        period, stamp = settings.sync_period_ns, settings.stamp
        self._assembler = ReadingAssembler(network, plan, scaling, period, self._told, self.follow, stamp)
        position = self.objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
        self._assembler.anchor_position(position, network.clock.now())
        limits = settings.torque_max_nm, settings.speed_max_rad_s
        self.control.carry(SetPointFrames(network, plan, scaling, *limits), plan, settings.mode)
        self.plan = plan
        self.watch.configure(self.error_control.told, plan, settings)
        self.supervision.configure(settings, plan, self._assembler)
        self.motion = Motion(self.control, self.modes, scaling)
        network.refuse_two(self.node_id)
        self._change_nmt(NmtCommand.START, NmtState.OPERATIONAL, settings)
        self.modes.change(settings.mode, network.deadline_after(CHANGE_LIMIT))
        self.notes = [*notes, *pdo_notes, *observed_notes]
        return self.notes

    # ---- state ----------------------------------------------------------------------------------------

    def enable(self, deadline: Instant) -> None:
        """Step to OPERATION ENABLED with a set-point that keeps the drive at rest."""
        self._configured()
        self.control.clear_bits(MODE_BITS)
        self.modes.prime(self.modes.mode)
        self.control.walk(State.OPERATION_ENABLED, deadline)
        self.modes.follow()
        self.control.await_older_words(self.plan, deadline)
        self.watch.begin()

    def disable(self, deadline: Instant) -> None:
        """Leave OPERATION ENABLED by the drive's own ramp (0x605C) and end in SWITCH ON DISABLED."""
        self.supervision.end()
        self._stop_following()
        if self.control.read_state() is State.OPERATION_ENABLED:
            self.control.command(DriveCommand.DISABLE_OPERATION)
            self.control.await_state(
                lambda state: state is not State.OPERATION_ENABLED, deadline, "leave operation enabled"
            )
        self.control.walk(State.SWITCH_ON_DISABLED, deadline)

    def stop(self, *, asking: bool = True) -> None:
        """Quick stop by RPDO and, if ``asking``, by SDO, without waiting for the shaft. Raises PeerFault."""
        self._stop_following()
        if self.identity is None:
            return
        self.control.command_by_pdo(DriveCommand.QUICK_STOP)
        if not asking:
            return
        if self.control.read_state() in (State.OPERATION_ENABLED, State.QUICK_STOP):
            self.control.command(DriveCommand.QUICK_STOP)
        self.supervision.end()

    def let_go(self) -> None:
        """Disable voltage, and let the shaft coast: for a shaft that turns slowly and does not stop."""
        self._stop_following()
        self.control.command(DriveCommand.DISABLE_VOLTAGE)

    def quick_stop(self, deadline: Instant) -> None:
        """Command a quick stop and wait until the shaft is slow and the drive disabled, or in fault."""
        self.stop()
        moving = (State.OPERATION_ENABLED, State.FAULT_REACTION)
        calm = calms(self.objects, self._assembler)
        state = self.control.await_state(
            lambda now: now not in moving and calm(), deadline, "come to rest", False, REST_POLL
        )
        if state is not State.FAULT:
            self.control.walk(State.SWITCH_ON_DISABLED, deadline)

    def release(self, limit: Duration = RELEASE_LIMIT) -> Release:
        """Leave the drive at rest and disabled; never raise because of the drive or the bus.

        Remove every load first: nothing holds the shaft then. Takes ``limit`` at most, REST_FOR and one SDO
        time-out. The drive then watches the host no more, and is pre-operational. If it cannot be brought to
        rest, it goes on watching, and the host's heartbeat ends, so that it stops by itself; so does every
        other drive of this network that is still watching.
        """
        if self.identity is None:
            return Release(True, None, "it was never connected")
        deadline = self.network.deadline_after(limit)
        try:
            rested_at = self._bring_to_rest(deadline)
        except PeerFault as failure:
            done = end_heartbeat(self.network, watched=self.error_control.host_watched)
            return Release(False, self.state, f"{failure}; {done}")
        try:
            unwatched = self._leave()
        except PeerFault as error:
            return Release(True, self.state, str(error), rested_at)
        return Release(True, self.state, rested_at=rested_at, unwatched=unwatched)

    def reset_fault(self, deadline: Instant) -> None:
        """Send a rising edge of the fault reset bit; raises DriveInFault if the fault stays."""
        if self.control.read_state() not in FAULTY:
            return
        self.control.await_state(
            lambda state: state is State.FAULT, deadline, "finish its fault reaction", faults=False
        )
        self.control.command(DriveCommand.DISABLE_VOLTAGE)
        self.control.command(DriveCommand.FAULT_RESET)
        self.control.await_state(lambda state: state not in FAULTY, deadline, "leave its fault", faults=False)
        self.control.command(DriveCommand.DISABLE_VOLTAGE)
        self.control.emergencies.clear()

    @property
    def state(self) -> State | None:
        """State in the last statusword, by PDO or SDO; None before the first."""
        return state_of(self._told.statusword) if self._told.statusword >= 0 else None

    # ---- the cycle ------------------------------------------------------------------------------------

    def has_readings(self) -> bool:
        return self._assembler is not None and self._assembler.has_readings

    def take_readings(self) -> list[Reading]:
        return [] if self._assembler is None else self._assembler.take()

    def take_readbacks(self) -> list[Readback]:
        return [] if self._assembler is None else self._assembler.take_readbacks()

    def take_demand_changes(self) -> list[DemandChange]:
        return [] if self._assembler is None else self._assembler.take_demand_changes()

    def write(self, command: Command) -> SentCommand | None:
        """Send a set-point, torque and speed clipped to their limits; None and nothing sent if it expired.
        Raises ValueError for a value that is no number, RuntimeError for another quantity than the plan's."""
        if self._now() > command.expires_at:
            self.unsent_commands += 1
            return None
        frames = self._configured()
        if isinstance(command, SpeedCommand):
            sent = frames.send_speed(command.speed_rad_s, command.sequence)
        elif isinstance(command, PositionCommand):
            self.modes.shake_hands(self._told.statusword)
            sent = frames.send_position(command.position_rad, command.sequence)
        else:
            sent = frames.send_torque(command.torque_nm, command.sequence)
        self.supervision.sent(sent.raw)
        return sent

    def held_position_rad(self) -> float:
        """Return the set-point at which it was enabled in a position mode, else the last one received."""
        return self.assembler.position_rad(self.modes.primed_position)

    def check(self) -> None:
        """Raise if the drive is not as it should be; see :meth:`.drive_watch.DriveWatch.check`."""
        self.watch.check(self.supervision.follows)

    def follows(self) -> bool:
        """Return False if 6061h or bit 12 of its statusword shows that the drive does not follow."""
        return self.follow.lapse is None

    def supervise_commands(self, *, own_timer: bool = True) -> str:
        """Begin :class:`.supervision.CommandSupervision`, right before the first cycle."""
        return self.supervision.begin(self.modes.mode, own_timer=own_timer)

    @property
    def enabled(self) -> bool:
        """True after ``enable`` until something seen or done ends it."""
        return self.watch.active

    @property
    def reading_bytes(self) -> int:
        """Length of the frame that carries the speed. RuntimeError before ``configure``."""
        speed = None if self.plan is None else self.plan.tpdo_with(Object.VELOCITY_ACTUAL_VALUE)
        if speed is None:
            raise RuntimeError(f"{self.name} was not configured")
        return speed.bits // 8

    @property
    def assembler(self) -> ReadingAssembler:
        """The assembler of the drive's TPDOs. RuntimeError before ``configure``."""
        if self._assembler is None:
            raise RuntimeError(f"{self.name} was not configured")
        return self._assembler

    @property
    def torque_shown(self) -> tuple[float, Instant]:
        """The last torque received, N m, and when; NaN and -1 before the first."""
        return self.assembler.torque_nm, self.assembler.torque_told_at

    @property
    def rated_torque_nm(self) -> float:
        """Reference of the drive's per-thousand torques. RuntimeError before ``configure``."""
        return self.assembler.scaling.rated_torque_nm

    # ---- modes ----------------------------------------------------------------------------------------

    def change_mode(self, mode: Mode, deadline: Instant) -> None:
        """Change the mode; see :meth:`servobench.drivers.cia402.mode_control.ModeControl.change`."""
        self._configured()
        self.modes.change(mode, deadline)

    def move_to(
        self,
        position_rad: float,
        deadline: Instant,
        profile: MoveProfile = KEEP_PROFILE,
        *,
        relative: bool = False,
    ) -> None:
        """Profile position: move, and wait until the drive has reached the target.

        To start a move without waiting, or queue it in the drive: :meth:`.motion.Motion.start_move`.
        """
        motion = self._moving()
        motion.start_move(position_rad, deadline, profile, relative=relative)
        motion.await_target(deadline)

    def run_at(self, speed_rad_s: float, deadline: Instant, profile: MoveProfile = KEEP_PROFILE) -> None:
        """Profile velocity: go to a speed by the drive's ramps, and wait until it is reached."""
        motion = self._moving()
        motion.start_speed(speed_rad_s, deadline, profile)
        motion.await_target(deadline)

    def apply_torque(self, torque_nm: float, deadline: Instant, profile: MoveProfile = KEEP_PROFILE) -> None:
        """Profile torque: go to a torque by the drive's slope, and wait until it is reached."""
        motion = self._moving()
        motion.start_torque(torque_nm, deadline, profile)
        motion.await_target(deadline)

    def home(self, method: int, deadline: Instant, how: HomingSetup = KEEP_HOMING) -> None:
        """Run a homing method of CiA 402-2 to its end."""
        self._moving().home(method, deadline, how)

    def halt(self, deadline: Instant) -> None:
        """Stop and stay enabled; ``resume`` goes on. For the profile modes and homing."""
        self._moving().halt(deadline)

    def resume(self) -> None:
        """Cancel a halt."""
        self._moving().resume()

    # ---- inside ---------------------------------------------------------------------------------------

    def _change_nmt(self, command: NmtCommand, wanted: NmtState, settings: DriveSettings) -> None:
        if not self.error_control.told:
            # Nobody tells what became of the command: give the drive its time.
            self.network.pump(Instant(self.network.command(command, self.node_id) + _SETTLE_NS))
            return
        heartbeat = Duration(settings.drive_heartbeat_ms * NS_PER_MS)
        self.network.change_nmt(self.node_id, self.control.title, command, wanted, heartbeat)

    def _moving(self) -> Motion:
        if self.motion is None:
            raise RuntimeError(f"{self.name} was not configured")
        return self.motion

    def _configured(self) -> SetPointFrames:
        if (frames := self.control.set_point) is None:
            raise RuntimeError(f"{self.name} was not configured")
        return frames

    def _bring_to_rest(self, deadline: Instant) -> Instant:
        """Repeat the quick stop until it succeeds or the deadline comes; return the begin of the rest."""
        while True:
            try:
                self.quick_stop(deadline)
                return resting_since(self.control, self._assembler, deadline)
            except PeerFault as error:
                if isinstance(error, BusDown) or self._now() >= deadline:
                    raise
            self.network.pump(self.network.deadline_after(REST_POLL))  # a failure need not take any time

    def _leave(self) -> str:
        """End the watch on both sides, and the PDOs; see :meth:`.error_control.ErrorControl.end`."""
        unwatched = self.error_control.end()
        self.network.command(NmtCommand.ENTER_PRE_OPERATIONAL, self.node_id)
        return unwatched

    def _stop_following(self) -> None:
        """Zero torque and speed in the frames, and stop requiring OPERATION ENABLED in ``check``."""
        self.watch.end()
        if self.control.set_point is not None:
            self.control.set_point.hold_rest()
