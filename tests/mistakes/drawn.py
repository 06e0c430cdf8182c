"""Mistakes at a nameplate, drawn: each makes another plate of a drive's own."""

import copy
import math
import random
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from servobench.drivers.cia402.objects402 import Object
from servobench.virtual_bus.drive.unknown_drive import unknown_drive

Plate = dict[str, dict[str, Any]]
Key = tuple[str, str]

KE: Final = ("motor", "ke_line_vrms_krpm")
TORQUE, CURRENT, SPEED = (("rating", name) for name in ("torque_nm", "current_a", "speed_rpm"))
BUS, RESISTANCE, PAIRS = ("rating", "dc_bus_voltage_v"), ("motor", "resistance_ohm"), ("motor", "pole_pairs")
INDUCTANCES: Final = (("motor", "inductance_d_h"), ("motor", "inductance_q_h"))
ROTOR: Final = ("motor", "inertia_kg_m2")
FACTORS: Final = (2.0, math.sqrt(2.0), math.sqrt(3.0), 10.0, 1000.0)
ROTOR_SHARE: Final = (0.2, 1.0)
"""Of the inertia with its load: a rotor that drives five of its own, and one that is alone."""
LACKS: Final = ((), (), (), (), ("6078",), ("6079",), ("6075", "6078"))
"""What drives do without: they tell the less of the plate."""


class Mistake(NamedTuple):
    """One of them."""

    text: str
    plate: Plate


def own_plate(seed: int) -> Plate:
    """What is printed on the motor of a seed: every other plate has no constant of the flux."""
    _, truth = unknown_drive(seed)
    plate: Plate = copy.deepcopy(truth.nameplate)
    draw = random.Random(f"plate {seed}")
    if draw.random() < 0.5:
        del plate["motor"][KE[1]]
    if draw.random() < 0.5:
        plate["motor"]["inertia_kg_m2"] = truth.motor.inertia_kg_m2 * draw.uniform(*ROTOR_SHARE)
    return plate


def lacks_of(seed: int) -> tuple[str, ...]:
    """Objects that the drive of a seed has not."""
    return random.Random(f"lacks {seed}").choice(LACKS)


def drawn_mistake(seed: int, draw: random.Random) -> Mistake:
    """Another plate than the drive's own; kinds that change nothing are drawn anew."""
    own = own_plate(seed)
    while True:
        text, plate = draw.choices(_KINDS, _WEIGHTS)[0](seed, copy.deepcopy(own), draw)
        if _differs(plate, own):
            return Mistake(text, plate)


def _differs(plate: Plate, own: Plate) -> bool:
    """By more than what two people read off one plate."""
    for table, values in own.items():
        for name, value in values.items():
            other = plate[table][name]
            if isinstance(value, str):
                continue
            if abs(other / value - 1.0) > 0.05:
                return True
    return False


def _times(plate: Plate, factor: float, *keys: Key) -> Plate:
    for table, name in keys:
        if name in plate[table]:
            value = plate[table][name] * factor
            plate[table][name] = max(1, round(value)) if name == PAIRS[1] else value
    return plate


def _factor(_seed: int, plate: Plate, draw: random.Random) -> tuple[str, Plate]:
    """A figure off by one of the usual factors, up or down."""
    keys = [key for key in (TORQUE, CURRENT, SPEED, BUS, RESISTANCE, KE, ROTOR) if key[1] in plate[key[0]]]
    key = draw.choice(keys)
    factor = draw.choice(FACTORS) ** draw.choice((1, -1))
    return f"{key[1]} x {factor:.4g}", _times(plate, factor, key)


