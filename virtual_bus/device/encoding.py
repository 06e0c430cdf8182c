"""Values of the CiA 301 data types as they are sent (clause 7.1)."""

import struct
from typing import Any

from servobench.drivers.canopen.data_types import BITS, REAL_BITS, SIGNED_BITS, STRUCT_CODES, DataType
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort


def byte_length(data_type: DataType) -> int | None:
    """Length over SDO, bytes; None for strings and domains."""
    bits = BITS.get(data_type)
    return None if bits is None else (bits + 7) // 8


def encode(data_type: DataType, value: Any) -> bytes:
    """``value`` (int, float, or bytes for strings and domains) as sent on the wire, little-endian."""
    if data_type in REAL_BITS:
        return struct.pack("<" + STRUCT_CODES[data_type], value)
    length = byte_length(data_type)
    if length is None:
        return bytes(value)
    return int(value).to_bytes(length, "little", signed=data_type in SIGNED_BITS)


def decode(data_type: DataType, data: bytes) -> Any:
    """Inverse of :func:`encode`. Error: SdoAbort 06070012h, 06070013h for a wrong length, 06090030h/31h
    for a boolean beyond 1."""
    length = byte_length(data_type)
    if length is None:
        return data
    if len(data) != length:
        raise SdoAbort(AbortCode.TOO_LONG if len(data) > length else AbortCode.TOO_SHORT)
    if data_type in REAL_BITS:
        return struct.unpack("<" + STRUCT_CODES[data_type], data)[0]
    value = int.from_bytes(data, "little", signed=data_type in SIGNED_BITS)
    if data_type is DataType.BOOLEAN and value > 1:
        raise SdoAbort(AbortCode.TOO_HIGH)
    return value
