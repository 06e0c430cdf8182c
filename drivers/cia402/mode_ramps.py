"""Ramps that a drive applies by itself (CiA 402-2), by the mode that obeys them."""

import math
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects, write_greatest
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.velocity_mode import write_velocity_mode_ramps

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
