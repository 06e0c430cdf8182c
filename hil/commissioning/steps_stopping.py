"""Tests whether the drive can stop: by its settings at rest, then by the shaft before it turns fast."""

import math
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects import write_greatest
from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, QuickStopOption, State, state_of
from servobench.drivers.cia402.velocity_mode import velocity_mode_ramp
from servobench.drivers.exchange import Reading
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.ramps import ramps_told
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import follow, ramp_time
from servobench.hil.loop.scenario import Ramp

_STOP_MAX_S: Final = 2.0
"""From the speed limit: everything that brings a drive to rest waits for 3 s at least."""
_STOP_S: Final = 0.5
"""From the speed limit, if the drive's own 6085h is unusable: below half of the deceleration by rated torque
of a servo motor with ten times its own inertia."""
_STEEP: Final = 0.9
"""Share of :data:`_STOP_S`, rounded to whole units: a ramp below that is steeper."""
_SHORTEST_S: Final = 0.005
"""No servo motor stops from its speed in less: the torque decides then, not 6085h."""
_PROOF_SHARE: Final = 0.1
"""Share of the speed limit: a hundredth of its energy."""
_RUN_UP_S: Final = 0.3
"""A servo motor with a load follows such a ramp, and :func:`_proof_speed` fits it into the travel."""
_HOLD_S: Final = 0.2
"""The speed has settled before it is stopped."""
_SLOWER: Final = 1.5
"""The ramp is the drive's, but its controller lags, and a stop begins within one of its cycles."""
_REST_UNITS: Final = 2
"""Position units: an encoder between two counts flickers by one."""
_REST_READINGS: Final = 5
"""Consecutive readings within :data:`_REST_UNITS`; a reversing shaft stands for less."""
_UNIT_OFF: Final = 1.3
"""A speed missed or overshot by this factor has another unit: set-points of 5 r/min round off less."""
_FIT_READINGS: Final = 10
"""Readings over which the speed is derived from positions: a count is a tenth of the error then."""


