"""CiA 301 data types: their numbers, sizes and encodings (clause 7.1, table 44)."""

import struct
from enum import IntEnum
from typing import Any

from virtual_bus.device.sdo_abort import AbortCode, SdoAbort


class DataType(IntEnum):
    """Static data types by their index in the object dictionary."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    UNICODE_STRING = 0x0B
    TIME_OF_DAY = 0x0C
    TIME_DIFFERENCE = 0x0D
    DOMAIN = 0x0F
    INTEGER24 = 0x10
    REAL64 = 0x11
    INTEGER40 = 0x12
    INTEGER48 = 0x13
    INTEGER56 = 0x14
    INTEGER64 = 0x15
    UNSIGNED24 = 0x16
    UNSIGNED40 = 0x18
    UNSIGNED48 = 0x19
    UNSIGNED56 = 0x1A
    UNSIGNED64 = 0x1B


BITS = {
    DataType.BOOLEAN: 1,
    DataType.INTEGER8: 8,
    DataType.INTEGER16: 16,
    DataType.INTEGER32: 32,
    DataType.UNSIGNED8: 8,
    DataType.UNSIGNED16: 16,
    DataType.UNSIGNED32: 32,
    DataType.REAL32: 32,
    DataType.TIME_OF_DAY: 48,
    DataType.TIME_DIFFERENCE: 48,
    DataType.INTEGER24: 24,
    DataType.REAL64: 64,
    DataType.INTEGER40: 40,
    DataType.INTEGER48: 48,
    DataType.INTEGER56: 56,
    DataType.INTEGER64: 64,
    DataType.UNSIGNED24: 24,
    DataType.UNSIGNED40: 40,
    DataType.UNSIGNED48: 48,
    DataType.UNSIGNED56: 56,
    DataType.UNSIGNED64: 64,
}
"""Length in a PDO, bits; types without a fixed length are absent and cannot be mapped."""

STRUCT_CODES = {
    DataType.INTEGER8: "b",
    DataType.INTEGER16: "h",
    DataType.INTEGER32: "i",
    DataType.UNSIGNED8: "B",
    DataType.UNSIGNED16: "H",
    DataType.UNSIGNED32: "I",
    DataType.REAL32: "f",
    DataType.REAL64: "d",
    DataType.INTEGER64: "q",
    DataType.UNSIGNED64: "Q",
}
"""Types that :mod:`struct` knows; the others go through integers of their bit length."""

REALS = frozenset({DataType.REAL32, DataType.REAL64})

SIGNED = frozenset(
    {
        DataType.INTEGER8,
        DataType.INTEGER16,
        DataType.INTEGER24,
        DataType.INTEGER32,
        DataType.INTEGER40,
        DataType.INTEGER48,
        DataType.INTEGER56,
        DataType.INTEGER64,
    }
)


def byte_length(data_type: DataType) -> int | None:
    """Length over SDO, bytes; None for strings and domains."""
    bits = BITS.get(data_type)
    return None if bits is None else (bits + 7) // 8


def encode(data_type: DataType, value: Any) -> bytes:
    """``value`` (int, float, or bytes for strings and domains) as sent on the wire, little-endian."""
    if data_type in REALS:
        return struct.pack("<" + STRUCT_CODES[data_type], value)
    length = byte_length(data_type)
    if length is None:
        return bytes(value)
    return int(value).to_bytes(length, "little", signed=data_type in SIGNED)


def decode(data_type: DataType, data: bytes) -> Any:
    """Inverse of :func:`encode`. Error: SdoAbort 06070012h, 06070013h for a wrong length, 06090030h/31h
    for a boolean beyond 1."""
    length = byte_length(data_type)
    if length is None:
        return data
    if len(data) != length:
        raise SdoAbort(AbortCode.TOO_LONG if len(data) > length else AbortCode.TOO_SHORT)
    if data_type in REALS:
        return struct.unpack("<" + STRUCT_CODES[data_type], data)[0]
    value = int.from_bytes(data, "little", signed=data_type in SIGNED)
    if data_type is DataType.BOOLEAN and value > 1:
        raise SdoAbort(AbortCode.TOO_HIGH)
    return value
