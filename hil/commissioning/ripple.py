"""Torque against the angle of the shaft: cogging, and friction that varies over a turn."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from servobench.hil.commissioning.exercise import Recording, smooth_speed
from servobench.hil.commissioning.identify import Array, Mechanics

_BINS: Final = 72
"""Bins of 5 degrees: twelve for a period of the sixth harmonic."""
_SMOOTHED: Final = 9
"""Samples of the line by which the speed is smoothed."""
_REACH_RAD: Final = 0.5
"""Span of those samples: half a period of the sixth harmonic, beyond which smoothing levels it."""
_FEWEST: Final = 5
"""Samples in a bin, for a mean with a scatter."""


class TorqueByAngle(NamedTuple):
    """Means over bins of the angle; NaN where too few samples fell."""

    angle_rad: Array
    """(72,) middle of each bin, from the drive's zero of position."""
    forward_nm: Array
    """(72,) torque beyond inertia and identified friction, turning towards positive positions."""
    backward_nm: Array
    error_nm: float
    """Standard error of a bin, root mean square."""

    @property
    def ripple_nm(self) -> float | None:
        """Half of peak to peak of the mean of both directions; None where bins are empty."""
        both = 0.5 * (self.forward_nm + self.backward_nm)
        return None if np.isnan(both).any() else float(np.ptp(both)) / 2.0


def torque_by_angle(recordings: Sequence[Recording], mechanics: Mechanics) -> TorqueByAngle:
    """Return the remaining torque by angle, from samples slow enough to know their acceleration."""
    samples = [np.zeros((3, 0))]
    for recording in recordings:
        if len(recording.time) <= _SMOOTHED:
            continue
        speed = recording.speed
        acceleration = smooth_speed(recording.time, speed)
        step = float(np.median(np.diff(recording.time)))
        slow = (np.abs(speed) * _SMOOTHED * step < _REACH_RAD) & (np.abs(speed) * _SMOOTHED * step > 0.01)
        sign = np.sign(speed)
        friction = (
            mechanics.viscous_friction_nm_s * speed
            + mechanics.coulomb_friction_nm * sign
            + mechanics.offset_nm
        )
        left = recording.torque - mechanics.inertia_kg_m2 * acceleration - friction
        samples.append(np.array([np.mod(recording.position, 2.0 * np.pi), left, sign])[:, slow])
    angle, torque, direction = np.concatenate(samples, axis=1)
    place = np.minimum(_BINS - 1, (angle / (2.0 * np.pi) * _BINS).astype(int))
    means, errors = [], []
    for way in (1.0, -1.0):
        parts = [torque[(place == number) & (direction == way)] for number in range(_BINS)]
        means.append(np.array([part.mean() if len(part) >= _FEWEST else np.nan for part in parts]))
        errors += [part.var(ddof=1) / len(part) for part in parts if len(part) >= _FEWEST]
    middle = (np.arange(_BINS) + 0.5) * 2.0 * np.pi / _BINS
    error = float(np.sqrt(np.mean(errors))) if errors else float("nan")
    return TorqueByAngle(middle, means[0], means[1], error)
