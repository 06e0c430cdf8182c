"""A drive as commissioning exercises see it: one way to write a set-point, in any mode.

A drive without a torque mode is given speeds, by a :class:`.SpeedCommand`; no other command is accepted then.
In a position mode they are summed up. In profile position, where the drive plans a move to each set-point and
brakes for it, a set-point leads the sum by the braking distance, so that the drive keeps moving:

    set-point = sum of speed times period + v |v| / (2 6084h)
"""

import math
from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.pdo import EVERY_SYNC
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import PeerFault
from servobench.drivers.exchange import (
    NEVER_TOLD,
    Command,
    DemandChange,
    Drive,
    PositionCommand,
    Readback,
    Reading,
    SentCommand,
    SpeedCommand,
)
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.loop.scenario import Quantity

QUANTITY_OF_MODE: Final = {
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: Quantity.TORQUE,
    Mode.PROFILE_TORQUE: Quantity.TORQUE,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: Quantity.SPEED,
    Mode.PROFILE_VELOCITY: Quantity.SPEED,
    Mode.VELOCITY: Quantity.SPEED,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: Quantity.POSITION,
    Mode.INTERPOLATED_POSITION: Quantity.POSITION,
    Mode.PROFILE_POSITION: Quantity.POSITION,
}
"""Modes in which an exercise can command a motion, in order of preference. In a position mode the exercise
commands speeds, which are summed up."""


class DrivePort(Drive):
    """A drive's interface to an axis of the loop."""

    def __init__(
        self, drive: ServoDrive, mode: Mode, period_s: float, braking_rad_s2: float = math.inf
    ) -> None:
        """``braking_rad_s2``: deceleration of the drive for a set-point, 6084h in profile position."""
        self.drive = drive
        self.mode = mode
        self.quantity = QUANTITY_OF_MODE[mode]
        self.listener: Callable[[list[Reading]], None] | None = None
        """Called with the readings as they are taken."""
        self.whole_only = _tells_each_position(drive)
        """True if a reading without its own position is dropped: it holds the last one, extrapolated by a
        velocity whose unit may be wrong by a hundred."""
        self.watched_by = ""
        """Supervision in the last exercise, in words."""
        self._command_watch = ""
        self._told_at = NEVER_TOLD
        self._period_s = period_s
        self._braking_rad_s2 = braking_rad_s2
        self._position_rad: float | None = None
        self._last: Instant | None = None

    def take_readings(self) -> list[Reading]:
        """Return the readings of the drive."""
        readings = self._whole(self.drive.take_readings())
        if self.listener is not None:
            self.listener(readings)
        if self._position_rad is None and readings:
            self._position_rad = readings[-1].position_rad
        return readings

    def _whole(self, readings: list[Reading]) -> list[Reading]:
        """Return the readings with their own position, received since the previous one."""
        kept = []
        for reading in readings:
            if reading.position_told_at != self._told_at or not self.whole_only:
                kept.append(reading)
            self._told_at = reading.position_told_at
        return kept

    def take_readbacks(self) -> list[Readback]:
        """Return the drive's read-backs."""
        return self.drive.take_readbacks()

    def take_demand_changes(self) -> list[DemandChange]:
        """Return the drive's demand changes."""
        return self.drive.take_demand_changes()

    def write(self, command: Command) -> SentCommand | None:
        """Send a set-point. Raises ValueError for a speed in a torque mode, TypeError for a torque in a mode
        of speeds or positions.
        """
        if self.quantity is Quantity.TORQUE:
            return self.drive.write(command)
        if not isinstance(command, SpeedCommand):
            raise TypeError(f"{self.drive.name} is given speeds in {self.mode.name}, not {command!r}")
        if self.quantity is Quantity.SPEED:
            return self.drive.write(command)
        return self._write_position(command)

    @property
    def commanded_rad(self) -> float | None:
        """The position commanded last; None in a mode without one."""
        return self._position_rad if self.quantity is Quantity.POSITION else None

    def check(self) -> None:
        """Check the drive."""
        self.drive.check()

    def begin(self) -> None:
        """Begin an exercise: supervise the commands until :meth:`end`. In a position mode, positions count
        from that of the shaft.

        The drive's own timer (1400h:05) would stop it between two exercises.
        """
        self._position_rad = self._last = None
        self._command_watch = self.drive.supervise_commands(own_timer=False)

    def end(self) -> None:
        """End an exercise: its commands cease."""
        mode_watch = self.drive.watch.mode_watch
        self.watched_by = f"its commands are watched by {self._command_watch}; its mode by {mode_watch}"
        self.drive.supervision.end()

    def _write_position(self, command: SpeedCommand) -> SentCommand | None:
        if self._position_rad is None:
            raise PeerFault("no position to count from")
        passed_s = self._period_s if self._last is None else (command.effective_at - self._last) / NS_PER_S
        self._last = command.effective_at
        speed = command.speed_rad_s
        self._position_rad += speed * passed_s
        ahead = self._position_rad + speed * abs(speed) / (2.0 * self._braking_rad_s2)
        return self.drive.write(
            PositionCommand(command.sequence, ahead, command.effective_at, command.expires_at)
        )


def _tells_each_position(drive: ServoDrive) -> bool:
    """Return True if the position comes with every SYNC."""
    pdo = None if drive.plan is None else drive.plan.tpdo_with(Object.POSITION_ACTUAL_VALUE)
    return pdo is not None and pdo.transmission_type == EVERY_SYNC
