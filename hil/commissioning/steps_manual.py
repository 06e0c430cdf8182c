"""Steps of ``hil jog`` and ``hil homing``: one motion by the drive's own loops, behind the set-up that a
commissioning makes.

Speed, torque and path are bounded twice: by the drive's 6080h, 6072h and 607Dh, written before it is enabled,
and by the host, cycle by cycle.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from servobench.drivers.cia402.motion import HOMED, HomingSetup
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.errors import LimitExceeded, PeerFault
from servobench.drivers.exchange import Reading
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.exercise import OVERSPEED
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.request import PlateLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import ramp_time
from servobench.hil.commissioning.steps_setup import SetUp, confirm_unwatched
from servobench.hil.commissioning.steps_static import BusCheck, IdentityCheck, UnitsTold
from servobench.hil.commissioning.steps_stopping import StopSettings
from servobench.hil.commissioning.turn import can_home
from servobench.hil.loop.scenario import Quantity, Ramp, Segment

_SPARE: Final = 1.2
"""Multiple of the path asked for at which a jog ends as gone too far."""
_SPARE_TURNS: Final = 0.05
"""Added to it: the run-on of a stop in a short jog."""
_SETTLE_S: Final = 0.3
"""Behind the ramp to rest: a drive's own speed loop follows within some ten milliseconds."""
_MISSED: Final = 0.1
"""Share of the path by which a jog may miss its end; half a tenth of a turn is always allowed."""
_STALL_SHARE: Final = 0.1
"""Share of the speed asked for below which a shaft counts as held."""
_STALL_COUNTS: Final = 3.0
"""Position units by which a held shaft may flicker."""
_STALL_S: Final = 0.5
"""Beyond the ramp: a jog of low torque breaks away by then."""
_HOMING_STALL_S: Final = 3.0
"""A homing turns round, finds an end stop by torque, and has the drive's own ramp."""
_WORD: Final = 1 << 32
"""6064h is an INTEGER32, and wraps."""


def jog_limits(turns: float, rpm: float, torque_percent: float) -> PlateLimits:
    """Return the limits of a jog over ``turns``."""
    reach = _SPARE * abs(turns) + _SPARE_TURNS
    return PlateLimits(speed_max_rpm=rpm, torque_max_percent=torque_percent, turns_max=reach)


def homing_limits(rpm: float, torque_percent: float) -> PlateLimits:
    """Return the limits of a homing, whose path :class:`Home` bounds: 607Dh would end it at the new zero."""
    return PlateLimits(speed_max_rpm=rpm, torque_max_percent=torque_percent)


class SpeedUnits(UnitsTold):
    """Reads the drive's units and picks a mode of speeds or positions; nothing needs the motor's data."""

    modes = tuple(mode for mode, quantity in QUANTITY_OF_MODE.items() if quantity is not Quantity.TORQUE)

    def compare(self, session: Session, outcome: StepOutcome, told: Scaling) -> None:
        """Compare nothing with a nameplate."""


class Stall:
    """Watches a shaft that is to turn; raises LimitExceeded for one that stands."""

    def __init__(self, session: Session, speed_rad_s: float, patience_s: float) -> None:
        """``speed_rad_s``: the least one asked for; a coarse encoder has the time of its counts."""
        counts_s = _STALL_COUNTS * session.position_rad / (_STALL_SHARE * speed_rad_s)
        self._patience_s = max(patience_s, counts_s)
        self._least_rad = _STALL_SHARE * speed_rad_s * self._patience_s
        self._place_rad = math.nan
        self._since = Instant(0)

    def look(self, place_rad: float, at: Instant) -> None:
        """Take a position."""
        if not abs(place_rad - self._place_rad) < self._least_rad:
            self._place_rad, self._since = place_rad, at
        elif at - self._since > self._patience_s * NS_PER_S:
            raise LimitExceeded(
                f"the shaft stands for {self._patience_s:.2g} s", "", "is it held, by a brake or an end stop?"
            )


