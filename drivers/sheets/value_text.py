"""Values of objects as a data sheet or a DCF writes them (CiA 306-1)."""

from collections.abc import Mapping
from contextlib import suppress
from struct import unpack
from typing import Final

from servobench.drivers.canopen.data_types import (
    REAL_BITS,
    SIGNED_BITS,
    STRUCT_CODES,
    TIME_BITS,
    UNSIGNED_BITS,
    DataType,
)

NUMBERS: Final = SIGNED_BITS | UNSIGNED_BITS | TIME_BITS
"""Types that a file writes as whole numbers, and their bits."""
_TEXTS: Final[Mapping[int, str]] = {DataType.VISIBLE_STRING: "ascii", DataType.UNICODE_STRING: "utf_16_le"}


def value_text(value: bytes, data_type: int | None) -> str:
    """Return a value in the form of a file: signed numbers in decimal, others in hexadecimal, text as it is,
    all else as bytes in hexadecimal."""
    if data_type in REAL_BITS and len(value) == REAL_BITS[DataType(data_type)] // 8:
        return repr(unpack(f"<{STRUCT_CODES[data_type]}", value)[0])
    if data_type in NUMBERS and value:
        signed = data_type in SIGNED_BITS
        number = int.from_bytes(value, "little", signed=signed)
        return str(number) if signed else f"0x{number:X}"
    text = _text_of(value, data_type)
    return value.hex().upper() if text is None else text


def is_kept(value: bytes, data_type: int | None) -> bool:
    """Return False for a text that a line of a file would change: it ends at a semicolon, is trimmed, and has
    no escapes."""
    if data_type not in _TEXTS:
        return True
    text = _text_of(value, data_type)
    return (
        text is not None
        and text.isascii()
        and text.isprintable()
        and text == text.strip()
        and ";" not in text
    )


def _text_of(value: bytes, data_type: int | None) -> str | None:
    """Return a text without the zeros that fill it up; None for another type, and for what is no text."""
    coding = _TEXTS.get(data_type or 0)
    with suppress(UnicodeDecodeError):
        return None if coding is None else value.decode(coding).rstrip("\0")
    return None
