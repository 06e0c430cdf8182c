"""Ramps that a drive makes by itself (CiA 402-2), by the mode that obeys them."""

from typing import Final

from drivers.cia402.objects402 import Object
from drivers.cia402.profile import Mode

_PROFILE: Final = (Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION)
_BOUNDS: Final = (Object.MAX_ACCELERATION, Object.MAX_DECELERATION)
RAMPS: Final = {
    Mode.PROFILE_POSITION: (*_PROFILE, *_BOUNDS),
    Mode.PROFILE_VELOCITY: (*_PROFILE, *_BOUNDS),
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: _BOUNDS,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: _BOUNDS,
    Mode.PROFILE_TORQUE: (Object.TORQUE_SLOPE,),
}
"""Other modes obey none of them."""
