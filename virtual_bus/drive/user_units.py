"""From the units of the master to encoder counts and rad/s, and back: the factor group of CiA 402-2.

    position unit      60A8h, else 6092h (feed) and 6091h (gear), else 608Fh
    velocity unit      60A9h, else 6096h times position units per second
    acceleration unit  60AAh, else velocity units per second
    jerk unit          60ABh, else acceleration units per second
    607Eh              bit 7 turns the sign of positions, bit 6 that of velocities
    607Bh              positions wrap from its maximum to its minimum, which are one place; where it is no
                       range, as an INTEGER32

The drive reads its own objects by the rules of :mod:`servobench.drivers.cia402.scaling`. Of a unit word and a
factor that say different things the one written last rules: a factor that is written clears the unit word.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object, Unit, unit_parts, unit_word
from servobench.drivers.cia402.quirky_units import apply_quirks
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault
from servobench.drivers.vendors.families import Quirk
from servobench.virtual_bus.core.native import user_position
from servobench.virtual_bus.device.object_dictionary import Access, ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode

POSITION_POLARITY: Final = 0x80
VELOCITY_POLARITY: Final = 0x40

_U8, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED32
_TURNS: Final = (Unit.REVOLUTION, Unit.DEGREE, Unit.RADIAN)
_LENGTHS: Final = (*_TURNS, Unit.INCREMENT)
_PER: Final = (Unit.SECOND, Unit.MINUTE, Unit.HOUR)
_EXPONENTS: Final = range(-9, 10)
"""Nano to giga."""
_MILLI_RPM_PER_REV_S: Final = 60_000
_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_EQUAL: Final = 1e-12
"""Ratios of integers below 2^32, rounded once: a factor of one differs by less, any other by far more."""


class UserUnits:
    """The factors in force, and the objects that set them."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        counts_per_revolution: int,
        may_change: Callable[[], bool],
        makers: Sequence[tuple[str, Quirk]] = (),
    ) -> None:
        """``may_change``: false while the drive is enabled; units then stay as they are (08000022h).
        ``makers``: what objects of the drive mean beside CiA 402-2."""
        self._makers = makers
        self._dictionary = dictionary
        self._may_change = may_change
        self._counts_per_rad = counts_per_revolution / math.tau
        self.origin: float = 0.0
        """Encoder count of the master's position 0."""
        self.counts_per_position = 1.0
        self.rad_s_per_velocity = 1.0
        self.velocity_per_rad_s = 1.0
        self.rad_s2_per_acceleration = 1.0
        self.rad_s3_per_jerk = 1.0
        self.low, self.span, self._half = -_HALF, _WRAP, _HALF
        """The least user position, and how many there are."""
        self.ranged = False
        """By 607Bh."""
        self.changed: Callable[[], None] = lambda: None
        """Called after every change of a factor or of the origin."""
        self._add_factors(counts_per_revolution)
        self._add_unit_words()
        self._add_range()
        self.polarity = dictionary.add(
            Object.POLARITY, "Polarity", _U8, check=self._check_polarity, on_write=self._on_factor
        )

    def take(self) -> None:
        """Read all objects anew, as at power-on."""
        scaling = self._scaling()
        signs = self.polarity.value
        velocity_sign = -1.0 if signs & VELOCITY_POLARITY else 1.0
        counts = scaling.position_rad * self._counts_per_rad
        if abs(counts - 1.0) < _EQUAL:
            counts = 1.0
        self.counts_per_position = -counts if signs & POSITION_POLARITY else counts
        self.rad_s_per_velocity = velocity_sign * scaling.velocity_rad_s
        self.velocity_per_rad_s = 1.0 / self.rad_s_per_velocity
        self.rad_s2_per_acceleration = scaling.acceleration_rad_s2
        self.rad_s3_per_jerk = scaling.jerk_rad_s3
        low, high = int(self.range_min.value), int(self.range_max.value)
        self.ranged = low < high and (low, high) != (-_HALF, _HALF - 1)
        self.low, self.span, self._half = -_HALF, _WRAP, _HALF
        if self.ranged:
            self.low, self.span, self._half = low, high - low, (high - low - 1) // 2

    def set_origin(self, count: float) -> None:
        """The master's position 0 is at that encoder count from now on."""
        self.origin = count
        self.changed()

    # ---- positions ------------------------------------------------------------------------------------

    def position_of(self, count: float) -> int:
        """User position of an encoder count, as it wraps."""
        if self.ranged:
            return self.within(round((count - self.origin) / self.counts_per_position))
        return user_position(count - self.origin, self.counts_per_position)

    def within(self, position: int) -> int:
        """A user position as it wraps."""
        return (position - self.low) % self.span + self.low

    def length_of(self, counts: float) -> int:
        """A difference of counts in position units, the nearest whole one."""
        return round(counts / self.counts_per_position)

    def count_of(self, position: int, near: float) -> float:
        """The encoder count of a user position in that turn of the range in which ``near`` is."""
        units = (near - self.origin) / self.counts_per_position
        turns = math.floor((units - self.low) / self.span)
        return self.origin + (self.within(position) + turns * self.span) * self.counts_per_position

    def nearest_count_of(self, position: int, near: float) -> float:
        """The encoder count of a user position that is the nearest to ``near``, even through the wrap; of two
        alike in 607Bh the upper."""
        units = round((near - self.origin) / self.counts_per_position)
        way = (position - units + self._half) % self.span - self._half
        return self.origin + (units + way) * self.counts_per_position

    def next_count_of(self, position: int, near: float, upwards: bool) -> float:
        """The encoder count of a user position on the one way from ``near``, even through the wrap."""
        units = round((near - self.origin) / self.counts_per_position)
        way = (position - units) % self.span if upwards else -((units - position) % self.span)
        return self.origin + (units + way) * self.counts_per_position

    def moved(self, count: float, way: int) -> float:
        """The encoder count so many user units beyond the whole position that is the nearest to ``count``."""
        units = round((count - self.origin) / self.counts_per_position)
        return self.origin + (units + way) * self.counts_per_position

    def turned(self, count: float) -> int:
        """How far the turn of 607Bh in which ``count`` is lies from the first; 0 without it."""
        if not self.ranged:
            return 0
        return (
            math.floor(((count - self.origin) / self.counts_per_position - self.low) / self.span) * self.span
        )

    # ---- objects --------------------------------------------------------------------------------------

    def _add_factors(self, counts: int) -> None:
        for index, name, per in (
            (Object.POSITION_ENCODER_RESOLUTION, "Position encoder resolution", ""),
            (Object.VELOCITY_ENCODER_RESOLUTION, "Velocity encoder resolution", " per second"),
        ):
            resolution = self._dictionary.add_array(index, name)
            resolution.add(1, f"Encoder increments{per}", _U32, Access.READ_ONLY, default=counts)
            resolution.add(2, f"Motor revolutions{per}", _U32, Access.READ_ONLY, default=1)
        common = math.gcd(_MILLI_RPM_PER_REV_S, counts)
        per_rev_s = (_MILLI_RPM_PER_REV_S // common, counts // common)
        position, velocity = Object.SI_UNIT_POSITION, Object.SI_UNIT_VELOCITY
        for index, parts, values, word in (
            (Object.GEAR_RATIO, ("Motor revolutions", "Shaft revolutions"), (1, 1), position),
            (Object.FEED_CONSTANT, ("Feed", "Shaft revolutions"), (counts, 1), position),
            (Object.VELOCITY_FACTOR, ("Numerator", "Divisor"), per_rev_s, velocity),
        ):
            factor, written = self._dictionary.add_array(index, index.title), self._on_written_factor(word)
            for sub, part, value in zip((1, 2), parts, values, strict=True):
                factor.add(sub, part, _U32, default=value, low=1, check=self.check_state, on_write=written)

    def _add_unit_words(self) -> None:
        rpm = Unit.REVOLUTION_PER_MINUTE
        for index, word, known in (
            (Object.SI_UNIT_POSITION, unit_word(0, Unit.INCREMENT), _is_position),
            (Object.SI_UNIT_VELOCITY, unit_word(-3, Unit.REVOLUTION, Unit.MINUTE), _is_velocity),
            (Object.SI_UNIT_ACCELERATION, unit_word(0, rpm, Unit.SECOND), _is_acceleration),
            (Object.SI_UNIT_JERK, unit_word(0, rpm, Unit.SQUARE_SECOND), _is_jerk),
        ):
            check = self._word_check(known)
            self._dictionary.add(
                index, index.title, _U32, default=word, check=check, on_write=self._on_factor
            )

    def _add_range(self) -> None:
        limits = self._dictionary.add_array(Object.POSITION_RANGE_LIMIT, Object.POSITION_RANGE_LIMIT.title)
        self.range_min, self.range_max = (
            limits.add(sub, name, DataType.INTEGER32, mappable=True, on_write=self._on_factor)
            for sub, name in ((1, "Minimum"), (2, "Maximum"))
        )

    def _word_check(self, known: Callable[[int], bool]) -> Callable[[int], AbortCode | None]:
        def check(word: int) -> AbortCode | None:
            return self.check_state(word) if known(word) else AbortCode.INVALID_VALUE

        return check

    def check_state(self, _value: int) -> AbortCode | None:
        """Refuses every value while the drive is enabled."""
        return None if self._may_change() else AbortCode.DEVICE_STATE

    def _check_polarity(self, value: int) -> AbortCode | None:
        if value & ~(POSITION_POLARITY | VELOCITY_POLARITY):
            return AbortCode.INVALID_VALUE
        return self.check_state(value)

    def _on_written_factor(self, word: int) -> Callable[[int], None]:
        def on_write(value: int) -> None:
            variable = self._dictionary.variable(word)
            if word == Object.SI_UNIT_VELOCITY or unit_parts(variable.value)[1] in _TURNS:
                variable.value = 0
            self._on_factor(value)

        return on_write

    def _on_factor(self, _value: int) -> None:
        self.take()
        self.changed()

    def _scaling(self) -> Scaling:
        """From what is on the bus, as a master reads it; where a vendor's dictionary tells nothing of the
        position unit, encoder counts."""
        try:
            return self._scaling_with(ScaleOverride(rated_torque_nm=1.0))
        except PeerFault:
            count_rad = 1.0 / self._counts_per_rad
            return self._scaling_with(ScaleOverride(position_rad=count_rad, rated_torque_nm=1.0))

    def _scaling_with(self, override: ScaleOverride) -> Scaling:
        values = {key: self._told(*key) for key in FACTOR_OBJECTS}
        known = apply_quirks(self._makers, values, override, self._told)
        return scaling_from(known.values, known.override)

    def _told(self, index: int, sub: int) -> int | None:
        variable: Variable | None = self._dictionary.get(index, sub)
        return None if variable is None else int(variable.value)


def wrapped(value: int) -> int:
    """Wrap to INTEGER32."""
    return (value + _HALF) % _WRAP - _HALF


def _is_position(word: int) -> bool:
    exponent, numerator, denominator = unit_parts(word)
    known = numerator in _TURNS or (numerator == Unit.INCREMENT and exponent == 0)
    return _is_plain(word) and denominator == 0 and known


def _is_velocity(word: int) -> bool:
    return _is_plain(word) and _is_rate(word, per_rpm=0, per_length=_PER)


def _is_acceleration(word: int) -> bool:
    """Lengths per second are read as lengths per second squared: drives write both."""
    return _is_plain(word) and _is_rate(word, Unit.SECOND, (Unit.SECOND, Unit.SQUARE_SECOND))


def _is_jerk(word: int) -> bool:
    return _is_plain(word) and _is_rate(word, Unit.SQUARE_SECOND, (Unit.CUBIC_SECOND,))


def _is_plain(word: int) -> bool:
    return not word & 0xFF and unit_parts(word)[0] in _EXPONENTS


def _is_rate(word: int, per_rpm: int, per_length: tuple[Unit, ...]) -> bool:
    """rev/min, or a length, by what they have to stand over."""
    _, numerator, denominator = unit_parts(word)
    if numerator == Unit.REVOLUTION_PER_MINUTE:
        return denominator == per_rpm
    return denominator in per_length and numerator in _LENGTHS
