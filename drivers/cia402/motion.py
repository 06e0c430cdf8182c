"""Moves that a drive plans itself: profile position, velocity and torque, and homing.

Source: CiA 402-2, the clauses of the modes PP, PV, TQ and HM. The hand-shake of PP, with bit 4 of the
controlword and bits 12 (set-point acknowledge) and 10 of the statusword:

    607Ah       --- target ------------------------------------
    bit 4       ______|--------------|_________________________
    bit 12      __________|--------------|_____________________   0 again: a further set-point would be taken
    bit 10      -------------|_________________________|-------   target reached
"""

from collections.abc import Callable
from dataclasses import dataclass

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.mode_control import ModeControl
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    CHANGE_AT_ONCE,
    NEW_SET_POINT,
    RELATIVE,
    Control,
    Mode,
    State,
    Status,
    state_of,
)
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.state_control import FAULTY, POLL_NS, StateControl
from servobench.drivers.errors import DriveInFault
from servobench.drivers.timebase import NS_PER_MS, Instant

CONFIRM_NS = 5 * NS_PER_MS
"""A bit already set when a move begins counts only if it stays set for this long: it may be stale."""

START_HOMING = Control.MODE_4
ACKNOWLEDGED = HOMED = Status.MODE_12
HOMING_FAILED = Status.MODE_13


@dataclass(frozen=True, slots=True)
class MoveProfile:
    """Speed and ramps of a move; None leaves the drive's value."""

    speed_rad_s: float | None = None
    acceleration_rad_s2: float | None = None
    deceleration_rad_s2: float | None = None
    """Applies to a halt too."""
    torque_slope_nm_s: float | None = None


@dataclass(frozen=True, slots=True)
class HomingSetup:
    """Speeds and offset for homing; None leaves the drive's value."""

    switch_speed_rad_s: float | None = None
    """Speed during the search for a switch."""
    zero_speed_rad_s: float | None = None
    """Speed during the search for the edge or the index."""
    acceleration_rad_s2: float | None = None
    offset_rad: float | None = None
    """Position 0 relative to the home found (0x607C)."""


KEEP_PROFILE = MoveProfile()
KEEP_HOMING = HomingSetup()


def _nothing(_word: int) -> None:
    """Look at nothing."""