class StopSettings(Step):
    """Checks how the drive would stop: 605Ah, 6085h, 6084h, in SI units, before it is enabled."""

    name = "stop"
    title = "Can it stop?"
    needs = ("setup",)
    writes = True
    essential = True

    def plan(self, session: Session, /) -> str:
        speed = session.limits.speed_rad_s / RAD_S_PER_RPM
        return (
            f"compute from 605Ah, 6085h and 6084h how long a stop from {speed:.0f} r/min takes; "
            "write what is needed for it and read it back"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        why = ""
        quick = _quick_ramp(session)
        for index, option in (
            (quick, QuickStopOption.QUICK_STOP_RAMP),
            (None, QuickStopOption.CURRENT_LIMIT),
            (Object.PROFILE_DECELERATION, QuickStopOption.SLOW_DOWN_RAMP),
        ):
            refused = _option_refused(session, option)
            time_s = None
            if not refused and index is Object.VL_VELOCITY_QUICK_STOP:
                time_s, refused = _velocity_mode_ramp(session)
            elif not refused and index is not None:
                time_s, refused = _ramp(session, index)
            if not refused:
                session.found.quick_stop_option = option
                if index is None:
                    outcome.faults.append(f"stops by its current limit (605Ah = {int(option)}): {why}")
                session.configure()
                _tell(session, outcome, time_s, option)
                return
            why = f"{why}; {refused}" if why else refused
        raise StepFailed(
            "the drive cannot be made to stop, and nothing was turned",
            why,
            f"set {quick:04X}h with the maker's tool, or lower limits.speed_max_rpm in the nameplate",
        )


def _quick_ramp(session: Session) -> Object:
    """Return the quick stop ramp in the mode of the exercises: velocity mode has its own."""
    velocity_mode = session.port.mode is Mode.VELOCITY
    return Object.VL_VELOCITY_QUICK_STOP if velocity_mode else Object.QUICK_STOP_DECELERATION


def _velocity_mode_ramp(session: Session) -> tuple[float | None, str]:
    """Check 604Ah; see :func:`_ramp`."""
    speed, index = session.limits.speed_rad_s, Object.VL_VELOCITY_QUICK_STOP
    held = velocity_mode_ramp(session.objects, index)
    if held is None:
        return None, ""
    if speed / held <= _STOP_MAX_S:
        return speed / held, ""
    session.found.quick_stop_rad_s2 = speed / _STOP_S
    notes = session.configure()
    held = velocity_mode_ramp(session.objects, index) or held
    if speed / held <= _STOP_MAX_S:
        return speed / held, ""
    told = "; ".join(note for note in notes if "604Ah" in note)
    return None, f"604Ah makes {held:.3g} rad/s^2, {speed / held:.3g} s from the limit; {told}"


def _option_refused(session: Session, option: QuickStopOption) -> str:
    """Explain why the drive does not hold the 605Ah wanted; empty if it does, or lacks 605Ah."""
    objects = session.objects
    held = objects.read_if_there(Object.QUICK_STOP_OPTION, 0, "h")
    if held is None:
        return "" if option is QuickStopOption.QUICK_STOP_RAMP else "no 605Ah to choose another stop by"
    if held == option:
        return ""
    return "; ".join(write_optional(objects, Object.QUICK_STOP_OPTION, "h", int(option), "stop"))


def _ramp(session: Session, index: Object) -> tuple[float | None, str]:
    """Return seconds of a stop by this ramp from the speed limit (None: unknown), or why not.

    A ramp of 0, or one that takes too long, is replaced.
    """
    unit, speed = session.acceleration_rad_s2, session.limits.speed_rad_s
    name = f"{int(index):04X}h"
    held = session.objects.read_if_there(index, 0, "I")
    if held is None:
        return None, "" if index is Object.QUICK_STOP_DECELERATION else f"{name} is missing"
    if held and speed / (held * unit) <= _STOP_MAX_S:
        return speed / (held * unit), ""
    fault = f"{name} is {held}" + (f", {speed / (held * unit):.3g} s from the limit" if held else "")
    needed = max(1, math.ceil(speed / _STOP_S / unit))
    if needed > 0xFFFF_FFFF:
        makes = f"the unit that it tells, {unit:.3g} rad/s^2, makes {needed} of {_STOP_S:g} s"
        return None, f"{fault}, and {makes}"
    granted = write_greatest(session.objects, index, "I", needed, "deceleration")
    rate = (granted.held or 0) * unit
    if speed > _STOP_MAX_S * rate:
        return None, f"{fault}, and {'; '.join(granted.notes)}"
    if index is Object.QUICK_STOP_DECELERATION:
        session.found.quick_stop_rad_s2 = rate
    return speed / rate, ""


def _tell(session: Session, outcome: StepOutcome, time_s: float | None, option: QuickStopOption) -> None:
    rpm = session.limits.speed_rad_s / RAD_S_PER_RPM
    outcome.figures = {"option": int(option), "stop_s": time_s}
    if time_s is None:
        outcome.say(f"605Ah = {int(option)}; how long a stop takes the drive does not tell: it is measured")
        return
    raw = session.objects.read_if_there(Object.QUICK_STOP_DECELERATION, 0, "I")
    held = "" if raw is None else f", 6085h = {raw} of {session.acceleration_rad_s2:.4g} rad/s^2"
    if _quick_ramp(session) is Object.VL_VELOCITY_QUICK_STOP:
        held = f", 604Ah makes {session.limits.speed_rad_s / time_s:.4g} rad/s^2"
    least = "; less than any motor takes, so the torque decides" if time_s < _SHORTEST_S else ""
    outcome.say(
        f"605Ah = {int(option)}{held}: a stop from {rpm:.0f} r/min takes {1e3 * time_s:.0f} ms{least}"
    )


class SlowStop(NamedTuple):
    """A measured stop."""

    speed_rad_s: float
    """Speed at its begin."""
    time_s: float
    """Time to rest; extrapolated for a shaft that still turned at the end."""

    @property
    def deceleration_rad_s2(self) -> float:
        """Mean deceleration."""
        return self.speed_rad_s / max(self.time_s, 1e-9)


class StopProof(Step):
    """Compares a quick stop from a low speed with the computed one."""

    name = "stop_proof"
    title = "A slow stop"
    needs = ("stop", "motion_units")
    moves = True
    essential = True

    def plan(self, session: Session, /) -> str:
        speed = _proof_speed(session) / RAD_S_PER_RPM
        return f"turn at {speed:.0f} r/min, command a quick stop, and time it, before anything turns faster"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        timed = _timed(session, outcome)
        if timed.may_be_torque and session.found.quick_stop_option is QuickStopOption.QUICK_STOP_RAMP:
            gentle = self._try_gentler(session, outcome, timed)
            timed = gentle if gentle.as_it_should else timed
        if timed.as_it_should:
            return
        if timed.computed_s is not None:
            if _quick_ramp(session) is Object.VL_VELOCITY_QUICK_STOP:
                self._set_both(session, outcome)
            else:
                self._believe(session, timed, outcome)
        if not _timed(session, outcome).as_it_should:
            raise StepFailed(
                "the drive does not stop as it should",
                outcome.lines[-1],
                f"set {_quick_ramp(session):04X}h with the maker's tool; nothing was turned faster than this",
            )

    def _try_gentler(self, session: Session, outcome: StepOutcome, steep: "_Timed") -> "_Timed":
        """Stop by a ramp that every motor follows: if it lasts as computed, the unit is right, and the
        drive's own ramp is restored."""
        found, figures, index = session.found, outcome.figures, _quick_ramp(session)
        before, found.quick_stop_rad_s2 = found.quick_stop_rad_s2, session.limits.speed_rad_s / _STOP_S
        session.configure()
        gentle = _timed(session, outcome)
        if not gentle.as_it_should:
            return gentle
        outcome.say(f"{index:04X}h was steeper than torque and controller allow: they decide, not its unit")
        if steep.at_limit_s <= _STOP_MAX_S and steep.ramp_rad_s2 < math.inf:
            found.quick_stop_rad_s2 = steep.ramp_rad_s2
            session.configure()
            found.quick_stop_rad_s2, outcome.figures = before, figures
        return gentle

    def _set_both(self, session: Session, outcome: StepOutcome) -> None:
        """Set 6085h as well: the drive may stop by it in velocity mode too."""
        outcome.faults.append("the quick stop of velocity mode does not go by 604Ah: 6085h is set as well")
        session.found.quick_stop_rad_s2 = session.limits.speed_rad_s / _STOP_S
        session.configure()

    def _believe(self, session: Session, timed: "_Timed", outcome: StepOutcome) -> None:
        """Derive the unit of 6085h from the measured stop, and write the ramp for a quick one."""
        unit = session.acceleration_rad_s2 * timed.stop.deceleration_rad_s2 / timed.ramp_rad_s2
        outcome.faults.append(
            f"acceleration unit: one unit of 6085h is {unit:.3g} rad/s^2 by a measured stop, "
            f"{session.acceleration_rad_s2:.3g} as the drive tells"
        )
        session.overridden(acceleration_rad_s2=unit)
        session.found.quick_stop_rad_s2 = session.limits.speed_rad_s / _STOP_S
        session.configure()


class _Timed(NamedTuple):
    """A measured stop and its computed time."""

    stop: SlowStop
    computed_s: float | None
    """None: no ramp applies, or it is unknown."""
    limit_rad_s: float
    lag_s: float

    @property
    def at_limit_s(self) -> float:
        return self.limit_rad_s / self.stop.deceleration_rad_s2

    @property
    def ramp_rad_s2(self) -> float:
        """The drive's ramp as computed; infinite if it takes no time, or is unknown."""
        return self.stop.speed_rad_s / self.computed_s if self.computed_s else math.inf

    @property
    def is_slow(self) -> bool:
        """True if it lasted longer than computed."""
        return self.computed_s is not None and self.stop.time_s > self.lag_s + _SLOWER * self.computed_s

    @property
    def as_it_should(self) -> bool:
        """True if it lasted as computed, and is fast enough from the speed limit."""
        return not self.is_slow and self.at_limit_s <= _STOP_MAX_S + 10.0 * self.lag_s

    @property
    def may_be_torque(self) -> bool:
        """True if it was slow, by a ramp that not every motor follows."""
        return self.is_slow and self.limit_rad_s / self.ramp_rad_s2 < _STEEP * _STOP_S


def _timed(session: Session, outcome: StepOutcome) -> _Timed:
    """Turn slowly, stop, and time it."""
    stop = _stop_slowly(session)
    computed_s = _computed_s(session, stop.speed_rad_s)
    timed = _Timed(stop, computed_s, session.limits.speed_rad_s, _lag_s(session))
    computed = "not computed" if computed_s is None else f"{1e3 * computed_s:.0f} ms were computed"
    outcome.say(
        f"from {stop.speed_rad_s:.3g} rad/s to rest in {1e3 * stop.time_s:.0f} ms, "
        f"{computed}; so {timed.at_limit_s:.2f} s from the limit of speed"
    )
    outcome.figures = {
        "speed_rad_s": stop.speed_rad_s,
        "stop_s": stop.time_s,
        "computed_s": computed_s,
        "stop_at_limit_s": timed.at_limit_s,
    }
    return timed


def _lag_s(session: Session) -> float:
    """Return how much later than computed a stop may seem to end, by readings and drive controller."""
    return 0.02 + (_REST_READINGS + 2) * session.found.period / NS_PER_S


def _computed_s(session: Session, speed_rad_s: float) -> float | None:
    """Return the computed time; None for a stop without a ramp, or an unknown one."""
    quick = session.found.quick_stop_option is QuickStopOption.QUICK_STOP_RAMP
    if quick and _quick_ramp(session) is Object.VL_VELOCITY_QUICK_STOP:
        rate = velocity_mode_ramp(session.objects, Object.VL_VELOCITY_QUICK_STOP)
        return speed_rad_s / rate if rate else None
    index = {
        QuickStopOption.QUICK_STOP_RAMP: Object.QUICK_STOP_DECELERATION,
        QuickStopOption.SLOW_DOWN_RAMP: Object.PROFILE_DECELERATION,
    }.get(session.found.quick_stop_option)
    held = None if index is None else session.objects.read_if_there(index, 0, "I")
    return speed_rad_s / (held * session.acceleration_rad_s2) if held else None


def _proof_speed(session: Session) -> float:
    limits = session.limits
    return min(_PROOF_SHARE * limits.speed_rad_s, 0.3 * limits.travel_rad / (_RUN_UP_S + _HOLD_S))


def _stop_slowly(session: Session) -> SlowStop:
    speed = _proof_speed(session)
    run_up_s = max(_RUN_UP_S, ramp_time(session, speed))
    with session.exercising() as exerciser:
        before = follow(session, exerciser, run_up_s + _HOLD_S, [Ramp(0.0, speed, run_up_s)])
        if len(before.position) < _FIT_READINGS:
            raise StepFailed("too few readings came")
        readings = _until_rest(session)
    turned = before.position[-1] - before.position[-_FIT_READINGS]
    passed_s = before.time[-1] - before.time[-_FIT_READINGS]
    began = abs(float(turned / passed_s))
    if session.port.mode is Mode.VELOCITY and not 1.0 / _UNIT_OFF < began / speed < _UNIT_OFF:
        raise StepFailed(
            f"a set-point of {speed / RAD_S_PER_RPM:.0f} r/min turns the shaft at "
            f"{began / RAD_S_PER_RPM:.3g} r/min",
            "604Ch says what a unit of 6042h is in r/min",
            "set 604Ch with the maker's tool",
        )
    if began < 0.3 * speed:
        ramps = ramps_told(session.found)
        raise StepFailed(
            "the shaft does not reach a low speed",
            f"{began:.3g} of {speed:.3g} rad/s in {run_up_s + _HOLD_S:.3g} s{f'; {ramps}' if ramps else ''}",
            "an end stop, a brake, a load, or limits.torque_max_percent of the nameplate?",
        )
    return _measured(session, began, readings)


def _until_rest(session: Session) -> list[Reading]:
    """Return the readings from the command to rest; a shaft that does not stop is left to coast."""
    network, drive, period = session.network, session.drive, session.found.period
    drive.take_readings()
    drive.stop()
    readings: list[Reading] = []
    deadline = session.deadline(_STOP_MAX_S)
    while session.clock_now < deadline and not _rests(session, readings):
        network.send_sync()
        network.pump(Instant(session.clock_now + period))
        readings += drive.take_readings()
        session.check_stop()
    if not _rests(session, readings):
        session.dialog.tell("    the quick stop takes too long: the shaft is let go, and coasts")
        drive.let_go()
    return readings


def _rests(session: Session, readings: list[Reading]) -> bool:
    positions = [each.position_rad for each in readings[-_REST_READINGS:]]
    still = max(positions, default=0.0) - min(positions, default=0.0) <= _REST_UNITS * session.position_rad
    return len(readings) >= _REST_READINGS and still and _stops(readings[-1])


def _stops(reading: Reading) -> bool:
    return state_of(reading.statusword) is not State.OPERATION_ENABLED


def _measured(session: Session, began_rad_s: float, readings: list[Reading]) -> SlowStop:
    stopping = [each for each in readings if _stops(each)]
    if len(stopping) < 2:
        raise StepFailed("the drive does not follow a quick stop", "its statusword says that it is enabled")
    first, last = stopping[0], stopping[-1]
    period_s = session.found.period / NS_PER_S
    if _rests(session, readings):
        way_rad = [abs(each.position_rad - first.position_rad) for each in stopping]
        there_rad = max(way_rad) - _REST_UNITS * session.position_rad  # a coupled load swings back from there
        arrived = next(place for place, rad in enumerate(way_rad) if rad >= there_rad)
        time_s = (stopping[arrived - 1].received_at - first.received_at) / NS_PER_S if arrived else 0.0
        return SlowStop(began_rad_s, time_s + period_s)
    half = stopping[len(stopping) // 2 :]
    passed_s = (half[-1].received_at - half[0].received_at) / NS_PER_S
    late = abs(half[-1].position_rad - half[0].position_rad) / max(passed_s, period_s)
    lost = max(began_rad_s - late, 1e-3 * began_rad_s)
    until_middle_s = 0.75 * (last.received_at - first.received_at) / NS_PER_S
    return SlowStop(began_rad_s, until_middle_s * began_rad_s / lost)
