"""Object indices of the communication profile, CiA 301 clause 7.5.2, and the blocks of the dictionary.

CiA 301 data types: their numbers and lengths (clause 7.1, table 44).
"""

from enum import IntEnum
from typing import Final

FIRST_OBJECT: Final = 0x1000
"""Lower indices are data types; a PDO maps them as gaps."""
MANUFACTURER: Final = range(0x2000, 0x6000)
SDO_SERVER: Final = 0x1200

# Of the first PDO each; the others follow.
RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00
PDO_PARAMETERS: Final = range(RPDO_COMMUNICATION, TPDO_MAPPING + 0x200)
MAPPING_OFFSET: Final = 0x200
"""Offset from a PDO's communication parameter to its mapping."""
PDOS_MAX: Final = 512
"""PDOs in either direction (CiA 301, 7.5.2.35 and 7.5.2.37)."""
PDO_ENTRIES_MAX: Final = 64
"""Objects that one PDO can carry, of a bit each (CiA 301, 7.5.2.36)."""


class Cia301(IntEnum):
    """Index of an object of the communication profile."""

    title: str
    """Its name in words: ``Device type``."""

    def __new__(cls, index: int, title: str) -> "Cia301":
        entry = int.__new__(cls, index)
        entry._value_, entry.title = index, title
        return entry

    DEVICE_TYPE = 0x1000, "Device type"
    ERROR_REGISTER = 0x1001, "Error register"
    STATUS_REGISTER = 0x1002, "Manufacturer status register"
    ERROR_HISTORY = 0x1003, "Pre-defined error field"
    SYNC_COB_ID = 0x1005, "COB-ID SYNC message"
    CYCLE_PERIOD = 0x1006, "Communication cycle period"
    SYNC_WINDOW = 0x1007, "Synchronous window length"
    DEVICE_NAME = 0x1008, "Manufacturer device name"
    HARDWARE_VERSION = 0x1009, "Manufacturer hardware version"
    SOFTWARE_VERSION = 0x100A, "Manufacturer software version"
    GUARD_TIME = 0x100C, "Guard time"
    LIFE_TIME_FACTOR = 0x100D, "Life time factor"
    STORE_PARAMETERS = 0x1010, "Store parameters"
    RESTORE_DEFAULTS = 0x1011, "Restore default parameters"
    TIME_COB_ID = 0x1012, "COB-ID time stamp object"
    HIGH_RESOLUTION_TIME_STAMP = 0x1013, "High resolution time stamp"
    EMCY_COB_ID = 0x1014, "COB-ID EMCY"
    EMCY_INHIBIT_TIME = 0x1015, "Inhibit time EMCY"
    CONSUMER_HEARTBEAT_TIME = 0x1016, "Consumer heartbeat time"
    PRODUCER_HEARTBEAT_TIME = 0x1017, "Producer heartbeat time"
    IDENTITY = 0x1018, "Identity object"
    SYNC_COUNTER_OVERFLOW = 0x1019, "Synchronous counter overflow value"
    STORE_EDS = 0x1021, "Store EDS"
    STORE_FORMAT = 0x1022, "Store format"
    ERROR_BEHAVIOUR = 0x1029, "Error behaviour"


MANDATORY: Final = (Cia301.DEVICE_TYPE, Cia301.ERROR_REGISTER, Cia301.IDENTITY)


def mapping_word(index: int, sub: int, bits: int) -> int:
    """Return one entry of a PDO mapping parameter (CiA 301 7.5.2.36)."""
    return index << 16 | sub << 8 | bits


def is_mapping(index: int) -> bool:
    """Return True for a PDO mapping parameter."""
    return index in PDO_PARAMETERS and bool(index & MAPPING_OFFSET)


def is_communication(index: int) -> bool:
    """Return True for a PDO communication parameter."""
    return index in PDO_PARAMETERS and not index & MAPPING_OFFSET


def object_name(index: int, sub: int) -> str:
    """``6040h:00``."""
    return f"{index:04X}h:{sub:02X}"


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
