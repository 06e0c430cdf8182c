"""Unit and ramps of the velocity mode (vl), which has its own (CiA 402-2): 604Ch, and 6048h to 604Ah.

    rad/s of a unit    604Ch:1 / 604Ch:2 r/min, and 1 r/min where the drive has none
    ramp               units in sub-index 1, changed in the seconds of sub-index 2

Speeds are those of the motor's shaft, as in 6080h. Each object that is missing or refused becomes a note.

Ramps that a drive applies by itself (CiA 402-2), by the mode that obeys them.
"""

import math
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects, write_greatest
from servobench.drivers.cia402.drive_setup import DriveSettings, write_optional
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.rotation import RAD_S_PER_RPM

_FINE = 100
"""Least number of units by which a ramp's speed changes: rounding to a whole unit is right to 0.5 %."""
_SECONDS_MAX = 0xFFFF


def velocity_mode_unit(objects: RemoteObjects) -> float:
    """Return rad/s of one unit of 6042h; negative if 604Ch reverses its sign. 604Ch has two INTEGER32."""
    numerator, denominator = (objects.read_if_there(Object.VL_DIMENSION_FACTOR, sub, "i") for sub in (1, 2))
    return RAD_S_PER_RPM * (numerator / denominator if numerator and denominator else 1.0)


def write_velocity_mode_ramps(objects: RemoteObjects, settings: DriveSettings) -> list[str]:
    """Write the quick stop and the change of set-points of ``settings``; return notes on what is not taken.
    Do nothing in another mode."""
    if settings.mode is not Mode.VELOCITY:
        return []
    unit_rad_s = abs(velocity_mode_unit(objects))
    quick_rad_s2, change_rad_s2 = settings.quick_stop_deceleration_rad_s2, settings.set_acceleration_rad_s2
    notes = []
    for index, rate_rad_s2, text in (
        (Object.VL_VELOCITY_ACCELERATION, change_rad_s2, "acceleration of the velocity mode"),
        (Object.VL_VELOCITY_DECELERATION, change_rad_s2, "deceleration of the velocity mode"),
        (Object.VL_VELOCITY_QUICK_STOP, quick_rad_s2, "quick stop of the velocity mode"),
    ):
        if rate_rad_s2 is not None:
            notes += _write_ramp(objects, index, rate_rad_s2 / unit_rad_s, text)
    return [*notes, _told(objects, unit_rad_s)]


def _told(objects: RemoteObjects, unit_rad_s: float) -> str:
    """Describe what the drive does to set-points beyond following them."""
    ramps = []
    for index in (Object.VL_VELOCITY_ACCELERATION, Object.VL_VELOCITY_DECELERATION):
        rate_rad_s2 = velocity_mode_ramp(objects, index)
        if rate_rad_s2 is not None:
            ramps.append(f"{index:04X}h = {rate_rad_s2 / RAD_S_PER_RPM:.4g} r/min per second")
    by_ramps = f", and ramped by {' and '.join(ramps)}" if ramps else ""
    return f"velocity mode: set-points are rounded to {unit_rad_s / RAD_S_PER_RPM:.4g} r/min{by_ramps}"


def _write_ramp(objects: RemoteObjects, index: int, units_s: float, text: str) -> list[str]:
    """Write a ramp as steep as requested, else as the drive allows: if it refuses the speed it may take less
    time."""
    seconds = min(max(1, math.ceil(_FINE / units_s)), _SECONDS_MAX)
    speed = min(max(1, round(units_s * seconds)), 0xFFFF_FFFF)
    granted = write_greatest(objects, index, "I", speed, text, sub=1)
    if granted.held is not None and granted.held < speed:
        seconds = max(1, math.floor(granted.held / units_s))
    return granted.notes + write_optional(objects, index, "H", seconds, text, 2)


def velocity_mode_ramp(objects: RemoteObjects, index: int) -> float | None:
    """Return rad/s^2 of 6048h, 6049h or 604Ah; infinite if its time is 0, None if the drive has no such
    ramp."""
    speed, seconds = objects.read_if_there(index, 1, "I"), objects.read_if_there(index, 2, "H")
    if not speed or seconds is None:
        return None
    return speed * abs(velocity_mode_unit(objects)) / seconds if seconds else math.inf


_PROFILE: Final = (Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION)
_BOUNDS: Final = (Object.MAX_ACCELERATION, Object.MAX_DECELERATION)
VL_RAMPS: Final = (Object.VL_VELOCITY_ACCELERATION, Object.VL_VELOCITY_DECELERATION)
"""Records: speed in sub-index 1, seconds in sub-index 2."""
SPEEDS: Final = {Mode.PROFILE_POSITION: (Object.PROFILE_VELOCITY, Object.MAX_PROFILE_VELOCITY)}
"""Speed limits of a move."""
RAMPS: Final = {
    Mode.PROFILE_POSITION: (*_PROFILE, *_BOUNDS),
    Mode.PROFILE_VELOCITY: (*_PROFILE, *_BOUNDS),
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: _BOUNDS,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: _BOUNDS,
    Mode.PROFILE_TORQUE: (Object.TORQUE_SLOPE,),
    Mode.VELOCITY: VL_RAMPS,
}
"""Ramps by mode; other modes obey none."""
_CYCLIC: Final = frozenset({Mode.CYCLIC_SYNCHRONOUS_VELOCITY, Mode.CYCLIC_SYNCHRONOUS_POSITION})
_RAW_MAX: Final = 0xFFFF_FFFF


def write_ramps(objects: RemoteObjects, settings: DriveSettings, scaling: Scaling) -> list[str]:
    """Make the drive's own ramps pass the steepest change of set-points in ``settings``; return notes on what
    was changed or refused. A drive with a slower ramp lags behind its set-points silently.

    In csv and csp 60C5h and 60C6h are raised where they are lower; vl has ramps of its own. Nothing in
    another mode.
    """
    notes = write_velocity_mode_ramps(objects, settings)
    if settings.mode not in _CYCLIC or settings.set_acceleration_rad_s2 is None:
        return notes
    raw = math.floor(settings.set_acceleration_rad_s2 / scaling.acceleration_rad_s2)
    wanted = min(max(1, raw), _RAW_MAX)
    for index in _BOUNDS:
        held = objects.read_if_there(index)
        if held is not None and held < wanted:
            granted = write_greatest(objects, index, "I", wanted, index.title)
            notes += [f"{index:04X}h was {held}, {granted.held} is set"] if granted.held != held else []
            notes += granted.notes
    return notes
