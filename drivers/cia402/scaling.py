"""Conversion between raw drive units with their signs and SI, the only place for it. Factors come from the
drive's objects, or from overrides.

    position      60A8h in turns, else 6092h (feed), else 6093h, else 608Fh
    velocity      60A9h, else 6094h, else 6096h, else position units per second
    acceleration  60AAh, else 6097h, else velocity units per second
    jerk          60ABh, else acceleration units per second
    torque        thousandths of 6076h

An override of a position unit that rests on increments (608Fh) changes the increment too: every value that
the drive states in increments (6094h, 6097h, its maker's units) follows. 608Fh with less than four increments
per turn is an unset factory value of 1/1: 6090h is read then.

Positions, speeds and accelerations here are those of the motor shaft. Turns in a unit word, and the feed, are
those of the driving shaft behind the gear 6091h.
Sources: CiA 402-2 clause 8 (factor group), CiA 303-2 (unit codes). 6093h and 6094h are of DSP 402 version 2;
a drive that has 6094h means 6097h as that version does, in increments.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.cia402.objects402 import Object, Unit, unit_parts
from servobench.drivers.errors import PeerFault
from servobench.drivers.rotation import RAD_PER_REVOLUTION, RAD_S_PER_RPM


@dataclass(eq=False)
class UnitNotTold(PeerFault):
    """The objects of a drive do not define one of its units."""

    unit: str = ""
    """torque, position, velocity or acceleration."""


ObjectValues = Mapping[tuple[int, int], int | None]
"""(index, sub) -> value; None or absent if the drive does not have it."""

_RATIOS = (
    Object.POSITION_ENCODER_RESOLUTION,
    Object.GEAR_RATIO,
    Object.FEED_CONSTANT,
    Object.VELOCITY_ENCODER_RESOLUTION,
    Object.POSITION_FACTOR,
    Object.VELOCITY_ENCODER_FACTOR,
    Object.VELOCITY_FACTOR,
    Object.ACCELERATION_FACTOR,
)
_UNIT_WORDS = (
    Object.SI_UNIT_POSITION,
    Object.SI_UNIT_VELOCITY,
    Object.SI_UNIT_ACCELERATION,
    Object.SI_UNIT_JERK,
)
FACTOR_OBJECTS: tuple[tuple[int, int], ...] = (
    (Object.MOTOR_RATED_TORQUE, 0),
    (Object.MOTOR_RATED_CURRENT, 0),
    *((index, sub) for index in _RATIOS for sub in (1, 2)),
    *((index, 0) for index in _UNIT_WORDS),
)
"""Objects read by :func:`scaling_from`."""

ENCODER_COUNTS_MIN: Final = 4
"""Increments per encoder line by quadrature: no encoder has fewer per turn."""
_TURNS_PER_UNIT = {
    Unit.REVOLUTION: 1.0,
    Unit.RADIAN: 1.0 / RAD_PER_REVOLUTION,
    Unit.DEGREE: 1.0 / 360.0,
}
_TURNING = frozenset({*_TURNS_PER_UNIT, Unit.REVOLUTION_PER_MINUTE})
_SECONDS_PER_UNIT = {Unit.SECOND: 1.0, Unit.MINUTE: 60.0, Unit.HOUR: 3600.0}
_POWERED_SECONDS = {Unit.SQUARE_SECOND: 2, Unit.CUBIC_SECOND: 3}


@dataclass(frozen=True, slots=True)
class ScaleOverride:
    """Factors and signs that the user knows better than the drive; None: believe the drive."""

    position_rad: float | None = None
    """rad of one raw position unit."""
    velocity_rad_s: float | None = None
    """rad/s of one raw velocity unit."""
    acceleration_rad_s2: float | None = None
    """rad/s^2 of one raw acceleration unit."""
    rated_torque_nm: float | None = None
    velocity_sign: float = 1.0
    """-1: the drive's velocity counts against its position."""
    torque_sign: float = 1.0
    """-1: positive torque of the drive turns its position down."""


