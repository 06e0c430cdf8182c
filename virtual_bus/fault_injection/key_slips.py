"""What a key that is not known was probably meant to be."""

import difflib
from collections.abc import Collection
from typing import Any

from drivers.errors import BadInput

_UNITS_S = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0}


def unknown_key(source: str, path: str, key: str, value: Any, known: Collection[str]) -> BadInput:
    """The error about ``key`` at the dotted ``path``; ``known``: the keys that may stand there."""
    if (meant := _other_unit(key, known)) is not None:
        remedy = _converted(key, value, meant)
        return BadInput(source, path, value, f"{meant} (the unit is part of the key)", remedy)
    if "percent" in key and "probability" in known:
        fraction = f" = {value / 100:g}" if _is_number(value) else ""
        return BadInput(source, path, value, "probability, from 0 to 1", f"write probability{fraction}")
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    expected = f"{near[0]}, the nearest known key" if near else "no such key"
    return BadInput(source, path, value, expected, f"known here: {', '.join(known)}")


def _other_unit(key: str, known: Collection[str]) -> str | None:
    """The known key that names the same quantity in another unit, or ``key`` without its unit."""
    stem = _split(key)[0]
    return next((other for other in known if _split(other)[1] and _split(other)[0] == stem), None)


def _split(key: str) -> tuple[str, str]:
    """``delay_min_us`` -> (``delay_min``, ``us``); the unit is empty if there is none."""
    stem, _, unit = key.rpartition("_")
    return (stem, unit) if unit in _UNITS_S else (key, "")


def _converted(key: str, value: Any, meant: str) -> str:
    found, wanted = _split(key)[1], _split(meant)[1]
    if not found or not _is_number(value):
        return f"write {meant} and give the value in that unit"
    return f"write {meant} = {value * _UNITS_S[found] / _UNITS_S[wanted]:.9g}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
