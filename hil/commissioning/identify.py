"""Inertia and friction of a shaft out of sampled position and torque, by weighted integrals.

    J domega/dt = T - B omega - T_c sign(omega) - T_0

Multiplied with a test function phi that vanishes with its derivative at both ends of a window, and integrated
by parts, it holds for the position itself:

    - J int(phi' dtheta) + B int(phi dtheta) + T_c int(phi sign omega) + T_0 int(phi) = int(phi T)

So no sample is differentiated twice, and an encoder's steps average out. Each window gives one equation; all
of them are solved together by least squares. The samples need not be evenly spaced: lost ones are just
missing. T_0 takes what a load or gravity adds in one direction.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POWER: Final = 4
"""phi = (1 - x^2)^4 on -1..1."""
_SAMPLES_MIN: Final = 12
"""Fewer in a window give no equation."""
_GAP_MAX: Final = 4.5
"""Periods without a sample that a window bears."""
_CONFIDENCE: Final = 2.0
"""Standard errors that are reported as the uncertainty."""


@dataclass(frozen=True, slots=True)
class Mechanics:
    """What turns, with twice the standard error of each figure."""

    inertia_kg_m2: float
    viscous_friction_nm_s: float
    coulomb_friction_nm: float
    offset_nm: float
    """Torque that pushes towards negative positions whichever way the shaft turns."""
    inertia_error: float
    viscous_error: float
    coulomb_error: float
    equations: int
    residual_nm: float
    """Root mean square of what the model leaves of a window's mean torque."""

    def friction_nm(self, speed_rad_s: float) -> float:
        """Friction at a speed, both kinds."""
        if speed_rad_s == 0.0:
            return 0.0
        return self.viscous_friction_nm_s * speed_rad_s + math.copysign(self.coulomb_friction_nm, speed_rad_s)


class NotIdentifiable(Exception):
    """The records hold too little motion for a figure."""


def identify_mechanics(
    records: list[tuple[Array, Array, Array]],
    window_s: float = 0.1,
    speed_min_rad_s: float = 0.0,
    with_viscous: bool = True,
    with_offset: bool = True,
    held_s: float | None = None,
) -> Mechanics:
    """Fit J, B, T_c and T_0 to ``records`` of (time s, position rad, torque N m).

    Windows in which the speed comes below ``speed_min_rad_s`` or changes its sign say nothing of sliding
    friction and are left out. ``held_s``: for torques that are held from command to command, how long after
    a sample the next one acts, so that a sample's torque acted since the sample before; None for torques that
    change by themselves, which are joined by straight lines. Raises NotIdentifiable.
    """
    rows: list[list[float]] = []
    torques: list[float] = []
    for time, position, torque in records:
        _equations(time, position, torque, window_s, speed_min_rad_s, held_s, rows, torques)
    columns = [0, 2] + ([1] if with_viscous else []) + ([3] if with_offset else [])
    if len(rows) < 2 * len(columns):
        raise NotIdentifiable(f"{len(rows)} usable windows of {window_s:g} s")
    matrix, right = np.array(rows)[:, columns], np.array(torques)
    scale = np.linalg.norm(matrix, axis=0)
    if np.any(scale == 0.0):
        raise NotIdentifiable("the motion excites too little")
    found, _, rank, _ = np.linalg.lstsq(matrix / scale, right, rcond=1e-9)
    if rank < len(columns):
        raise NotIdentifiable("friction and inertia cannot be told apart in this motion")
    residual = right - (matrix / scale) @ found
    variance = float(residual @ residual) / max(1, len(rows) - len(columns))
    covariance = variance * np.linalg.inv((matrix / scale).T @ (matrix / scale))
    values = np.zeros(4)
    errors = np.zeros(4)
    for place, column in enumerate(columns):
        values[column] = found[place] / scale[place]
        errors[column] = _CONFIDENCE * math.sqrt(covariance[place, place]) / scale[place]
    return Mechanics(
        inertia_kg_m2=float(values[0]),
        viscous_friction_nm_s=float(values[1]),
        coulomb_friction_nm=float(values[2]),
        offset_nm=float(values[3]),
        inertia_error=float(errors[0]),
        viscous_error=float(errors[1]),
        coulomb_error=float(errors[2]),
        equations=len(rows),
        residual_nm=math.sqrt(variance),
    )


