"""SDO abort codes (CiA 301, table 22) and the exception that carries one to the client.

Values of the CiA 301 data types as they are sent (clause 7.1).
"""

import struct
from enum import IntEnum
from typing import Any

from servobench.drivers.canopen.objects301 import BITS, REAL_BITS, SIGNED_BITS, STRUCT_CODES, DataType


class AbortCode(IntEnum):
    """Why an SDO transfer was refused."""

    TOGGLE_BIT = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND_UNKNOWN = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    PARAMETER_INCOMPATIBLE = 0x06040043
    INTERNAL_INCOMPATIBLE = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    NO_RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024

    @classmethod
    def _missing_(cls, value: object) -> "AbortCode | None":
        """A code that CiA 301 does not have: some makers' drives send such."""
        if not isinstance(value, int):
            return None
        code = int.__new__(cls, value)
        code._name_, code._value_ = "OF_A_MAKER", value
        return code


class SdoAbort(Exception):
    """An access to the dictionary that the standard forbids; becomes an abort on the bus, never a crash."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"SDO abort {code:#010x} {code.name}")
        self.code = code


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
