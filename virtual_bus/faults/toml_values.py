"""Values out of the tables of a fault plan: each is checked, and blamed by its key."""

from collections.abc import Mapping
from typing import Any

from drivers.errors import MISSING
from drivers.timebase import NS_PER_S, Duration
from virtual_bus.faults.plan_checks import require

Table = Mapping[str, Any]
NS_PER_UNIT = {"us": 1_000, "ms": 1_000_000, "s": NS_PER_S}
_TIME_MAX_S = 1e8
NUMBER_MAX = 1e12
"""Above every time in every unit: ten days in us. What is larger has no product in float."""
INTEGER_MAX = 2**31 - 1
"""Frames: at the 20 000 per second of a full bus, a day."""


def number(table: Table, key: str, default: float | None = None) -> float:
    """A number that times and probabilities can be made of."""
    value = table.get(key, MISSING if default is None else default)
    require(is_number(value), key, value, f"a number, at most {NUMBER_MAX:g}")
    return float(value)


def is_number(value: Any) -> bool:
    """Neither a boolean nor nan, nor beyond ``NUMBER_MAX``."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= NUMBER_MAX


def is_integer(value: Any) -> bool:
    """TOML's booleans are no numbers."""
    return isinstance(value, int) and not isinstance(value, bool)


def integer(table: Table, key: str) -> int:
    """A whole number."""
    value = table.get(key, MISSING)
    usable = is_integer(value) and abs(value) <= INTEGER_MAX
    require(usable, key, value, f"a whole number, at most {INTEGER_MAX}")
    return int(value)


def time_s(table: Table, key: str, default: float | None = None) -> float:
    """A time in seconds, not negative."""
    value = number(table, key, default)
    require(0.0 <= value <= _TIME_MAX_S, key, value, "a time in seconds, >= 0")
    return value


def nanoseconds(seconds: float) -> Duration:
    """To the nearest."""
    return Duration(round(seconds * NS_PER_S))


def time_ns(table: Table, key: str, default: float | None = None) -> Duration:
    """A time in the unit that ends ``key``, in ns."""
    unit = key.rpartition("_")[2]
    return Duration(round(number(table, key, default) * NS_PER_UNIT[unit]))


def fixed_or_range(table: Table, stem: str, unit: str, what: str) -> tuple[Duration, Duration]:
    """``STEM_UNIT``, or ``STEM_min_UNIT`` and ``STEM_max_UNIT``: least and most, ns; ``what`` it is."""
    fixed, least, most = range_keys(stem, unit)
    given = [key for key in (fixed, least, most) if key in table]
    require(bool(given), fixed, MISSING, f"a {what}, or {least} and {most}")
    if fixed in given:
        require(len(given) == 1, given[-1], table[given[-1]], f"nothing beside {fixed}")
        both = time_ns(table, fixed)
        return both, both
    return time_ns(table, least), time_ns(table, most)


def range_keys(stem: str, unit: str) -> tuple[str, str, str]:
    """The three keys of :func:`fixed_or_range`."""
    return f"{stem}_{unit}", f"{stem}_min_{unit}", f"{stem}_max_{unit}"


def nodes(table: Table) -> tuple[int, ...]:
    """``nodes``, none if left out."""
    given = table.get("nodes", [])
    whole = isinstance(given, list) and all(is_integer(node) for node in given)
    require(whole, "nodes", given, "a list of node ids, such as [1, 2]")
    return tuple(given)


def truth(table: Table, key: str) -> bool:
    """``true`` or ``false``; false if left out."""
    value = table.get(key, False)
    require(isinstance(value, bool), key, value, "true or false")
    return bool(value)


def one_of(table: Table, key: str, names: Mapping[str, Any], default: str | None = None) -> Any:
    """What the word under ``key`` stands for."""
    value = table.get(key, MISSING if default is None else default)
    known = isinstance(value, str) and value in names
    require(known, key, value, f"one of {', '.join(names)}")
    return names[value]


def short(value: Any) -> Any:
    """``value``, or a word for what would not fit into a line."""
    if isinstance(value, Mapping):
        return "a table"
    return "a list" if isinstance(value, list) and len(repr(value)) > 60 else value
