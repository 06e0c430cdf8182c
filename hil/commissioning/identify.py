"""Inertia and friction of a shaft from sampled position and torque, by weighted integrals.

    J domega/dt = T - B omega - T_c sign(omega) - T_0

Multiplied with a test function phi that vanishes with its derivative at both ends of a window, and integrated
by parts, it holds for the position itself:

    - J int(phi' dtheta) + B int(phi dtheta) + T_c int(phi sign omega) + T_0 int(phi) = int(phi T)

So no sample is differentiated twice, and an encoder's steps average out. Each window gives one equation; all
of them are solved together by least squares. The samples need not be evenly spaced: lost ones are just
missing. T_0 takes what a load or gravity adds in one direction.

A torque dated wrongly by tau leaves tau dT/dt, which over ramps looks like viscous friction (tau J a' against
B omega: with J/B of seconds, 50 us are percents of B). So tau is fitted as well, from - int(phi' T).

Uncertainty. Neighbouring windows overlap, and friction or ripple that the model lacks lasts longer than one:
the residuals are correlated, not white. The covariance is that of the jackknife over blocks of windows
(Quenouille 1956, Kuensch 1989). An error that repeats in every window shows in no residual; it is added:
``_UNSEEN``. Stated are expanded uncertainties, k = 2. The accuracy of 6076h is in none of them: every figure
is in proportion to it.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POWER: Final = 4
"""phi = (1 - x^2)^4 on -1..1."""
_SAMPLES_MIN: Final = 12
"""Fewer in a window give no equation."""
_GAP_MAX: Final = 4.5
"""Periods without a sample that a window tolerates."""
COVERAGE_FACTOR: Final = 2.0
"""k: factor from standard to expanded uncertainties."""
_BLOCK: Final = 12
"""Equations, a quarter of a window apart, of a block: three windows, so that two have little in common."""
_UNSEEN: Final = (0.02, 0.012)
"""Units of 6077h, 0.1 % of the rating: standard uncertainty of what its readings differ from the mean torque
in the same way in every window, at the top speed and at the ramps' torque. A voltage that stands still for a
period of the inverter while the rotor turns makes a torque that its sample at the start does not show, and
which grows with the square of the speed; a current that follows a ramp is late. Both sizes are what the
simulated drives of the seeds 0 to 59 were off, root mean square. What was made of them was then looked at
over the seeds 60 to 159, so only seeds from 200 on are held out: docs/commissioning.md has their coverage."""


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Mechanical data, with the expanded uncertainty (k = 2) of each figure."""

    inertia_kg_m2: float
    viscous_friction_nm_s: float
    coulomb_friction_nm: float
    offset_nm: float
    """Torque towards negative positions in both directions of rotation."""
    inertia_error: float
    viscous_error: float
    coulomb_error: float
    equations: int
    residual_nm: float
    """Root mean square of the residual of a window's mean torque."""
    torque_shift_s: float = 0.0
    """Delay of the torque relative to its assumed instant."""

    def friction_nm(self, speed_rad_s: float) -> float:
        """Return the friction at a speed, both kinds."""
        if speed_rad_s == 0.0:
            return 0.0
        return self.viscous_friction_nm_s * speed_rad_s + math.copysign(self.coulomb_friction_nm, speed_rad_s)


class NotIdentifiable(Exception):
    """The records hold too little motion for a figure."""


_INERTIA, _VISCOUS, _COULOMB, _OFFSET, _SHIFT, _TORQUE = range(6)
"""Columns of an equation; the last is its right side."""