class ManualStep(Step):
    """A motion that is not repeated unless somebody says so: it would double its path."""

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    moves = True
    essential = True
    repeatable = False

    def lack(self, session: Session) -> str:  # noqa: ARG002 - most drives can do it
        """Return why this drive cannot do it; empty if it can."""
        return ""

    def left_out(self, session: Session) -> str | None:
        """Raise PeerFault for a drive that cannot do it: without this step nothing is done."""
        if lack := self.lack(session):
            raise PeerFault(lack)
        return None

    def run(self, session: Session, outcome: StepOutcome) -> None:
        if session.unwatched:
            confirm_unwatched(session, outcome)
        self.move(session, outcome)

    @abstractmethod
    def move(self, session: Session, outcome: StepOutcome) -> None:
        """Do it, with the drive watched or somebody standing by. Raises as :meth:`run` does."""


class Jog(ManualStep):
    """Turns the shaft by a path, at a speed."""

    name = "jog"
    title = "Jog"
    limit = "the shaft does not arrive, or leaves the limits of path, speed or torque"

    def __init__(self, turns: float) -> None:
        """``turns``: the path at the motor shaft; negative: backwards."""
        self._turns = turns

    def plan(self, session: Session, /) -> str:
        speed, rise_s, hold_s = self._course(session)
        limits = session.limits
        return (
            f"turn the shaft by {self._turns:+g} turns at {speed / RAD_S_PER_RPM:.3g} r/min within "
            f"{2 * rise_s + hold_s:.3g} s, with {limits.torque_nm:.4g} N m at most; it is stopped by any "
            f"key, at {OVERSPEED * limits.speed_rad_s / RAD_S_PER_RPM:.4g} r/min, and "
            f"{limits.travel_rad / math.tau:.4g} turns from here"
        )

    def move(self, session: Session, outcome: StepOutcome) -> None:
        speed, rise_s, hold_s = self._course(session)
        signed = math.copysign(speed, self._turns)
        limits = session.limits
        bounded = replace(
            limits,
            power_w=limits.torque_nm * limits.speed_rad_s,
            energy_j=2.0 * limits.torque_nm * limits.travel_rad,
        )
        course: list[Segment] = [Ramp(0.0, signed, rise_s), Ramp(rise_s + hold_s, 0.0, rise_s)]
        stall = Stall(session, speed, rise_s + _STALL_S)

        def listen(readings: list[Reading]) -> None:
            for each in readings:
                stall.look(each.position_rad, each.received_at)

        session.port.listener = listen
        with session.exercising(bounded) as exerciser:
            recording = exerciser.run_speeds(2 * rise_s + hold_s + _SETTLE_S, course)
        if not len(recording.position):
            raise StepFailed("no reading came while the drive was enabled")
        turned = float(recording.position[-1] - recording.position[0]) / math.tau
        fastest = float(abs(recording.speed).max()) / RAD_S_PER_RPM
        outcome.say(f"the shaft turned by {turned:+.4f} turns, at {fastest:.1f} r/min at most")
        outcome.say(session.port.watched_by)
        outcome.figures = {"turns": turned, "rpm_max": fastest, "lost": recording.lost}
        strongest = float(abs(recording.torque).max())
        if not math.isnan(strongest):
            outcome.say(f"with {strongest:.4g} N m at most")
            outcome.figures["torque_nm_max"] = strongest
        if abs(turned - self._turns) > max(_MISSED * abs(self._turns), _SPARE_TURNS):
            raise StepFailed(
                f"the shaft turned by {turned:+.4f} of {self._turns:+g} turns",
                "; ".join(outcome.lines),
                "is it held, or is the torque too small for its load (--torque-max-percent)?",
            )

    def _course(self, session: Session) -> tuple[float, float, float]:
        """Return speed, rad/s, time of either ramp, s, and time between them, s."""
        way, speed = math.tau * abs(self._turns), session.limits.speed_rad_s
        rise_s = ramp_time(session, speed)
        if way < speed * rise_s:
            return way / rise_s, rise_s, 0.0
        return speed, rise_s, way / speed - rise_s


