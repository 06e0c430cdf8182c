"""Steps that set the drive up and test its watch over the host, before anything turns."""

import math
from typing import Final

from servobench.drivers.canopen.objects import write_greatest
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.mode_control import ModeRefused
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import PlanImpossible
from servobench.drivers.cia402.profile import HaltOption, Mode, State, state_of
from servobench.drivers.errors import PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.outside import raise_driven
from servobench.hil.commissioning.ramps import RampTooSlow, ramps_told
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session

_PATIENCE: Final = 4.0
"""Time-outs to wait for the drive's reaction."""
_LATE: Final = 1.5
"""A reaction later than this many time-outs fails the step."""
_SILENT_PERIODS: Final = 5
"""Periods without readings after which the drive is asked for its state: it no longer answers a SYNC."""
_REST_S: Final = 0.3
"""A shaft driven by a torque offset has crept visibly by then."""
_REST_TURNS: Final = 0.01
"""3.6 degrees: more than a drive settles by when its controllers are switched on."""


class SetUp(Step):
    """Writes and verifies heartbeats, reactions, limits and the PDO plan."""

    name = "setup"
    title = "Limits, reactions and PDO plan"
    limit = "the drive does not take what the bench needs"
    needs = ("units",)
    writes = True
    essential = True

    def plan(self, session: Session, /) -> str:
        limits = session.limits
        return (
            "write heartbeats (1016h, 1017h), reactions (6007h, 605Ah to 605Eh), "
            "ramps that are too slow (6083h, 6084h, 6087h, 60C5h, 60C6h), "
            "limits (6072h, 6073h, 6080h, 607Dh, 6065h) to "
            f"{limits.torque_nm:.4g} N m and {limits.speed_rad_s:.4g} rad/s, and the PDOs"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        mode = self._first_mode_taken(session, outcome)
        for note in _extra_limits(session):
            outcome.say(note)
        plan = session.drive.plan
        assert plan is not None
        for pdo in plan:
            mapped = " ".join(f"{entry.index:04X}h/{entry.bits}" for entry in pdo.entries)
            outcome.say(f"{pdo.name} {pdo.cob_id:03X}h type {pdo.transmission_type}: {mapped}")
        if ramps := ramps_told(session.found):
            outcome.say(f"the drive's own ramps: {ramps}")
        load = budget_of([plan], session.found.period, session.request.bitrate_bit_s).load_percent
        outcome.say(
            f"mode {mode.name.lower().replace('_', ' ')}; at most {load:.0f} % bus load; all read back"
        )
        outcome.headline = outcome.lines[-1]
        outcome.figures = {"mode": mode.name.lower(), "bus_load_percent_max": load}

    def _first_mode_taken(self, session: Session, outcome: StepOutcome) -> Mode:
        """Configure the first mode that the drive takes; remove those that it does not."""
        refusals: list[str] = []
        while True:
            mode = session.motion_mode()
            if mode is None:
                raise StepFailed(
                    "the drive takes none of the modes in which the bench could move it", "; ".join(refusals)
                )
            try:
                outcome.lines += session.configure(mode)
            except PeerFault as error:
                if not _of_the_mode(error):
                    raise
                refusals.append(f"{mode.title}: {error}")
                outcome.say(f"{mode.title} is not taken: {error}")
                session.found.modes = tuple(other for other in session.found.modes if other is not mode)
            else:
                return mode


def _of_the_mode(error: PeerFault) -> bool:
    """Return True if another mode may be taken, or be served by the PDOs."""
    return isinstance(error, ModeRefused | PlanImpossible | RampTooSlow) or isinstance(
        error.__cause__, PlanImpossible
    )


def _extra_limits(session: Session) -> list[str]:
    """Write optional limits, beyond those of the drive client."""
    objects, limits, rated = session.objects, session.limits, session.rated_torque_nm
    share = min(0xFFFF, round(1000.0 * limits.torque_nm / rated))
    held = objects.read_if_there(Object.MAX_CURRENT, 0, "H")
    notes = []
    if held is not None and share < held:
        notes += write_greatest(objects, Object.MAX_CURRENT, "H", share, "current limit").notes
    option = HaltOption.QUICK_STOP_RAMP
    notes += write_optional(objects, Object.HALT_OPTION, "h", int(option), "halt by quick stop ramp")
    window = max(1, round(limits.following_rad / session.position_rad))
    notes += write_optional(
        objects, Object.FOLLOWING_ERROR_WINDOW, "I", min(window, 0xFFFF_FFFE), "following error"
    )
    if limits.travel_rad < math.inf:
        here = objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
        reach = round(limits.travel_rad / session.position_rad)
        for sub, bound in ((1, here - reach), (2, here + reach)):
            bound = min(max(bound, -0x8000_0000), 0x7FFF_FFFF)
            notes += write_optional(
                objects, Object.SOFTWARE_POSITION_LIMIT, "i", bound, "position limit", sub
            )
    return notes


class Watchdog(Step):
    """Stops the host's heartbeat while the drive is enabled, and times its reaction."""

    name = "watchdog"
    title = "Host watch test"
    limit = "the drive stays enabled, or is late"
    needs = ("setup",)
    writes = True
    essential = True

    def plan(self, session: Session, /) -> str:
        if session.unwatched:
            return "have somebody stand by, as the drive does not watch its host"
        timeout = session.request.heartbeat_timeout_ms
        return (
            f"enable the drive at rest, stop the host's heartbeat, and time how long it stays enabled "
            f"({timeout} ms are set in the drive); a fault that this causes is reset"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        if session.unwatched:
            confirm_unwatched(session, outcome)
            return
        timeout_ms = session.request.heartbeat_timeout_ms
        with session.stop.armed():
            try:
                session.drive.enable(session.deadline(3.0))
                reaction_ms, state = _silence(session, timeout_ms)
            finally:
                session.network.resume_life_signs()
                session.wait(3e-3 * session.request.heartbeat_ms)
        _recover(session)
        if reaction_ms is None:
            raise StepFailed(
                "the drive stays enabled without its host",
                f"{_PATIENCE * timeout_ms:.0f} ms after the last heartbeat",
                "1016h, 100Ch or 6007h does not work in this drive: do not go on",
            )
        named = "an unknown state" if state is None else repr(state.value)
        outcome.say(f"left 'operation enabled' for {named} {reaction_ms:.1f} ms after the last heartbeat")
        outcome.figures = {"reaction_ms": reaction_ms, "timeout_ms": timeout_ms}
        if reaction_ms > _LATE * timeout_ms + 20.0:
            raise StepFailed("the drive reacts too late", f"{reaction_ms:.0f} ms, {timeout_ms} ms were set")


def confirm_unwatched(session: Session, outcome: StepOutcome) -> None:
    """Have somebody confirm that he stands by."""
    limits = session.limits
    session.dialog.tell(
        "    Nothing stops this drive if host, cable or adapter fail: it goes on with its last command. "
        f"It is given {limits.torque_nm:.4g} N m and {limits.speed_rad_s / RAD_S_PER_RPM:.0f} r/min at most, "
        "and few turns. Somebody has to stand at its emergency stop."
    )
    if session.dialog.attended:
        answer = session.dialog.line("    Type yes if you do.", session.idle)
        if answer.strip().lower() != "yes":
            raise StepFailed("nobody stands by to stop the drive")
    outcome.faults.append("the drive does not notice that its host is gone; its motions were limited")
    outcome.figures = {"reaction_ms": None, "timeout_ms": None}


def _silence(session: Session, timeout_ms: int) -> tuple[float | None, State | None]:
    """Send one last heartbeat; return ms until the drive reports that it is no longer enabled, and its state
    then.

    A drive may report it by statusword, by EMCY, or by falling silent: with the node's NMT state its PDOs end
    too (1029h). The state itself is then read.
    """
    network, drive = session.network, session.drive
    drive.take_readings()
    emergencies = network.emergencies_seen
    network.resume_life_signs()
    last_at = heard_at = session.clock_now
    network.withhold_life_signs()
    period = session.found.period
    began_rad: float | None = None
    due = Instant(last_at + period)
    while due < last_at + round(_PATIENCE * timeout_ms * NS_PER_MS):
        network.pump(due)
        session.check_stop()
        for reading in drive.take_readings():
            heard_at = reading.received_at
            began_rad = reading.position_rad if began_rad is None else began_rad
            _refuse_load((reading.position_rad - began_rad) / math.tau)
            state = state_of(reading.statusword)
            if state is not State.OPERATION_ENABLED:
                return (heard_at - last_at) / NS_PER_MS, state
        emergency = network.emergencies_seen != emergencies
        if emergency or session.clock_now - heard_at > _SILENT_PERIODS * period:
            state = drive.control.read_state()
            if state is not State.OPERATION_ENABLED:
                at = network.emergencies[-1].at if emergency else session.clock_now
                return (at - last_at) / NS_PER_MS, state
            emergencies, heard_at = network.emergencies_seen, session.clock_now
        network.send_sync()
        due = Instant(max(due + period, session.clock_now))
    return None, State.OPERATION_ENABLED


def _refuse_load(turns: float) -> None:
    """Raise StepFailed for a shaft that turns though it was given no torque yet."""
    if abs(turns) > _REST_TURNS:
        raise_driven(turns, "enabled without torque; its brake, if it has one, is open then")


def _recover(session: Session) -> None:
    """Return from the test's aftermath to disabled."""
    drive = session.drive
    if drive.control.read_state() in (State.FAULT, State.FAULT_REACTION):
        drive.reset_fault(session.deadline(3.0))
    session.calm()
    # The loss may have taken the node out of the NMT state OPERATIONAL.
    session.configure()


class EnableAtZero(Step):
    """Enables the drive without commands, and checks that nothing happens."""

    name = "enable"
    title = "Enable at zero torque"
    limit = "the shaft turns by more than 0.01 turns"
    needs = ("watchdog",)
    moves = True
    essential = True

    def plan(self, session: Session, /) -> str:
        what = "torque" if session.torque_mode() is not None else "speed"
        return f"enable with {what} 0 for {_REST_S:g} s; the shaft must stay within {_REST_TURNS:g} turns"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        with session.exercising() as exerciser:
            recording = exerciser.rest(_REST_S)
        if not len(recording.position):
            raise StepFailed("no reading came while the drive was enabled")
        crept = float(recording.position.max() - recording.position.min()) / math.tau
        mean_nm = float(recording.torque.mean())
        torque = "no torque is told" if math.isnan(mean_nm) else f"mean torque {mean_nm:.4g} N m"
        outcome.say(f"the shaft turned by {crept:.5f} turns; {torque}")
        outcome.say(session.port.watched_by)
        outcome.figures = {"crept_turns": crept}
        if crept > _REST_TURNS:
            raise StepFailed(
                f"the shaft creeps by {crept:.3f} turns in {_REST_S:g} s",
                torque,
                "take the load off, or hold it: the figures would be worth nothing",
            )
