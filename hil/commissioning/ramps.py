"""The drive's own ramps, and its speed of a move: read, set and verified before it moves.

    profile position, profile velocity      6083h and 6084h, cut by 60C5h and 60C6h
    profile position                        6081h, cut by 607Fh
    velocity mode                           6048h and 6049h, which its set-up has written
    cyclic velocity and position            60C5h and 60C6h
    profile torque                          6087h

Each is raised to the host's own limits if necessary; the exercises then use no more than the drive has
granted. Steeper ramps are left alone: torque and set-points have their own bounds.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects, write_greatest
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.velocity_mode import RAMPS, SPEEDS, VL_RAMPS, velocity_mode_ramp
from servobench.hil.commissioning.findings import DriveRamp, Findings, StepFailed
from servobench.hil.commissioning.request import MotionLimits

MOVE_RUN_UP_S: Final = 0.5
"""From rest to the speed limit. A drive with consecutive set-points accelerates and brakes from one to the
next, so that its speed swings by this acceleration times the cycles of a hand-shake: at 4 ms by 0.4 % of the
limit. No exercise needs more than the limit in 2 s."""
CATCH_UP: Final = 1.3
"""Multiple of the speed limit, as the host's own: a drive that has fallen behind its set-point catches up."""


def write_moves(objects: RemoteObjects, limits: MotionLimits, scaling: Scaling) -> tuple[float, list[str]]:
    """Write speed and ramps; return the drive's deceleration, rad/s^2, and notes on what it does not take."""
    rate = limits.speed_rad_s / MOVE_RUN_UP_S
    notes: list[str] = []
    for index, value, unit, text in (
        (Object.PROFILE_VELOCITY, CATCH_UP * limits.speed_rad_s, scaling.velocity_rad_s, "speed"),
        (Object.PROFILE_ACCELERATION, rate, scaling.acceleration_rad_s2, "acceleration"),
        (Object.PROFILE_DECELERATION, rate, scaling.acceleration_rad_s2, "deceleration"),
    ):
        raw = min(max(1, round(value / unit)), 0xFFFF_FFFF)
        notes += write_greatest(objects, index, "I", raw, f"{text} of a move").notes
    held = objects.read_if_there(Object.PROFILE_DECELERATION)
    return (held * scaling.acceleration_rad_s2 if held else rate), notes


_HIDDEN_S: Final = 1e-3
"""Time for the rated torque: 6087h then hides no command, whose switches are a tenth of it; the host itself
limits a command's rise."""
_RUN_UP_MAX_S: Final = 5.0
"""To a tenth of the speed limit, or to the torque limit: no exercise waits for longer."""
_PROOF_SHARE: Final = 0.1
_STEEPER: Final = 1000.0
"""Factor if no shaft moves by the value set: units of the acceleration are wrong by as much."""
_SCALED: Final = frozenset({*RAMPS[Mode.PROFILE_VELOCITY]})
"""Objects in the drive's unit of acceleration."""
_SPEEDS: Final = frozenset(SPEEDS[Mode.PROFILE_POSITION])
_RAW_MAX: Final = 0xFFFF_FFFF


class RampTooSlow(StepFailed):
    """The drive's own ramp permits no motion in this mode; another mode may have none."""