class Home(ManualStep):
    """Runs a homing method of the drive to its end."""

    name = "homing"
    title = "Homing"
    limit = "the drive reports a homing error, finds no home in time, or leaves the limits"

    def __init__(self, method: int | None, how: HomingSetup, turns: float, limit_s: float) -> None:
        """``method``: None: the drive's 6098h; ``turns``: path after which the host ends it; ``limit_s``: the
        same for its time."""
        self._method, self._how, self._turns, self._limit_s = method, how, turns, limit_s
        self._path_units = 0
        self._last: int | None = None

    def lack(self, session: Session) -> str:
        return "" if can_home(session) else "the drive has no homing"

    def plan(self, session: Session, /) -> str:
        how, limits = self._within(session), session.limits
        method = self._method if self._method is not None else "of its 6098h"
        speeds = [
            f"{speed / RAD_S_PER_RPM:.3g}"
            for speed in (how.switch_speed_rad_s, how.zero_speed_rad_s)
            if speed
        ]
        offset = "" if how.offset_rad is None else f", offset {how.offset_rad / math.tau:+g} turns (607Ch)"
        return (
            f"run homing method {method} at {' and '.join(speeds)} r/min (6099h){offset}, with "
            f"{limits.torque_nm:.4g} N m at most; it is stopped by any key, after {self._turns:g} turns and "
            f"after {self._limit_s:g} s"
        )

    def move(self, session: Session, outcome: StepOutcome) -> None:
        drive, objects = session.drive, session.objects
        method = self._method
        if method is None:
            method = objects.read(Object.HOMING_METHOD, 0, "b")
        self._path_units, self._last = 0, None
        began = session.clock_now
        motion = drive.motion
        assert motion is not None, "the step 'setup' comes first"
        drive.change_mode(Mode.HOMING, session.deadline(1.0))
        with session.enabled():
            until = session.deadline(self._limit_s)
            how = self._within(session)
            slowest = min(filter(None, (how.switch_speed_rad_s, how.zero_speed_rad_s)), default=math.inf)
            stall = Stall(session, slowest, _HOMING_STALL_S)
            motion.home(method, until, how, lambda word: self._look(session, stall, word))
            took_s = (session.clock_now - began) / NS_PER_S
        place = objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i") * session.position_rad / math.tau
        path = self._path_units * session.position_rad / math.tau
        outcome.say(f"method {method} found its home after {path:.3f} turns and {took_s:.2f} s")
        outcome.say(f"6064h tells {place:+.4f} turns where the shaft has come to rest")
        outcome.figures = {"method": method, "path_turns": path, "position_turns": place, "seconds": took_s}

    def _within(self, session: Session) -> HomingSetup:
        """Return the set-up within the speed limit, which is lower for a drive that is not watched."""
        how, most = self._how, session.limits.speed_rad_s
        switch, zero = how.switch_speed_rad_s, how.zero_speed_rad_s
        return replace(
            how,
            switch_speed_rad_s=None if switch is None else min(switch, most),
            zero_speed_rad_s=None if zero is None else min(zero, most),
        )

    def _look(self, session: Session, stall: Stall, word: int) -> None:
        """Look at the shaft between two statuswords. A position of before the home is known is part of the
        path: the drive sets it anew before the statusword that shows it found."""
        session.check_stop()
        if word & HOMED:
            return
        path_rad = self._path_units * session.position_rad
        if path_rad > self._turns * math.tau:
            raise LimitExceeded(f"no home within {self._turns:g} turns")
        place = session.objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
        if self._last is not None:
            apart = (place - self._last) % _WORD
            self._path_units += min(apart, _WORD - apart)
        self._last = place
        stall.look(place * session.position_rad, session.clock_now)


def set_up_steps(units: UnitsTold) -> list[Step]:
    """Return the steps before a single motion."""
    return [BusCheck(), IdentityCheck(), units, SetUp(), StopSettings()]


def jog_steps(turns: float) -> Sequence[Step]:
    """Return the steps of ``hil jog``."""
    return [*set_up_steps(SpeedUnits()), Jog(turns)]


def homing_steps(home: Home) -> Sequence[Step]:
    """Return the steps of ``hil homing``."""
    return [*set_up_steps(SpeedUnits()), home]