class Motion:
    """Profile moves and homing of one drive, which must be enabled.

    Each method changes the mode if need be, returns when the drive has confirmed, and raises DriveInFault
    with the statusword if it has not by the deadline, met a fault, or left OPERATION ENABLED.
    """

    def __init__(self, control: StateControl, modes: ModeControl, scaling: Scaling) -> None:
        self._control = control
        self._modes = modes
        self._objects = control.objects
        self._scaling = scaling

    def start_move(
        self,
        position_rad: float,
        deadline: Instant,
        profile: MoveProfile = KEEP_PROFILE,
        *,
        relative: bool = False,
        at_once: bool = True,
    ) -> None:
        """Hand a target position to the drive and wait until it is acknowledged.

        ``relative``: relative to the previous target. ``at_once``: drop the move under way; else the drive
        finishes it first. Raises ValueError for a position beyond the range of 0x607A.
        """
        self._modes.ensure(Mode.PROFILE_POSITION, deadline)
        self._write_profile(profile, Object.PROFILE_VELOCITY)
        self._await(ACKNOWLEDGED, 0, deadline, "take a further set-point")
        raw = round(position_rad / self._scaling.position_rad)
        self._control.write_value(Object.TARGET_POSITION, "i", raw)
        flags = (CHANGE_AT_ONCE if at_once else 0) | (RELATIVE if relative else 0)
        self._control.set_bits(NEW_SET_POINT | CHANGE_AT_ONCE | RELATIVE, NEW_SET_POINT | flags)
        self._await(ACKNOWLEDGED, ACKNOWLEDGED, deadline, "acknowledge its set-point")
        self._control.clear_bits(NEW_SET_POINT)

    def await_target(self, deadline: Instant) -> None:
        """Wait until the drive reports that it has reached its target."""
        reached = Status.TARGET_REACHED
        self._await(reached, reached, deadline, "reach its target", confirm_ns=CONFIRM_NS)

    def start_speed(self, speed_rad_s: float, deadline: Instant, profile: MoveProfile) -> None:
        """Bring the drive to a speed by its ramps."""
        self._modes.ensure(Mode.PROFILE_VELOCITY, deadline)
        self._write_profile(profile, None)
        self._control.write_value(Object.TARGET_VELOCITY, "i", self._scaling.velocity_raw(speed_rad_s))
        self._check_enabled()

    def start_torque(self, torque_nm: float, deadline: Instant, profile: MoveProfile) -> None:
        """Bring the drive to a torque by its slope."""
        self._modes.ensure(Mode.PROFILE_TORQUE, deadline)
        if profile.torque_slope_nm_s is not None:
            slope = max(1, abs(self._scaling.torque_raw(profile.torque_slope_nm_s)))
            self._write_needed(Object.TORQUE_SLOPE, "I", slope, "torque slope")
        self._control.write_value(Object.TARGET_TORQUE, "h", self._scaling.torque_raw(torque_nm))
        self._check_enabled()

    def home(
        self, method: int, deadline: Instant, how: HomingSetup, look: Callable[[int], None] = _nothing
    ) -> None:
        """Run a homing method of CiA 402-2 to its end. ``look``: called with each statusword; may raise."""
        self._modes.ensure(Mode.HOMING, deadline)
        self._control.clear_bits(START_HOMING)
        self._write_homing(method, how)
        self._control.set_bits(START_HOMING, START_HOMING)
        homed = HOMED | Status.TARGET_REACHED
        self._await(homed, homed, deadline, "find its home", CONFIRM_NS, failed=HOMING_FAILED, look=look)
        self._control.clear_bits(START_HOMING)

    def halt(self, deadline: Instant) -> None:
        """Stop the drive by 0x605D, keep it enabled, and wait until it stands.

        Raises ValueError in the cyclic synchronous modes, which know no halt: nothing is sent then.
        """
        mode = self._modes.mode
        if mode >= Mode.CYCLIC_SYNCHRONOUS_POSITION:
            raise ValueError(
                f"{self._control.title} knows no halt in {mode.title}: "
                "let the set-points lead it to rest, or quick_stop"
            )
        self._control.set_bits(Control.HALT, Control.HALT)
        standing = Status.TARGET_REACHED
        self._await(standing, standing, deadline, "come to a halt", confirm_ns=CONFIRM_NS)

    def resume(self) -> None:
        """Cancel the halt; the drive goes on with its target."""
        self._control.clear_bits(Control.HALT)

    # ---- inside ---------------------------------------------------------------------------------------

    def _await(
        self,
        mask: int,
        wanted: int,
        deadline: Instant,
        action: str,
        confirm_ns: int = 0,
        failed: int = 0,
        look: Callable[[int], None] = _nothing,
    ) -> None:
        """Poll the statusword until ``word & mask == wanted``, for ``confirm_ns`` if it is so at first."""
        control, clock = self._control, self._control.network.clock
        seen_otherwise = False
        started = clock.now()
        while True:
            word = self._check_enabled()
            look(word)
            now = clock.now()
            if failed and word & failed:
                raise DriveInFault(f"{control.title} failed to {action}", control.evidence())
            if word & mask != wanted:
                seen_otherwise = True
            elif seen_otherwise or now - started >= confirm_ns:
                return
            if now >= deadline:
                raise control.stuck(action)
            control.network.pump(Instant(now + POLL_NS))

    def _check_enabled(self) -> int:
        """Return the statusword of a drive that is in OPERATION ENABLED; raise otherwise."""
        control = self._control
        word = control.read_status()
        state = state_of(word)
        if state in FAULTY:
            raise control.in_fault()
        if state is not State.OPERATION_ENABLED:
            named = "an unknown state" if state is None else repr(state.value)
            raise DriveInFault(f"{control.title} is in {named}", control.evidence(), "enable it first")
        return word

    def _write_profile(self, profile: MoveProfile, speed_object: Object | None) -> None:
        scaling = self._scaling
        if speed_object is not None and profile.speed_rad_s is not None:
            raw = max(1, round(abs(profile.speed_rad_s) / scaling.velocity_rad_s))
            self._write_needed(speed_object, "I", raw, "profile velocity")
        for index, value, text in (
            (Object.PROFILE_ACCELERATION, profile.acceleration_rad_s2, "profile acceleration"),
            (Object.PROFILE_DECELERATION, profile.deceleration_rad_s2, "profile deceleration"),
        ):
            if value is not None:
                self._write_needed(index, "I", max(1, round(value / scaling.acceleration_rad_s2)), text)

    def _write_homing(self, method: int, how: HomingSetup) -> None:
        scaling = self._scaling
        self._write_needed(Object.HOMING_METHOD, "b", method, "homing method")
        for sub, speed_rad_s in ((1, how.switch_speed_rad_s), (2, how.zero_speed_rad_s)):
            if speed_rad_s is not None:
                raw = max(1, round(speed_rad_s / scaling.velocity_rad_s))
                self._write_needed(Object.HOMING_SPEEDS, "I", raw, "homing speed", sub)
        if how.acceleration_rad_s2 is not None:
            raw = max(1, round(how.acceleration_rad_s2 / scaling.acceleration_rad_s2))
            self._write_needed(Object.HOMING_ACCELERATION, "I", raw, "homing acceleration")
        if how.offset_rad is not None:
            raw = round(how.offset_rad / scaling.position_rad)
            self._write_needed(Object.HOME_OFFSET, "i", raw, "home offset")

    def _write_needed(self, index: int, code: str, raw: int, text: str, sub: int = 0) -> None:
        """Write a value that must be taken: a move at another speed than requested is wrong."""
        refused = write_optional(self._objects, index, code, raw, text, sub)
        if refused:
            raise SettingRefused(f"{self._control.title} cannot move as asked", "; ".join(refused))
