"""Moves in profile position, and the trapezoid that they follow."""

import math

from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.unit.virtual_bus.motion_bench import COUNTS, MotionBench

SPEED, UP, DOWN = 10.0, 100.0, 50.0
"""turns/s, turns/s^2: 0.1 s and 0.5 turns up, 0.2 s and 1 turn down."""
SETTLED_MS = 10
"""6068h at power-on."""
CLOSE = 0.003
"""turns."""
COUNT_PER_PERIOD = 16_000 / COUNTS
"""turns/s: what one encoder count more in an inner period makes of the speed."""


def bench_with_profile(drive: DriveParameters | None = None) -> MotionBench:
    bench = MotionBench(Mode.PROFILE_POSITION, drive)
    bench.profile(SPEED, UP, DOWN)
    return bench


def way(time_s: float, distance: float) -> float:
    """Position on the trapezoid, turns."""
    peak = min(SPEED, math.sqrt(2 * distance * UP * DOWN / (UP + DOWN)))
    rising, falling = peak / UP, peak / DOWN
    cruise = distance / peak - 0.5 * (rising + falling)
    left = rising + cruise + falling - time_s
    if time_s < rising:
        return 0.5 * UP * time_s**2
    if left > falling:
        return 0.5 * UP * rising**2 + peak * (time_s - rising)
    return distance - 0.5 * DOWN * max(left, 0.0) ** 2


def duration_ms(distance: float) -> float:
    peak = min(SPEED, math.sqrt(2 * distance * UP * DOWN / (UP + DOWN)))
    return 1000 * (distance / peak + 0.5 * peak * (1 / UP + 1 / DOWN))
