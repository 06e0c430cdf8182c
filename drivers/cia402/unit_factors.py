"""Explains a wrong unit by its factor: the usual mistakes of drives and their set-up."""

import math
from itertools import product
from typing import Final, NamedTuple

from servobench.drivers.rotation import RAD_S_PER_RPM

_TOLERANCE: Final = 0.005
"""Relative. Wider, and half of all factors would be some product of slips and powers of ten."""
_TURN: Final = 360.0
"""The largest slip tried together with a power of ten."""


class Slip(NamedTuple):
    """One way to get a unit wrong, by ``factor`` or by its inverse."""

    factor: float
    text: str


MOTION_SLIPS: Final = (
    Slip(60.0, "a minute taken for a second, or the other way round"),
    Slip(3600.0, "an hour taken for a second, or the other way round"),
    Slip(math.tau, "turns taken for radians, or the other way round"),
    Slip(RAD_S_PER_RPM, "rev/min taken for rad/s, or the other way round"),
    Slip(_TURN, "turns taken for degrees, or the other way round"),
    Slip(6.0, "rev/min taken for degrees per second, or the other way round"),
    Slip(math.pi / 180.0, "degrees taken for radians, or the other way round"),
    Slip(2.0, "edges counted twice, or pole pairs taken for poles"),
    Slip(4.0, "encoder lines taken for counts (four edges a line), or the other way round"),
    Slip(65536.0, "a fixed point number 16.16 taken for a whole one, or the other way round"),
)
TORQUE_SLIPS: Final = (
    Slip(math.sqrt(2.0), "effective current taken for peak current, or the other way round"),
    Slip(1.5, "power-invariant and amplitude-invariant transforms mixed up"),
    Slip(math.sqrt(1.5), "power-invariant and amplitude-invariant transforms mixed up"),
    Slip(2.0, "a factor of two"),
)
WINDING_SLIPS: Final = (
    Slip(2.0, "between two lines taken for a phase, or poles for pole pairs, or the other way round"),
    Slip(math.sqrt(2.0), "effective current taken for peak current, or the other way round"),
    Slip(3.0, "a delta's phase taken for that of its star, or the other way round"),
)


def likely_slip(
    factor: float,
    slips: tuple[Slip, ...] = MOTION_SLIPS,
    gear_ratio: float = 1.0,
    tolerance: float = _TOLERANCE,
) -> str:
    """Explain ``factor`` (> 0), by which a unit is wrong; empty if nothing usual fits.

    One slip is preferred to a power of ten, that to two slips. ``gear_ratio``: 6091h.
    """
    plain = list(slips)
    if gear_ratio != 1.0:
        plain.append(Slip(gear_ratio, "the gear 6091h counted twice, or not at all"))
    single = [made for slip in plain for made in (slip, slip._replace(factor=1.0 / slip.factor))]
    powers = [Slip(10.0**n, f"a power of ten, {10.0**n:g}") for n in range(-9, 10) if n]
    mixed = [
        Slip(one.factor * two.factor, f"{one.text}, and {two.text}")
        for one, two in product(single, powers)
        if max(one.factor, 1.0 / one.factor) <= _TURN
    ]
    geared = [
        Slip(one.factor * two.factor, f"{one.text}, and {two.text}")
        for one, two in product(single, single)
        if "6091h" in two.text and "6091h" not in one.text
    ]
    for slip in (*single, *powers, *geared, *mixed):
        if abs(factor / slip.factor - 1.0) <= tolerance:
            return slip.text
    return ""