def _unit(_seed: int, plate: Plate, draw: random.Random) -> tuple[str, Plate]:
    """A figure in another unit."""
    units: Mapping[str, tuple[float, tuple[Key, ...]]] = {
        "N mm for N m": (1e3, (TORQUE,)),
        "N cm for N m": (1e2, (TORQUE,)),
        "N m for N mm": (1e-3, (TORQUE,)),
        "lb in for N m": (8.8507, (TORQUE,)),
        "mA for A": (1e3, (CURRENT,)),
        "A for mA": (1e-3, (CURRENT,)),
        "rad/s for r/min": (math.pi / 30.0, (SPEED,)),
        "r/min for rad/s": (30.0 / math.pi, (SPEED,)),
        "r/s for r/min": (1.0 / 60.0, (SPEED,)),
        "mH for H": (1e3, INDUCTANCES),
        "H for mH": (1e-3, INDUCTANCES),
        "mohm for ohm": (1e3, (RESISTANCE,)),
        "V/(rad/s) for V/krpm": (30.0 / math.pi / 1000.0, (KE,)),
        "kg cm^2 for kg m^2": (1e4, (ROTOR,)),
        "kg m^2 for kg cm^2": (1e-4, (ROTOR,)),
    }
    text = draw.choice(sorted(units))
    factor, keys = units[text]
    return text, _times(plate, factor, *keys)


def _convention(_seed: int, plate: Plate, draw: random.Random) -> tuple[str, Plate]:
    """Line and phase, peak and rms, AC and DC, poles and pairs."""
    root = math.sqrt(2.0)
    conventions: Mapping[str, tuple[float, tuple[Key, ...]]] = {
        "current peak for rms": (root, (CURRENT,)),
        "current rms for peak": (1.0 / root, (CURRENT,)),
        "current of a delta's phase": (1.0 / math.sqrt(3.0), (CURRENT,)),
        "resistance between lines": (2.0, (RESISTANCE,)),
        "resistance of a delta's phase": (3.0, (RESISTANCE,)),
        "inductance between lines": (2.0, INDUCTANCES),
        "voltage constant of a phase": (1.0 / math.sqrt(3.0), (KE,)),
        "voltage constant peak": (root, (KE,)),
        "AC for DC": (1.0 / root, (BUS,)),
        "poles for pairs": (2.0, (PAIRS,)),
        "pairs halved": (0.5, (PAIRS,)),
    }
    text = draw.choice(sorted(conventions))
    factor, keys = conventions[text]
    return text, _times(plate, factor, *keys)


def _of_drive(seed: int, plate: Plate, _draw: random.Random) -> tuple[str, Plate]:
    """The plate mended by what the drive tells."""
    servo, _ = unknown_drive(seed)
    plate["rating"]["torque_nm"] = int(servo.dictionary.variable(Object.MOTOR_RATED_TORQUE).read()) / 1e3
    return "torque as the drive tells it", plate


def _of_another(seed: int, plate: Plate, draw: random.Random) -> tuple[str, Plate]:
    """The plate of another motor, or one line of it."""
    other = own_plate(seed + draw.randint(1, 1000))
    if draw.random() < 0.5:
        whole = {
            table: {**plate[table], **{k: v for k, v in other[table].items() if k in plate[table]}}
            for table in plate
        }
        return "another motor's plate", whole
    key = draw.choice([TORQUE, CURRENT, SPEED, BUS, RESISTANCE])
    plate[key[0]][key[1]] = other[key[0]][key[1]]
    return f"{key[1]} of another motor", plate


def _swapped(_seed: int, plate: Plate, draw: random.Random) -> tuple[str, Plate]:
    """Two figures in each other's place."""
    keys = [TORQUE, CURRENT, SPEED, BUS, RESISTANCE, *INDUCTANCES[1:]]
    one, two = draw.sample(keys, 2)
    first, second = plate[one[0]][one[1]], plate[two[0]][two[1]]
    plate[one[0]][one[1]], plate[two[0]][two[1]] = float(second), float(first)
    return f"{one[1]} and {two[1]} swapped", plate


_KINDS: Final[tuple[Callable[[int, Plate, random.Random], tuple[str, Plate]], ...]] = (
    _factor, _unit, _convention, _of_drive, _of_another, _swapped,
)  # fmt: skip
_WEIGHTS: Final = (40, 20, 20, 5, 10, 5)
