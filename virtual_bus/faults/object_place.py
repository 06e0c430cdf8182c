"""An object of a dictionary as a fault plan names it, and as the upper 24 bits of a mapping word have it."""

import re
from typing import Annotated, Any, Final

from pydantic import Field, PlainValidator

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.key_advice import nearest

_BY_NAME: Final = {entry.name.lower(): int(entry) for entry in Object}
_BY_NUMBER: Final = re.compile(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?")
_EXPECTED: Final = 'an object, such as "606C", "1A00:1" or "velocity_actual_value"'


def place_of(text: str) -> int:
    """Index and sub-index of ``606C``, ``1A00:1`` or the name of a CiA 402 object. Error: ValueError."""
    if text in _BY_NAME:
        return _BY_NAME[text] << 8
    match = _BY_NUMBER.fullmatch(text)
    if match is None or int(match[2] or 0) > 0xFF:
        actual = f"{text}_actual_value"
        near = actual if actual in _BY_NAME else nearest(text, _BY_NAME)
        raise ValueError(f'"{near}", the nearest name' if near else _EXPECTED)
    return int(match[1], 16) << 8 | int(match[2] or 0)


def place_text(place: int) -> str:
    """``606Ch``, or ``1A00h:1``."""
    return f"{place >> 8:04X}h" + (f":{place & 0xFF}" if place & 0xFF else "")


def _named(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(_EXPECTED)  # noqa: TRY004 - pydantic's validators tell by it
    place_of(value)
    return value


ObjectPlace = Annotated[str, PlainValidator(_named), Field(description=_EXPECTED)]
"""A field of a table."""