def set_ramps(
    objects: RemoteObjects, found: Findings, mode: Mode, most_told: Callable[[int], int | None]
) -> list[str]:
    """Read the ramps of ``mode`` and raise those that are too slow; return notes on what was changed or
    refused.

    ``most_told``: the greatest value of an object by the data sheet. Raises RampTooSlow, naming the object
    and its value.
    """
    notes: list[str] = []
    found.ramps = {}
    limits = found.limits
    assert limits is not None, "the step 'units' comes first"
    for index in SPEEDS.get(mode, ()):
        if speed := objects.read_if_there(index):
            _keep(found, index, speed)
    for index in VL_RAMPS if mode is Mode.VELOCITY else ():
        rate = velocity_mode_ramp(objects, index)
        if rate is not None:
            speed, seconds = objects.read_if_there(index, 1), objects.read_if_there(index, 2, "H")
            found.ramps[index] = DriveRamp(f"{index:04X}h = {speed} in {seconds} s", rate)
    for index in RAMPS.get(mode, ()) if mode is not Mode.VELOCITY else ():
        held = objects.read_if_there(index)
        if held is None:
            continue
        wanted = _wanted(found, limits, index, mode)
        if held < wanted:
            granted = write_greatest(objects, index, "I", wanted, index.title, most=most_told(index))
            notes += [f"{index:04X}h was {held}, {granted.held} is set"] if granted.held != held else []
            notes += granted.notes
            held = granted.held or 0
        _keep(found, index, held)
    for index, ramp in found.ramps.items():
        why = _too_slow(limits, index, ramp.amount)
        if why:
            failure = RampTooSlow(
                f"a {'speed' if index in _SPEEDS else 'ramp'} of the drive is too slow for {mode.title}",
                "; ".join([f"{_told(index, ramp)}: {why}", *notes]),
                f"set {index:04X}h with the maker's tool",
            )
            found.ramps = {}  # those of another mode may do
            raise failure
    return notes


def steepen(found: Findings) -> bool:
    """Make the next :func:`set_ramps` use a thousand times more, as the shaft has not moved; False if that
    was done already, or there is no ramp."""
    if found.ramp_factor > 1.0 or not found.ramps.keys() & _SCALED:
        return False
    found.ramp_factor = _STEEPER
    return True


def within_ramps(found: Findings, limits: MotionLimits) -> MotionLimits:
    """Return ``limits``, reduced to the drive's ramps."""
    speed, acceleration, slew = limits.speed_rad_s, limits.acceleration_rad_s2, limits.torque_slew_nm_s
    for index, ramp in found.ramps.items():
        if index is Object.TORQUE_SLOPE:
            slew = min(slew, ramp.amount)
        elif index in _SPEEDS:
            speed = min(speed, ramp.amount / CATCH_UP)
        elif found.ramp_factor == 1.0:  # else nobody knows what a unit of it is
            acceleration = min(acceleration, ramp.amount)
    return replace(limits, speed_rad_s=speed, acceleration_rad_s2=acceleration, torque_slew_nm_s=slew)


def ramps_told(found: Findings) -> str:
    """Describe the ramps in force, in SI units; empty in a mode without."""
    return ", ".join(_told(index, ramp) for index, ramp in found.ramps.items())


def _told(index: Object, ramp: DriveRamp) -> str:
    unit = "N m/s" if index is Object.TORQUE_SLOPE else "rad/s" if index in _SPEEDS else "rad/s^2"
    return f"{ramp.held} ({ramp.amount:.4g} {unit})"


def _keep(found: Findings, index: Object, held: int) -> None:
    units = found.scaling
    unit = units.velocity_rad_s if index in _SPEEDS else units.acceleration_rad_s2
    unit = units.torque_nm if index is Object.TORQUE_SLOPE else unit
    found.ramps[index] = DriveRamp(f"{index:04X}h = {held}", held * unit)


def _wanted(found: Findings, limits: MotionLimits, index: Object, mode: Mode) -> int:
    if index is Object.TORQUE_SLOPE:
        return round(1000.0 / _HIDDEN_S)
    steepest = limits.acceleration_rad_s2
    if mode is Mode.PROFILE_POSITION:  # where write_moves has set them
        steepest = within_ramps(found, limits).speed_rad_s / MOVE_RUN_UP_S
    raw = found.ramp_factor * steepest / found.scaling.acceleration_rad_s2
    return min(max(1, math.floor(raw)), _RAW_MAX)


def _too_slow(limits: MotionLimits, index: Object, amount: float) -> str:
    """Explain why no motion results; empty if one does."""
    slow_rad_s = _PROOF_SHARE * limits.speed_rad_s
    if index in _SPEEDS:
        return "" if amount >= CATCH_UP * slow_rad_s else f"a slow motion goes at {slow_rad_s:.3g} rad/s"
    change = limits.torque_nm if index is Object.TORQUE_SLOPE else slow_rad_s
    takes_s = change / max(amount, 1e-9)
    return "" if takes_s <= _RUN_UP_MAX_S else f"a slow motion takes {takes_s:.3g} s to begin"
