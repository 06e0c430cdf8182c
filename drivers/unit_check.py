"""Units proved by motion: what a drive's objects say of its units against what its values do.

    velocity   606Ch integrated, against the way of 6064h
    position   6064h, against turns that were measured otherwise
    torque     6077h times 6076h, against current 6078h times 6075h and the torque constant
    direction  torque against the acceleration that it makes

A factor that is not 1 is looked up among those that units go wrong by (60, 2 pi, 360, 2, 4, powers of ten,
the gear, the encoder, a sign, and products of them), and the object is named that it rests on.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.scaling import Scaling

Samples = NDArray[np.float64]

TOLERANCE = 0.03
"""Relative; what filters and delays in a drive change in a slow motion."""
_LIKENESS = 0.9
"""Below this correlation two signals are no two views of one quantity."""
_SAMPLES_MIN = 20
_TURNS_MIN = 0.05
"""Motion of less than so much of a turn is no evidence."""


@dataclass(frozen=True, slots=True)
class MotionSamples:
    """A motion as the drive told it, raw. All arrays (n,), at the same instants."""

    time_s: Samples
    position: Samples
    """6064h, unwrapped."""
    velocity: Samples
    """606Ch."""
    torque: Samples
    """6077h, or the set-point 6071h of a drive that does not tell it."""
    current: Samples | None = None
    """6078h."""


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of motor and drive beside its objects; None for what is not."""

    turns: float | None = None
    """Turns of the motor shaft between the first sample and the last, signed, measured otherwise."""
    rated_current_a: float | None = None
    torque_constant_nm_a: float | None = None
    gear_ratio: float | None = None
    encoder_increments: float | None = None
    """Per turn of the motor shaft."""


class Finding(NamedTuple):
    """A factor that is wrong."""

    quantity: str
    """velocity, position, torque or direction."""
    factor: float
    """What SI values must be multiplied with to be right; NaN if there is no such factor."""
    objects: tuple[str, ...]
    """Where the fault probably is, the likeliest first."""
    cause: str

    def __str__(self) -> str:
        wrong = (
            "is no multiple of what it should be" if math.isnan(self.factor) else f"times {self.factor:.6g}"
        )
        return f"{self.quantity} {wrong}: {self.cause} ({' or '.join(self.objects)})"


class UnitCheck(NamedTuple):
    """What was compared, and what was found wrong."""

    velocity_ratio: float | None
    """Way by 6064h over way by 606Ch; None if that could not be compared."""
    position_ratio: float | None
    """True way over way by 6064h."""
    torque_ratio: float | None
    """Torque by 6078h over torque by 6077h."""
    direction: int | None
    """1 if positive torque accelerates to positive speeds, else -1."""
    findings: tuple[Finding, ...]


def check_units(samples: MotionSamples, scaling: Scaling, known: Known | None = None) -> UnitCheck:
    """Compare. A motion with accelerations both ways, of some turns, says most.

    Raises ValueError for samples of unequal length, fewer than 20, or not in the order of time.
    """
    _require(samples)
    facts = known or Known()
    findings: list[Finding] = []
    position = _position(samples, scaling, facts, findings)
    velocity = _velocity(samples, scaling, facts, findings, position is not None)
    torque = _torque(samples, scaling, facts, findings)
    direction = _direction(samples, scaling, velocity, findings)
    return UnitCheck(velocity, position, torque, direction, tuple(findings))


def _require(samples: MotionSamples) -> None:
    arrays = [samples.position, samples.velocity, samples.torque]
    arrays += [] if samples.current is None else [samples.current]
    count = samples.time_s.size
    if count < _SAMPLES_MIN or any(values.shape != (count,) for values in arrays):
        raise ValueError(f"at least {_SAMPLES_MIN} samples of equal length are needed")
    if not np.all(np.diff(samples.time_s) > 0.0):
        raise ValueError("the samples are not in the order of time")


# ---- comparisons ------------------------------------------------------------------------------------------


