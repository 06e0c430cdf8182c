"""CiA 301 data types: their numbers and lengths (clause 7.1, table 44)."""

from enum import IntEnum


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


def _lengths(family: str) -> dict[int, int]:
    """Return the bits of the types named ``family`` plus a number."""
    return {kind: int(kind.name[len(family) :]) for kind in DataType if kind.name.startswith(family)}


SIGNED_BITS = _lengths("INTEGER")
UNSIGNED_BITS = {DataType.BOOLEAN: 1} | _lengths("UNSIGNED")
REAL_BITS = _lengths("REAL")
TIME_BITS: dict[int, int] = {DataType.TIME_OF_DAY: 48, DataType.TIME_DIFFERENCE: 48}

BITS = SIGNED_BITS | UNSIGNED_BITS | REAL_BITS | TIME_BITS
"""Length in a PDO, bits; strings and domains have none and cannot be mapped."""

STRUCT_CODES: dict[int, str] = {
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
"""``struct`` characters of the types that have one."""