def identify_mechanics(
    records: list[tuple[Array, Array, Array]],
    window_s: float = 0.1,
    speed_min_rad_s: float = 0.0,
    with_viscous: bool = True,
    with_offset: bool = True,
    held_s: float | None = None,
    with_shift: bool = False,
    torque_unit_nm: float = 0.0,
) -> Mechanics:
    """Fit J, B, T_c and T_0 to ``records`` of (time s, position rad, torque N m).

    Windows in which the speed comes below ``speed_min_rad_s`` or changes its sign say nothing about sliding
    friction and are left out. ``held_s``: for torques that are held from command to command, how long after a
    sample the next one acts, so that a sample's torque acted since the sample before; None for torques that
    change by themselves, which are joined by straight lines. ``with_shift``: fit the error of that instant,
    too. ``torque_unit_nm``: one raw unit of the torque. Raises NotIdentifiable.
    """
    parts = [_equations(*record, window_s, speed_min_rad_s, held_s) for record in records]
    parts = [part for part in parts if len(part)]
    chosen = {_VISCOUS: with_viscous, _OFFSET: with_offset, _SHIFT: with_shift}
    columns = [column for column in range(_TORQUE) if chosen.get(column, True)]
    count = sum(len(part) for part in parts)
    if count < 2 * len(columns):
        raise NotIdentifiable(f"{count} usable windows of {window_s:g} s")
    stacked = np.vstack(parts)
    matrix, right = stacked[:, columns], stacked[:, _TORQUE]
    scale = np.linalg.norm(matrix, axis=0)
    if np.any(scale == 0.0):
        raise NotIdentifiable("the motion excites too little")
    matrix = matrix / scale
    solution, _, rank, _ = np.linalg.lstsq(matrix, right, rcond=1e-9)
    if rank < len(columns):
        raise NotIdentifiable("friction and inertia cannot be told apart in this motion")
    residual = right - matrix @ solution
    inverse = np.linalg.inv(matrix.T @ matrix)
    covariance = _covariance(matrix, residual, [len(part) for part in parts])
    covariance += _unseen(stacked, solution[0] / scale[0], torque_unit_nm, inverse @ matrix.T)
    values, errors = np.zeros(_TORQUE), np.zeros(_TORQUE)
    values[columns] = solution / scale
    errors[columns] = COVERAGE_FACTOR * np.sqrt(np.diag(covariance)) / scale
    return Mechanics(
        inertia_kg_m2=float(values[_INERTIA]),
        viscous_friction_nm_s=float(values[_VISCOUS]),
        coulomb_friction_nm=float(values[_COULOMB]),
        offset_nm=float(values[_OFFSET]),
        inertia_error=float(errors[_INERTIA]),
        viscous_error=float(errors[_VISCOUS]),
        coulomb_error=float(errors[_COULOMB]),
        equations=count,
        residual_nm=math.sqrt(float(residual @ residual) / (count - len(columns))),
        torque_shift_s=float(-values[_SHIFT]),
    )


def _covariance(matrix: Array, residual: Array, lengths: list[int]) -> Array:
    """Return the covariance of the solution, by the jackknife: its change when each block of equations is
    left out."""
    normal = matrix.T @ matrix
    total = np.zeros_like(normal)
    blocks = begin = 0
    for length in lengths:
        edges = begin + np.linspace(0, length, max(1, round(length / _BLOCK)) + 1).astype(int)
        for low, high in itertools.pairwise(edges):
            part = matrix[low:high]
            change = np.linalg.lstsq(normal - part.T @ part, part.T @ residual[low:high], rcond=1e-9)[0]
            total += np.outer(change, change)
        blocks += len(edges) - 1
        begin += length
    return np.asarray(total * (blocks - 1) / blocks) if blocks > 1 else np.full_like(total, math.inf)


def _unseen(equations: Array, inertia: float, unit_nm: float, solving: Array) -> Array:
    """Return the covariance of the solution by torque errors common to all windows: one that grows with
    the square of the speed, one in proportion to the torque of acceleration. ``solving``: (unknowns,
    equations)."""
    speed = np.abs(equations[:, _VISCOUS])
    direction = equations[:, _COULOMB]
    ramp = inertia * equations[:, _INERTIA]
    total = np.zeros((len(solving), len(solving)))
    shapes = (direction * speed**2 / np.max(speed) ** 2, ramp / math.sqrt(np.mean(ramp**2)))
    for units, shape in zip(_UNSEEN, shapes, strict=True):
        effect = solving @ (units * unit_nm * shape)
        total += np.outer(effect, effect)
    return total


def _equations(
    time: Array, position: Array, torque: Array, window_s: float, speed_min: float, held_s: float | None
) -> Array:
    """Return one equation per window, a quarter of a window apart; each is divided by int(phi)."""
    half = window_s / 2.0
    rows: list[list[float]] = []
    if len(time) < _SAMPLES_MIN:
        return np.zeros((0, _TORQUE + 1))
    usual = float(np.median(np.diff(time)))
    told_at, torque = _filled(time, torque, usual)
    centre = float(time[0]) + half
    while centre + half <= time[-1]:
        low, high = np.searchsorted(time, (centre - half, centre + half))
        first, last = np.searchsorted(told_at, (centre - half, centre + half))
        if high - low >= _SAMPLES_MIN and not _has_gap(time[low:high], usual):
            rows += _equation(
                time[low:high] - centre, position[low:high],
                told_at[first:last] - centre, torque[first:last], half, speed_min, held_s,
            )  # fmt: skip
        centre += half / 2.0
    return np.array(rows).reshape(-1, _TORQUE + 1)


def _has_gap(time: Array, usual: float) -> bool:
    """Return True if so many samples in a row are missing that the torque is unknown."""
    return bool(np.max(np.diff(time)) > _GAP_MAX * usual)


