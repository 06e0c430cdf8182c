"""Object indices of the communication profile, CiA 301 clause 7.5.2, and the blocks of the dictionary."""

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
