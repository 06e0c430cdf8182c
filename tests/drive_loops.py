"""The speed loop inside a simulated drive, opened by brute force: torques beside its own, tick by tick, and
what the speed that it compares makes of them. Nothing of bench, bus or identification takes part.
"""

import math
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl

_SECONDS: Final = 2.0
"""Of the measurement; lines are multiples of a half of 1/this."""
_SPEED_RAD_S: Final = 31.7
_COUNTS: Final = 1 << 28
"""Of a turn: steps of an encoder are noise, which the loop's linear behaviour is without."""
_TORQUE_SHARE: Final = 0.2
"""Of the rated torque, all lines together: the loop itself must have room beside them."""
_LINES_HZ: Final = np.unique(np.round(np.geomspace(2.0, 900.0, 140)))


class OpenLoop(NamedTuple):
    """Behaviour of a loop, by its response in lines."""

    bandwidth_hz: float
    crossover_hz: float
    phase_margin_deg: float


def opened(
    motor: PmsmParameters, parameters: FirmwareParameters, proportional: float, integral: float
) -> OpenLoop:
    """Return the behaviour of the speed loop of a drive with these gains, N m s/rad and N m/rad."""
    firmware = Firmware(motor, replace(parameters, encoder_counts_per_revolution=_COUNTS))
    firmware.control(InnerControl.TORQUE)
    inner, tick_s = firmware.inner, firmware.tick_s
    inner.speed_gain, inner.speed_integral_gain = proportional, integral
    count = round(_SECONDS / tick_s)
    random = np.random.Generator(np.random.PCG64(7))
    phases = random.uniform(0.0, math.tau, len(_LINES_HZ))
    ticks = np.arange(2 * count)
    share = _TORQUE_SHARE * motor.rated_torque_nm / math.sqrt(len(_LINES_HZ))
    added = share * np.cos(np.outer(ticks * tick_s, math.tau * _LINES_HZ) + phases).sum(axis=1)
    speed = np.empty(2 * count)
    for k in ticks:
        firmware.ramp_to_speed(_SPEED_RAD_S, 1000.0, float(added[k]))
        firmware.advance_to(firmware.tick_after(Instant(firmware.tick_at + 1)))
        speed[k] = inner.speed_measured_rad_s
    late = slice(count, 2 * count)
    bins = np.round(_LINES_HZ * _SECONDS).astype(int)
    closed = np.fft.rfft(speed[late])[bins] / np.fft.rfft(added[late])[bins]
    back = np.exp(-1j * math.tau * _LINES_HZ * tick_s)
    controller = proportional + integral * tick_s * back / (1.0 - back)
    loop = controller * closed / (1.0 - controller * closed)
    size, phase = np.abs(loop), np.degrees(np.unwrap(np.angle(loop)))
    crossover_hz = _falls(size, 1.0)
    margin = 180.0 + float(np.interp(crossover_hz, _LINES_HZ, phase))
    return OpenLoop(_falls(np.abs(loop / (1.0 + loop)), math.sqrt(0.5)), crossover_hz, margin % 360.0)


def _falls(values: np.ndarray, level: float) -> float:
    """Return where the values are above a level last, Hz."""
    k = int(np.flatnonzero(values >= level)[-1])
    share = math.log(values[k] / level) / math.log(values[k] / values[k + 1])
    return float(_LINES_HZ[k] * (_LINES_HZ[k + 1] / _LINES_HZ[k]) ** share)
