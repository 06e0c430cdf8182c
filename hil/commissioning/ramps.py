"""The ramps that a drive makes by itself: read, set and read back before it moves by them.

    profile position, profile velocity      6083h and 6084h, cut by 60C5h and 60C6h
    cyclic velocity and position            60C5h and 60C6h
    profile torque                          6087h

Each is made steep enough for the host's own limits, where it is not; the exercises then ask for no more than
the drive has granted. Ramps that are steeper are left as they are: torque and set-points are bounded beside
them.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from drivers.canopen.greatest import write_greatest
from drivers.canopen.objects import RemoteObjects
from drivers.cia402.mode_ramps import RAMPS
from drivers.cia402.objects402 import Object
from drivers.cia402.profile import Mode
from hil.commissioning.findings import Findings
from hil.commissioning.moves import MOVE_RUN_UP_S
from hil.commissioning.outcome import StepFailed
from hil.commissioning.request import MotionLimits

_HIDDEN_S: Final = 1e-3
"""The rated torque in so long: 6087h then hides no command, whose switches are a tenth of it; how fast a
command may rise the host sees to itself."""
_RUN_UP_MAX_S: Final = 5.0
"""To a tenth of the limit of speed, or to the limit of torque: no exercise waits for longer."""
_PROOF_SHARE: Final = 0.1
_STEEPER: Final = 1000.0
"""Where no shaft moves by what was set: units of the acceleration are wrong by as much."""
_RAW_MAX: Final = 0xFFFF_FFFF


class RampTooSlow(StepFailed):
    """The drive's own ramp makes no motion in this mode; another mode may have none."""


def set_ramps(
    objects: RemoteObjects, found: Findings, mode: Mode, most_told: Callable[[int], int | None]
) -> list[str]:
    """Read the ramps of ``mode`` and write those that are too slow; notes on what was changed or refused.

    ``most_told``: the greatest value of an object by the data sheet. Raises RampTooSlow, naming the object
    and its value.
    """
    notes: list[str] = []
    found.ramps = {}
    limits = found.limits
    assert limits is not None, "the step 'units' comes first"
    for index in RAMPS.get(mode, ()):
        held = objects.read_if_there(index)
        if held is None:
            continue
        wanted = _wanted(found, limits, index, mode)
        if held < wanted:
            granted = write_greatest(objects, index, "I", wanted, index.title, most=most_told(index))
            notes += [f"{index:04X}h was {held}, {granted.held} is set"] if granted.held != held else []
            notes += granted.notes
            held = granted.held or 0
        found.ramps[index] = held
    for index in found.ramps:
        takes_s = _takes_s(found, limits, index)
        if takes_s > _RUN_UP_MAX_S:
            failure = RampTooSlow(
                f"a ramp of the drive is too slow for {mode.title}",
                "; ".join([f"{_told(found, index)}: a slow motion takes {takes_s:.3g} s to begin", *notes]),
                f"set {index:04X}h with the maker's tool",
            )
            found.ramps = {}  # those of another mode may do
            raise failure
    return notes


def steepen(found: Findings) -> bool:
    """Have the next :func:`set_ramps` ask for a thousand times more, as the shaft has not moved by what was
    set; False if it did already, or there is nothing to ask for."""
    if found.ramp_factor > 1.0 or not found.ramps.keys() - {Object.TORQUE_SLOPE}:
        return False
    found.ramp_factor = _STEEPER
    return True


def within_ramps(found: Findings, limits: MotionLimits) -> MotionLimits:
    """``limits``, cut to what the drive's ramps let a set-point do."""
    acceleration, slew = limits.acceleration_rad_s2, limits.torque_slew_nm_s
    for index in found.ramps:
        if index is Object.TORQUE_SLOPE:
            slew = min(slew, _rate(found, index))
        elif found.ramp_factor == 1.0:  # else nobody knows what a unit of it is
            acceleration = min(acceleration, _rate(found, index))
    return replace(limits, acceleration_rad_s2=acceleration, torque_slew_nm_s=slew)


def ramps_told(found: Findings) -> str:
    """The ramps in force, in SI units; empty in a mode without."""
    return ", ".join(_told(found, index) for index in found.ramps)


def _told(found: Findings, index: Object) -> str:
    unit = "N m/s" if index is Object.TORQUE_SLOPE else "rad/s^2"
    return f"{index:04X}h = {found.ramps[index]} ({_rate(found, index):.4g} {unit})"


def _rate(found: Findings, index: Object) -> float:
    """N m/s or rad/s^2."""
    units = found.scaling
    unit = units.torque_nm if index is Object.TORQUE_SLOPE else units.acceleration_rad_s2
    return found.ramps[index] * unit


def _wanted(found: Findings, limits: MotionLimits, index: Object, mode: Mode) -> int:
    if index is Object.TORQUE_SLOPE:
        return round(1000.0 / _HIDDEN_S)
    steepest = limits.acceleration_rad_s2
    if mode is Mode.PROFILE_POSITION:  # where write_moves has set them
        steepest = limits.speed_rad_s / MOVE_RUN_UP_S
    raw = found.ramp_factor * steepest / found.scaling.acceleration_rad_s2
    return min(max(1, math.floor(raw)), _RAW_MAX)


def _takes_s(found: Findings, limits: MotionLimits, index: Object) -> float:
    """How long a slow motion takes to begin."""
    change = limits.torque_nm if index is Object.TORQUE_SLOPE else _PROOF_SHARE * limits.speed_rad_s
    return change / max(_rate(found, index), 1e-9)