@dataclass(frozen=True, slots=True)
class Scaling:
    """SI value = raw value times factor; for velocity and torque times their sign too.

    Factors are positive: limits and ramps of a drive have no sign.
    """

    position_rad: float
    velocity_rad_s: float
    acceleration_rad_s2: float
    rated_torque_nm: float
    torque_nm: float
    """N m of one raw torque unit, a thousandth of the rated torque."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """The object on which each factor rests, for a report."""
    notes: tuple[str, ...] = ()
    """Remarks on the factors."""
    jerk_rad_s3: float = 0.0
    """rad/s^3 of one raw jerk unit; 0 if not read."""
    rated_current_a: float | None = None
    """Reference of per-thousand currents, 0x6075; None if the drive has none."""
    gear_ratio: float = 1.0
    """Motor revolutions per revolution of the driving shaft, 0x6091."""
    velocity_sign: float = 1.0
    """See :class:`ScaleOverride`: no object of a drive holds it."""
    torque_sign: float = 1.0

    def torque_raw(self, torque_nm: float) -> int:
        """Return the nearest raw torque."""
        return round(self.torque_sign * torque_nm / self.torque_nm)

    def velocity_raw(self, velocity_rad_s: float) -> int:
        """Return the nearest raw velocity."""
        return round(self.velocity_sign * velocity_rad_s / self.velocity_rad_s)


def scaling_from(values: ObjectValues, override: ScaleOverride | None = None) -> Scaling:
    """Work out the factors. Raises UnitNotTold if the drive's objects and the override are not enough."""
    given = override or ScaleOverride()
    sources: dict[str, str] = {}

    def choose(
        name: str, overridden: float | None, derive: Callable[[], tuple[float, str] | None], remedy: str
    ) -> float:
        chosen = (overridden, "override") if overridden is not None else derive()
        if chosen is None or not (math.isfinite(chosen[0]) and chosen[0] > 0.0):
            raise UnitNotTold(f"the drive does not tell its {name} unit", "", remedy, unit=name)
        sources[name] = chosen[1]
        return chosen[0]

    rated = choose("torque", given.rated_torque_nm, lambda: _rated_torque(values), "give its rated torque")
    position = choose("position", given.position_rad, lambda: _position(values), "give rad per position unit")
    increment = increment_of(values, given.position_rad)
    velocity = choose(
        "velocity",
        given.velocity_rad_s,
        lambda: _velocity(values, position, increment),
        "give rad/s per velocity unit",
    )
    acceleration = choose(
        "acceleration",
        given.acceleration_rad_s2,
        lambda: _acceleration(values, position, velocity, increment),
        "give rad/s^2 per acceleration unit",
    )
    jerk, sources["jerk"] = _jerk(values, position, acceleration)
    raw_ma = values.get((Object.MOTOR_RATED_CURRENT, 0))
    return Scaling(
        position,
        velocity,
        acceleration,
        rated,
        rated / 1000.0,
        sources,
        jerk_rad_s3=jerk,
        rated_current_a=raw_ma / 1000.0 if raw_ma else None,
        gear_ratio=_gear(values)[0],
        velocity_sign=given.velocity_sign,
        torque_sign=given.torque_sign,
    )


def _ratio(values: ObjectValues, index: int) -> float | None:
    """Return sub 1 over sub 2, both positive; None if the object is missing or not set."""
    numerator, denominator = values.get((index, 1)), values.get((index, 2))
    if not numerator or not denominator or numerator < 0 or denominator < 0:
        return None
    return numerator / denominator


def _rated_torque(values: ObjectValues) -> tuple[float, str] | None:
    raw_mnm = values.get((Object.MOTOR_RATED_TORQUE, 0))
    return (raw_mnm / 1000.0, "6076h") if raw_mnm else None


def _gear(values: ObjectValues) -> tuple[float, str]:
    """Return motor revolutions per revolution of the driving shaft, and their source."""
    ratio = _ratio(values, Object.GEAR_RATIO)
    return (1.0, "") if ratio is None or ratio == 1.0 else (ratio, ", 6091h")


def _turn_rad(values: ObjectValues) -> tuple[float, str] | None:
    """Return rad of the motor shaft per encoder increment, by its resolution."""
    position, velocity = (
        _ratio(values, index)
        for index in (Object.POSITION_ENCODER_RESOLUTION, Object.VELOCITY_ENCODER_RESOLUTION)
    )
    if velocity is not None and (position is None or position < ENCODER_COUNTS_MIN <= velocity):
        why = "no 608Fh" if position is None else f"608Fh is {position:g}"
        return RAD_PER_REVOLUTION / velocity, f"6090h ({why})"
    return None if position is None else (RAD_PER_REVOLUTION / position, "608Fh")


def increment_of(values: ObjectValues, position_rad: float | None) -> tuple[float, str] | None:
    """Return rad of the motor shaft per increment, and its source. ``position_rad``: the position unit, if
    known better than from the drive."""
    if position_rad is None or _position_in_units(values) is not None:
        return _turn_rad(values)
    return position_rad / (_ratio(values, Object.POSITION_FACTOR) or 1.0), "the position unit"


def _position(values: ObjectValues) -> tuple[float, str] | None:
    """Return rad of the motor shaft per position unit."""
    in_units = _position_in_units(values)
    if in_units is not None:
        return in_units
    increment = _turn_rad(values)
    if increment is None:
        return None
    factor = _ratio(values, Object.POSITION_FACTOR)
    if factor is not None and factor != 1.0:
        # DSP 402: increments = position in user units, times 6093h.
        return increment[0] * factor, f"6093h, {increment[1]}"
    return increment