def _filled(time: Array, torque: Array, usual: float) -> tuple[Array, Array]:
    """Interpolate missing times and torques: a torque is held for one period, and the torque during a lost
    reading is nearer to the mean of its neighbours than to the next one."""
    place = np.concatenate([[0.0], np.cumsum(np.maximum(1.0, np.round(np.diff(time) / usual)))])
    every = np.arange(place[-1] + 1.0)
    return np.interp(every, place, time), np.interp(every, place, torque)


def _equation(
    t: Array, position: Array, told_at: Array, torque: Array, half: float, speed_min: float,
    held_s: float | None,
) -> list[list[float]]:  # fmt: skip
    """Return the equation of one window, or none."""
    speed = _speed(t, position)
    slowest = float(np.min(np.abs(speed)))
    if slowest <= speed_min or np.min(speed) * np.max(speed) <= 0.0:
        return []
    # Between samples the position is taken for a straight line; then the integrals are sums of differences,
    # and what a line leaves out of a constant acceleration drops out of them.
    x = t / half
    x[0], x[-1] = -1.0, 1.0
    phi = (1.0 - x * x) ** _POWER
    area = half * _antiderivative(x)
    slopes = np.diff(position) / np.diff(t)
    weight = float(area[-1] - area[0])
    inertia, viscous = -float(slopes @ np.diff(phi)) / weight, float(slopes @ np.diff(area)) / weight
    direction = math.copysign(1.0, float(position[-1] - position[0]))
    between = 0.5 * (torque[1:] + torque[:-1]) if held_s is None else torque[1:]
    x = np.clip((told_at + (held_s or 0.0)) / half, -1.0, 1.0)
    if held_s is None:
        x[0], x[-1] = -1.0, 1.0
    phi, area = (1.0 - x * x) ** _POWER, half * _antiderivative(x)
    weight = float(area[-1] - area[0])
    shift = float(between @ np.diff(phi)) / weight
    return [[inertia, viscous, direction, 1.0, shift, float(between @ np.diff(area)) / weight]]


def _antiderivative(x: Array) -> Array:
    """Return the antiderivative of phi."""
    y = x * x
    return np.asarray(x * (1.0 + y * (-4.0 / 3.0 + y * (6.0 / 5.0 + y * (-4.0 / 7.0 + y / 9.0)))))


def _speed(t: Array, position: Array) -> Array:
    """Return the speed in the window by a cubic through the positions: enough to see its sign."""
    return np.asarray(np.polyval(np.polyder(np.polyfit(t, position, 3)), t))


def slope_error(across: Array, along: Array, blocks: int = 12) -> float:
    """Return the standard uncertainty of the slope of ``along`` over ``across``, (n,) in the order of time.

    By the jackknife over blocks, as neighbouring residuals are correlated.
    """
    slopes = np.array(
        [
            np.polyfit(np.delete(across, block), np.delete(along, block), 1)[0]
            for block in np.array_split(np.arange(len(across)), blocks)
        ]
    )
    return math.sqrt((blocks - 1) * float(slopes.var()))


class SpeedRatio(NamedTuple):
    """Velocity over the derivative of the position; negative if the two count against each other."""

    value: float
    """NaN without a path."""
    error: float
    """Relative expanded uncertainty, k = 2."""


def ratio_of(records: Sequence[tuple[Array, Array, Array]], blocks: int = 12) -> SpeedRatio:
    """Return the ratio from (time, velocity, position) from rest to rest: the integrals of the velocity over
    the paths.

    The uncertainty is the jackknife's over blocks: the error that an encoder's steps and noise leave in the
    integral.
    """
    paths, integrals = [], []
    for time, velocity, position in records:
        change = np.diff(position)
        integral = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)
        # Forwards and backwards are weighed by their own direction, so a way there and back counts in full.
        direction = np.sign(np.convolve(change, np.ones(25) / 25.0, mode="same"))
        paths += [float(part.sum()) for part in np.array_split(direction * change, blocks)]
        integrals += [float(part.sum()) for part in np.array_split(direction * integral, blocks)]
    path, integral = np.array(paths), np.array(integrals)
    if not path.sum():
        return SpeedRatio(math.nan, math.inf)
    value = float(integral.sum() / path.sum())
    without = (integral.sum() - integral) / (path.sum() - path)
    error = COVERAGE_FACTOR * math.sqrt((len(path) - 1) * float(np.mean((without - value) ** 2)))
    return SpeedRatio(value, error / abs(value) if value else math.inf)


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
    """Return the power of ten, of two or the change of unit near ``ratio`` (> 0), if there is one."""
    best = min(_PLAIN, key=lambda plain: abs(math.log(ratio / plain)))
    return best if abs(ratio / best - 1.0) <= tolerance else ratio
