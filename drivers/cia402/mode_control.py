"""Changing a drive's mode of operation, CiA 402-2 clause 7 (modes of operation, 0x6060 and 0x6061).

Bits 4 to 6 of the controlword mean another thing in each mode: bit 4 is "new set-point" in one and "start
homing" in another. So they are 0 before the mode changes, and the set-point of the new mode is such that the
drive neither jumps nor turns by an old value. A mode that follows only with some of them set gets these once
the drive is enabled in it.
"""

from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_plans import TARGETS
from servobench.drivers.cia402.profile import (
    CHANGE_AT_ONCE,
    FOLLOW_BITS,
    NEW_SET_POINT,
    Control,
    Mode,
    State,
    Status,
    offers_mode,
    run_words,
    tells_modes,
)
from servobench.drivers.cia402.state_control import FAULTY, POLL_NS, StateControl
from servobench.drivers.cia402.velocity_mode import velocity_mode_unit
from servobench.drivers.errors import TransferAborted
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import Instant


class ModeRefused(SettingRefused):
    """A drive does not take up a mode: it lacks it, refuses the change, or stays in another one."""


MODE_BITS = Control.MODE_4 | Control.MODE_5 | Control.MODE_6


class ModeControl:
    """The mode of one drive. Every method pumps the network."""

    def __init__(self, control: StateControl, follow: FollowWatch) -> None:
        self.mode = Mode.NONE
        """The last confirmed mode; NONE before the first change."""
        self.primed_position: int | None = None
        """The last 607Ah written to start a position mode; None in any other mode."""
        self._control = control
        self._follow = follow
        self._objects: RemoteObjects = control.objects

    def change(self, mode: Mode, deadline: Instant) -> None:
        """Switch the drive to a mode, in whatever state it is, and wait until it shows it.

        A position mode begins at the present position, a torque mode at 0, a velocity mode at the present
        speed if the drive is enabled, else at 0. Raises ModeRefused if the drive has no such mode, refuses it
        or keeps another one until the deadline, DriveInFault if a fault comes up.
        """
        self.require(mode)
        self.mode = Mode.NONE
        self._follow.aim(Mode.NONE)
        self._control.clear_bits(MODE_BITS)
        try:
            self.prime(mode)
            self._write(mode)
        except TransferAborted as error:
            raise ModeRefused(
                f"{self._control.title} does not take {mode.title} mode", f"{error.summary}; {error.evidence}"
            ) from error
        self._await_display(mode, deadline)
        self.mode = mode
        self._follow.aim(mode)
        if mode in FOLLOW_BITS and self._turns():
            self.follow()

    def follow(self) -> None:
        """Set the bits of the controlword without which the mode does not follow; the drive is enabled."""
        bits = FOLLOW_BITS.get(self.mode)
        if bits is not None:
            self._control.set_bits(MODE_BITS, bits)

    def ensure(self, mode: Mode, deadline: Instant) -> None:
        """Call :meth:`change` unless the drive is already in that mode."""
        if self.mode is not mode:
            self.change(mode, deadline)

    def prime(self, mode: Mode) -> None:
        """Write a set-point with which the mode can begin."""
        target = TARGETS.get(mode)
        self.primed_position = None
        if target is None:
            return
        self._aim(mode)
        raw = 0
        if target.index in (Object.TARGET_POSITION, Object.INTERPOLATION_DATA_RECORD):
            raw = self.primed_position = self._objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
        elif target.index == Object.TARGET_VELOCITY and self._turns():
            raw = self._objects.read(Object.VELOCITY_ACTUAL_VALUE, 0, "i")
        elif target.index == Object.VL_TARGET_VELOCITY and self._turns():
            raw = self._objects.read_if_there(Object.VL_VELOCITY_ACTUAL_VALUE, 0, "h") or 0
        self._control.write_value(target.index, target.code, raw, target.sub)

    def _write(self, mode: Mode) -> None:
        """Set 6060h to ``mode``; a drive with one mode may refuse the write but hold it anyway."""
        try:
            self._control.write_value(Object.MODES_OF_OPERATION, "b", mode)
        except TransferAborted:
            if self._objects.read_if_there(Object.MODES_OF_OPERATION, 0, "b") != mode:
                raise

    def _aim(self, mode: Mode) -> None:
        """Make the RPDOs of each cycle carry the set-points of ``mode``, in its units."""
        frames = self._control.set_point
        if frames is not None:
            unit = velocity_mode_unit(self._objects) if mode is Mode.VELOCITY else RAD_S_PER_RPM
            frames.aim(mode, unit)

    def shake_hands(self, statusword: int) -> None:
        """Make the next RPDO hand over its set-point in profile position, even during a move; do nothing in
        another mode. Bit 4 of the controlword rises while bit 12 of the statusword is 0, and falls once that
        acknowledges it: two or more cycles per set-point."""
        if self.mode is not Mode.PROFILE_POSITION or self._control.set_point is None:
            return
        acknowledged = statusword & Status.MODE_12
        word = (
            self._control.controlword & ~MODE_BITS | CHANGE_AT_ONCE | (0 if acknowledged else NEW_SET_POINT)
        )
        self._control.controlword = word
        self._control.set_point.hold(Object.CONTROLWORD, word)

    def _turns(self) -> bool:
        return self._control.read_state() is State.OPERATION_ENABLED

    def require(self, mode: Mode) -> None:
        """Raise ModeRefused if 6502h says that the drive lacks ``mode``."""
        modes = self._objects.read_if_there(Object.SUPPORTED_DRIVE_MODES)
        if modes is not None and tells_modes(modes) and not offers_mode(modes, mode):
            raise ModeRefused(
                f"{self._control.title} has no {mode.title} mode",
                f"6502h is {modes:08X}h",
                run_words([each for each in Mode if offers_mode(modes, each)]),
            )

    def _await_display(self, mode: Mode, deadline: Instant) -> None:
        """Wait until 0x6061 follows 0x6060; a drive without 0x6061 is believed."""
        control, network = self._control, self._control.network
        while (held := self._objects.read_if_there(Object.MODES_OF_OPERATION_DISPLAY, 0, "b")) != mode:
            if held is None:
                return
            if control.read_state() in FAULTY:
                raise control.in_fault()
            if network.clock.now() >= deadline:
                raise ModeRefused(
                    f"{control.title} stays in mode {held}",
                    f"mode {mode:d} was asked for; {control.evidence()}",
                )
            network.pump(Instant(network.clock.now() + POLL_NS))
