"""Profile position moves that make a steady motion: speed and ramps of the drive (6081h, 6083h, 6084h)."""

from typing import Final

from servobench.drivers.canopen.greatest import write_greatest
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import Scaling
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
