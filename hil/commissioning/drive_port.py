"""A drive as the exercises of commissioning see it: one way to write a set-point, in whatever mode.

A drive without a torque mode is given speeds, by a :class:`.SpeedCommand`; no other command is taken then.
In a mode of positions they are summed up. In profile position, where the drive plans a move to each set-point
and brakes for it, a set-point leads the sum by the way that braking takes, so that the drive goes on:

    set-point = sum of speed times period + v |v| / (2 6084h)
"""

import math
from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.pdo import EVERY_SYNC
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.readings import NEVER_TOLD
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import PeerFault
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
"""Modes in which an exercise can command a motion, the one to be preferred first. For one of positions the
exercise asks for speeds, which are summed up."""


class DrivePort(Drive):
    """What an axis of the loop needs of a drive."""

    def __init__(
        self, drive: ServoDrive, mode: Mode, period_s: float, braking_rad_s2: float = math.inf
    ) -> None:
        """``braking_rad_s2``: with which the drive brakes for a set-point, 6084h in profile position."""
        self.drive = drive
        self.mode = mode
        self.quantity = QUANTITY_OF_MODE[mode]
        self.listener: Callable[[list[Reading]], None] | None = None
        """Sees the readings as they are taken."""
        self.whole_only = _tells_each_position(drive)
        """A reading whose position was lost is none: it holds the last one, carried on by a velocity whose
        unit may be wrong by a hundred."""
        self.watched_by = ""
        """By what, in words, in the last exercise."""
        self._command_watch = ""
        self._told_at = NEVER_TOLD
        self._period_s = period_s
        self._braking_rad_s2 = braking_rad_s2
        self._position_rad: float | None = None
        self._last: Instant | None = None

    def take_readings(self) -> list[Reading]:
        """The readings of the drive."""
        readings = self._whole(self.drive.take_readings())
        if self.listener is not None:
            self.listener(readings)
        if self._position_rad is None and readings:
            self._position_rad = readings[-1].position_rad
        return readings

    def _whole(self, readings: list[Reading]) -> list[Reading]:
        """Those with a position of their own: it was told since the one before."""
        kept = []
        for reading in readings:
            if reading.position_told_at != self._told_at or not self.whole_only:
                kept.append(reading)
            self._told_at = reading.position_told_at
        return kept

    def take_readbacks(self) -> list[Readback]:
        """As the drive's own."""
        return self.drive.take_readbacks()

    def take_demand_changes(self) -> list[DemandChange]:
        """As the drive's own."""
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
        """The position that was commanded last; None in a mode without one."""
        return self._position_rad if self.quantity is Quantity.POSITION else None

    def check(self) -> None:
        """As the drive's own."""
        self.drive.check()

    def begin(self) -> None:
        """An exercise begins: the host looks whether the drive follows its commands, until :meth:`end`. In a
        position mode, positions are counted on from where the shaft stands now.

        The drive's own timer (1400h:05) would stop it between two exercises.
        """
        self._position_rad = self._last = None
        self._command_watch = self.drive.supervise_commands(own_timer=False)

    def end(self) -> None:
        """The commands of an exercise cease."""
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
    """The position is told with every SYNC."""
    pdo = None if drive.plan is None else drive.plan.tpdo_with(Object.POSITION_ACTUAL_VALUE)
    return pdo is not None and pdo.transmission_type == EVERY_SYNC