def _position_in_units(values: ObjectValues) -> tuple[float, str] | None:
    """Return rad of the motor shaft per position unit if it does not rest on increments."""
    gear, by_gear = _gear(values)
    word = values.get((Object.SI_UNIT_POSITION, 0))
    if word:
        exponent, numerator, _ = unit_parts(word)
        turns = _TURNS_PER_UNIT.get(Unit(numerator)) if _is_unit(numerator) else None
        if turns is not None:
            return RAD_PER_REVOLUTION * gear * turns * 10.0**exponent, f"60A8h{by_gear}"
    feed = _ratio(values, Object.FEED_CONSTANT)
    # A feed constant of 1 is a factory default that nobody set: whole turns are no unit of position.
    if feed is not None and feed != 1.0:
        return RAD_PER_REVOLUTION * gear / feed, "6092h, 6091h"
    return None


def _velocity(
    values: ObjectValues, position_rad: float, increment: tuple[float, str] | None
) -> tuple[float, str] | None:
    """Return rad/s per velocity unit; position units per second by default."""
    rate = _told_rate(values, Object.SI_UNIT_VELOCITY, position_rad, power=1)
    if rate is not None:
        return rate
    factor = _ratio(values, Object.VELOCITY_ENCODER_FACTOR)
    if factor is not None and increment is not None:
        # DSP 402: increments per second = velocity in user units, times 6094h.
        return increment[0] * factor, f"6094h, {increment[1]}"
    factor = _ratio(values, Object.VELOCITY_FACTOR)
    if factor is not None:
        # CiA 402-2: velocity in user units = velocity in position units per second, times 6096h.
        return position_rad / factor, "6096h"
    return position_rad, "position unit per second (no 60A9h)"


def _acceleration(
    values: ObjectValues, position_rad: float, velocity_rad_s: float, increment: tuple[float, str] | None
) -> tuple[float, str] | None:
    """Return rad/s^2 per acceleration unit; velocity units per second by default."""
    rate = _told_rate(values, Object.SI_UNIT_ACCELERATION, position_rad, power=2)
    if rate is not None:
        return rate
    factor = _ratio(values, Object.ACCELERATION_FACTOR)
    of_dsp_402 = _ratio(values, Object.VELOCITY_ENCODER_FACTOR) is not None
    if factor is not None and of_dsp_402 and increment is not None:
        # DSP 402: increments per second squared = acceleration in user units, times 6097h.
        return increment[0] * factor, f"6097h, {increment[1]}"
    if factor is not None and not of_dsp_402:
        # As 6096h: acceleration in user units = position units per second squared, times 6097h.
        return position_rad / factor, "6097h"
    return velocity_rad_s, "velocity unit per second (no 60AAh)"


def _jerk(values: ObjectValues, position_rad: float, acceleration_rad_s2: float) -> tuple[float, str]:
    """Return rad/s^3 per jerk unit; acceleration units per second without a unit word."""
    rate = _told_rate(values, Object.SI_UNIT_JERK, position_rad, power=3)
    return rate or (acceleration_rad_s2, "acceleration unit per second (no 60ABh)")


def _told_rate(
    values: ObjectValues, unit_word: Object, position_rad: float, power: int
) -> tuple[float, str] | None:
    """Return rad/s^power by a unit word; None if it is not set, or unknown here."""
    word = values.get((unit_word, 0))
    rate = _rate(word, values, position_rad, power) if word else None
    if not word or rate is None:
        return None
    if unit_parts(word)[1] in _TURNING:  # turns of the driving shaft
        gear, by_gear = _gear(values)
        return rate * gear, f"{unit_word:04X}h{by_gear}"
    return rate, f"{unit_word:04X}h"


def _rate(word: int, values: ObjectValues, position_rad: float, power: int) -> float | None:
    """Return rad/s^power of one unit of a unit word, without gear; None if it uses unknown codes."""
    exponent, numerator, denominator = unit_parts(word)
    if not _is_unit(numerator) or not _is_unit(denominator):
        return None
    scale = 10.0**exponent
    unit = Unit(numerator)
    if unit is Unit.REVOLUTION_PER_MINUTE:
        powered = _POWERED_SECONDS.get(Unit(denominator)) == power - 1
        seconds = 1.0 if powered else _SECONDS_PER_UNIT.get(Unit(denominator), 1.0)
        return scale * RAD_S_PER_RPM / seconds ** (power - 1)
    powered = _POWERED_SECONDS.get(Unit(denominator)) == power
    seconds = 1.0 if powered else _SECONDS_PER_UNIT.get(Unit(denominator), 0.0)
    if not seconds:
        return None
    turns = _TURNS_PER_UNIT.get(unit)
    if turns is not None:
        return scale * RAD_PER_REVOLUTION * turns / seconds**power
    if unit is Unit.METRE:
        metre_rad = _metre_rad(values, position_rad)
        return None if metre_rad is None else scale * metre_rad / seconds**power
    return scale * position_rad / seconds**power if unit is Unit.INCREMENT else None


def _metre_rad(values: ObjectValues, position_rad: float) -> float | None:
    """Return rad of the motor shaft per metre, for a drive whose position unit is a length."""
    word = values.get((Object.SI_UNIT_POSITION, 0))
    exponent, numerator, _ = unit_parts(word or 0)
    return position_rad / 10.0**exponent if numerator == Unit.METRE else None


def _is_unit(code: int) -> bool:
    return code in Unit.__members__.values()