def _velocity(
    samples: MotionSamples, scaling: Scaling, known: Known, findings: list[Finding], position_known: bool
) -> float | None:
    """The ratio of the two ways, and a finding if it is not 1.

    With the position proved, or its fault found, a fault that is left is the velocity's own.
    """
    way = np.diff(samples.position) * scaling.position_rad
    if float(np.abs(way).sum()) < _TURNS_MIN * math.tau and known.turns is None:
        return None
    speed = samples.velocity * scaling.velocity_rad_s
    integral = 0.5 * (speed[1:] + speed[:-1]) * np.diff(samples.time_s)
    # Sums over stretches: the steps of an encoder at low speed are long against a cycle.
    stretch = max(1, way.size // 50)
    ways, integrals = _summed(way, stretch), _summed(integral, stretch)
    ratio = _ratio(ways, integrals)
    sources = scaling.sources
    if ratio is None:
        unlike = "606Ch does not follow the change of 6064h"
        findings.append(Finding("velocity", math.nan, ("606Ch", sources.get("velocity", "60A9h")), unlike))
        return None
    own = ratio * math.prod(found.factor for found in findings if found.quantity == "position")
    if math.isnan(own) or abs(own - 1.0) <= TOLERANCE:
        return ratio
    factor, cause, blamed = plain_factor(own, known)
    told_by = {"velocity": sources.get("velocity", "60A9h")}
    if not position_known:
        told_by["position"] = sources.get("position", "608Fh")
    objects = _objects(blamed, told_by, "velocity")
    findings.append(Finding("velocity", factor, objects, f"velocity against the way of 6064h: {cause}"))
    return ratio


def _position(
    samples: MotionSamples, scaling: Scaling, known: Known, findings: list[Finding]
) -> float | None:
    if known.turns is None:
        return None
    way = float(samples.position[-1] - samples.position[0]) * scaling.position_rad
    if abs(known.turns) < _TURNS_MIN:
        return None
    source = scaling.sources.get("position", "608Fh")
    if way == 0.0:
        still = "6064h stands still while the shaft turns"
        findings.append(Finding("position", math.nan, ("6064h", source), still))
        return None
    ratio = known.turns * math.tau / way
    if abs(ratio - 1.0) <= TOLERANCE:
        return ratio
    factor, cause, blamed = plain_factor(ratio, known)
    objects = _objects(blamed, {"position": source}, "position")
    findings.append(Finding("position", factor, objects, f"6064h against the turns of the shaft: {cause}"))
    return ratio


def _torque(samples: MotionSamples, scaling: Scaling, known: Known, findings: list[Finding]) -> float | None:
    current, rating, constant = samples.current, known.rated_current_a, known.torque_constant_nm_a
    if current is None or rating is None or constant is None:
        return None
    by_current = current * 1e-3 * rating * constant
    by_torque = samples.torque * scaling.torque_nm
    if float(np.abs(by_torque).max()) == 0.0:
        return None
    ratio = _ratio(by_current, by_torque)
    source = scaling.sources.get("torque", "6076h")
    if ratio is None:
        unlike = "6077h does not follow 6078h"
        findings.append(Finding("torque", math.nan, ("6077h", "6078h"), unlike))
        return None
    if abs(ratio - 1.0) <= TOLERANCE:
        return ratio
    factor, cause, _ = plain_factor(ratio, known, _TORQUE_CAUSES)
    objects = (source, "6075h")
    findings.append(
        Finding("torque", factor, objects, f"torque against current times torque constant: {cause}")
    )
    return ratio


def _direction(
    samples: MotionSamples, scaling: Scaling, velocity_ratio: float | None, findings: list[Finding]
) -> int | None:
    """The sign of torque over acceleration, by regression against acceleration and the sign of speed."""
    speed = np.gradient(samples.position * scaling.position_rad, samples.time_s)
    width = max(1, samples.time_s.size // 50)
    speed = np.convolve(speed, np.ones(width) / width, mode="same")
    inner = slice(width, -width)
    acceleration = np.gradient(speed, samples.time_s)[inner]
    torque = (samples.torque * scaling.torque_nm)[inner]
    if acceleration.size < _SAMPLES_MIN or float(np.abs(torque).max(initial=0.0)) == 0.0:
        return None
    friction = np.sign(speed)[inner]
    columns = np.column_stack([acceleration, friction, np.ones_like(acceleration)])
    solution, *_ = np.linalg.lstsq(columns, torque, rcond=None)
    explained = columns @ solution
    if _likeness(explained, torque) < 0.5 or solution[0] == 0.0:
        return None
    sign = 1 if solution[0] > 0.0 else -1
    if sign < 0:
        reversed_too = velocity_ratio is not None and velocity_ratio > 0.0
        also = "position and velocity" if reversed_too else "the position"
        cause = f"positive torque makes {also} fall: a torque loop would push the wrong way"
        findings.append(Finding("direction", -1.0, ("607Eh", "motor phases"), cause))
    return sign


def _summed(values: Samples, width: int) -> Samples:
    count = values.size // width
    sums: Samples = values[: count * width].reshape(count, width).sum(axis=1)
    return sums


def _ratio(numerator: Samples, denominator: Samples) -> float | None:
    """Least squares of ``numerator = ratio * denominator``; None if the two are not alike."""
    if _likeness(numerator, denominator) < _LIKENESS:
        return None
    return float(numerator @ denominator / (denominator @ denominator))


def _likeness(one: Samples, other: Samples) -> float:
    """|cosine| between the two, 0 if one of them is nothing."""
    size = math.sqrt(float(one @ one) * float(other @ other))
    return abs(float(one @ other)) / size if size > 0.0 else 0.0


# ---- factors ----------------------------------------------------------------------------------------------


class _Cause(NamedTuple):
    factor: float
    text: str
    quantity: str
    """Whose unit is probably wrong; empty if it may be either."""


_TURN = 360.0
_CAUSES = (
    _Cause(60.0, "a minute taken for a second, or the other way round", "velocity"),
    _Cause(3600.0, "an hour taken for a second, or the other way round", "velocity"),
    _Cause(math.tau, "turns taken for radians, or the other way round", ""),
    _Cause(math.tau / 60.0, "rev/min taken for rad/s, or the other way round", "velocity"),
    _Cause(_TURN, "turns taken for degrees, or the other way round", ""),
    _Cause(6.0, "rev/min taken for degrees per second, or the other way round", "velocity"),
    _Cause(math.pi / 180.0, "degrees taken for radians, or the other way round", ""),
    _Cause(2.0, "edges counted twice", "position"),
    _Cause(4.0, "encoder lines taken for counts (four edges a line)", "position"),
    _Cause(65536.0, "a fixed point number 16.16 taken for a whole one", "velocity"),
)
_TORQUE_CAUSES = (
    _Cause(math.sqrt(2.0), "effective current taken for peak current, or the other way round", ""),
    _Cause(1.5, "power-invariant and amplitude-invariant transforms mixed up", ""),
    _Cause(math.sqrt(1.5), "power-invariant and amplitude-invariant transforms mixed up", ""),
    _Cause(2.0, "a factor of two", ""),
)
_POWERS = tuple(10.0**exponent for exponent in range(-9, 10) if exponent)


def plain_factor(
    ratio: float, known: Known | None = None, causes: tuple[_Cause, ...] = _CAUSES
) -> tuple[float, str, str]:
    """The plain factor nearest to ``ratio``, its cause, and whose unit is probably wrong.

    A ratio that is none is returned as it is. One cause goes before two, and two before a sign besides.
    """
    facts = known or Known()
    candidates = _candidates(facts, causes)
    size = abs(ratio)
    fitting = [made for made in candidates if abs(size / made.factor - 1.0) <= TOLERANCE]
    sign = math.copysign(1.0, ratio)
    if not fitting:
        return ratio, f"a factor of {ratio:.6g} that is no usual one", ""
    found = fitting[0]
    if sign > 0.0:
        return found.factor, found.text, found.quantity
    if found.factor == 1.0:
        return -1.0, "the sign is turned", "sign"
    return -found.factor, f"{found.text}, and the sign is turned", found.quantity


def _candidates(known: Known, causes: tuple[_Cause, ...]) -> list[_Cause]:
    """In the order in which they are believed."""
    single = [_Cause(1.0, "nothing", "")]
    plain = list(causes)
    if known.gear_ratio and known.gear_ratio != 1.0:
        plain.append(_Cause(abs(known.gear_ratio), "the gear 6091h, counted twice or not at all", "gear"))
    if known.encoder_increments:
        plain.append(_Cause(known.encoder_increments, "increments taken for turns", "position"))
    both = [made for cause in plain for made in (cause, cause._replace(factor=1.0 / cause.factor))]
    powers = [_Cause(power, f"a power of ten, {power:g}", "prefix") for power in _POWERS]
    mixed = [
        _Cause(cause.factor * power.factor, f"{cause.text}, and {power.text}", cause.quantity)
        for cause, power in product(both, powers)
        if max(cause.factor, 1.0 / cause.factor) <= _TURN and 1e-12 < cause.factor * power.factor < 1e12
    ]
    geared = [
        _Cause(one.factor * two.factor, f"{one.text}, and {two.text}", one.quantity)
        for one, two in product(both, both)
        if two.quantity == "gear" and one.quantity != "gear"
    ]
    return [*single, *both, *powers, *geared, *mixed]


def _objects(blamed: str, told_by: Mapping[str, str], quantity: str) -> tuple[str, ...]:
    """The objects to look at: that on which the blamed factor rests goes first."""
    if blamed == "sign":
        return ("607Eh",)
    if blamed == "gear":
        return ("6091h", *told_by.values())
    first = blamed if blamed in told_by else quantity
    rest = [source for name, source in told_by.items() if name != first]
    return (told_by[first], *rest)
