"""What a rotor tells that follows a turning field: pole pairs, direction, friction's lag, and how far the
angle that its drive commutates by is off.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.hil.commissioning.findings import StepFailed

Array = NDArray[np.float64]

_WHOLE: Final = 0.2
"""By which the pole pairs found may miss a whole number."""
_LAG_MAX_DEG: Final = 50.0
"""Friction takes 77 % of the torque then; a rotor that lags by 90 degrees slips."""
_SPREAD_MAX_DEG: Final = 30.0
"""Of the rotor about its line; a rotor that slips is anywhere."""
_QUARTER_RAD: Final = 0.5 * math.pi


class Sweep(NamedTuple):
    """The rotor while the field is turned one way, behind the run-in."""

    field_rad: Array
    """60EAh, (n,)."""
    shaft_rad: Array
    """6064h, (n,)."""
    told_rad: Array
    """The angle by which the drive commutates, (n,); NaN where it does not tell it."""


class Alignment(NamedTuple):
    """What two sweeps tell."""

    pole_pairs: int
    rises: bool
    """The rotor's electrical angle rises with the encoder's."""
    lag_deg: float
    """Of the rotor behind the field, by friction, electrical."""
    ahead_deg: float | None
    """Of the angle that the drive takes for the rotor's, beyond the rotor's; None: it does not tell it."""


def judged(there: Sweep, back: Sweep, up: float) -> Alignment:
    """Compare the rotor with the field; ``up``: -1 for positions that fall as the encoder's count rises.
    Raises StepFailed for a rotor that does not follow."""
    slope = 0.5 * sum(float(np.polyfit(each.field_rad, each.shaft_rad, 1)[0]) for each in (there, back))
    pairs = math.inf if slope == 0.0 else 1.0 / abs(slope)
    whole = round(min(pairs, 1e6))
    evidence = f"an electrical turn of the field turned it by {slope:+.4f} turns"
    if not 0 < whole < 1000 or abs(pairs - whole) > _WHOLE:
        raise StepFailed(
            "the rotor does not follow the field",
            evidence,
            "is it held, is the torque too small for its friction, or the position's unit wrong?",
        )
    sign = math.copysign(1.0, slope)
    behind = [each.field_rad + _QUARTER_RAD - sign * whole * each.shaft_rad for each in (there, back)]
    means = [_mean_angle(each) for each in behind]
    spread = max(
        math.degrees(float(np.std(_near(each, mean)))) for each, mean in zip(behind, means, strict=True)
    )
    lag_deg = 0.5 * math.degrees(_wrapped(means[0] - means[1]))
    if spread > _SPREAD_MAX_DEG or abs(lag_deg) > _LAG_MAX_DEG:
        raise StepFailed(
            "the rotor slips in the field",
            f"{evidence}; it lags by {lag_deg:.0f} electrical degrees, +- {spread:.0f}",
            "the torque is too small for its friction or load (--torque-max-percent)",
        )
    if np.isnan(there.told_rad).any():
        return Alignment(whole, slope * up > 0.0, lag_deg, None)
    told = [np.unwrap(each.told_rad) for each in (there, back)]
    rises = sum(float(line[-1] - line[0]) * way for line, way in zip(told, (1.0, -1.0), strict=True)) > 0.0
    ahead = [
        _mean_angle(line - each.field_rad - _QUARTER_RAD)
        for line, each in zip(told, (there, back), strict=True)
    ]
    middle = ahead[0] + 0.5 * _wrapped(ahead[1] - ahead[0])
    return Alignment(whole, rises, lag_deg, math.degrees(_wrapped(middle)))


def _mean_angle(angles_rad: Array) -> float:
    return float(np.angle(np.mean(np.exp(1j * angles_rad))))


def _near(angles_rad: Array, mean_rad: float) -> Array:
    return np.asarray(np.angle(np.exp(1j * (angles_rad - mean_rad))))


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)
