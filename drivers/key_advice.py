"""Guesses what an unknown key was meant to be: the nearest known key, or the same quantity in its right
unit."""

import difflib
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RAD_PER_REVOLUTION, RAD_S_PER_RPM

_UNITS_OF: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "frequency": {"hz": 1.0, "khz": 1e3},
    "angular speed": {"rad/s": 1.0, "rpm": RAD_S_PER_RPM, "deg/s": RAD_PER_REVOLUTION / 360.0},
    "torque": {"nm": 1.0, "mnm": 1e-3},
    "current": {"a": 1.0, "ma": 1e-3},
    "voltage": {"v": 1.0, "kv": 1e3},
    "resistance": {"ohm": 1.0, "mohm": 1e-3},
    "inductance": {"h": 1.0, "mh": 1e-3, "uh": 1e-6},
    "flux": {"wb": 1.0, "mwb": 1e-3},
    "inertia": {"kg/m2": 1.0, "g/m2": 1e-3, "kg/cm2": 1e-4, "g/cm2": 1e-7},
    "ratio": {"ratio": 1.0, "percent": 1e-2, "permille": 1e-3, "ppm": 1e-6},
    "bit rate": {"bit/s": 1.0, "kbit/s": 1e3, "mbit/s": 1e6},
}
UNITS = {unit: (quantity, si) for quantity, units in _UNITS_OF.items() for unit, si in units.items()}
"""Unit as the words of a key, joined by a slash -> its quantity and its value in SI."""

_UNIT_WORDS = frozenset(word for unit in UNITS for word in unit.split("/")) | {"rad", "deg", "s2", "m2"}


def nearest(unknown: str, known: Iterable[str]) -> str | None:
    """Return the known word most similar to ``unknown``; None if none is similar."""
    near = difflib.get_close_matches(unknown, list(known), n=1, cutoff=0.6)
    return near[0] if near else None


def same_quantity(unknown: str, known: Iterable[str]) -> str | None:
    """Return the known key for the same quantity in another unit, or without a unit in ``unknown``."""
    stem, unit = split_unit(unknown)
    for key in known:
        key_stem, key_unit = split_unit(key)
        if stem and stem == key_stem and unit != key_unit:
            return key
    return None


def split_unit(key: str) -> tuple[str, str]:
    """Split ``speed_max_rpm`` into (``speed_max``, ``rpm``); the unit is empty if the key has none."""
    words = key.lower().split("_")
    stem = "_".join(word for word in words if word not in _UNIT_WORDS)
    return stem, "/".join(word for word in words if word in _UNIT_WORDS)


def converted(value: Any, found_key: str, expected_key: str) -> str | None:
    """Convert ``value`` from the unit of ``found_key`` to that of ``expected_key``, as it would be typed;
    None if it cannot be converted."""
    given, wanted = (UNITS.get(split_unit(key)[1]) for key in (found_key, expected_key))
    if given is None or wanted is None or given[0] != wanted[0]:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return f"{value * given[1] / wanted[1]:.9g}"


def _period_of(value: Any, found_key: str, expected_key: str) -> str | None:
    """Convert the frequency ``value`` to the period of ``expected_key``, likewise."""
    given, wanted = (UNITS.get(split_unit(key)[1], ("", 0.0)) for key in (found_key, expected_key))
    if (given[0], wanted[0]) != ("frequency", "time") or isinstance(value, bool):
        return None
    if not isinstance(value, int | float) or not value > 0.0:
        return None
    return f"{1.0 / (value * given[1] * wanted[1]):.9g}"


class UnknownKey(BadInput):
    """A key that the file must not hold."""

    meant: str | None = None
    """The known key that was probably meant."""


TABLES_MAX, TABLES_NAMED = 3, 2
"""A key that stands in more tables says nothing of the one that was meant; the outermost are named."""


def unknown_key(
    source: str, path: str, value: Any, known: Collection[str], elsewhere: Sequence[str] = ()
) -> UnknownKey:
    """Return the error for the key at the dotted ``path``; ``known``: the plain names allowed there.

    ``elsewhere``: the headings of the tables that have it, the outermost first.
    """
    name = path.rpartition(".")[2]
    if other := same_quantity(name, known):
        number = converted(value, name, other)
        expected, remedy = f"{other} (the unit is part of the key)", f"write {other}"
        remedy += f" = {number}" if number is not None else " and give the value in that unit"
    elif "percent" in name and "probability" in known:
        other, number = "probability", converted(value, "percent", "ratio")
        expected, remedy = "probability, from 0 to 1", "write probability"
        remedy += f" = {number}" if number is not None else ""
    elif (other := next((key for key in known if split_unit(key)[0] == "period"), None)) and (
        period := _period_of(value, name, other)
    ):
        expected, remedy = f"{other}, a period", f"write {other} = {period}"
    elif 0 < len(elsewhere) <= TABLES_MAX:
        other = None
        place = " or ".join(f"[{each}]" if each else "no table" for each in elsewhere[:TABLES_NAMED])
        expected, remedy = "no such key here", f"it stands in {place}"
    elif other := nearest(name, known):
        expected, remedy = f"{other}, the nearest known key", f"known here: {', '.join(known)}"
    else:
        expected, remedy = "no such key", f"known here: {', '.join(known)}"
    error = UnknownKey(source, path, value, expected, remedy)
    error.meant = other
    return error
