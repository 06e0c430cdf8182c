"""An object's value as it came over the bus: its number by the type that it has, or its text."""

import math
import struct
from dataclasses import dataclass
from typing import Any, Final

from servobench.drivers.canopen.objects301 import REAL_BITS, SIGNED_BITS, UNSIGNED_BITS, DataType, object_name
from servobench.drivers.errors import printable
from servobench.drivers.sheets.eds.types import BYTE_TYPES, TEXT_TYPES

Number = int | float
_INTEGER_BYTES: Final = 8
_SHOWN_BYTES: Final = 32
"""A longer value is cut where it is shown; its length is told."""
_REAL_FORMATS: Final = {4: "<f", 8: "<d"}


@dataclass(frozen=True, slots=True)
class ObjectValue:
    """An object with what came of it."""

    index: int
    sub: int
    name: str
    """Name in the data sheet, else in the standard; empty if neither has it."""
    raw: Number | str | None
    """None if no data came."""
    si: float | None = None
    """In ``unit``; None where nobody has told how the drive counts."""
    unit: str = ""
    words: str = ""
    """Meaning of the number, for states, modes and errors."""
    hexadecimal: bool = False
    """It is a word of bits, or an identifier."""

    def __str__(self) -> str:
        name = f"{object_name(self.index, self.sub)}{f' {self.name}' if self.name else ''}"
        return f"{name} = {self.shown}"

    @property
    def shown(self) -> str:
        """The value alone: SI first, then what was sent."""
        raw = self.raw
        text = "no data" if raw is None else f"{raw:X}h" if self._is_word else f"{raw}"
        if self.si is not None:
            text = f"{self.si:.6g} {self.unit} ({text})"
        return f"{text} ({self.words})" if self.words else text

    @property
    def _is_word(self) -> bool:
        return self.hexadecimal and isinstance(self.raw, int) and self.raw >= 0

    def as_json(self) -> dict[str, Any]:
        """Plain values; a REAL that is no number is its name."""
        raw = str(self.raw) if isinstance(self.raw, float) and not math.isfinite(self.raw) else self.raw
        told = {"index": self.index, "sub": self.sub, "name": self.name, "raw": raw}
        if self.si is not None:
            told |= {"si": self.si, "unit": self.unit}
        if self.words:
            told["words"] = self.words
        return told


def value_of(data: bytes, data_type: int | None) -> Number | str | None:
    """``data``, little endian, by its type; by its length and look if that is None or does not fit.

    Devices send more octets than a type has, and fewer: an integer is as long as what both have.
    """
    if not data:
        return "" if data_type in TEXT_TYPES else None
    if data_type in SIGNED_BITS:
        return int.from_bytes(data[: SIGNED_BITS[DataType(data_type)] // 8], "little", signed=True)
    if data_type in UNSIGNED_BITS:
        return int.from_bytes(data[: max(1, UNSIGNED_BITS[DataType(data_type)] // 8)], "little")
    if data_type in REAL_BITS and len(data) in _REAL_FORMATS:
        return float(struct.unpack(_REAL_FORMATS[len(data)], data)[0])
    if data_type == DataType.UNICODE_STRING:
        return _cut(data.decode("utf-16-le", "replace").rstrip("\0"), len(data))
    if data_type == DataType.VISIBLE_STRING or (data_type not in BYTE_TYPES and _is_text(data)):
        return _cut(data.decode("latin-1").rstrip("\0"), len(data))
    if len(data) <= _INTEGER_BYTES and data_type not in BYTE_TYPES:
        return int.from_bytes(data, "little")
    shown = data[:_SHOWN_BYTES].hex(" ")
    return shown if len(data) <= _SHOWN_BYTES else f"{shown} ... ({len(data)} bytes)"


def _is_text(data: bytes) -> bool:
    """Longer than an integer, and nothing in it that is no text."""
    if len(data) <= _INTEGER_BYTES:
        return False
    return all(0x20 <= one < 0x7F or one in b"\t\r\n" for one in data.rstrip(b"\0"))


def _cut(text: str, length: int) -> str:
    text = printable(text)
    return text if len(text) <= 4 * _SHOWN_BYTES else f"{text[: 4 * _SHOWN_BYTES]} ... ({length} bytes)"