def _equations(
    time: Array,
    position: Array,
    torque: Array,
    window_s: float,
    speed_min: float,
    held_s: float | None,
    rows: list[list[float]],
    torques: list[float],
) -> None:
    """One equation for each window, a quarter of a window apart; each is divided by int(phi)."""
    half = window_s / 2.0
    if len(time) < _SAMPLES_MIN:
        return
    usual = float(np.median(np.diff(time)))
    centre = float(time[0]) + half
    while centre + half <= time[-1]:
        low, high = np.searchsorted(time, (centre - half, centre + half))
        if high - low >= _SAMPLES_MIN and not _has_gap(time[low:high], usual):
            _equation(
                time[low:high] - centre,
                position[low:high],
                torque[low:high],
                half,
                speed_min,
                held_s,
                rows,
                torques,
            )
        centre += half / 2.0


def _has_gap(time: Array, usual: float) -> bool:
    """So many samples in a row are missing that nobody knows what the torque was."""
    return bool(np.max(np.diff(time)) > _GAP_MAX * usual)


def _equation(
    t: Array,
    position: Array,
    torque: Array,
    half: float,
    speed_min: float,
    held_s: float | None,
    rows: list[list[float]],
    torques: list[float],
) -> None:
    speed = _speed(t, position)
    slowest = float(np.min(np.abs(speed)))
    if slowest <= speed_min or np.min(speed) * np.max(speed) <= 0.0:
        return
    # Between samples the position is taken for a straight line; then the integrals are sums of differences,
    # and what a line leaves out of a constant acceleration drops out of them.
    x = t / half
    x[0], x[-1] = -1.0, 1.0
    phi = (1.0 - x * x) ** _POWER
    area = half * _antiderivative(x)
    slopes = np.diff(position) / np.diff(t)
    weight = float(area[-1] - area[0])
    rows.append(
        [
            -float(slopes @ np.diff(phi)) / weight,
            float(slopes @ np.diff(area)) / weight,
            math.copysign(1.0, float(position[-1] - position[0])),
            1.0,
        ]
    )
    if held_s is None:
        between = 0.5 * (torque[1:] + torque[:-1])
    else:
        between = torque[1:]
        area = half * _antiderivative(np.clip((t + held_s) / half, -1.0, 1.0))
    torques.append(float(between @ np.diff(area)) / float(area[-1] - area[0]))


def _antiderivative(x: Array) -> Array:
    """Of phi."""
    y = x * x
    return np.asarray(x * (1.0 + y * (-4.0 / 3.0 + y * (6.0 / 5.0 + y * (-4.0 / 7.0 + y / 9.0)))))


def _speed(t: Array, position: Array) -> Array:
    """Speed in the window by a cubic through the positions: enough to see its sign."""
    return np.asarray(np.polyval(np.polyder(np.polyfit(t, position, 3)), t))


def ratio_of(velocity_time: Array, velocity: Array, position: Array) -> float:
    """Velocity over position derivative, from rest to rest: the integral over the path. NaN without a path.

    Signed: negative if the two count against each other.
    """
    change = np.diff(position)
    integral = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(velocity_time)
    # Forwards and backwards are weighed by their own direction, so a way there and back counts in full.
    direction = np.sign(np.convolve(change, np.ones(25) / 25.0, mode="same"))
    path = float(np.sum(direction * change))
    return float(np.sum(direction * integral)) / path if path else math.nan


_PLAIN: Final = tuple(
    sorted(
        {
            base * 10.0**exponent
            for exponent in range(-6, 7)
            for base in (1.0, 2.0, 4.0, 5.0, 2.5, 8.0, 1.25, 60.0, 1.0 / 60.0, math.tau, 1.0 / math.tau)
        }
    )
)


def plain_ratio(ratio: float, tolerance: float = 0.02) -> float:
    """The power of ten, of two or the change of unit that ``ratio`` (> 0) stands for, if one is near."""
    best = min(_PLAIN, key=lambda plain: abs(math.log(ratio / plain)))
    return best if abs(ratio / best - 1.0) <= tolerance else ratio
